"""Reward networks (RNs) in NumPy, around a Gymnasium environment of their task."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces, utils, wrappers
from gymnasium.envs.toy_text.cliffwalking import CliffWalkingEnv
from numpy.typing import ArrayLike

from sejax import envs
from sejax.gym import networks
from sejax.gym.tasks import Env, Info, RealTask, signature
from sejax.options import Fraction, checked, require, shortened
from sejax.options.plain import configure
from sejax.proxies import MAX_ABS_VALUE
from sejax.proxies.header import Header, check_tensors, configured, is_known, read
from sejax.proxies.reward import RewardConfig

# Wrappers of observations that change no number, and wrappers that change rewards.
SAME_NUMBERS = (wrappers.DtypeObservation, wrappers.FlattenObservation)
OTHER_REWARDS = (gymnasium.RewardWrapper, wrappers.NormalizeReward, wrappers.MaxAndSkipObservation)
GYMNASIUM_NAMES = {"reward_run": "reward_forward"}  # entries of `info` with another name there


class RewardNetwork(gymnasium.Wrapper[Any, Any, Any, Any], utils.RecordConstructorArgs):
    r"""An environment whose reward an RN makes; see `sejax.proxies.reward.RewardEnv`.

    Dynamics, spaces, starts and ends are the environment's own. Let r be the environment's reward
    and :math:`\Phi` the network. Agents get a sum. Its first part is r (additive) or 0 (exclusive).
    Its learned part is :math:`\gamma \Phi(s') - \Phi(s)` (potential), :math:`\Phi(s')`
    (non-potential) or :math:`w^\top i'` (weighted info). `info["real_reward"]` is r.
    `info["discount"]` is 0 if the episode has terminated, else 1. A reward that is not finite, or
    whose learned part is beyond 1e6, becomes 0 and terminates.

    A potential needs the agent's gamma. The default is the gamma of the agent that the RN was
    learned with.

    Args:
      env: an environment of the RN's task with its step limit, as `gymnasium.make` gives it.
        Wrappers that change observations or rewards go around this one: the network knows the
        task's own.
      source: a run directory, a safetensors file of one RN, or the name of one that ships with the
        package.
      discount: gamma of the agent that will train.

    Raises:
      ConfigError: if the environment's spaces or wrappers do not fit the RN's task.

    Example:
      >>> env = RewardNetwork(gymnasium.make("CartPole-v1"), "cartpole-rn", discount=0.98)
      >>> obs, info = env.reset(seed=0)
      >>> obs, reward, terminated, truncated, info = env.step(1)
      >>> info["real_reward"], reward == 1.0
      (1.0, False)
    """

    def __init__(self, env: Env, source: str | Path, discount: float | None = None):
        utils.RecordConstructorArgs.__init__(self, source=str(source), discount=discount)
        super().__init__(env)
        path, weights, header = read(source, kinds=("rn",), single=True)
        self.config: RewardConfig = configure("proxy", header.config["proxy"])
        discount = header.discount if discount is None else discount
        self.discount = checked(discount, Fraction, "discount", header.discount)
        weighs_info = self.config.shaping.weighs_info
        keys: tuple[str, ...] = ()
        if weighs_info or self.config.augmented:  # the task's configuration has the keys
            rule = "must be of a task with a registered name, which says what info the RN reads"
            require(is_known("env", header.config["env"]), "source", rule, got=header.task)
            spec = envs.spec_of(configured("env", header.config["env"], path.name))
            keys = spec.info_keys if weighs_info else spec.augmented_keys
        self._info_keys = [GYMNASIUM_NAMES.get(key, key) for key in keys]
        _require_task(env, header)
        num_inputs = spaces.flatdim(env.observation_space)
        num_keys = len(self._info_keys)
        hidden = [self.config.hidden_size] * self.config.num_layers
        shapes = networks.shapes_of({"potential": [num_inputs + num_keys, *hidden, 1]})
        if weighs_info:
            shapes = {"info_weights": (num_keys,)}
        check_tensors("weights", weights, shapes, "those of the environment's task")
        self._weights = weights.get("info_weights")  # [info_keys]
        self._layers = networks.network_layers(weights, "potential")
        self._table: list[float] | None = None  # [num_states]: potentials of discrete states
        if isinstance(env.observation_space, spaces.Discrete) and self._layers and not keys:
            self._table = self._apply(np.eye(num_inputs)).tolist()
        self._potential = 0.0  # of the agent's state

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Begins an episode of the environment."""
        obs, info = self.env.reset(seed=seed, options=options)
        # The numbers of `info` are 0 before the first step, as in JAX.
        self._potential = self.potential(obs, np.zeros(len(self._info_keys), np.float32))
        return obs, info

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, Info]:
        """One step of the environment, with the RN's reward.

        Raises:
          KeyError: if `info` lacks an entry that the RN weighs or sees.
        """
        obs, real_reward, terminated, truncated, info = self.env.step(action)
        real_reward = float(real_reward)
        info_values = np.array([info[key] for key in self._info_keys], np.float32)
        bonus = self._bonus(obs, info_values, bool(terminated))
        reward = real_reward + bonus if self.config.shaping.is_additive else bonus
        if not (np.isfinite(reward) and abs(bonus) < MAX_ABS_VALUE):
            reward = 0.0
            terminated = True
        info = {**info, "discount": float(not terminated), "real_reward": real_reward}
        return obs, reward, bool(terminated), bool(truncated), info

    def potential(self, obs: np.ndarray, info_values: np.ndarray | tuple[()] = ()) -> float:
        """Phi of an observation and of the numbers of `info` that the network sees."""
        if self._table is not None:
            return self._table[obs]
        if not self._layers:
            return 0.0
        if len(info_values):
            obs = np.concatenate([spaces.flatten(self.env.observation_space, obs), info_values])
        return float(self._apply(obs))

    def _apply(self, inputs: np.ndarray) -> np.ndarray:
        x = np.asarray(inputs, np.float32)
        outputs = networks.forward(self._layers, self.config.activation, x)
        return self.config.output_scale * outputs[..., 0]

    def _bonus(self, obs: np.ndarray, info_values: np.ndarray, terminated: bool) -> float:
        """The learned part of a transition's reward."""
        if self._weights is not None:
            return float(self._weights @ info_values)
        before = self._potential
        self._potential = self.potential(obs, info_values)
        after = 0.0 if terminated and self.config.zero_at_terminal else self._potential
        return self.discount * after - before if self.config.shaping.is_potential_based else after


def _require_task(env: Env, header: Header) -> None:
    """Checks that an environment's spaces and wrappers fit the task of a file."""
    layers = [env]  # the innermost last
    while isinstance(layers[-1], gymnasium.Wrapper):
        layers.append(layers[-1].env)
    learned = RealTask.of_spec(header.spec)
    observers = [layer for layer in layers if isinstance(layer, gymnasium.ObservationWrapper)]
    rule = f"must be sejax's {shortened(header.task, 40)}, its numbers unchanged by wrappers"
    is_same = (
        not isinstance(layers[-1], CliffWalkingEnv)  # Gymnasium's, which has other rules
        and signature(env.observation_space) == signature(learned.observation_space)
        and signature(env.unwrapped.action_space) == signature(learned.action_space)
        and all(isinstance(layer, SAME_NUMBERS) for layer in observers)
        and not any(isinstance(layer, OTHER_REWARDS) for layer in layers)
    )
    require(is_same, "env", rule, got=env)
