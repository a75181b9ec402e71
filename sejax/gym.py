"""Synthetic environments (SEs) for Gymnasium, in NumPy alone: any agent, no JAX.

`make("cartpole")` is a plain `gymnasium.Env`. Neither JAX nor gymnax is loaded, so that beyond
Gymnasium it takes a twentieth of a second and 5 MB, steps in 10 microseconds, and forks and pickles
as as other environments do. It needs the extra `gym`: `pip install 'sejax[gym]'`. Episodes of the
shipped SEs have one step.

Example:
  >>> env = make("cartpole")
  >>> obs, info = env.reset(seed=0)
  >>> obs, reward, terminated, truncated, info = env.step(1)
  >>> obs.shape, terminated, truncated
  ((4,), True, False)
"""

import copy
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from sejax import plugins
from sejax.envs import cliff_walking, gridworld_2x2
from sejax.errors import ConfigError, require, shortened, told
from sejax.proxies import ABSURD, stored
from sejax.proxies.configs import SyntheticConfig
from sejax.proxies.units import units_of

# The tasks that Gymnasium has too, with the same spaces, dynamics and initial states.
GYMNASIUM_IDS = {
    "cartpole": "CartPole-v1",
    "cartpole_v1": "CartPole-v1",
    "acrobot": "Acrobot-v1",
    "mountain_car": "MountainCar-v0",
    "mountain_car_continuous": "MountainCarContinuous-v0",
    "pendulum": "Pendulum-v1",
    "halfcheetah": "HalfCheetah-v5",
    "hopper": "Hopper-v5",
    "walker2d": "Walker2d-v5",
    "swimmer": "Swimmer-v5",
    "inverted_pendulum": "InvertedPendulum-v5",
    "ant": "Ant-v5",
    "reacher": "Reacher-v5",
}
# Gymnasium's Cliff Walking numbers the actions otherwise; the start and the sizes are on the maps.
_MAPS = {"cliff_walking": cliff_walking.MAP, "gridworld_2x2": gridworld_2x2.MAP}

Starts = Callable[[np.random.Generator], Any]

ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "fast_tanh": np.tanh,  # which differs by at most 1.4e-6
    "relu": lambda x: np.maximum(x, 0),
    "leaky_relu": lambda x: np.maximum(x, 0.01 * x),
    "prelu": lambda x: np.maximum(x, 0.25 * x),  # the slope that proxies keep
}


@dataclass(frozen=True, kw_only=True)
class RealTask:
    """What an SE takes from the task that it stands in for.

    Attributes:
      observation_space: a `Box` of vectors, whose bounds only matter to an SE that has its units by
        them (`state_units=bounds`), or `Discrete`.
      action_space: a `Discrete`, or a `Box` of vectors.
      max_steps: steps after which an episode is cut, if the SE has no horizon of its own.
      starts: the first observation of an episode, drawn with a generator; must be picklable for the
        environment to be. None if the SE has learned its initial states.
    """

    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    max_steps: int
    starts: Starts | None = None

    @classmethod
    def of_gymnasium(cls, env_id: str, max_steps: int | None = None) -> "RealTask":
        """A task that Gymnasium knows.

        Args:
          env_id: such as `"CartPole-v1"`.
          max_steps: in the place of Gymnasium's limit.

        Raises:
          ConfigError: if Gymnasium cannot make it, or has no limit for it and none is given.
        """
        try:
            env = gymnasium.make(env_id)
        except (gymnasium.error.Error, ImportError) as error:
            raise ConfigError(
                f"task must be one that Gymnasium can make here, because initial states and "
                f"actions are those of the real task; {env_id} raised {told(error)}."
            ) from error
        limit = max_steps or gymnasium.spec(env_id).max_episode_steps
        require(limit, "task", "have a step limit", "an episode of an SE may never end by itself",
                env_id, "max_steps")  # fmt: skip
        return cls(
            observation_space=env.observation_space, action_space=env.action_space,
            max_steps=int(limit or 0), starts=_GymnasiumStarts(env.unwrapped),
        )  # fmt: skip


class _GymnasiumStarts:
    """First observations of a Gymnasium environment."""

    def __init__(self, env: gymnasium.Env[Any, Any]):
        self._env = env

    def __call__(self, rng: np.random.Generator) -> Any:
        self._env.np_random = rng
        return self._env.reset()[0]


@dataclass(frozen=True)
class _FixedStart:
    """The same first observation every time."""

    index: int

    def __call__(self, rng: np.random.Generator) -> int:
        return self.index


class SyntheticEnv(gymnasium.Env[Any, Any]):
    """An SE: small networks that make the next state, the reward and the end of an episode.

    It is `sejax.proxies.synthetic.SyntheticEnv` in NumPy, step by step. Observations are float32
    vectors without bounds, since a learned world need not stay where the real one does; or, for
    tasks of discrete states, the index of the state vector's largest entry.

    An episode is *terminated* where the done output d says so (`config.done`), where a learned
    horizon ends it (`config.horizon`, unless it merely cuts), or where an output is not finite or
    beyond 1e6, which also costs the step its reward and leaves the state where it was. It is
    *truncated* at the task's step limit, here and not by a wrapper. `info["discount"]` is what the
    agents that an SE was learned with bootstrap with: 0 where the episode has terminated and 1
    elsewhere, save in an SE with `done=soft`, where it is 1 - d. Such an SE teaches through that
    number, which Gymnasium's agents do not see.

    Args:
      weights: by `network/layer/parameter`, kernels `[out, in]` and biases `[out]`, float32.
      config: of the SE.
      task: what it takes from the real task.

    Raises:
      ConfigError: if the weights are not those of such networks.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as Gymnasium declares it)

    def __init__(self, weights: Mapping[str, np.ndarray], config: SyntheticConfig, task: RealTask):
        self.config = config
        self.action_space = copy.deepcopy(task.action_space)  # its sampler is this one's
        self._num_states = _num_categories(task.observation_space)
        self._num_actions = _num_categories(task.action_space)
        self._obs_dim = _size(task.observation_space, "task.observation_space")
        action_dim = _size(task.action_space, "task.action_space")
        if self._num_states:
            self.observation_space = task.observation_space
        else:
            self.observation_space = spaces.Box(-np.inf, np.inf, (self._obs_dim,), np.float32)
        start_size = len(weights.get("start/Dense_0/bias", ()))
        _check(weights, _shapes(config, self._obs_dim, action_dim, start_size))
        heads = ["reward"] if config.horizon == 1 else ["state", "reward", "done"]
        self._layers = _joined([_layers(weights, head) for head in heads])
        self._start_layers = _layers(weights, "start")
        self._units = None
        if config.state_units == "bounds" and isinstance(task.observation_space, spaces.Box):
            space = task.observation_space
            self._units = units_of(space.low.ravel(), space.high.ravel(), self._obs_dim)
        self._starts = task.starts
        require(self._starts or config.initial_state != "real", "task.starts", "be given for an SE "
                "whose initial states are the real task's", "episodes begin there", None,
                "RealTask(starts=...)")  # fmt: skip
        self._max_steps = config.max_steps(task.max_steps)
        self._one_hot = np.eye(action_dim, dtype=np.float32)
        self._vector: np.ndarray | None = None  # [obs_dim]: what the networks see and predict
        self._num_steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode; `options` has no effect."""
        super().reset(seed=seed)
        self._num_steps = 0
        self._vector = self._first_vector()
        return self._observe(self._vector), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step.

        Raises:
          gymnasium.error.ResetNeeded: if no episode is running.
          gymnasium.error.InvalidAction: for an action that is none of the space's. Continuous ones
            are clipped to its bounds, as in Gymnasium's own environments.
        """
        if self._vector is None:
            raise gymnasium.error.ResetNeeded("call reset() first: no episode is running")
        outputs = self._predict(self._encode(action), self._vector)  # [obs_dim + 2]
        is_sane = bool(np.abs(outputs).max() < ABSURD)  # False for nan
        vector = outputs[:-2] if is_sane else self._vector
        reward, done = (float(x) for x in outputs[-2:])
        self._num_steps += 1
        at_limit = self._num_steps >= self._max_steps
        is_last = at_limit and self.config.horizon is not None and self.config.horizon_is_terminal
        ends = not is_sane or self._ends(done)
        discount = 1.0 - (done if self.config.done == "soft" else ends)
        info = {"discount": discount if is_sane and not is_last else 0.0}
        terminated, truncated = ends or is_last, at_limit and not is_last
        self._vector = None if terminated or truncated else vector
        return self._observe(vector), reward if is_sane else 0.0, terminated, truncated, info

    def _first_vector(self) -> np.ndarray:
        if self.config.initial_state != "real":
            vector = noise = self.np_random.standard_normal(self._obs_dim, np.float32)
            if self._start_layers:
                vector = noise + self._forward(self._start_layers, noise)
            vector = vector if self._units is None else self._units.decode(vector)
            return np.clip(vector, -ABSURD, ABSURD)
        assert self._starts is not None
        obs = self._starts(self.np_random)
        if self._num_states:
            return np.eye(self._obs_dim, dtype=np.float32)[obs]
        return np.array(obs, np.float32)

    def _encode(self, action: Any) -> np.ndarray:
        """The action as the networks see it, `[action_dim]`: one-hot if it is discrete."""
        space = self.action_space
        if self._num_actions:
            if not space.contains(action):
                raise gymnasium.error.InvalidAction(f"{action!r} is none of {space}")
            return self._one_hot[action]
        action = np.asarray(action, np.float32)
        if action.shape != space.shape:
            raise gymnasium.error.InvalidAction(f"{action!r} is none of {space}")
        return np.minimum(np.maximum(action, space.low), space.high)

    def _predict(self, action: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """Next state, reward and done output d, `[obs_dim + 2]`; in a bandit the state stays."""
        seen = vector if self._units is None else self._units.encode(vector)
        outputs = self._forward(self._layers, np.concatenate([action, seen]))
        if self.config.horizon == 1:
            return np.concatenate([vector, outputs, [1]], dtype=np.float32)
        if self._units is not None:
            outputs[: self._obs_dim] = self._units.decode(outputs[: self._obs_dim])
        return outputs

    def _forward(self, layers: "Layers", x: np.ndarray) -> np.ndarray:
        activate = ACTIVATIONS[self.config.activation]
        *hidden, (last_kernel, last_bias) = layers
        with np.errstate(over="ignore", invalid="ignore"):  # `step` looks at what comes out
            for kernel, bias in hidden:
                x = activate(kernel @ x + bias)
            return last_kernel @ x + last_bias

    def _ends(self, done: float) -> bool:
        """Whether the done output ends the episode."""
        if self.config.done == "bernoulli":
            return self.np_random.random() < done
        if self.config.done == "sigmoid":
            return self.np_random.random() < (1 + math.tanh(done / 2)) / 2
        return done > 0.5

    def _observe(self, vector: np.ndarray) -> Any:
        return int(np.argmax(vector)) if self._num_states else vector.copy()


def make(source: str | Path, task: RealTask | str | None = None) -> SyntheticEnv:
    """Makes a stored SE a Gymnasium environment.

    Args:
      source: a run directory, a safetensors file of one SE, the name of one that ships with the
        package, or one on the Hugging Face Hub (`hf://user/repo`).
      task: the real task, or its id in Gymnasium; needed if it is none that sejax and Gymnasium
        both know.

    Raises:
      ConfigError: if there is no such file, it is damaged, it holds no SE or several, or its task
        is not known.

    Example:
      >>> make("acrobot").observation_space.shape
      (6,)
    """
    path = stored.find(source)
    weights, header = stored.read(path, "source")
    config = header["config"]
    require(not header["is_set"], "source", "be a single proxy", "an agent trains in one world",
            f"{path}, a set", "source to a run directory")  # fmt: skip
    kind = config["proxy"].get("name")
    require(kind == "se", "source", "be a synthetic environment", "a reward network needs the real "
            "task's steps, and other proxies are JAX code", f"proxy={shortened(kind)} in {path}",
            "source to an SE; sejax.load reads all proxies")  # fmt: skip
    if isinstance(task, str):
        task = RealTask.of_gymnasium(task)
    env = SyntheticEnv(
        weights, plugins.configure("proxy", config["proxy"]), task or _known_task(config["env"])
    )
    # No max_episode_steps: it would be a second time limit, by a wrapper.
    env.spec = EnvSpec(
        id=f"sejax/{header['task'].replace('/', '-')}", entry_point=f"{__name__}:make",
        kwargs={"source": str(source)} | ({} if task is None else {"task": task}),
    )  # fmt: skip
    return env


def _known_task(config: Mapping[str, Any]) -> RealTask:
    """The task that a file's metadata names, if it is one that needs no JAX."""
    name = str(config.get("name"))
    if name in _MAPS:
        cells = "".join(_MAPS[name])
        return RealTask(
            observation_space=spaces.Discrete(len(cells)), action_space=spaces.Discrete(4),
            max_steps=plugins.find("env", name).facts.max_steps,
            starts=_FixedStart(cells.index("S")),
        )  # fmt: skip
    if name in GYMNASIUM_IDS:
        return RealTask.of_gymnasium(GYMNASIUM_IDS[name], plugins.find("env", name).facts.max_steps)
    gymnax_id = name.removeprefix("gymnax/")
    if gymnax_id != name and gymnax_id in gymnasium.registry:
        return RealTask.of_gymnasium(gymnax_id, config.get("max_steps"))
    raise ConfigError(
        f"task must be given for {shortened(name)}, because Gymnasium knows no environment of that "
        f"name; got none. Known: {', '.join([*GYMNASIUM_IDS, *_MAPS])}. Set "
        f"sejax.gym.make(source, task=sejax.gym.RealTask(...)), or to an id of Gymnasium."
    )


# --- networks ------------------------------------------------------------------------------------

Layers = list[tuple[np.ndarray, np.ndarray]]  # kernel [out, in] and bias [out] of each


def _layers(weights: Mapping[str, np.ndarray], network: str) -> Layers:
    """A network's layers, none if it is not there."""
    names = (f"{network}/Dense_{i}" for i in itertools.count())
    there = itertools.takewhile(lambda name: f"{name}/kernel" in weights, names)
    return [(weights[f"{name}/kernel"], weights[f"{name}/bias"]) for name in there]


def _joined(networks: list[Layers]) -> Layers:
    """Networks of the same input as one, whose outputs are theirs one after the other.

    One product over the zeros between the blocks takes less time than three small ones.
    """
    joined: Layers = []
    for parts in zip(*networks, strict=True):
        kernels, biases = zip(*parts, strict=True)
        kernel = _block_diagonal(kernels) if joined else np.concatenate(kernels)
        joined.append((kernel, np.concatenate(biases)))
    return joined


def _block_diagonal(blocks: tuple[np.ndarray, ...]) -> np.ndarray:
    rows, columns = (
        np.cumsum([0, *sizes]) for sizes in zip(*(x.shape for x in blocks), strict=True)
    )
    whole = np.zeros((rows[-1], columns[-1]), np.float32)
    for block, row, column in zip(blocks, rows, columns, strict=False):
        whole[row : row + block.shape[0], column : column + block.shape[1]] = block
    return whole


def _shapes(
    config: SyntheticConfig, obs_dim: int, action_dim: int, start_size: int
) -> dict[str, tuple[int, ...]]:
    """Shape of each weight of an SE; `start_size`: hidden units of what makes initial states."""
    hidden = [action_dim + obs_dim, *[config.hidden_size] * config.num_layers]
    sizes = {"reward": [*hidden, 1]}
    if config.horizon != 1:
        sizes |= {"state": [*hidden, obs_dim], "done": [*hidden, 1]}
    if config.initial_state == "learned":
        sizes["start"] = [obs_dim, start_size, obs_dim]
    shapes: dict[str, tuple[int, ...]] = {}
    for network, units in sizes.items():
        for i, (num_inputs, num_outputs) in enumerate(itertools.pairwise(units)):
            shapes[f"{network}/Dense_{i}/kernel"] = (num_outputs, num_inputs)
            shapes[f"{network}/Dense_{i}/bias"] = (num_outputs,)
    return shapes


def _check(weights: Mapping[str, np.ndarray], shapes: dict[str, tuple[int, ...]]) -> None:
    there = {name: x.shape for name, x in weights.items()}
    if there != shapes or not all(np.isfinite(x).all() for x in weights.values()):
        what = "numbers that are not finite" if there == shapes else shortened(there)
        raise ConfigError(
            f"weights must be those of the SE's networks, because they are its dynamics; got "
            f"{what} in place of {shortened(shapes)}. Learn it again, or give its own task."
        )


def _num_categories(space: spaces.Space[Any]) -> int | None:
    """Size of a `Discrete` space; None for a `Box`."""
    return int(space.n) if isinstance(space, spaces.Discrete) else None


def _size(space: spaces.Space[Any], name: str) -> int:
    """Length of the vector that networks see; an index is one-hot to them."""
    is_index = isinstance(space, spaces.Discrete) and space.start == 0
    is_vector = isinstance(space, spaces.Box) and len(space.shape) == 1
    require(is_index or is_vector, name, "be a Box of vectors or a Discrete from 0", "networks "
            "take vectors", space, f"{name} to what `sejax.Task` has")  # fmt: skip
    return _num_categories(space) or int(space.shape[0])  # type: ignore[index]
