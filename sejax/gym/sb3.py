"""Many episodes of an SE as a `VecEnv` of Stable-Baselines3; the extra `sb3` is needed."""

from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from sejax.gym.gridworld import Info
from sejax.gym.synthetic import SyntheticEnv, SyntheticWorld
from sejax.gym.vector import SyntheticVectorEnv

Indices = int | Iterable[int] | None


class SyntheticVecEnv(VecEnv):
    """Episodes of an SE side by side; each step is one pass through its networks.

    As in Stable-Baselines3's own, an environment whose episode has ended begins the next one in
    the same step: `infos[i]["terminal_observation"]` is where the old one ended, and
    `infos[i]["TimeLimit.truncated"]` says whether it was merely cut. Environment i is that of
    `sejax.gym.make` after `reset(seed=seed + i)`.

    The environments are not objects. What `get_attr` and `env_method` ask for is that of one
    environment, which stands for all of them, and `set_attr` sets it for all.

    Args:
      world: of the SE.
      num_envs: number of environments.
    """

    def __init__(self, world: SyntheticWorld, num_envs: int):
        self._env = SyntheticEnv(world)  # what each environment is
        self._envs = SyntheticVectorEnv(world, num_envs, AutoresetMode.DISABLED)
        self._actions = np.zeros(0)  # which no space has
        super().__init__(num_envs, self._env.observation_space, self._env.action_space)

    def reset(self) -> np.ndarray:
        """First observations, `[num_envs, ...]`, with the seeds of the last call of `seed`."""
        obs, _ = self._envs.reset(seed=self._seeds)
        self._reset_seeds()
        self._reset_options()  # which have no effect
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Info]]:  # type: ignore[override]
        """Observations, rewards and ends, `[num_envs, ...]`, and an info for each environment."""
        obs, rewards, terminated, truncated, told = self._envs.step(self._actions)
        dones, cut = terminated | truncated, truncated & ~terminated
        infos: list[Info] = [
            {"discount": discount, "TimeLimit.truncated": is_cut}
            for discount, is_cut in zip(told["discount"].tolist(), cut.tolist(), strict=True)
        ]
        if dones.any():
            for i in np.flatnonzero(dones):
                infos[i]["terminal_observation"] = obs[i]
            obs, _ = self._envs.reset(options={"reset_mask": dones})
        return obs, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """There is nothing to close."""

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        return [getattr(self._env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Sets an attribute for all environments.

        Raises:
          NotImplementedError: for some of them.
        """
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise NotImplementedError(
                "environments share their attributes: set them with indices=None"
            )
        setattr(self._env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method of the environment that stands for them all, for each of them.

        Raises:
          NotImplementedError: for `reset` and `step`, which all environments do together.
        """
        if method_name in ("reset", "step"):
            raise NotImplementedError(f"environments {method_name} together: call it on the VecEnv")
        method = getattr(self._env, method_name)
        return [method(*method_args, **method_kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Indices = None
    ) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        return [None] * self.num_envs
