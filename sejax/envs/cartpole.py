"""CartPole-v0: Gymnasium's dynamics, 200 steps."""

from dataclasses import dataclass
from typing import ClassVar

from sejax.envs.base import Facts, Task


@dataclass(frozen=True, kw_only=True)
class CartPole:
    """A pole on a cart, paid 1 for each step that it stands.

    Source: paper, appendix, fixed hyperparameters (episode length and solved reward).
    """

    facts: ClassVar[Facts] = Facts("vector", "discrete", max_steps=200)

    def make(self) -> Task:
        from gymnax.environments.classic_control import cartpole

        return Task(
            name="cartpole",
            env=cartpole.CartPole(),
            params=cartpole.EnvParams(),
            max_steps=self.facts.max_steps,
            solved_reward=195.0,
        )
