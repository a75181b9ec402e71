"""Reward networks (RNs) in NumPy, around a Gymnasium environment of their task."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.envs.toy_text.cliffwalking import CliffWalkingEnv
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import DtypeObservation, FlattenObservation
from numpy.typing import ArrayLike

from sejax.envs.spec import Discrete
from sejax.gym import networks
from sejax.gym.gridworld import Info
from sejax.gym.tasks import GYMNASIUM_IDS, RealTask, space_of
from sejax.options import ConfigError, as_python, fraction, registry, require, shortened
from sejax.proxies import MAX_ABS_VALUE
from sejax.proxies.header import check_tensors, read
from sejax.proxies.reward import RewardConfig

SAME_NUMBERS = (DtypeObservation, FlattenObservation)  # wrappers that change no number
GYMNASIUM_NAMES = {"reward_run": "reward_forward"}  # entries of `info` that it calls otherwise


class RewardNetwork(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    r"""An environment whose reward is made by an RN; see `sejax.proxies.reward.RewardEnv`.

    Dynamics, spaces, starts and ends are the environment's own; with r its reward and
    :math:`\Phi` the network, agents get r or 0 (additive or exclusive) plus
    :math:`\gamma \Phi(s') - \Phi(s)`, :math:`\Phi(s')` or :math:`w^\top i'` (potential,
    non-potential or weighted info). `info["real_reward"]` is r, `info["discount"]` 0 where the
    episode has terminated and 1 elsewhere. A reward that is not finite, or whose learned part is
    beyond 1e6, is 0 and terminates.

    A gamma belongs to a potential, and it is the agent's: the default is that of the agent which
    the RN was learned with.

    Args:
      env: of the RN's task, its step limit included (`gymnasium.make` sees to it). Wrappers that
        change observations or rewards go around this one, as the network knows the task's own.
      source: a run directory, a safetensors file of one RN, or the name of one that ships with the
        package.
      discount: gamma of the agent that will train.
      info_keys: what of a step's `info` the RN weighs (`*_weighted_info`) or sees (`augmented`), in
        the order of `sejax.Task`; needed for a task that is not sejax's own.
      limit_is_terminal: whether the agent does not bootstrap at the step limit, for an RN with
        `zero_at_terminal`; agents written for Gymnasium do.

    Raises:
      ConfigError: if the environment is not of the RN's task as far as its spaces tell, or the keys
        are not known.

    Example:
      >>> env = RewardNetwork(gymnasium.make("CartPole-v1"), "cartpole-rn", discount=0.98)
      >>> obs, info = env.reset(seed=0)
      >>> obs, reward, terminated, truncated, info = env.step(1)
      >>> info["real_reward"], reward == 1.0
      (1.0, False)
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        source: str | Path,
        discount: float | None = None,
        info_keys: Sequence[str] | None = None,
        limit_is_terminal: bool = False,
    ):
        RecordConstructorArgs.__init__(
            self,
            source=str(source),
            discount=discount,
            info_keys=info_keys,
            limit_is_terminal=limit_is_terminal,
        )
        super().__init__(env)
        _, weights, header = read(source, kinds=("rn",), single=True)
        self.config: RewardConfig = registry.configure("proxy", header.config["proxy"])
        discount = as_python(discount)
        if discount is not None:
            fraction()("discount", discount, header.discount)
        self.discount = float(header.discount if discount is None else discount)
        self.limit_is_terminal = limit_is_terminal
        self._info_keys = self._keys(header.task, info_keys)
        obs_space = space_of(env.observation_space, "env.observation_space")
        _require_task(env, RealTask.of_spec(header.spec), header.task)
        num_keys = len(self._info_keys)
        hidden = [self.config.hidden_size] * self.config.num_layers
        shapes: networks.Shapes = {"info_weights": (num_keys,)}
        if not self.config.shaping.weighs_info:
            shapes = networks.shapes_of({"potential": [obs_space.size + num_keys, *hidden, 1]})
        check_tensors("weights", weights, shapes, "those of the environment's task")
        self._weights = weights.get("info_weights")  # [info_keys]
        self._layers = networks.layers_of(weights, "potential")
        self._table: list[float] | None = None  # [num_states]: potentials of discrete states
        if isinstance(obs_space, Discrete) and self._layers:
            self._table = self._apply(np.eye(obs_space.n, dtype=np.float32)).tolist()
        self._potential = 0.0  # of the state that the agent is in
        self._made_as: EnvSpec | None = None

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Begins an episode of the environment."""
        obs, info = self.env.reset(seed=seed, options=options)
        nothing = np.zeros(len(self._info_keys), np.float32)  # v before the first step, as in JAX
        self._potential = self.potential(obs, nothing)
        return obs, info

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, Info]:
        """One step of the environment, with the RN's reward.

        Raises:
          ConfigError: if `info` lacks what the RN weighs or sees.
        """
        obs, real_reward, terminated, truncated, info = self.env.step(action)
        real_reward, terminated, truncated = float(real_reward), bool(terminated), bool(truncated)
        ends = terminated or (truncated and self.limit_is_terminal)
        reward = bonus = self._bonus(obs, self._told(info), ends)
        if self.config.shaping.is_additive:
            reward += real_reward
        if not (np.isfinite(reward) and abs(bonus) < MAX_ABS_VALUE):
            reward, terminated = 0.0, True
        info = {**info, "discount": float(not terminated), "real_reward": real_reward}
        return obs, reward, terminated, truncated, info

    def potential(self, obs: Any, told: np.ndarray | tuple[()] = ()) -> float:
        """Phi of an observation, and of what `info` told of it if it sees that."""
        if self._table is not None:
            return self._table[obs]
        if not self._layers:
            return 0.0
        vector = np.asarray(obs, np.float32)
        return float(self._apply(np.concatenate([vector, told]) if len(told) else vector))

    @property
    def spec(self) -> EnvSpec | None:
        """That of `sejax.gym.make`, which makes all of it; else the environment's, with this."""
        return self._made_as or super().spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        self._made_as = value

    def _bonus(self, obs: Any, told: np.ndarray, ends: bool) -> float:
        """What a transition is worth beside the real reward."""
        if self._weights is not None:
            return float(self._weights @ told)
        before, self._potential = self._potential, self.potential(obs, told)
        after = 0.0 if ends and self.config.zero_at_terminal else self._potential
        return self.discount * after - before if self.config.shaping.is_potential_based else after

    def _apply(self, inputs: np.ndarray) -> np.ndarray:
        outputs = networks.forward(self._layers, self.config.activation, inputs)
        return self.config.output_scale * outputs[..., 0]

    def _told(self, info: Info) -> np.ndarray:
        """The entries of a step's `info` that the RN weighs or sees, `[info_keys]`."""
        try:
            return np.array([info[key] for key in self._info_keys], np.float32)
        except KeyError as error:
            raise ConfigError(
                f"env must tell {', '.join(self._info_keys)} in a step's info; got "
                f"{', '.join(info) or 'none'}. Set RewardNetwork(..., info_keys=[...]).",
                "env",
            ) from error

    def _keys(self, task: str, given: Sequence[str] | None) -> tuple[str, ...]:
        """Entries of `info` that the RN needs."""
        weighs_info = self.config.shaping.weighs_info
        if not (weighs_info or self.config.augmented):
            return ()
        name = "info_keys" if weighs_info else "augmented_keys"
        keys: Sequence[str] = given or ()
        if not given and task in GYMNASIUM_IDS:
            spec = registry.configure("env", {"name": task}).spec
            keys = [GYMNASIUM_NAMES.get(key, key) for key in getattr(spec, name)]
        require(
            keys,
            "info_keys",
            f"must be given for {shortened(task)}, whose info is not known here; got none. Set "
            f"info_keys to `sejax.Task.{name}`.",
        )
        return tuple(keys)


def _require_task(env: gymnasium.Env[Any, Any], learned: RealTask, name: str) -> None:
    """Checks that an environment is of a task, as far as its spaces and wrappers tell."""
    layers = list(_layers(env))
    own, wanted = env.observation_space, learned.observation_space
    is_as_it_is = _kind(layers[-1].observation_space) == _kind(wanted)  # made so by no wrapper
    odd = [
        each
        for each in layers
        if isinstance(each, gymnasium.ObservationWrapper) and not isinstance(each, SAME_NUMBERS)
    ]
    # Wrappers may make actions of one kind of another: some layer has the task's.
    acts = {_kind(layer.action_space) for layer in layers}
    checks = (
        (not isinstance(env.unwrapped, CliffWalkingEnv), "sejax's actions and falls", env),
        (_kind(own) == _kind(wanted), f"the observations {wanted}", own),
        (acts & {_kind(learned.action_space), None}, "its actions", env.action_space),
        (not (is_as_it_is and odd), "observations that no wrapper below has changed", odd[:1]),
    )
    for holds, must, got in checks:
        require(holds, "env", f"must be of {shortened(name)}, with {must}; got {shortened(got)}.")


def _layers(env: gymnasium.Env[Any, Any]) -> Iterator[gymnasium.Env[Any, Any]]:
    """An environment and what it is wrapped around, the innermost last."""
    yield env
    while isinstance(env, gymnasium.Wrapper):
        env = env.env
        yield env


def _kind(space: gymnasium.Space[Any]) -> tuple[str, int] | None:
    """What must be equal for two spaces to be of one task; None for one that is not known."""
    if isinstance(space, gymnasium.spaces.Discrete):
        return "discrete", int(space.n)
    return ("box", int(np.prod(space.shape))) if isinstance(space, gymnasium.spaces.Box) else None
