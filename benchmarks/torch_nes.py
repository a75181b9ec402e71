"""One NES generation over a pool of processes, around the PyTorch inner loop.

The outer loop of `sejax.es.nes` in NumPy. One process for each core with one torch thread each, as
the paper's authors spread their workers, but without their files and polling.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.pool import Pool
from typing import Any

import numpy as np
import torch
from torch_reference import SyntheticEnv, Weights, play_test_episodes, train

from sejax.agents.dqn import DDQNConfig
from sejax.es.nes import NESConfig
from sejax.proxies.synthetic import SyntheticConfig
from sejax.training import TrainingConfig


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Of a generation of SEs for CartPole. Scores are mean test returns."""

    agent: DDQNConfig
    training: TrainingConfig
    proxy: SyntheticConfig
    es: NESConfig

    @classmethod
    def of(cls, config: Any) -> "Settings":
        """The same as in a `sejax.config`.

        Raises:
          ValueError: if it asks for what is not built here.
        """
        got = {group: config.name(group) for group in ("env", "proxy", "es", "objective")}
        if got != {"env": "cartpole", "proxy": "se", "es": "nes", "objective": "max_reward"}:
            raise ValueError(f"the reference is of cartpole, se, nes and max_reward; got {got}.")
        return cls(agent=config.agent, training=config.training, proxy=config.proxy, es=config.es)


@dataclass(kw_only=True)
class Outcome:
    """What came of one candidate, and what it cost."""

    score: float  # nan if the training diverged
    train_steps: int
    cpu_s: float


def evaluate(weights: Weights, settings: Settings, seed: int) -> Outcome:
    """Trains a fresh agent on the SE with these weights and tests it on the real task.

    Source: paper, Algorithm 1, TrainAgent and EvaluateAgent.
    """
    start = time.process_time()
    agent, training = settings.agent, settings.training
    result = train(SyntheticEnv(weights, settings.proxy), agent, training, seed)
    returns = play_test_episodes(result.agent.state, agent, training.test_episodes, seed + 1)
    return Outcome(
        score=math.nan if result.nonfinite else float(returns.mean()),
        train_steps=result.train_steps,
        cpu_s=time.process_time() - start,
    )


@contextmanager
def worker_pool(num_processes: int, settings: Settings) -> Iterator[Pool]:
    """A pool of processes with one torch thread each, started and with everything imported."""
    with get_context("spawn").Pool(
        num_processes, initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        pool.map(_warm_up, [settings] * num_processes, chunksize=1)
        yield pool


def _warm_up(settings: Settings) -> None:
    """What a process does first: it imports what reading the settings takes."""
    time.sleep(0.1)  # so that no process takes another's turn


def generation(
    weights: Weights, settings: Settings, pool: Pool, seed: int
) -> tuple[Weights, list[Outcome]]:
    """One pass of Algorithm 1's outer loop; returns the next SE and the candidates' outcomes.

    Each member tries psi + eps and psi - eps; the last candidates are psi itself. A free process
    takes the next candidate, so that long and short trainings balance out.
    """
    es = settings.es
    psi, unravel = ravel(weights)
    rng = np.random.default_rng(seed)
    noise = es.noise_std * rng.standard_normal((es.population_size, psi.size), dtype=np.float32)
    num_incumbents = es.num_incumbent_evals or es.population_size
    candidates = [*(psi + noise), *(psi - noise), *[psi] * num_incumbents]
    seeds = rng.integers(2**31, size=len(candidates)).tolist()
    jobs = [(unravel(flat), settings, s) for flat, s in zip(candidates, seeds, strict=True)]
    outcomes = pool.starmap(evaluate, jobs, chunksize=1)
    scores = np.array([outcome.score for outcome in outcomes])
    return unravel(nes_update(psi, noise, scores, es)), outcomes


def nes_update(psi: np.ndarray, noise: np.ndarray, scores: np.ndarray, es: NESConfig) -> np.ndarray:
    """The next psi from the scores of psi + eps `[n]`, psi - eps `[n]` and psi `[any]`, in a row.

    Args:
      psi: `[dims]` the incumbent.
      noise: `[n, dims]` eps of each member, its std included.
      scores: higher is better; those that are not finite rank worst. All Better 2 weighs them.
      es: the step and its rule.

    Raises:
      ValueError: for a transform or a way of sampling other than the paper's tables have.

    Source: paper, Algorithm 1 and appendix "NES Score Transformation".
    """
    if not (es.mirrored and es.score_transform == "all_better_2" and es.num_evals == 1):
        raise ValueError("the reference knows mirrored sampling, one evaluation and all_better_2.")
    scores = np.where(np.isfinite(scores), scores, -np.inf)
    plus, minus, incumbent = np.split(scores, [len(noise), 2 * len(noise)])
    signed = np.where(minus > plus, -1, 1)[:, None] * noise
    weights = all_better_2(np.maximum(plus, minus), incumbent)
    step = es.step_size * weights @ signed
    if es.update_rule == "paper":
        step = step / (es.population_size * es.noise_std)
    return ((1 - es.weight_decay) * psi + step).astype(np.float32)


def all_better_2(scores: np.ndarray, incumbent: np.ndarray) -> np.ndarray:
    """Weights by how much members beat the incumbent's mean, with sum 1; all 0 if none does."""
    finite = np.isfinite(scores)
    measured = incumbent[np.isfinite(incumbent)]
    floor = measured.mean() if measured.size else scores[finite].min(initial=np.inf)
    advantage = np.where(finite, np.maximum(scores - floor, 0), 0)
    return advantage / advantage.sum() if advantage.any() else advantage


def ravel(weights: Weights) -> tuple[np.ndarray, Callable[[np.ndarray], Weights]]:
    """An SE's weights as one vector, and the function that takes a vector back to weights."""
    paths = [(head, layer, leaf) for head, net in weights.items() for layer in net
             for leaf in net[layer]]  # fmt: skip
    arrays = [np.asarray(weights[a][b][c], np.float32) for a, b, c in paths]
    ends = np.cumsum([array.size for array in arrays])

    def unravel(flat: np.ndarray) -> Weights:
        tree: Weights = {}
        pieces = np.split(flat, ends[:-1])
        for (head, layer, leaf), piece, array in zip(paths, pieces, arrays, strict=True):
            tree.setdefault(head, {}).setdefault(layer, {})[leaf] = piece.reshape(array.shape)
        return tree

    return np.concatenate([array.ravel() for array in arrays]), unravel
