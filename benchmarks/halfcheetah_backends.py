"""Which of brax's physics to use for HalfCheetah: what a step costs, and how like MuJoCo it is.

The task of the paper runs on MuJoCo, which moves one body at a time on one core. Here every backend
of brax is timed, as one cheetah and as 32 in parallel, and is given the same gaits as MuJoCo
itself: sinusoidal torques of several frequencies and phases, and random ones, from rest. Their
returns say whether what runs in MuJoCo runs there. MuJoCo's own model is Gymnasium's
`half_cheetah.xml`.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import common
import numpy as np

from sejax.envs.mujoco.tasks import BACKENDS

BRAX = BACKENDS[1:]  # the first is MuJoCo itself
GAIT_STEPS = 200
DT = 0.05  # seconds of a control step: five physics steps of 0.01
MUJOCO_FRAMES = 5
NUM_JOINTS = 6
NUM_PARALLEL = 32


def main() -> None:
    args = common.parse_args(__doc__, add_options)
    if args.side:
        serve_backend(args)
        return
    if args.quick:
        args.backends, args.gaits = args.backends[:1], min(args.gaits, 8)
    actions = gaits(args.gaits, args.seed)
    mujoco_us, expected = mujoco_returns(actions)
    mujoco = {"step_us": mujoco_us, "lanes_us": None, "compile_s": None}
    rows = [{"physics": "MuJoCo", **mujoco, **compare(expected, expected)}]
    for backend in args.backends:
        options = {"gaits": args.gaits, "seed": args.seed}
        with common.sides_of(__file__, [backend], **options) as sides:
            measured = sides[backend].ask()
        returns = np.array(measured.pop("returns"))
        rows.append({"physics": backend, **measured, **compare(returns, expected)})
    columns = ["physics", "µs a step", f"{NUM_PARALLEL} in parallel", "compile s", "mean return",
               "correlation", "mean difference"]  # fmt: skip
    cells = [
        [row["physics"], *(_number(row[key]) for key in ("step_us", "lanes_us", "compile_s")),
         f"{row['mean_return']:.0f}", f"{row['correlation']:.2f}", f"{row['mean_difference']:.0f}"]
        for row in rows
    ]  # fmt: skip
    title = "HalfCheetah on one core: returns of gaits, and how they go with MuJoCo's"
    common.print_table(title, columns, cells)
    common.finish("halfcheetah_backends", args, {"rows": rows})


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--backends", nargs="+", default=list(BRAX))
    parser.add_argument("--gaits", type=int, default=24)


def compare(returns: np.ndarray, expected: np.ndarray) -> dict[str, float]:
    """How the gaits' returns go with those in MuJoCo."""
    return {
        "mean_return": float(returns.mean()),
        "correlation": float(np.corrcoef(returns, expected)[0, 1]),
        "mean_difference": float(np.abs(returns - expected).mean()),
    }


def _number(value: Any) -> str:
    return "" if value is None else f"{value:,.0f}"


def gaits(count: int, seed: int) -> np.ndarray:
    """Torques `[gait, step, joint]`: sinusoids of 1 to 4 Hz, and one in four of noise."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(GAIT_STEPS)[:, None] * DT
    out = []
    for index in range(count):
        frequency, amplitude = rng.uniform(1, 4), rng.uniform(0.3, 1, NUM_JOINTS)
        phase = rng.uniform(0, 2 * np.pi, NUM_JOINTS)
        wave = amplitude * np.sin(2 * np.pi * frequency * seconds + phase)
        noise = rng.uniform(-1, 1, (GAIT_STEPS, NUM_JOINTS))
        out.append(noise if index % 4 == 3 else wave)
    return np.array(out, np.float32)


def mujoco_returns(actions: np.ndarray) -> tuple[float, np.ndarray]:
    """Microseconds of a step, and the return of each gait, in MuJoCo."""
    import gymnasium
    import mujoco

    folder = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
    model = mujoco.MjModel.from_xml_path(str(folder / "half_cheetah.xml"))
    returns = np.zeros(len(actions))
    started = time.process_time()
    for index, gait in enumerate(actions):
        data = mujoco.MjData(model)
        for torques in gait:
            before, data.ctrl[:] = data.qpos[0], torques
            mujoco.mj_step(model, data, MUJOCO_FRAMES)
            returns[index] += (data.qpos[0] - before) / DT - 0.1 * np.sum(torques**2)
    steps = actions.shape[0] * actions.shape[1]
    return (time.process_time() - started) / steps * 1e6, returns


def serve_backend(args: argparse.Namespace) -> None:
    """The side of one backend, on one core."""
    from sejax.cli.runtime import configure_xla

    configure_xla(1)
    import jax
    import jax.numpy as jnp

    from sejax import envs

    task = envs.make("halfcheetah", backend=args.side)
    actions = jnp.asarray(gaits(args.gaits, args.seed))
    many_actions = jnp.resize(actions, (NUM_PARALLEL, *actions.shape[1:]))
    state, key = at_rest_state(task.env), jax.random.key(0)  # which has no effect

    def play(gait: Any) -> Any:
        def step(state: Any, torques: Any) -> Any:
            _, state, reward, _, _ = task.env.step_env(key, state, torques, task.params)
            return state, reward

        return jax.lax.scan(step, state, gait)[1].sum()

    def handle(_: dict[str, Any]) -> dict[str, Any]:
        one, compiling = common.measure(lambda: jax.jit(play).lower(actions[0]).compile())
        many = jax.jit(jax.vmap(play)).lower(many_actions).compile()
        returns, used = common.measure(lambda: [float(one(gait)) for gait in actions])
        _, together = common.measure(lambda: jax.block_until_ready(many(many_actions)))
        return {
            "step_us": used["cpu_s"] / (args.gaits * GAIT_STEPS) * 1e6,
            "lanes_us": together["cpu_s"] / (NUM_PARALLEL * GAIT_STEPS) * 1e6,
            "compile_s": compiling["cpu_s"], "returns": returns,
        }  # fmt: skip

    common.serve({}, handle)


def at_rest_state(env: Any) -> Any:
    """The cheetah in its model's own pose, without the noise of a reset."""
    import jax.numpy as jnp

    from sejax.envs.mujoco.brax import CheetahState

    system = env._brax.sys
    physics = env._brax.pipeline_init(system.init_q, jnp.zeros(system.qd_size()))
    return CheetahState(physics=physics, time=jnp.int32(0))


if __name__ == "__main__":
    main()
