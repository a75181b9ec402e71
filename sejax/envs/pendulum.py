"""Pendulum-v1: Gymnasium's dynamics, 200 steps."""

from dataclasses import dataclass
from typing import ClassVar

from sejax.envs.base import Facts, Task


@dataclass(frozen=True, kw_only=True)
class Pendulum:
    """A pendulum to be swung up and held, paid minus its distance from upright, speed and torque.

    The solved reward is our choice: neither the paper nor Gymnasium defines one.
    """

    facts: ClassVar[Facts] = Facts("vector", "continuous", max_steps=200)

    def make(self) -> Task:
        from gymnax.environments.classic_control import pendulum

        return Task(
            name="pendulum",
            env=pendulum.Pendulum(),
            params=pendulum.EnvParams(),
            max_steps=self.facts.max_steps,
            solved_reward=-250.0,
        )
