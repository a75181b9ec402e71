"""Many episodes of an SE as a `VecEnv` of Stable-Baselines3; the extra `sb3` is needed."""

from functools import partial

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

from sejax.gym.synthetic import SyntheticGymEnv, SyntheticVectorEnv, SyntheticWorld
from sejax.gym.tasks import Info


class SyntheticVecEnv(DummyVecEnv):
    """Episodes of an SE side by side; each step is one pass through its networks.

    As in Stable-Baselines3's own, an environment whose episode has ended begins the next one in
    the same step. `infos[i]["terminal_observation"]` is the last observation of the old episode,
    and `infos[i]["TimeLimit.truncated"]` says whether its time limit cut it. Environment i equals
    that of `sejax.gym.make` after `reset(seed=seed + i)`.

    `get_attr`, `set_attr` and `env_method` reach other environments, which take no steps.

    Args:
      world: the SE's world.
      num_envs: number of environments.
    """

    def __init__(self, world: SyntheticWorld, num_envs: int):
        super().__init__([partial(SyntheticGymEnv, world)] * num_envs)
        self._episodes = SyntheticVectorEnv(world, num_envs)

    def reset(self) -> np.ndarray:
        """First observations, `[num_envs, ...]`, with the seeds of the last call of `seed`."""
        obs, _ = self._episodes.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()  # options have no effect
        return obs

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Info]]:  # type: ignore[override]
        """Observations, rewards and ends, `[num_envs, ...]`, and an info for each environment."""
        rewards, terminated, truncated, discounts = self._episodes.advance(self.actions)
        dones = terminated | truncated
        cut = truncated & ~terminated
        infos: list[Info] = [
            {"discount": discount, "TimeLimit.truncated": is_cut}
            for discount, is_cut in zip(discounts.tolist(), cut.tolist(), strict=True)
        ]
        last = self._episodes.observe()
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = last[i]
        self._episodes.begin(dones)
        return self._episodes.observe(), rewards.astype(np.float32), dones, infos
