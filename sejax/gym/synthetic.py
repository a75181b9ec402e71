"""Synthetic environments (SEs) in NumPy: the networks, and one episode or many side by side."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from sejax.gym import networks
from sejax.gym.tasks import Info, RealTask
from sejax.options import require, require_known
from sejax.proxies import MAX_ABS_VALUE
from sejax.proxies.header import check_tensors
from sejax.proxies.synthetic import SyntheticConfig, Units

PREFETCHED = 32  # starts that an environment draws at once, if its generator draws nothing else

Number: TypeAlias = float | np.ndarray


class SyntheticWorld:
    """The networks of an SE, and the part of its task that it uses; without a state.

    It is `sejax.proxies.synthetic.SyntheticEnv` in NumPy. Its functions take one episode, or
    a batch of them along a first axis.

    Args:
      weights: arrays by `network/layer/parameter`, kernels `[out, in]` and biases `[out]`, float32.
      config: the SE's configuration.
      task: the part of the real task that the SE uses.

    Attributes:
      observation_space: for one episode: a `Box` without bounds, or the task's own `Discrete`.
      action_space: the task's.
      max_steps: the step limit of an episode.
      draws_ends: whether ends of episodes are drawn at random.
      draws_noise: whether initial states are made of noise, and not drawn from the real task.

    Raises:
      ConfigError: if the weights do not fit these networks, or if `task` must have `starts`.
    """

    def __init__(self, weights: Mapping[str, np.ndarray], config: SyntheticConfig, task: RealTask):
        self.config = config
        self.action_space = task.action_space
        self.max_steps = config.max_steps(task.max_steps)
        self.draws_ends = config.done == "bernoulli" and not config.is_bandit
        self.draws_noise = config.initial_state != "real"
        self.observation_space = space = task.observation_space
        self.obs_dim = spaces.flatdim(space)
        action_dim = spaces.flatdim(task.action_space)
        self._units = Units()
        if isinstance(space, spaces.Box):
            self._units = config.units(space.low, space.high)
            self.observation_space = spaces.Box(-np.inf, np.inf, (self.obs_dim,), np.float32)
        sizes = config.networks(self.obs_dim, action_dim)
        check_tensors("weights", weights, networks.shapes_of(sizes), "those of the proxy's task")
        self._start_layers = networks.network_layers(weights, "start")
        heads = [networks.network_layers(weights, name) for name in sizes if name != "start"]
        self._layers = networks.joined(heads)
        are_known = self.draws_noise or task.starts
        require(are_known, "task.starts", "must draw initial states. Set RealTask(starts=...).")
        self._starts: Any = task.starts  # not None where it is called
        self._one_hot = np.eye(action_dim, dtype=np.float32)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draws noise or real states for `count` first states, `[count, obs_dim]` float32."""
        if self.draws_noise:
            return rng.standard_normal((count, self.obs_dim), np.float32)
        starts = [self._starts(rng) for _ in range(count)]
        if isinstance(self.observation_space, spaces.Discrete):
            return np.eye(self.obs_dim, dtype=np.float32)[starts]
        return np.array(starts, np.float32)

    def first(self, drawn: np.ndarray) -> np.ndarray:
        """First states `[*batch, obs_dim]`, made from the numbers that `draw` has drawn."""
        if not self.draws_noise:
            return drawn
        vector = drawn
        if self._start_layers:
            vector = drawn + networks.forward(self._start_layers, self.config.activation, drawn)
        return np.minimum(np.maximum(self._units.decode(vector), -MAX_ABS_VALUE), MAX_ABS_VALUE)

    def encode(self, action: ArrayLike, space: spaces.Space[Any]) -> np.ndarray:
        """Actions as the networks see them, `[*batch, action_dim]`: one-hot if they are discrete.

        Args:
          action: from `space`; continuous actions are clipped to its bounds, as in Gymnasium.
          space: the task's, or a batch of it.

        Raises:
          gymnasium.error.InvalidAction: for an index or a shape that the space does not have.
        """
        if isinstance(self.action_space, spaces.Discrete):
            array = np.asarray(action)
            if array.dtype.kind in "iu" and space.contains(action):
                return self._one_hot[array]
        elif np.shape(action) == space.shape:
            low, high = self.action_space.low, self.action_space.high  # type: ignore[attr-defined]
            return np.minimum(np.maximum(np.asarray(action, np.float32), low), high)
        raise gymnasium.error.InvalidAction(f"{action!r} is none of {space}")

    def step(
        self, vector: np.ndarray, action: np.ndarray, time: Number, chance: Number | None = None
    ) -> tuple[np.ndarray, Any, Any, Any, Any]:
        """One step of each episode.

        Args:
          vector: the state, `[*batch, obs_dim]`.
          action: from `encode`, `[*batch, action_dim]`.
          time: steps of the episode, including this one, `[*batch]`.
          chance: uniform in [0, 1), `[*batch]`, if `draws_ends`.

        Returns:
          `(vector, reward, terminated, truncated, discount)`: the next state, `[*batch, obs_dim]`;
          the others `[*batch]`, or numbers for one episode.
        """
        outputs = self._predict(action, vector)  # [*batch, obs_dim + 2]
        absurd: Any = False
        if not np.abs(outputs).max() < MAX_ABS_VALUE:  # also true for nan
            absurd = ~(np.abs(outputs).max(axis=-1) < MAX_ABS_VALUE)
            outputs[absurd, :-2] = vector[absurd]  # the state stays, without a reward
            outputs[absurd, -2:] = 0, 1
        reward, done = outputs[..., -2], outputs[..., -1]
        if outputs.ndim == 1:  # one at a time, Python's numbers are quicker than NumPy's
            reward, done = reward.item(), done.item()
        at_limit = time >= self.max_steps
        may_end = (time >= self.config.min_steps) | absurd
        ends = chance < done if self.draws_ends else done > 0.5
        terminated = ends & may_end | absurd
        discount = 1 - (done * may_end if self.config.done == "soft" else terminated)
        truncated = at_limit
        if self.config.horizon is not None:
            terminated = terminated | at_limit
            truncated = at_limit & False  # a horizon terminates instead
            discount = discount * (1 - at_limit)
        return outputs[..., :-2], reward, terminated, truncated, discount

    def observe(self, vector: np.ndarray) -> Any:
        """What agents see of a state, a copy: `[*batch, obs_dim]`, or an index `[*batch]`."""
        if isinstance(self.observation_space, spaces.Box):
            return vector.copy()
        index = np.argmax(vector, axis=-1)
        return index if index.ndim else int(index)

    def _predict(self, action: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """Next state, reward and done output d; in a bandit the state stays, and d is 1."""
        seen = self._units.encode(vector)
        is_distance = self.config.reward_form != "network"
        inputs = seen if is_distance else np.concatenate([action, seen], axis=-1)
        outputs = networks.forward(self._layers, self.config.activation, inputs)
        if is_distance:
            bound = self.action_space.high  # type: ignore[attr-defined]
            outputs = -np.abs(action - bound * np.clip(outputs, -1, 1)).sum(-1, keepdims=True)
        if self.config.is_bandit:
            done = np.ones_like(outputs)
            return np.concatenate([vector, outputs, done], axis=-1, dtype=np.float32)
        outputs[..., :-2] = self._units.decode(outputs[..., :-2])
        return outputs


class SyntheticGymEnv(gymnasium.Env[Any, Any]):
    """An SE: small networks that make the next state, the reward and the end of an episode.

    Observations are float32 vectors without bounds, since a learned world may leave the bounds of
    the real one. For tasks of discrete states they are the index of the state vector's largest
    entry.

    An episode is *terminated* if the done output d says so (`config.done`), at the step
    `config.min_steps` at the earliest, or at its horizon (`config.horizon`). It is also terminated
    if an output is not finite or beyond 1e6; then the reward is 0 and the state stays. It is
    *truncated* at the task's step limit, by this class and not by a wrapper. `info["discount"]` is
    the factor with which sejax's agents bootstrap: 0 if the episode has terminated, else 1. In an
    SE with `done=soft` it is 1 - d; such an SE teaches through this factor, which Gymnasium's
    agents do not see.

    Args:
      world: the SE's world.
    """

    def __init__(self, world: SyntheticWorld):
        self.world = world
        self.observation_space = world.observation_space
        self.action_space = copy.deepcopy(world.action_space)  # with its own sampler
        self._vector: np.ndarray | None = None  # [obs_dim]: the state that networks see
        self._time = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Begins an episode; `options` has no effect."""
        super().reset(seed=seed)
        self._time = 0
        self._vector = self.world.first(self.world.draw(self.np_random, 1)[0])
        return self.world.observe(self._vector), {}

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, Info]:
        """One step.

        Raises:
          gymnasium.error.ResetNeeded: if no episode is running.
          gymnasium.error.InvalidAction: for an index or a shape that the space does not have.
            Continuous actions are clipped to its bounds, as in Gymnasium's own environments.
        """
        if self._vector is None:
            raise gymnasium.error.ResetNeeded("call reset() first: no episode is running")
        encoded = self.world.encode(action, self.action_space)
        self._time += 1
        chance = self.np_random.random() if self.world.draws_ends else None
        outcome = self.world.step(self._vector, encoded, self._time, chance)
        vector, reward, terminated, truncated, discount = outcome
        self._vector = None if terminated or truncated else vector
        info = {"discount": float(discount)}
        return self.world.observe(vector), float(reward), bool(terminated), bool(truncated), info


class SyntheticVectorEnv(VectorEnv[Any, Any, np.ndarray]):
    """Episodes of an SE as a Gymnasium vector environment.

    Environment i equals `SyntheticGymEnv` after `reset(seed=seed + i)` up to rounding. The others
    do not affect it: each has its own generator, which draws its starts and ends. Infos, and what
    follows an end, are those of `gymnasium.vector.SyncVectorEnv`.

    Args:
      world: the SE's world.
      num_envs: number of environments.
      autoreset_mode: NextStep (the step after an end ignores the action and begins an episode),
        or SameStep (the step that ends an episode returns the next one's first observation, and its
        own last observation in `infos["final_obs"]`).
    """

    def __init__(
        self, world: SyntheticWorld, num_envs: int, autoreset_mode: AutoresetMode | str = "NextStep"
    ):
        self.world = world
        self.num_envs = num_envs
        mode = str(getattr(autoreset_mode, "value", autoreset_mode))
        require_known("autoreset_mode", mode, ["NextStep", "SameStep"])
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode(mode)}
        self.single_observation_space = world.observation_space
        self.single_action_space = world.action_space
        self.observation_space = batch_space(world.observation_space, num_envs)
        self.action_space = batch_space(world.action_space, num_envs)
        self._vectors = np.zeros((num_envs, world.obs_dim), np.float32)
        self._times = np.zeros(num_envs, np.int64)
        self._ended = np.zeros(num_envs, np.bool_)
        self._generators: list[np.random.Generator] = []  # from the first reset on
        # Drawing many numbers at once is quicker than one by one, and gives the same numbers.
        num_drawn = PREFETCHED if world.draws_noise and not world.draws_ends else 1
        self._drawn = np.zeros((num_envs, num_drawn, world.obs_dim), np.float32)
        self._num_used = np.full(num_envs, num_drawn)  # of the drawn starts

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        """Begins an episode in each environment.

        Args:
          seed: of the first environment, the others have seed + 1, seed + 2, ...; or of each one.
            An environment without a seed keeps its generator.
          options: have no effect.

        Raises:
          ConfigError: for another number of seeds.
        """
        if not isinstance(seed, Sequence):
            seed = [None if seed is None else seed + i for i in range(self.num_envs)]
        require(len(seed) == self.num_envs, "seed", f"must be one, or {self.num_envs} of them.")
        generators: list[Any] = self._generators.copy() or [None] * self.num_envs
        for i, number in enumerate(seed):
            if number is not None or generators[i] is None:
                generators[i], _ = gymnasium.utils.seeding.np_random(number)
        # Starts drawn before are void.
        self._num_used[[x is not None for x in seed]] = self._drawn.shape[1]
        self._generators = generators
        self._ended = np.zeros(self.num_envs, np.bool_)
        self.begin(~self._ended)
        return self.observe(), {}

    def step(
        self, actions: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """One step of each environment.

        Raises:
          gymnasium.error.ResetNeeded: before the first reset.
          gymnasium.error.InvalidAction: for indices or a shape that the space does not have.
        """
        on = ~self._ended  # the others begin an episode
        rewards, terminated, truncated, discounts = self.advance(actions)
        self.begin(self._ended)
        ended = terminated | truncated
        infos = _infos(discounts, on)
        if self.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP:
            self._ended = ended
        elif ended.any():
            obs = self.observe()
            final_obs = np.full(self.num_envs, None)
            for i in np.flatnonzero(ended):
                final_obs[i] = obs[i]
            infos = {"final_obs": final_obs, "final_info": _infos(discounts, ended)}
            infos |= {"_final_obs": ended, "_final_info": ended} | _infos(discounts, ~ended)
            self.begin(ended)
        return self.observe(), rewards, terminated, truncated, infos

    def observe(self) -> np.ndarray:
        """What agents see of all states, `[num_envs, ...]`, a copy."""
        return np.asarray(self.world.observe(self._vectors))

    def advance(self, actions: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """One step of the environments whose episodes have not ended; begins none.

        Returns:
          `(rewards, terminated, truncated, discounts)`, `[num_envs]` each.

        Raises:
          gymnasium.error.ResetNeeded, gymnasium.error.InvalidAction: as `step`.
        """
        if not self._generators:
            raise gymnasium.error.ResetNeeded("call reset() first: no episode is running")
        encoded = self.world.encode(actions, self.action_space)
        on = ~self._ended
        rewards, discounts = np.zeros((2, self.num_envs))
        terminated, truncated = np.zeros((2, self.num_envs), np.bool_)
        if on.any():
            self._times += on
            chances = None
            if self.world.draws_ends:
                chances = np.array([self._generators[i].random() for i in np.flatnonzero(on)])
            self._vectors[on], rewards[on], terminated[on], truncated[on], discounts[on] = (
                self.world.step(self._vectors[on], encoded[on], self._times[on], chances)
            )
        return rewards, terminated, truncated, discounts

    def begin(self, mask: np.ndarray) -> None:
        """Begins an episode in the environments of the mask."""
        indices = np.flatnonzero(mask)
        num_drawn = self._drawn.shape[1]
        if not indices.size:
            return
        for i in indices[self._num_used[indices] == num_drawn]:
            self._drawn[i] = self.world.draw(self._generators[i], num_drawn)
            self._num_used[i] = 0
        self._vectors[indices] = self.world.first(self._drawn[indices, self._num_used[indices]])
        self._num_used += mask
        self._times *= ~mask


def _infos(discounts: np.ndarray, mask: np.ndarray) -> Info:
    """Discounts of the environments of a mask, in Gymnasium's form of infos; empty for none."""
    return {"discount": np.where(mask, discounts, 0.0), "_discount": mask} if mask.any() else {}
