"""Synthetic environments (SEs) in NumPy: the world that one is, and one episode in it at a time."""

import copy
from collections.abc import Mapping
from typing import Any, NamedTuple, NoReturn

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from sejax.envs.spec import Box
from sejax.gym import networks
from sejax.gym.gridworld import Info
from sejax.gym.tasks import RealTask
from sejax.options import require
from sejax.proxies import MAX_ABS_VALUE
from sejax.proxies.header import check_tensors
from sejax.proxies.synthetic import SyntheticConfig

Numbers = np.ndarray | float


class Step(NamedTuple):
    """What a step comes to: of one episode numbers, of several arrays `[batch]`."""

    vector: np.ndarray  # [*batch, obs_dim]
    reward: Any
    terminated: Any
    truncated: Any
    discount: Any


class SyntheticWorld:
    """The networks of an SE, and what it has of its task; it has no state.

    It is `sejax.proxies.synthetic.SyntheticEnv` in NumPy. Its functions take one episode, or
    a batch of them along a first axis.

    Args:
      weights: by `network/layer/parameter`, kernels `[out, in]` and biases `[out]`, float32.
      config: of the SE.
      task: what it takes from the real task.

    Attributes:
      observation_space: of one episode: a `Box` without bounds, or the task's own `Discrete`.
      action_space: the task's.
      max_steps: of an episode.
      draws_ends: whether ends of episodes are drawn at random.
      draws_noise: whether initial states are made of noise, and not drawn from the real task.

    Raises:
      ConfigError: if the weights are not those of such networks.
    """

    def __init__(self, weights: Mapping[str, np.ndarray], config: SyntheticConfig, task: RealTask):
        self.config = config
        self.action_space = task.action_space
        self.max_steps = config.max_steps(task.max_steps)
        self.draws_ends = config.done in ("bernoulli", "sigmoid") and not config.is_bandit
        self.draws_noise = config.initial_state != "real"
        spec = task.spec
        self.obs_dim = spec.obs_dim
        self._num_states, self._num_actions = spec.num_states, spec.num_actions
        self.observation_space, self._units = task.observation_space, None
        if isinstance(spec.observation, Box):
            self._units = config.units(spec.observation)
            self.observation_space = spaces.Box(-np.inf, np.inf, (self.obs_dim,), np.float32)
        units = config.networks(self.obs_dim, spec.action_dim)
        check_tensors("weights", weights, networks.shapes_of(units), "those of the proxy's task")
        self._start_layers = networks.layers_of(weights, "start")
        heads = [networks.layers_of(weights, name) for name in units if name != "start"]
        self._layers = networks.joined(heads)
        self._starts = task.starts
        require(
            self.draws_noise or self._starts,
            "task.starts",
            "must be given for an SE whose initial states are the real task's; got None. Set "
            "RealTask(starts=...).",
        )
        self._one_hot = np.eye(spec.action_dim, dtype=np.float32)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """What the first states of `count` episodes are made of, `[count, obs_dim]` float32."""
        if self.draws_noise:
            return rng.standard_normal((count, self.obs_dim), np.float32)
        assert self._starts is not None
        starts = [self._starts(rng) for _ in range(count)]
        if self._num_states:
            return np.eye(self.obs_dim, dtype=np.float32)[starts]
        return np.array(starts, np.float32)

    def first(self, drawn: np.ndarray) -> np.ndarray:
        """First states `[*batch, obs_dim]`, of what `draw` has drawn."""
        if not self.draws_noise:
            return drawn
        vector = drawn
        if self._start_layers:
            vector = drawn + networks.forward(self._start_layers, self.config.activation, drawn)
        vector = vector if self._units is None else self._units.decode(vector)
        return np.minimum(np.maximum(vector, np.float32(-MAX_ABS_VALUE)), np.float32(MAX_ABS_VALUE))

    def encode(self, action: Any, space: spaces.Space[Any]) -> np.ndarray:
        """Actions as the networks see them, `[*batch, action_dim]`: one-hot if they are discrete.

        Args:
          action: of `space`; continuous ones are clipped to its bounds, as in Gymnasium's own
            environments.
          space: the task's, or a batch of it.

        Raises:
          gymnasium.error.InvalidAction: for an action that is none of the space's.
        """
        if self._num_actions:
            array = np.asarray(action) if space.shape else action
            if space.contains(array):  # also of bools, which would be a mask
                return self._one_hot[array.astype(np.intp) if space.shape else int(array)]
        elif np.shape(action) == space.shape:
            low, high = self.action_space.low, self.action_space.high  # type: ignore[attr-defined]
            return np.minimum(np.maximum(np.asarray(action, np.float32), low), high)
        raise gymnasium.error.InvalidAction(f"{action!r} is none of {space}")

    def step(
        self, vector: np.ndarray, action: np.ndarray, time: Numbers, chance: Any = None
    ) -> Step:
        """One step of each episode.

        Args:
          vector: the state, `[*batch, obs_dim]`.
          action: from `encode`, `[*batch, action_dim]`.
          time: steps of the episode with this one, `[*batch]`.
          chance: uniform in [0, 1), `[*batch]`, if `draws_ends`.
        """
        outputs = self._predict(action, vector)  # [*batch, obs_dim + 2]
        absurd: Any = False
        if not np.abs(outputs).max() < MAX_ABS_VALUE:  # nan is not either
            absurd = ~(np.abs(outputs).max(axis=-1) < MAX_ABS_VALUE)
            stays = np.zeros_like(outputs)  # where it was, without a reward
            stays[..., :-2], stays[..., -1] = vector, 1
            outputs = np.where(absurd[..., None], stays, outputs)
        reward, done = outputs[..., -2], outputs[..., -1]
        if outputs.ndim == 1:  # one at a time, Python's numbers are quicker than NumPy's
            reward, done = reward.item(), done.item()
        at_limit = time >= self.max_steps
        may_end = (time >= self.config.min_steps) | absurd
        terminated = self._ends(done, chance) & may_end | absurd
        discount = 1 - (done * may_end if self.config.done == "soft" else terminated)
        truncated = at_limit
        if self.config.ends_at_horizon:
            terminated, truncated = terminated | at_limit, at_limit & False
            discount = discount * (1 - at_limit)
        return Step(outputs[..., :-2], reward, terminated, truncated, discount)

    def observe(self, vector: np.ndarray) -> np.ndarray:
        """What agents see of a state, a copy: `[*batch, obs_dim]`, or an index `[*batch]`."""
        return np.argmax(vector, axis=-1) if self._num_states else vector.copy()

    def _predict(self, action: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """Next state, reward and done output d; in a bandit the state stays, and d is 1."""
        seen = vector if self._units is None else self._units.encode(vector)
        known = self.config.reward_form != "network"
        inputs = seen if known else np.concatenate([action, seen], axis=-1)
        outputs = networks.forward(self._layers, self.config.activation, inputs)
        if known:
            bound = self.action_space.high  # type: ignore[attr-defined]
            apart = action - bound * np.clip(outputs, -1, 1)
            cost = np.abs(apart) if self.config.reward_form == "distance" else apart**2
            outputs = -self.config.reward_slope * cost.sum(axis=-1, keepdims=True)
        if self.config.is_bandit:
            whole = np.empty((*vector.shape[:-1], self.obs_dim + 2), np.float32)
            whole[..., :-2], whole[..., -2:-1], whole[..., -1] = vector, outputs, 1
            return whole
        if self._units is not None:
            outputs[..., :-2] = self._units.decode(outputs[..., :-2])
        return outputs

    def _ends(self, done: Any, chance: Any) -> Any:
        """Whether the done output ends the episode."""
        if not self.draws_ends:
            return done > 0.5
        is_logit = self.config.done == "sigmoid"
        return chance < ((1 + np.tanh(done / 2)) / 2 if is_logit else done)


class SyntheticEnv(gymnasium.Env[Any, Any]):
    """An SE: small networks that make the next state, the reward and the end of an episode.

    Observations are float32 vectors without bounds, since a learned world need not stay where the
    real one does; or, for tasks of discrete states, the index of the state vector's largest entry.

    An episode is *terminated* where the done output d says so (`config.done`), at the step
    `config.min_steps` at the earliest; where a learned horizon ends it (`config.horizon`, unless it
    merely cuts); or where an output is not finite or beyond 1e6, which also costs the step its
    reward and leaves the state where it was. It is *truncated* at the task's step limit, here and
    not by a wrapper. `info["discount"]` is what the agents that an SE was learned with bootstrap
    with: 0 where the episode has terminated and 1 elsewhere, save in an SE with `done=soft`, where
    it is 1 - d. Such an SE teaches through that number, which Gymnasium's agents do not see.

    Args:
      world: of the SE.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as Gymnasium declares it)

    def __init__(self, world: SyntheticWorld):
        self.world = world
        self.config = world.config
        self.observation_space = world.observation_space
        self.action_space = copy.deepcopy(world.action_space)  # its sampler is this one's
        self._vector: np.ndarray | None = None  # [obs_dim]: what the networks see and predict
        self._time = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Begins an episode; `options` has no effect."""
        super().reset(seed=seed)
        self._time = 0
        self._vector = self.world.first(self.world.draw(self.np_random, 1)[0])
        return self._observe(self._vector), {}

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, Info]:
        """One step.

        Raises:
          gymnasium.error.ResetNeeded: if no episode is running.
          gymnasium.error.InvalidAction: for an action that is none of the space's. Continuous ones
            are clipped to its bounds, as in Gymnasium's own environments.
        """
        if self._vector is None:
            raise gymnasium.error.ResetNeeded("call reset() first: no episode is running")
        encoded = self.world.encode(action, self.action_space)
        self._time += 1
        chance = self.np_random.random() if self.world.draws_ends else None
        step = self.world.step(self._vector, encoded, self._time, chance)
        terminated, truncated = bool(step.terminated), bool(step.truncated)
        self._vector = None if terminated or truncated else step.vector
        info = {"discount": float(step.discount)}
        return self._observe(step.vector), float(step.reward), terminated, truncated, info

    def render(self) -> NoReturn:
        """Raises `NotImplementedError`: the states of an SE have no picture."""
        raise NotImplementedError("an SE's states have no picture: render its real task")

    def _observe(self, vector: np.ndarray) -> Any:
        obs = self.world.observe(vector)
        return obs if obs.ndim else int(obs)
