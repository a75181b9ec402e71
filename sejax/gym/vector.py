"""Many episodes of an SE side by side: each step is one pass through its networks."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from sejax.gym.gridworld import Info
from sejax.gym.synthetic import SyntheticWorld
from sejax.options import one_of, require

PREFETCHED = 32  # starts that an environment draws at once, if its generator draws nothing else


class SyntheticVectorEnv(VectorEnv[Any, Any, np.ndarray]):
    """Episodes of an SE as a Gymnasium vector environment.

    Environment i equals `SyntheticEnv` after `reset(seed=seed + i)` up to rounding, whatever
    happens in the others: each has a generator of its own, which draws its starts and ends. Infos,
    and what is done where an episode ends, are those of `gymnasium.vector.SyncVectorEnv`.

    Args:
      world: of the SE.
      num_envs: number of environments.
      autoreset_mode: NextStep (the step after an end ignores the action and begins an episode),
        SameStep (the end's step returns the next episode's first observation, and the last one's
        own as `infos["final_obs"]`), or Disabled (`reset(options={"reset_mask": ended})`).
    """

    def __init__(
        self,
        world: SyntheticWorld,
        num_envs: int,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ):
        self.world = world
        self.num_envs = num_envs
        if not isinstance(autoreset_mode, AutoresetMode):
            one_of([mode.value for mode in AutoresetMode])("autoreset_mode", autoreset_mode, None)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self.single_observation_space = world.observation_space
        self.single_action_space = world.action_space
        self.observation_space = batch_space(world.observation_space, num_envs)
        self.action_space = batch_space(world.action_space, num_envs)
        self._vectors = np.zeros((num_envs, world.obs_dim), np.float32)
        self._times = np.zeros(num_envs, np.int64)
        self._ended = np.zeros(num_envs, np.bool_)
        # Of each environment, as in Gymnasium's own; None before the first reset.
        self._np_random: list[Any] = [None] * num_envs  # type: ignore[assignment]
        self._np_random_seed: list[int | None] = [None] * num_envs  # type: ignore[assignment]
        # A generator gives the same numbers one by one and all at once, which is quicker.
        num_drawn = PREFETCHED if world.draws_noise and not world.draws_ends else 1
        self._drawn = np.zeros((num_envs, num_drawn, world.obs_dim), np.float32)
        self._num_used = np.full(num_envs, num_drawn)  # of those

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        """Begins an episode in each environment.

        Args:
          seed: of the first environment, and the next ones have the numbers that follow; or a seed
            for each.
          options: `reset_mask`, `[num_envs]` of bool: only these environments.

        Raises:
          ConfigError: for seeds or a mask of another length.
        """
        seeds = self._listed(seed)
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_)))
        require(
            len(seeds) == self.num_envs,
            "seed",
            f"must be one number, or {self.num_envs}; got {len(seeds)}.",
        )
        require(
            mask.shape == (self.num_envs,) and mask.dtype == np.bool_,
            "options.reset_mask",
            f"must be [{self.num_envs}] of bool; got {mask.shape} of {mask.dtype}.",
        )
        indices = np.flatnonzero(mask)
        for i in indices:
            if self._np_random[i] is None or seeds[i] is not None:
                self._np_random[i], self._np_random_seed[i] = seeding.np_random(seeds[i])
                self._num_used[i] = self._drawn.shape[1]  # what it had drawn before is void
        self._begin(indices)
        return self.world.observe(self._vectors), {}

    def step(
        self, actions: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """One step of each environment.

        Raises:
          gymnasium.error.ResetNeeded: if an environment has no episode that goes on.
          gymnasium.error.InvalidAction: for actions that are none of the space's.
        """
        is_next_step = self.autoreset_mode is AutoresetMode.NEXT_STEP
        if None in self._np_random or (self._ended.any() and not is_next_step):
            raise gymnasium.error.ResetNeeded("call reset() first: no episode is running")
        encoded = self.world.encode(actions, self.action_space)
        goes_on = ~self._ended
        waiting, indices = np.flatnonzero(self._ended), np.flatnonzero(goes_on)
        rewards, discounts = np.zeros(self.num_envs), np.zeros(self.num_envs)
        terminated, truncated = np.zeros((2, self.num_envs), np.bool_)
        if indices.size:
            self._times[indices] += 1
            step = self.world.step(
                self._vectors[indices],
                encoded[indices],
                self._times[indices],
                self._chance(indices),
            )
            self._vectors[indices] = step.vector
            rewards[indices], discounts[indices] = step.reward, step.discount
            terminated[indices], truncated[indices] = step.terminated, step.truncated
        self._begin(waiting)
        self._ended = terminated | truncated
        infos = _told(discounts, goes_on)
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            infos = self._final(discounts)
            self._begin(np.flatnonzero(self._ended))
        return self.world.observe(self._vectors), rewards, terminated, truncated, infos

    def _final(self, discounts: np.ndarray) -> Info:
        """Infos of a step whose ended environments will begin anew at once."""
        ended = self._ended.copy()
        final_obs = np.full(self.num_envs, None, dtype=object)
        obs = self.world.observe(self._vectors)
        for i in np.flatnonzero(ended):
            final_obs[i] = obs[i]
        return {
            "final_obs": final_obs,
            "_final_obs": ended,
            "final_info": _told(discounts, ended),
            "_final_info": ended.copy(),
            **_told(discounts, ~ended),
        }

    def _begin(self, indices: np.ndarray) -> None:
        """Puts environments at the beginning of an episode."""
        if not indices.size:
            return
        num_drawn = self._drawn.shape[1]
        for i in indices[self._num_used[indices] == num_drawn]:
            self._drawn[i] = self.world.draw(self._np_random[i], num_drawn)
            self._num_used[i] = 0
        self._vectors[indices] = self.world.first(self._drawn[indices, self._num_used[indices]])
        self._num_used[indices] += 1
        self._times[indices], self._ended[indices] = 0, False

    def _chance(self, indices: np.ndarray) -> np.ndarray | None:
        """What decides over ends, `[indices]`, drawn with each environment's own generator."""
        if not self.world.draws_ends:
            return None
        return np.array([self._np_random[i].random() for i in indices])

    def _listed(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + i for i in range(self.num_envs)]
        return list(seed)


def _told(discounts: np.ndarray, mask: np.ndarray) -> dict[str, np.ndarray]:
    """Discounts of some environments in Gymnasium's form of infos; empty if of none."""
    if not mask.any():
        return {}
    return {"discount": np.where(mask, discounts, 0.0), "_discount": mask}
