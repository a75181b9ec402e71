"""Proxies by configuration."""

from typing import Any

from sejax import envs
from sejax.configs import LearnConfig, ProxyConfig, RewardConfig
from sejax.proxies.reward import RewardEnv, RewardParams, make_reward
from sejax.proxies.synthetic import SyntheticEnv, SyntheticParams, make_synthetic

ProxyEnv = SyntheticEnv | RewardEnv
ProxyParams = SyntheticParams | RewardParams


def make_proxy(task: envs.Task, config: ProxyConfig) -> ProxyEnv:
    """The SE or RN for a task, built once for each configuration."""
    if isinstance(config, RewardConfig):
        return make_reward(task, config)
    return make_synthetic(task, config)


def params_as_learned(env: ProxyEnv, weights: Any, config: LearnConfig) -> ProxyParams:
    """`EnvParams` of a learned proxy; an RN's discount is that of the agent it was learned with."""
    if isinstance(env, RewardEnv):
        return env.params(weights, config.agent.discount)
    return env.params(weights)
