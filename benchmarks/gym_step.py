"""What a step costs from Python: sejax's NumPy environments, gymnax's wrapper, Gymnasium's own.

Everything on one core, in CPU time of the process. Each side is a loop as an agent has it: a step
with an action drawn beforehand, and a reset where the episode has ended. An SE of one step begins
an episode with every one; the soft SE has long episodes. gymnax's wrapper is around the same SE
from `sejax.load`; its step is compiled and begins episodes by itself. The sides are measured in
turn, so that they meet the same machine.
"""

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import common
import numpy as np

SOFT = Path(__file__).parents[1] / "results/soft_ses/cartpole.safetensors"
ONE_STEP = "cartpole"
NUM_ENVS = 256
NUM_STEPS = {"one": 3000, "batch": 60, "jax": 600, "jax batch": 60}  # calls of `step` in a row
SIDES = {
    "numpy": "sejax.gym.make, an SE of one step",
    "numpy-soft": "sejax.gym.make, the soft SE",
    "numpy-rn": "sejax.gym.make, cartpole-rn",
    "numpy-batch": f"sejax.gym.make_vec, {NUM_ENVS} environments, an SE of one step",
    "numpy-batch-soft": f"sejax.gym.make_vec, {NUM_ENVS} environments, the soft SE",
    "gymnax": "gymnax's wrapper, an SE of one step",
    "gymnax-batch": f"gymnax's vector wrapper, {NUM_ENVS} environments, an SE of one step",
    "CartPole-v1": "Gymnasium's CartPole-v1",
    "Acrobot-v1": "Gymnasium's Acrobot-v1",
}


def main() -> None:
    args = common.parse_args(__doc__, add_options)
    if args.side:
        serve(args)
        return
    repeats = min(args.repeats, 3) if args.quick else args.repeats
    where = common.machine(("jax", "gymnasium", "gymnax", "numpy", "sejax"))
    with common.sides_of(__file__, [*SIDES], core=args.core, seed=args.seed) as sides:
        answers = common.in_turns(sides, [{}] * repeats)
    us = {name: common.spread([each["us"] for each in mine]) for name, mine in answers.items()}
    rows = [[SIDES[name], common.show_spread(values, 2)] for name, values in us.items()]
    title = "CPU time of a step of one environment, median (min to max)"
    common.print_table(title, ["side", "µs"], rows)
    common.finish("gym_step", args, {"us": us, "machine": where})


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--repeats", type=int, default=15)
    common.add_core(parser)


def serve(args: argparse.Namespace) -> None:
    """A side."""
    os.sched_setaffinity(0, {args.core})
    walk, num_steps = (walk_many if "batch" in args.side else walk_alone)(args.side, args.seed)

    def handle(_: dict[str, Any]) -> dict[str, Any]:
        return {"us": common.measure(walk)[1]["cpu_s"] / num_steps * 1e6}

    common.serve({}, handle)


def walk_alone(side: str, seed: int) -> tuple[Callable[[], None], int]:
    """A function that makes some steps in one environment, and how many."""
    env = make_gymnax() if side == "gymnax" else make_env(side)
    num_steps = NUM_STEPS["jax" if side == "gymnax" else "one"]
    env.reset(seed=seed)
    env.action_space.seed(seed)
    actions = [env.action_space.sample() for _ in range(num_steps)]
    begins_alone = side == "gymnax"

    def walk() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if not begins_alone and (terminated or truncated):
                env.reset()

    return walk, num_steps


def walk_many(side: str, seed: int) -> tuple[Callable[[], None], int]:
    """Likewise in many, which begin their episodes by themselves; steps of all of them."""
    envs: Any
    if side == "gymnax-batch":
        envs, num_steps = make_gymnax(NUM_ENVS), NUM_STEPS["jax batch"]
    else:
        import sejax.gym

        source = SOFT if side.endswith("soft") else ONE_STEP
        envs = sejax.gym.make_vec(source, NUM_ENVS, autoreset_mode="SameStep")
        num_steps = NUM_STEPS["batch"]
    envs.reset(seed=seed)
    actions = np.random.default_rng(seed).integers(2, size=(num_steps, NUM_ENVS))

    def walk() -> None:
        for action in actions:
            obs, *_ = envs.step(action)
        np.asarray(obs)  # JAX may not have finished

    return walk, num_steps * NUM_ENVS


def make_env(side: str) -> Any:
    import gymnasium

    import sejax.gym

    if not side.startswith("numpy"):
        return gymnasium.make(side)
    sources: dict[str, Path | str] = {
        "numpy": ONE_STEP, "numpy-soft": SOFT, "numpy-rn": "cartpole-rn"
    }  # fmt: skip
    return sejax.gym.make(sources[side])


def make_gymnax(num_envs: int | None = None) -> Any:
    """gymnax's wrapper for Gymnasium around the SE in JAX."""
    from sejax.runs.runtime import configure_xla

    configure_xla(1)
    from gymnax.wrappers import gym

    import sejax

    env, params = sejax.load(ONE_STEP)
    if num_envs is None:
        return gym.GymnaxToGymWrapper(env, params)
    return gym.GymnaxToVectorGymWrapper(env, num_envs, params)


if __name__ == "__main__":
    main()
