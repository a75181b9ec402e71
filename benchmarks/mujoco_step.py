"""What a step of the MuJoCo tasks costs: sejax's, beside Gymnasium's and, on HalfCheetah, brax's.

All on one core, in CPU time: sejax's steps in a compiled loop, `gymnasium.make(...).step` in a
loop of Python, Gymnasium's `SyncVectorEnv`, for each of its environments, and the physics of mjx
and of brax's spring in a compiled loop. They get the same
actions, sinusoids of another phase for each joint. The vector environment resets what has fallen;
elsewhere it goes on lying. They are measured in turn, so that they meet the same machine.
"""

import argparse
import os
from typing import Any

import common
import numpy as np

TASKS = ("halfcheetah", "hopper", "walker2d", "swimmer", "inverted_pendulum", "ant", "reacher")
SIDES = ("mujoco", "gymnasium", "vector")
ON_HALFCHEETAH = ("mjx", "spring")
NUM_ENVS = 16  # of the vector environment
NUM_STEPS = 2000


def main() -> None:
    args = common.parse_args(__doc__, add_options)
    if args.side:
        {"gymnasium": serve_gymnasium, "vector": serve_gymnasium}.get(args.side, serve_sejax)(args)
        return
    if args.quick:
        args.tasks, args.repeats = args.tasks[:1], min(args.repeats, 2)
    where = common.machine(("jax", "mujoco", "brax", "gymnasium", "sejax"))
    result: dict[str, Any] = {"tasks": {}, "machine": where}
    for task in args.tasks:
        result["tasks"][task] = compare(task, args)
    show(result)
    common.finish("mujoco_step", args, result)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--task", help=argparse.SUPPRESS)
    parser.add_argument("--repeats", type=int, default=5)
    common.add_core(parser)


def compare(task: str, args: argparse.Namespace) -> dict[str, Any]:
    """Microseconds of a step of each side, and how many times sejax's that is, in pairs."""
    names = (*SIDES, *(ON_HALFCHEETAH if task == "halfcheetah" else ()))
    with common.sides_of(__file__, names, task=task, core=args.core) as sides:
        compiled = {name: side.ready["compile_s"] for name, side in sides.items()}
        answers = common.in_turns(sides, [{}] * args.repeats)
    times = {name: [answer["us"] for answer in x] for name, x in answers.items()}
    return {
        name: {
            "us": common.spread(us),
            "ratio": common.spread([b / a for a, b in zip(times["mujoco"], us, strict=True)]),
            "compile_s": compiled[name],
        }
        for name, us in times.items()
    }


def show(result: dict[str, Any]) -> None:
    rows = [
        [f"{task}, {name}", common.show_spread(row["us"]), common.show_spread(row["ratio"]),
         "" if row["compile_s"] is None else f"{row['compile_s']:.1f}"]
        for task, sides in result["tasks"].items() for name, row in sides.items()
    ]  # fmt: skip
    columns = ["task, side", "µs a step", "times sejax's", "compile s"]
    common.print_table("CPU time of a step on one core, median (min to max)", columns, rows)


def actions_of(num_steps: int, size: int, xp: Any = np) -> Any:
    """Torques `[num_steps, size]` in [-1, 1]."""
    steps, joints = xp.arange(num_steps)[:, None], xp.arange(size)
    return xp.sin(0.3 * steps + joints).astype(xp.float32)


def serve_gymnasium(args: argparse.Namespace) -> None:
    """The sides of Gymnasium."""
    import gymnasium

    from sejax.gym import GYMNASIUM_IDS

    os.sched_setaffinity(0, {args.core})
    name = GYMNASIUM_IDS[args.task]
    env: Any = gymnasium.make(name)
    actions = actions_of(NUM_STEPS, env.action_space.shape[0])
    if args.side == "vector":
        env = gymnasium.make_vec(name, NUM_ENVS, "sync")
        actions = np.repeat(actions[: NUM_STEPS // NUM_ENVS, None], NUM_ENVS, axis=1)
    env.reset(seed=args.seed)

    def walk() -> None:
        for action in actions:
            env.step(action)

    def handle(_: dict[str, Any]) -> dict[str, Any]:
        return {"us": common.measure(walk)[1]["cpu_s"] / NUM_STEPS * 1e6}

    common.serve({"compile_s": None}, handle)


def serve_sejax(args: argparse.Namespace) -> None:
    """The side of one of sejax's physics."""
    os.sched_setaffinity(0, {args.core})
    from sejax.runs.runtime import configure_xla

    configure_xla(1)
    import jax

    from sejax import envs

    options = {} if args.side == "mujoco" else {"backend": args.side}
    key, task = jax.random.key(args.seed), envs.make(args.task, **options)
    walk_once = jax.jit(walk_of(task))
    walk, used = common.measure(lambda: walk_once.lower(key).compile())

    def handle(_: dict[str, Any]) -> dict[str, Any]:
        _, used = common.measure(lambda: jax.block_until_ready(walk(key)))
        return {"us": used["cpu_s"] / NUM_STEPS * 1e6}

    common.serve({"compile_s": used["cpu_s"]}, handle)


def walk_of(task: Any) -> Any:
    """A function of a key: the return of a walk."""
    import jax
    import jax.numpy as jnp

    def walk(key: Any) -> Any:
        _, state = task.env.reset_env(key, task.params)

        def step(state: Any, action: Any) -> Any:
            _, state, reward, _, _ = task.env.step_env(None, state, action, task.params)
            return state, reward

        return jax.lax.scan(step, state, actions_of(NUM_STEPS, task.action_dim, jnp))[1].sum()

    return walk


if __name__ == "__main__":
    main()
