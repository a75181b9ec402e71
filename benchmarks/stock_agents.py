"""Agents that others wrote, with settings that others tuned, trained on an SE as it ships.

Stable-Baselines3's PPO, A2C, DQN, SAC and TD3 with RL Zoo's hyperparameters learn on an SE, which
they see as a plain `gymnasium.Env` (`sejax.gym.make`), and for comparison on the real task; each is
tested greedily on Gymnasium's real task. No agent of sejax and no JAX is involved.

An agent trains once, for the largest number of steps asked for, and is tested on the way: after n
steps it is the agent as the last update left it that had seen at most n. Schedules over a training
(learning rates, exploration) span that training. With `--real-steps` real agents train on with the
zoo's own schedules, to see after how many steps they are as good as those that the SE taught. Tests
are kept in `--rows`, and none is made again.

It needs Stable-Baselines3 beside sejax, `pip install 'sejax[bench]'`:

    python benchmarks/stock_agents.py cartpole cartpole --steps 1000,2500 --real-steps 50000

An agent in capitals has the library's own defaults in place of RL Zoo's, here on the SE alone:

    python benchmarks/stock_agents.py hopper hopper-distilled --agents SAC,PPO --alone
"""

import argparse
import ast
import itertools
import math
import multiprocessing
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import common
import gymnasium
import numpy as np
import pandas as pd
import stable_baselines3 as sb3
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import VecNormalize

import sejax.gym
from sejax.ops.files import write_text

TASKS = {  # id in Gymnasium, and the step limit
    "cartpole": ("CartPole-v1", 200),  # which is CartPole-v0
    "cartpole_v1": ("CartPole-v1", 500),
    "acrobot": ("Acrobot-v1", 500),
    "mountain_car": ("MountainCar-v0", 200),
    "mountain_car_continuous": ("MountainCarContinuous-v0", 999),
    "pendulum": ("Pendulum-v1", 200),
    "halfcheetah": ("HalfCheetah-v5", 1000),
    "hopper": ("Hopper-v5", 1000),
    "swimmer": ("Swimmer-v5", 1000),
    "walker2d": ("Walker2d-v5", 1000),
}
ALGORITHMS = {"ppo": sb3.PPO, "a2c": sb3.A2C, "dqn": sb3.DQN, "sac": sb3.SAC, "td3": sb3.TD3}
REAL = "the real task"
FIRST_TEST_SEED = 10_000  # of test episodes, the same for all agents


@dataclass(frozen=True)
class Zoo:
    """An entry of RL Zoo's files.

    Attributes:
      total_steps: `n_timesteps`: how long it is meant to train.
      num_envs: how many copies of the world it acts in at once.
      normalize: whether observations and rewards are scaled by running statistics.
      noise: of the actions of TD3, its kind and standard deviation.
      hparams: all others, as Stable-Baselines3 takes them.
    """

    total_steps: float
    num_envs: int = 1
    normalize: bool = False
    noise: tuple[str, float] | None = None
    hparams: dict[str, Any] = field(default_factory=dict)


def linear(initial: float) -> Callable[[float], float]:
    """The zoo's `lin_x`: from `initial` to 0 over a training."""
    return lambda progress_remaining: progress_remaining * initial


# Source: hyperparams/{ppo,a2c,dqn,sac,td3}.yml of https://github.com/DLR-RM/rl-baselines3-zoo, at
# 00128b5 (ppo, sac), c6c209e (a2c), ce95481 (dqn) and a02f4fb (td3, there for Pendulum-v0). Of
# HalfCheetah they have v4 (ppo, 208b6fd) and v3 (sac).
WIDE: dict[str, Any] = {"net_arch": [256, 256]}
ZOO = {
    ("ppo", "CartPole-v1"): Zoo(1e5, num_envs=8, hparams=dict(
        n_steps=32, batch_size=256, gae_lambda=0.8, gamma=0.98, n_epochs=20, ent_coef=0.0,
        learning_rate=linear(0.001), clip_range=linear(0.2))),
    ("ppo", "Acrobot-v1"): Zoo(1e6, num_envs=16, normalize=True, hparams=dict(
        n_steps=256, gae_lambda=0.94, gamma=0.99, n_epochs=4, ent_coef=0.0)),
    ("ppo", "MountainCar-v0"): Zoo(1e6, num_envs=16, normalize=True, hparams=dict(
        n_steps=16, gae_lambda=0.98, gamma=0.99, n_epochs=4, ent_coef=0.0)),
    ("ppo", "MountainCarContinuous-v0"): Zoo(2e4, normalize=True, hparams=dict(
        batch_size=256, n_steps=8, gamma=0.9999, learning_rate=7.77e-5, ent_coef=0.00429,
        clip_range=0.1, n_epochs=10, gae_lambda=0.9, max_grad_norm=5, vf_coef=0.19, use_sde=True,
        policy_kwargs=dict(log_std_init=-3.29, ortho_init=False))),
    ("ppo", "Pendulum-v1"): Zoo(1e5, num_envs=4, hparams=dict(
        n_steps=1024, gae_lambda=0.95, gamma=0.9, n_epochs=10, ent_coef=0.0, learning_rate=1e-3,
        clip_range=0.2, use_sde=True, sde_sample_freq=4)),
    ("ppo", "HalfCheetah-v5"): Zoo(1e6, normalize=True, hparams=dict(
        n_steps=512, batch_size=64, gae_lambda=0.92, gamma=0.98, n_epochs=20, ent_coef=0.000401762,
        learning_rate=2.0633e-5, clip_range=0.1, max_grad_norm=0.8, vf_coef=0.58096,
        policy_kwargs=dict(log_std_init=-2, ortho_init=False, activation_fn=torch.nn.ReLU,
                           net_arch=dict(pi=[256, 256], vf=[256, 256])))),
    ("a2c", "CartPole-v1"): Zoo(5e5, num_envs=8, hparams=dict(ent_coef=0.0)),
    ("a2c", "Acrobot-v1"): Zoo(5e5, num_envs=16, normalize=True, hparams=dict(ent_coef=0.0)),
    ("a2c", "MountainCar-v0"): Zoo(1e6, num_envs=16, normalize=True, hparams=dict(ent_coef=0.0)),
    ("a2c", "MountainCarContinuous-v0"): Zoo(1e5, num_envs=4, normalize=True, hparams=dict(
        n_steps=100, ent_coef=0.0, use_sde=True, sde_sample_freq=16,
        policy_kwargs=dict(log_std_init=0.0, ortho_init=False))),
    ("a2c", "Pendulum-v1"): Zoo(1e6, num_envs=8, normalize=True, hparams=dict(
        ent_coef=0.0, max_grad_norm=0.5, n_steps=8, gae_lambda=0.9, vf_coef=0.4, gamma=0.9,
        use_rms_prop=True, normalize_advantage=False, learning_rate=linear(7e-4), use_sde=True,
        policy_kwargs=dict(log_std_init=-2, ortho_init=False))),
    ("dqn", "CartPole-v1"): Zoo(5e4, hparams=dict(
        learning_rate=2.3e-3, batch_size=64, buffer_size=100_000, learning_starts=1000, gamma=0.99,
        target_update_interval=10, train_freq=256, gradient_steps=128, exploration_fraction=0.16,
        exploration_final_eps=0.04, policy_kwargs=WIDE)),
    ("dqn", "Acrobot-v1"): Zoo(1e5, hparams=dict(
        learning_rate=6.3e-4, batch_size=128, buffer_size=50_000, learning_starts=0, gamma=0.99,
        target_update_interval=250, train_freq=4, gradient_steps=-1, exploration_fraction=0.12,
        exploration_final_eps=0.1, policy_kwargs=WIDE)),
    ("dqn", "MountainCar-v0"): Zoo(1.2e5, hparams=dict(
        learning_rate=4e-3, batch_size=128, buffer_size=10_000, learning_starts=1000, gamma=0.98,
        target_update_interval=600, train_freq=16, gradient_steps=8, exploration_fraction=0.2,
        exploration_final_eps=0.07, policy_kwargs=WIDE)),
    ("sac", "MountainCarContinuous-v0"): Zoo(5e4, hparams=dict(
        learning_rate=3e-4, buffer_size=50_000, batch_size=512, ent_coef=0.1, train_freq=32,
        gradient_steps=32, gamma=0.9999, tau=0.01, learning_starts=0, use_sde=True,
        policy_kwargs=dict(log_std_init=-3.67, net_arch=[64, 64]))),
    ("sac", "Pendulum-v1"): Zoo(2e4, hparams=dict(learning_rate=1e-3)),
    ("sac", "HalfCheetah-v5"): Zoo(1e6, hparams=dict(learning_starts=10_000)),
    ("td3", "MountainCarContinuous-v0"): Zoo(3e5, noise=("ornstein-uhlenbeck", 0.5)),
    ("td3", "Pendulum-v1"): Zoo(2e4, noise=("normal", 0.1), hparams=dict(
        gamma=0.98, buffer_size=200_000, learning_starts=10_000, gradient_steps=-1,
        train_freq=(1, "episode"), learning_rate=1e-3, policy_kwargs=dict(net_arch=[400, 300]))),
}  # fmt: skip


class Training(NamedTuple):
    """One agent's training.

    Attributes:
      world: an SE, as `sejax.gym.make` takes it, or `REAL`.
      task: one of `TASKS`.
      agent: one of `ALGORITHMS`, and changes of the zoo's settings: `sac learning_rate=1e-3`,
        `PPO num_envs=8`.
      seed: of the agent and of its world.
      total_steps: what schedules span.
      num_episodes: of each test.
      tests: steps after which it is tested; it ends with the last.
    """

    world: str
    task: str
    agent: str
    seed: int
    total_steps: int
    num_episodes: int
    tests: tuple[int, ...]


def main() -> None:
    args = common.parse_args(__doc__, add_options)
    if args.quick:
        args.agents, args.steps, args.seeds, args.episodes = ["ppo"], [500], 2, 5
    if args.alone and args.real_steps:
        raise SystemExit("error: --alone must stand without --real-steps.")
    of_zoo = [agent for agent, of in ZOO if of == TASKS[args.task][0]]
    unknown = [x for x in args.agents or [] if x == x.lower() and kind_of(x) not in of_zoo]
    if unknown or not (args.agents or of_zoo):
        raise SystemExit(f"error: --agents must be in capitals for {args.task}, as RL Zoo's "
                         "settings of it are not here.")  # fmt: skip
    # A look leaves the results that are kept alone.
    path = args.rows or Path("runs" if args.quick else "results", "stock_agents", "rows.csv")
    agents = args.agents or of_zoo
    known = pd.read_csv(path) if path.exists() else pd.DataFrame(columns=COLUMNS)
    learners = list(itertools.product(agents, range(args.seed, args.seed + args.seeds)))
    worlds = [args.source] if args.alone else [args.source, REAL]
    trainings = [in_budget(args, world, *x) for world in worlds for x in learners]
    if args.real_steps:
        trainings += [as_the_zoo(args, *x) for x in learners]
    new = run_all([training for training in trainings if not is_known(known, training)], args.jobs)
    table = pd.concat([known, new] if len(known) else [new])
    table = table.drop_duplicates(COLUMNS[:7], keep="last").sort_values(COLUMNS[:7])
    write_text(path, table.to_csv(index=False))
    table = table[table["task"] == args.task]
    of_worlds = (table[table["world"] == world] for world in (args.source, REAL))
    rows = list(summarise(args, agents, *of_worlds))
    common.print_table(
        f"{args.task}: greedy returns on the real task", list(rows[0]),
        [[str(x) for x in row.values()] for row in rows],
    )  # fmt: skip
    common.finish("stock_agents", args, {"task": args.task, "source": args.source, "rows": rows})


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("source", help="an SE: a shipped name, a safetensors file, a run directory")
    parser.add_argument("--agents", type=agents_of, metavar="A,B", help=", ".join(ALGORITHMS) + "; "
                        "in capitals with the library's defaults; with other "
                        "settings: 'sac learning_rate=1e-3'")  # fmt: skip
    parser.add_argument("--steps", type=numbers_of, default=[1000, 2500, 6000], metavar="N,N")
    parser.add_argument("--seeds", type=int, default=5, help="agents of each kind")
    parser.add_argument("--episodes", type=int, default=20, help="of each test")
    parser.add_argument("--real-steps", type=int, default=0, help="train real agents with the "
                        "zoo's schedules for as many steps as well")  # fmt: skip
    parser.add_argument("--alone", action="store_true", help="no agents on the real task")
    parser.add_argument("--real-every", type=int, default=1000, help="steps between their tests")
    parser.add_argument("--jobs", type=int, default=1, help="processes, of one thread each")
    parser.add_argument("--rows", type=Path, help="results/stock_agents/rows.csv")


def agents_of(text: str) -> list[str]:
    names = text.split(",")
    changes = [word for name in names for word in name.split()[1:]]
    if not {kind_of(name) for name in names} <= {*ALGORITHMS} or not all("=" in x for x in changes):
        raise argparse.ArgumentTypeError(f"must be among {', '.join(ALGORITHMS)}; got {text}")
    return names


def kind_of(agent: str) -> str:
    """One of `ALGORITHMS`, of a name that may have settings behind it, or be in capitals."""
    return (agent.split() or [""])[0].lower()


def numbers_of(text: str) -> list[int]:
    return sorted(int(x) for x in text.split(","))


def in_budget(args: argparse.Namespace, world: str, agent: str, seed: int) -> Training:
    return Training(world, args.task, agent, seed, max(args.steps), args.episodes,
                    tuple(args.steps))  # fmt: skip


def as_the_zoo(args: argparse.Namespace, agent: str, seed: int) -> Training:
    """On the real task, with the zoo's own schedules."""
    total = int(ZOO[kind_of(agent), TASKS[args.task][0]].total_steps)
    tests = range(args.real_every, min(args.real_steps, total) + 1, args.real_every)
    return Training(REAL, args.task, agent, seed, total, args.episodes, tuple(tests))


# --- training ------------------------------------------------------------------------------------

COLUMNS = [*Training._fields[:-1], "steps", "mean_return", "std", "cpu_s"]


def is_known(table: pd.DataFrame, training: Training) -> bool:
    """Whether all its tests are in the table."""
    same = (table[COLUMNS[:6]] == list(training[:6])).all(axis=1)
    return set(training.tests) <= set(table[same]["steps"])


def run_all(trainings: Iterable[Training], jobs: int) -> pd.DataFrame:
    """A row for each test of all trainings, printed as they come."""
    rows = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context) as pool:
        for future in as_completed([pool.submit(run, training) for training in trainings]):
            for row in future.result():
                print(*row, sep="  ", flush=True)
                rows.append(row)
    return pd.DataFrame(rows, columns=COLUMNS)


def run(training: Training) -> list[tuple[Any, ...]]:
    """Trains one agent; a row of `COLUMNS` for each of its tests."""
    torch.set_num_threads(1)
    env_id, _ = TASKS[training.task]
    kind = kind_of(training.agent)
    is_default = training.agent.startswith(kind.upper())
    zoo = Zoo(training.total_steps) if is_default else ZOO[kind, env_id]
    changes = (word.split("=", 1) for word in training.agent.split()[1:])
    hparams = zoo.hparams | {name: ast.literal_eval(value) for name, value in changes}
    num_envs = hparams.pop("num_envs", zoo.num_envs)
    envs: Any = make_vec_env(lambda: make_world(training), num_envs, seed=training.seed)
    if zoo.normalize:
        envs = VecNormalize(envs, gamma=hparams.get("gamma", 0.99))
    if zoo.noise:
        hparams["action_noise"] = make_noise(*zoo.noise, envs.action_space.shape)
    algorithm: Any = ALGORITHMS[kind]
    model = algorithm("MlpPolicy", envs, seed=training.seed, device="cpu", **hparams)
    examiner = Examiner(training)
    model.learn(training.total_steps, examiner)
    return examiner.rows


def make_world(training: Training) -> gymnasium.Env[Any, Any]:
    if training.world != REAL:
        return sejax.gym.make(training.world)
    env_id, limit = TASKS[training.task]
    return gymnasium.make(env_id, max_episode_steps=limit)


def make_noise(kind: str, std: float, shape: tuple[int, ...]) -> Any:
    noise = NormalActionNoise if kind == "normal" else OrnsteinUhlenbeckActionNoise
    return noise(mean=np.zeros(shape), sigma=std * np.ones(shape))


class Examiner(BaseCallback):
    """Tests the agent on the real task as it goes, and ends the training after the last test."""

    def __init__(self, training: Training):
        super().__init__()
        self.rows: list[tuple[Any, ...]] = []
        self._training = training
        self._due = list(training.tests)
        self._cpu_s = 0.0  # of training alone

    def _on_training_start(self) -> None:
        self._since = time.process_time()

    def _on_step(self) -> bool:
        """Steps have been made and not learned from yet: a test after fewer of them is due."""
        return self._test_up_to(self.num_timesteps - 1)

    def _on_training_end(self) -> None:
        self._test_up_to(self.num_timesteps)

    def _test_up_to(self, num_steps: int) -> bool:
        """Makes the tests that are due; returns whether more will be."""
        while self._due and self._due[0] <= num_steps:
            self._cpu_s += time.process_time() - self._since
            returns = test(self.model, self._training)
            self.rows.append((*self._training[:-1], self._due.pop(0), round(returns.mean(), 2),
                              round(returns.std(), 2), round(self._cpu_s, 2)))  # fmt: skip
            self._since = time.process_time()
        return bool(self._due)


def test(model: Any, training: Training) -> np.ndarray:
    """Returns of greedy episodes on the real task, `[num_episodes]`, played side by side."""
    env_id, limit = TASKS[training.task]
    envs = [gymnasium.make(env_id, max_episode_steps=limit) for _ in range(training.num_episodes)]
    obs = np.stack([env.reset(seed=FIRST_TEST_SEED + i)[0] for i, env in enumerate(envs)])
    returns, running = np.zeros(len(envs)), list(range(len(envs)))
    normalizer = model.get_vec_normalize_env()
    while running:
        seen = obs[running] if normalizer is None else normalizer.normalize_obs(obs[running])
        actions, _ = model.predict(seen, deterministic=True)
        for i, action in zip(tuple(running), actions, strict=True):
            obs[i], reward, terminated, truncated, _ = envs[i].step(action)
            returns[i] += float(reward)
            if terminated or truncated:
                running.remove(i)
    return returns


# --- report --------------------------------------------------------------------------------------


def summarise(
    args: argparse.Namespace, agents: list[str], taught: pd.DataFrame, real: pd.DataFrame
) -> Iterator[dict[str, Any]]:
    """A row for each agent and number of steps."""
    seeds = range(args.seed, args.seed + args.seeds)
    for agent, steps in itertools.product(agents, args.steps):
        mine, theirs = (
            table[(table.agent == agent) & table.seed.isin(seeds)
                  & (table.num_episodes == args.episodes)]
            for table in (taught, real)
        )  # fmt: skip
        here = mine[(mine.steps == steps) & (mine.total_steps == max(args.steps))]
        zoo = ZOO.get((kind_of(agent), TASKS[args.task][0]))
        total = zoo.total_steps if args.real_steps and zoo else max(args.steps)
        alone = theirs[theirs.total_steps == total]
        there = theirs[(theirs.steps == steps) & (theirs.total_steps == max(args.steps))]
        beside = {
            "real task": round(there.mean_return.mean(), 1),
            "real steps to be as good": as_good(alone, here.mean_return.mean(), len(seeds)),
        }
        yield {
            "agent": agent,
            "steps": steps,
            "SE": round(here.mean_return.mean(), 1),
            "each seed": ", ".join(f"{x:.1f}" for x in here.sort_values("seed").mean_return),
            "CPU s": round(here.cpu_s.mean(), 1),
            **({} if args.alone else beside),
        }


def as_good(real: pd.DataFrame, target: float, num_seeds: int) -> str:
    """Steps to a real agent's first test that reaches a mean: median (smallest to largest).

    One lucky test is enough, so that it is rather too few. A seed that is never as good took more
    than all of its steps.
    """
    most = real.steps.max()
    first = real[real.mean_return >= target].groupby("seed").steps.min()
    never = num_seeds - len(first)
    if first.empty:
        return f"more than {most:,}"
    steps = sorted([*first, *[math.inf] * never])
    middle, *ends = (f"{x:,.0f}" if math.isfinite(x) else f"more than {most:,}"
                     for x in (float(np.median(steps)), steps[0], steps[-1]))  # fmt: skip
    found = f"{middle} ({ends[0]} to {ends[1]})"
    return f"{found}, {len(first)} of {num_seeds} seeds" if never else found


if __name__ == "__main__":
    main()
