"""Agents that others wrote, with settings that others tuned, trained on an SE as it ships.

Stable-Baselines3's PPO, A2C, DQN, SAC and TD3 with RL Zoo's hyperparameters learn on an SE, which
they see as a plain `gymnasium.Env` (`sejax.gym.make`), and, for comparison, on the real task; each
is tested greedily on Gymnasium's real task. No line of sejax's agents or of JAX is involved.

An agent trains once, up to the largest number of steps asked for, and is tested on the way: after
`steps` it is the agent as it was left by the last update that had seen at most so many. Schedules
over a training (learning rates, exploration) span that training. Then, with `--real-steps`, real
agents train with the zoo's schedules until a test is as good as the mean of those that the SE
taught.

It needs Stable-Baselines3 and Gymnasium beside sejax: `pip install 'sejax[bench]'`.
"""

import argparse
import csv
import itertools
import multiprocessing
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

import common
import gymnasium
import numpy as np
import stable_baselines3 as sb3
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import VecNormalize

import sejax.gym

TASKS = {  # id in Gymnasium, and the step limit
    "cartpole": ("CartPole-v1", 200),  # which is CartPole-v0
    "cartpole_v1": ("CartPole-v1", 500),
    "acrobot": ("Acrobot-v1", 500),
    "mountain_car": ("MountainCar-v0", 200),
    "mountain_car_continuous": ("MountainCarContinuous-v0", 999),
    "pendulum": ("Pendulum-v1", 200),
}
ALGORITHMS = {"ppo": sb3.PPO, "a2c": sb3.A2C, "dqn": sb3.DQN, "sac": sb3.SAC, "td3": sb3.TD3}
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
# 00128b5 (ppo, sac), c6c209e (a2c), ce95481 (dqn) and a02f4fb (td3, there for Pendulum-v0).
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
    ("td3", "MountainCarContinuous-v0"): Zoo(3e5, noise=("ornstein-uhlenbeck", 0.5)),
    ("td3", "Pendulum-v1"): Zoo(2e4, noise=("normal", 0.1), hparams=dict(
        gamma=0.98, buffer_size=200_000, learning_starts=10_000, gradient_steps=-1,
        train_freq=(1, "episode"), learning_rate=1e-3, policy_kwargs=dict(net_arch=[400, 300]))),
}  # fmt: skip


class Training(NamedTuple):
    """One agent's training.

    Attributes:
      source: an SE, as `sejax.gym.make` takes it; None for the real task.
      task: one of `TASKS`.
      agent: one of `ALGORITHMS`.
      seed: of the agent and of its world.
      tests: steps after which it is tested.
      total_steps: what schedules span.
      num_episodes: of each test.
      target: mean return at which it has learned enough and ends.
    """

    source: str | None
    task: str
    agent: str
    seed: int
    tests: tuple[int, ...]
    total_steps: int
    num_episodes: int
    target: float = np.inf


def main() -> None:
    args = parse_args()
    env_id, _ = TASKS[args.task]
    agents = args.agents or [agent for agent, of in ZOO if of == env_id]
    budget = max(args.steps)
    each = list(itertools.product(agents, range(args.seed, args.seed + args.seeds)))
    trainings = [
        Training(source, args.task, agent, seed, tuple(args.steps), budget, args.episodes)
        for source in (args.source, None)
        for agent, seed in each
    ]
    rows = list(run_all(trainings, args.jobs))
    targets = {agent: mean_of(rows, args.source, agent, budget) for agent in agents}
    if args.real_steps:
        trainings = [until_as_good(args, agent, seed, targets[agent]) for agent, seed in each]
        rows += list(run_all(trainings, args.jobs))
    path = args.csv or Path(f"results/stock_agents/{args.task}-{Path(args.source).stem}.csv")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    report(args, agents, rows)
    print(f"{path} holds every test.")


def parse_args() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("source", help="an SE: a shipped name, a safetensors file, a run directory")
    parser.add_argument("--agents", type=names_of, metavar="A,B", help=", ".join(ALGORITHMS))
    parser.add_argument("--steps", type=numbers, default=[1000, 2500, 6000], metavar="N,N")
    parser.add_argument("--seeds", type=int, default=5, help="agents of each kind")
    parser.add_argument("--seed", type=int, default=0, help="of the first")
    parser.add_argument("--episodes", type=int, default=20, help="of each test")
    parser.add_argument("--real-steps", type=int, default=0, help="train real agents at most so "
                        "long to be as good as the SE's; 0: do not")  # fmt: skip
    parser.add_argument("--real-every", type=int, default=1000, help="steps between their tests")
    parser.add_argument("--jobs", type=int, default=1, help="processes, of one thread each")
    parser.add_argument("--csv", type=Path, help="results/stock_agents/TASK-SOURCE.csv")
    return parser.parse_args()


def names_of(text: str) -> list[str]:
    names = text.split(",")
    if not set(names) <= set(ALGORITHMS):
        raise argparse.ArgumentTypeError(f"must be among {', '.join(ALGORITHMS)}; got {text}")
    return names


def numbers(text: str) -> list[int]:
    return sorted(int(float(x)) for x in text.split(","))


def until_as_good(args: argparse.Namespace, agent: str, seed: int, target: float) -> Training:
    """A training on the real task with the zoo's own schedules."""
    total = int(ZOO[agent, TASKS[args.task][0]].total_steps)
    tests = tuple(range(args.real_every, min(args.real_steps, total) + 1, args.real_every))
    return Training(None, args.task, agent, seed, tests, total, args.episodes, target)


# --- training ------------------------------------------------------------------------------------


def run_all(trainings: Iterable[Training], jobs: int) -> Iterator[dict[str, Any]]:
    """Rows of all trainings, as they come."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context) as pool:
        for future in as_completed([pool.submit(run, training) for training in trainings]):
            for row in future.result():
                print("  ".join(f"{name} {value}" for name, value in row.items()), flush=True)
                yield row


def run(training: Training) -> list[dict[str, Any]]:
    """Trains one agent; a row for each of its tests."""
    torch.set_num_threads(1)
    env_id, _ = TASKS[training.task]
    zoo = ZOO[training.agent, env_id]
    hparams = dict(zoo.hparams)
    envs: Any = make_vec_env(lambda: make_world(training), zoo.num_envs, seed=training.seed)
    if zoo.normalize:
        envs = VecNormalize(envs, gamma=hparams.get("gamma", 0.99))
    if zoo.noise:
        hparams["action_noise"] = make_noise(*zoo.noise, envs.action_space.shape)
    algorithm: Any = ALGORITHMS[training.agent]
    model = algorithm("MlpPolicy", envs, seed=training.seed, device="cpu", **hparams)
    examiner = Examiner(training)
    model.learn(training.total_steps, examiner)
    return examiner.rows


def make_world(training: Training) -> gymnasium.Env[Any, Any]:
    if training.source is not None:
        return sejax.gym.make(training.source)
    env_id, limit = TASKS[training.task]
    return gymnasium.make(env_id, max_episode_steps=limit)


def make_noise(kind: str, std: float, shape: tuple[int, ...]) -> Any:
    noise = NormalActionNoise if kind == "normal" else OrnsteinUhlenbeckActionNoise
    return noise(mean=np.zeros(shape), sigma=std * np.ones(shape))


class Examiner(BaseCallback):
    """Tests the agent on the real task as it goes, and ends the training after the last test."""

    def __init__(self, training: Training):
        super().__init__()
        self.rows: list[dict[str, Any]] = []
        self._training = training
        self._due = list(training.tests)
        self._cpu_s = 0.0  # of training alone

    def _on_training_start(self) -> None:
        self._resumed = time.process_time()

    def _on_step(self) -> bool:
        """A step beyond n has been made, and no update since: the agent has learned from n."""
        return self._test_up_to(self.num_timesteps - 1)

    def _on_training_end(self) -> None:
        self._test_up_to(self.num_timesteps)

    def _test_up_to(self, num_steps: int) -> bool:
        """Makes the tests that are due; whether to go on."""
        while self._due and self._due[0] <= num_steps:
            self._cpu_s += time.process_time() - self._resumed
            returns = test(self.model, self._training)
            self.rows.append({
                "trained_on": self._training.source or "real task",
                "task": self._training.task,
                "agent": self._training.agent,
                "seed": self._training.seed,
                "steps": self._due.pop(0),
                "total_steps": self._training.total_steps,
                "mean_return": round(float(returns.mean()), 2),
                "std": round(float(returns.std()), 2),
                "cpu_s": round(self._cpu_s, 1),
            })  # fmt: skip
            if returns.mean() >= self._training.target:
                self._due = []
            self._resumed = time.process_time()
        return bool(self._due)


def test(model: Any, training: Training) -> np.ndarray:
    """Returns of greedy episodes on the real task, `[num_episodes]`, which run side by side."""
    env_id, limit = TASKS[training.task]
    envs = [gymnasium.make(env_id, max_episode_steps=limit) for _ in range(training.num_episodes)]
    obs = [env.reset(seed=FIRST_TEST_SEED + i)[0] for i, env in enumerate(envs)]
    returns = np.zeros(len(envs))
    running = list(range(len(envs)))
    normalizer = model.get_vec_normalize_env()
    while running:
        batch = np.stack([obs[i] for i in running])
        if normalizer is not None:
            batch = normalizer.normalize_obs(batch)
        actions, _ = model.predict(batch, deterministic=True)
        for i, action in zip(list(running), actions, strict=True):
            obs[i], reward, terminated, truncated, _ = envs[i].step(action)
            returns[i] += float(reward)
            if terminated or truncated:
                running.remove(i)
    return returns


# --- report --------------------------------------------------------------------------------------


def of(rows: list[dict[str, Any]], source: str | None, agent: str) -> list[dict[str, Any]]:
    name = source or "real task"
    return [row for row in rows if row["trained_on"] == name and row["agent"] == agent]


def mean_of(rows: list[dict[str, Any]], source: str | None, agent: str, steps: int) -> float:
    return fmean(row["mean_return"] for row in of(rows, source, agent) if row["steps"] == steps)


def report(args: argparse.Namespace, agents: list[str], rows: list[dict[str, Any]]) -> None:
    budget, lines = max(args.steps), []
    for agent, source, steps in itertools.product(agents, (args.source, None), args.steps):
        there = [row for row in of(rows, source, agent)
                 if row["steps"] == steps and row["total_steps"] == budget]  # fmt: skip
        returns = [row["mean_return"] for row in sorted(there, key=lambda row: row["seed"])]
        lines.append([agent, "the real task" if source is None else "the SE", f"{steps:,}",
                      f"{fmean(returns):.1f}", ", ".join(f"{x:.1f}" for x in returns),
                      f"{fmean(row['cpu_s'] for row in there):.1f}"])  # fmt: skip
    common.print_table(
        f"{args.task}: stock agents, {args.episodes} greedy episodes of each on the real task",
        ["agent", "trained on", "steps", "mean", "each seed", "CPU s"], lines,
    )  # fmt: skip
    for agent in agents if args.real_steps else ():
        target = mean_of(rows, args.source, agent, budget)
        print(f"{agent}: {target:.1f} on the real task itself {as_good(args, agent, rows, target)}")


def as_good(args: argparse.Namespace, agent: str, rows: list[dict[str, Any]], target: float) -> str:
    """After how many real steps real agents are as good, in words."""
    zoo_total = int(ZOO[agent, TASKS[args.task][0]].total_steps)
    there = [row for row in of(rows, None, agent) if row["total_steps"] == zoo_total]
    reached = [row["steps"] for row in there if row["mean_return"] >= target]
    missed = args.seeds - len(reached)
    never = f"; not within {max(row['steps'] for row in there):,} in {missed}" if missed else ""
    if not reached:
        return f"by none of {args.seeds} seeds{never}"
    return (f"after {median(reached):,.0f} steps ({min(reached):,} to {max(reached):,}) in "
            f"{len(reached)} of {args.seeds} seeds{never}")  # fmt: skip


if __name__ == "__main__":
    main()
