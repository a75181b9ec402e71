"""An objective of one's own: the mean test return, less the deviation between test episodes.

    python own_objective.py
    python -m sejax.run env=cartpole objective=own_objective:RiskAverse    # in this folder

The script learns one proxy by the mean test return and one by its own, 75 seconds on four cores:

    MaxReward: mean return 198, deviation between an agent's episodes 2.1
    RiskAverse: mean return 191, deviation between an agent's episodes 4.2

An objective maps what came of trainings, a `sejax.Outcome`, to scores; higher ones are better.
"""

import argparse
from dataclasses import dataclass
from typing import ClassVar

import jax

import sejax
from sejax.options import NonNegative, Options


@dataclass(frozen=True, kw_only=True)
class RiskAverse(Options):
    """An agent's mean test return minus some of the deviation between its test episodes."""

    group: ClassVar[str] = "objective"

    aversion: NonNegative = 1.0

    def make(self, task: sejax.Task) -> sejax.Objective:
        def score(outcome: sejax.Outcome) -> jax.Array:
            returns = outcome.test_returns  # [agent, episode]
            return returns.mean(axis=-1) - self.aversion * returns.std(axis=-1)

        return sejax.Objective(score=score, meaning="a mean return minus its deviation")


def main() -> None:
    parser = argparse.ArgumentParser(description="Learns CartPole SEs by two objectives.")
    parser.add_argument("--generations", type=int, default=12)
    parser.add_argument("--population", type=int, default=64)
    parser.add_argument("--steps", type=int, default=2000, help="of each training")
    parser.add_argument("--agents", type=int, default=64, help="trained on each of the two")
    args = parser.parse_args()
    sejax.configure_xla()  # a device for each core
    config = sejax.config(["env=cartpole", f"es.population_size={args.population}",
                           f"training.max_steps={args.steps}",
                           f"training.max_episodes={args.steps}"])  # fmt: skip
    for objective in (sejax.MaxReward(), RiskAverse(aversion=1.0)):
        parts = {**config.parts(), "objective": objective}
        learn = sejax.make_learner(**parts, generations=args.generations)
        proxy, agent, task = parts["proxy"], parts["agent"], parts["task"]
        params = proxy.params(jax.jit(learn)(jax.random.key(0)).weights)
        keys = jax.random.split(jax.random.key(1), args.agents)
        outcome = sejax.evaluate_agents(agent, proxy, params, task, parts["training"], keys)
        deviation = outcome.test_returns.std(axis=-1).mean()
        print(f"{type(objective).__name__}: mean return {outcome.test_return.mean():.0f}, "
              f"deviation between an agent's episodes {deviation:.1f}")  # fmt: skip


if __name__ == "__main__":
    main()
