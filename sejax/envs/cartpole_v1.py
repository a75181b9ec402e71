"""CartPole-v1: Gymnasium's dynamics, 500 steps."""

from dataclasses import dataclass
from typing import ClassVar

from sejax.envs.base import Facts, Task


@dataclass(frozen=True, kw_only=True)
class CartPoleV1:
    """A pole on a cart, paid 1 for each step that it stands: `cartpole` with a longer episode.

    Source: Gymnasium's registry (episode length and reward threshold).
    """

    facts: ClassVar[Facts] = Facts("vector", "discrete", max_steps=500)

    def make(self) -> Task:
        from gymnax.environments.classic_control import cartpole

        return Task(
            name="cartpole_v1",
            env=cartpole.CartPole(),
            params=cartpole.EnvParams(),
            max_steps=self.facts.max_steps,
            solved_reward=475.0,
        )
