"""What a step of the MuJoCo tasks costs: sejax's, beside mjx, brax and Gymnasium.

Everything on one core, in CPU time: sejax's steps in a compiled loop, `gymnasium.make(...).step` in
a loop of Python, and on HalfCheetah the same task with brax's physics. All get the same actions,
sinusoids of another phase for each joint, and none is reset: what has fallen goes on lying. The
sides are measured in turn, so that they meet the same machine. Then the wall-clock time of the same
walks on one device and on two.
"""

import argparse
import os
from statistics import median
from typing import Any

import common
import numpy as np

TASKS = ("halfcheetah", "hopper", "walker2d", "swimmer", "inverted_pendulum", "ant", "reacher")
ON_HALFCHEETAH = ("mjx", "spring")
NUM_STEPS = {"mujoco": 2000, "gymnasium": 2000, "mjx": 500, "spring": 500}
WALKS = 16  # on one device and on two


def main() -> None:
    args = common.parse_args(__doc__, add_options)
    if args.side:
        {"gymnasium": serve_gymnasium, "devices": serve_devices}.get(args.side, serve_sejax)(args)
        return
    if args.quick:
        args.tasks, args.repeats = args.tasks[:1], min(args.repeats, 2)
    where = common.machine(("jax", "mujoco", "brax", "gymnasium", "sejax"))
    result: dict[str, Any] = {"tasks": {}, "machine": where}
    for task in args.tasks:
        names = ["mujoco", "gymnasium", *(ON_HALFCHEETAH if task == "halfcheetah" else ())]
        result["tasks"][task] = compare(task, names, args)
    result["devices"] = compare_devices(args)
    show(result)
    common.finish("mujoco_step", args, result)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--task", help=argparse.SUPPRESS)
    parser.add_argument("--repeats", type=int, default=5)
    common.add_core(parser)


def compare(task: str, names: list[str], args: argparse.Namespace) -> dict[str, Any]:
    """Microseconds of a step of each side, and how many times sejax's that is, in pairs."""
    with common.sides_of(__file__, names, task=task, core=args.core) as sides:
        compiled = {name: side.ready["compile_s"] for name, side in sides.items()}
        answers = common.in_turns(sides, [{}] * args.repeats)
    times = {name: [each["us"] for each in mine] for name, mine in answers.items()}
    return {
        name: {
            "us": common.spread(mine),
            "ratio": common.spread([b / a for a, b in zip(times["mujoco"], mine, strict=True)]),
            "compile_s": compiled[name],
        }
        for name, mine in times.items()
    }


def compare_devices(args: argparse.Namespace) -> dict[str, Any]:
    """Seconds of the same walks on one device and on two, and the ratio within pairs."""
    with common.sides_of(__file__, ["devices"], task="halfcheetah") as sides:
        pairs = common.in_turns(sides, [{}] * args.repeats)["devices"]
    ratios = [pair["one"] / pair["two"] for pair in pairs]
    return {
        "one_s": common.spread([pair["one"] for pair in pairs]),
        "two_s": common.spread([pair["two"] for pair in pairs]),
        "ratio": common.spread(ratios),
        "cores_used": median(pair["cores"] for pair in pairs),
    }


def show(result: dict[str, Any]) -> None:
    rows = [
        [f"{task}, {name}", common.show_spread(row["us"]), common.show_spread(row["ratio"]),
         "" if row["compile_s"] is None else f"{row['compile_s']:.1f}"]
        for task, sides in result["tasks"].items() for name, row in sides.items()
    ]  # fmt: skip
    columns = ["task, side", "µs a step", "times sejax's", "compile s"]
    common.print_table("CPU time of a step on one core, median (min to max)", columns, rows)
    devices = result["devices"]
    print(f"{WALKS} walks of halfcheetah on two devices: "
          f"{common.show_spread(devices['ratio'], 2)} times as fast as on one, with "
          f"{devices['cores_used']:.2f} cores in use")  # fmt: skip


def actions_of(num_steps: int, size: int, xp: Any = np) -> Any:
    """Torques `[num_steps, size]` in [-1, 1]."""
    steps, joints = xp.arange(num_steps)[:, None], xp.arange(size)
    return xp.sin(0.3 * steps + joints).astype(xp.float32)


def serve_gymnasium(args: argparse.Namespace) -> None:
    """The side of Gymnasium."""
    import gymnasium

    from sejax.gym import GYMNASIUM_IDS

    os.sched_setaffinity(0, {args.core})
    env = gymnasium.make(GYMNASIUM_IDS[args.task])
    env.reset(seed=args.seed)
    actions = actions_of(NUM_STEPS["gymnasium"], env.action_space.shape[0])  # type: ignore[index]

    def walk() -> None:
        for action in actions:
            env.step(action)

    def handle(_: dict[str, Any]) -> dict[str, Any]:
        return {"us": common.measure(walk)[1]["cpu_s"] / len(actions) * 1e6}

    common.serve({"compile_s": None}, handle)


def serve_sejax(args: argparse.Namespace) -> None:
    """The side of one of sejax's physics."""
    os.sched_setaffinity(0, {args.core})
    from sejax.runs.runtime import configure_xla

    configure_xla(1)
    import jax

    from sejax import envs

    options = {} if args.side == "mujoco" else {"backend": args.side}
    task, num_steps = envs.make(args.task, **options), NUM_STEPS[args.side]
    key = jax.random.key(args.seed)
    walk, used = common.measure(lambda: jax.jit(walk_of(task, num_steps)).lower(key).compile())

    def handle(_: dict[str, Any]) -> dict[str, Any]:
        _, used = common.measure(lambda: jax.block_until_ready(walk(key)))
        return {"us": used["cpu_s"] / num_steps * 1e6}

    common.serve({"compile_s": used["cpu_s"]}, handle)


def serve_devices(args: argparse.Namespace) -> None:
    """The side that has two devices."""
    from sejax.runs.runtime import configure_xla

    configure_xla(2)
    import jax

    from sejax import envs
    from sejax.ops.parallel import spread_over_devices

    walk = walk_of(envs.make(args.task), NUM_STEPS["mujoco"])
    keys = jax.random.split(jax.random.key(args.seed), WALKS)
    one, two = (jax.jit(spread_over_devices(walk, count, 1)).lower(keys).compile()
                for count in (1, 2))  # fmt: skip

    def handle(_: dict[str, Any]) -> dict[str, Any]:
        _, alone = common.measure(lambda: jax.block_until_ready(one(keys)))
        _, together = common.measure(lambda: jax.block_until_ready(two(keys)))
        return {"one": alone["wall_s"], "two": together["wall_s"],
                "cores": together["cpu_s"] / together["wall_s"]}  # fmt: skip

    common.serve({}, handle)


def walk_of(task: Any, num_steps: int) -> Any:
    """A function of a key: the return of a walk."""
    import jax
    import jax.numpy as jnp

    def walk(key: Any) -> Any:
        _, state = task.env.reset_env(key, task.params)

        def step(state: Any, action: Any) -> Any:
            _, state, reward, _, _ = task.env.step_env(None, state, action, task.params)
            return state, reward

        return jax.lax.scan(step, state, actions_of(num_steps, task.action_dim, jnp))[1].sum()

    return walk


if __name__ == "__main__":
    main()
