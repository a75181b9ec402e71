"""Any environment that gymnax knows, by its id: `env=gymnax/MountainCar-v0`.

Its spaces are known only when it is made: there is no `spec`.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

from sejax.envs.base import Task
from sejax.options import Count, Options, foreign_code, unknown_name

PREFIX = "gymnax/"
# Gymnasium's registry defines when these count as solved; it has no threshold for the others.
SOLVED_REWARD = {
    "CartPole-v1": 475.0,
    "Acrobot-v1": -100.0,
    "MountainCar-v0": -110.0,
    "MountainCarContinuous-v0": 90.0,
    "FrozenLake-misc": 0.7,
}


@dataclass(frozen=True, kw_only=True)
class GymnaxTask(Options):
    """An environment of gymnax, or one that another package has registered there.

    Attributes:
      solved_reward: mean return that counts as solved; null: Gymnasium's, with gymnax's step limit
      max_steps: step limit; null: gymnax's

    Raises:
      ConfigError: when it is made, for an id that gymnax does not know or cannot make.
    """

    group: ClassVar[str] = "env"

    name: str = f"{PREFIX}CartPole-v1"
    solved_reward: float | None = None
    max_steps: Count | None = None

    def make(self) -> Task:
        import gymnax
        from gymnax.registration import registered_envs

        gymnax_id = self.name.removeprefix(PREFIX)
        if gymnax_id not in registered_envs:
            raise unknown_name("env", self.name, [PREFIX + x for x in registered_envs])
        # It raises for a data set that cannot be fetched.
        with foreign_code("env", f"must be one that gymnax makes; {gymnax_id}"):
            env, params = gymnax.make(gymnax_id)
        max_steps = self.max_steps or params.max_steps_in_episode
        solved_reward = self.solved_reward
        if solved_reward is None:
            is_usual = max_steps == params.max_steps_in_episode
            solved_reward = SOLVED_REWARD.get(gymnax_id, math.inf) if is_usual else math.inf
        return Task(name=self.name, env=env, solved_reward=solved_reward, max_steps=max_steps)
