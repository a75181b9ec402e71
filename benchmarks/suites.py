"""Agent steps a CPU second in environments of other JAX suites, through `env=stoa/SUITE/ID`.

PPO agents side by side, as `sejax.make_trainer` trains them; the second call is timed. Suites that
are not installed are left out: `pip install 'sejax[stoa]' brax craftax jumanji navix pgx playground
xminigrid`.

    python benchmarks/suites.py
    python benchmarks/suites.py navix/Navix-DoorKey-5x5-v0 brax/inverted_pendulum
"""

import argparse
from typing import Any

import common
import jax

import sejax
from sejax.training import TrainingConfig, make_trainer

NAMES = (
    *("navix/Navix-Empty-5x5-v0", "navix/Navix-DoorKey-5x5-v0", "xminigrid/MiniGrid-Empty-5x5"),
    *("jumanji/Maze-v0", "jumanji/Game2048-v1", "jumanji/Snake-v1", "pgx/2048"),
    *("pgx/minatar-breakout", "pgx/minatar-asterix", "brax/inverted_pendulum"),
    *("playground/CartpoleBalance", "craftax/Craftax-Classic-Symbolic-v1"),
)


def main() -> None:
    args = common.parse_args(__doc__, add_options)
    names = args.names or (NAMES[:1] if args.quick else NAMES)
    rows = [{"name": name} | measured(name, args) for name in names]
    columns = ["env=stoa/", "observation", "actions", "most steps", "agent steps / CPU s"]
    common.print_table(
        f"PPO, {args.agents} agents side by side", columns,
        [[row["name"], *([row["left_out"]] if "left_out" in row else [
            row["obs_dim"], row["actions"], row["max_steps"], f"{row['steps_per_cpu_s']:,.0f}"
        ])] for row in rows],
    )  # fmt: skip
    machine = common.machine(("jax", "sejax"))
    common.finish("suites", args, {"machine": machine, "agents": args.agents, "rows": rows})


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("names", nargs="*", metavar="SUITE/ID")
    parser.add_argument("--agents", type=int, default=4)
    parser.add_argument("--steps", type=int, default=512, help="of each agent")


def measured(name: str, args: argparse.Namespace) -> dict[str, Any]:
    """Spaces, limit and speed; or why there is none."""
    try:
        task = sejax.envs.make(f"stoa/{name}")
    except sejax.ConfigError as error:
        return {"left_out": str(error).partition(";")[0]}
    agent = sejax.make_agent(sejax.PPOConfig(), task)
    training = TrainingConfig(max_steps=args.steps, max_episodes=args.steps, stop_rule="never")
    train = jax.jit(jax.vmap(make_trainer(agent, task.env, training), (0, None)))
    keys = jax.random.split(jax.random.key(args.seed), args.agents)
    jax.block_until_ready(train(keys, task.params))
    result, times = common.measure(lambda: jax.block_until_ready(train(keys, task.params)))
    discrete = task.num_actions is not None
    return {
        "obs_dim": task.obs_dim,
        "actions": task.num_actions if discrete else f"{task.action_dim} numbers",
        "max_steps": task.max_steps,
        "steps_per_cpu_s": int(result.train_steps.sum()) / times["cpu_s"],
    }


if __name__ == "__main__":
    main()
