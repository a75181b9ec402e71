"""What the soft discount of the paper's SEs teaches, which does not cross Gymnasium's interface.

Fresh agents, as the SE was learned with, train on a soft SE (`results/soft_ses/`) with the discount
that its `info` says, and with 1 - terminated in its place, which is all that an agent written for
Gymnasium sees. Both are tested on the real task. Nothing else differs.
"""

import argparse
import copy
from pathlib import Path
from typing import Any

import common

from sejax.cli.runtime import configure_xla

TASKS = ("cartpole", "acrobot")
FOLDER = Path(__file__).parents[1] / "results/soft_ses"


def main() -> None:
    args = common.parse_args(__doc__, add_options)
    configure_xla(1)
    if args.quick:
        args.tasks, args.agents = args.tasks[:1], min(args.agents, 4)
    where = common.machine(("jax", "sejax"))
    result: dict[str, Any] = {task: returns_on(task, args.agents, args.seed) for task in args.tasks}
    rows = [[task, *map(show, both.values())] for task, both in result.items()]
    common.print_table(f"Return on the real task, {args.agents} agents: mean ± standard deviation",
                       ["soft SE", "with its discount", "without"], rows)  # fmt: skip
    common.finish("soft_discount", args, {"returns": result, "machine": where})


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--agents", type=int, default=20, help="fresh ones of each kind")


def show(returns: list[float]) -> str:
    import numpy as np

    return f"{np.mean(returns):.1f} ± {np.std(returns):.1f}"


def returns_on(task: str, num_agents: int, seed: int) -> dict[str, list[float]]:
    """Mean test returns of each agent, with the SE's discount and without."""
    import jax

    import sejax

    proxy = sejax.load_proxy(FOLDER / f"{task}.safetensors")
    agent = sejax.make_agent(proxy.learned_with("agent"), proxy.task)
    keys = jax.random.split(jax.random.key(seed), num_agents)

    def test(env: Any) -> list[float]:
        evaluate = sejax.make_evaluator(agent, env, proxy.task, sejax.training_of(proxy))
        one_by_one = jax.jit(
            lambda keys: jax.lax.map(lambda key: evaluate(key, proxy.params), keys)
        )
        return one_by_one(keys).test_returns.mean(axis=1).tolist()

    return {"with": test(proxy.env), "without": test(without_discount(proxy.env))}


def without_discount(env: Any) -> Any:
    """The same SE, whose `info` says of an episode's end what every agent sees."""

    class Blind(type(env)):  # type: ignore[misc]
        def step_env(self, *args: Any) -> Any:
            obs, state, reward, terminated, info = super().step_env(*args)
            return obs, state, reward, terminated, {**info, "discount": 1.0 - terminated}

    blind = copy.copy(env)
    blind.__class__ = Blind
    return blind


if __name__ == "__main__":
    main()
