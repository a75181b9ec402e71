"""Acrobot-v1: Gymnasium's dynamics, 500 steps."""

from dataclasses import dataclass
from typing import ClassVar

from sejax.envs.base import Facts, Task


@dataclass(frozen=True, kw_only=True)
class Acrobot:
    """A double pendulum that is to swing its tip above a line, paid -1 a step until it does.

    Source: paper, appendix, fixed hyperparameters (episode length and solved reward).
    """

    facts: ClassVar[Facts] = Facts("vector", "discrete", max_steps=500)

    def make(self) -> Task:
        from gymnax.environments.classic_control import acrobot

        return Task(
            name="acrobot",
            env=acrobot.Acrobot(),
            params=acrobot.EnvParams(),
            max_steps=self.facts.max_steps,
            solved_reward=-100.0,
        )
