"""Proxies by configuration."""

from sejax import envs
from sejax.configs import ProxyConfig, RewardConfig
from sejax.proxies.reward import RewardEnv, RewardParams, make_reward
from sejax.proxies.synthetic import SyntheticEnv, SyntheticParams, make_synthetic

ProxyEnv = SyntheticEnv | RewardEnv
ProxyParams = SyntheticParams | RewardParams


def make_proxy(task: envs.Task, config: ProxyConfig) -> ProxyEnv:
    """The SE or RN for a task, built once for each configuration."""
    if isinstance(config, RewardConfig):
        return make_reward(task, config)
    return make_synthetic(task, config)
