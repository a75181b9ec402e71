"""Augmented random search: a linear policy of a task, found by rollouts alone.

A generation tries random directions of the policy's weights, both ways, an episode each. It moves
along the directions with the best returns. It is one compiled program.

Agents learn a policy only roughly, and a policy that teaches must bear that. So each episode may
have its own error: a random linear map of the observation that is added to the policy.

A whole search starts several times. The start with the best tested policy goes on. The work up to
each test is kept, so that a stopped search goes on.

Source: Mania et al., "Simple random search of static linear policies is competitive for
reinforcement learning" (2018), Algorithm 2 (V2-t). The emulated error is ours.
"""

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Float

from sejax.agents.base import Agent
from sejax.envs.base import Task
from sejax.evaluation import Steps, Tests, make_fixed, make_recorder, make_tester
from sejax.ops.parallel import spread_over_devices
from sejax.ops.scores import merged_moments, or_lowest_finite, reaches
from sejax.options import Count, Finite, NonNegative, Options, Positive, require
from sejax.proxies.exact import Layer, require_vectors
from sejax.runs.store import Store

Arrays = dict[str, np.ndarray]

# Columns of search.csv: a row for each policy that was tested.
COLUMNS = ("start", "generation", "test_mean", "test_std", "real_steps", "cpu_s")


@dataclass(frozen=True, kw_only=True)
class PolicySearchConfig(Options):
    """How a linear policy is searched. Its weights map observations with mean 0, variance 1 to
    actions in units of the task's bound.

    Attributes:
      num_starts: Searches that begin. Each runs start_generations (up to a test); the one with the
        best tested policy goes on, as a search may get stuck at a poor gait, which shows early.
      num_directions: N, two episodes each
      num_top: b: directions that count
      noise_std: nu
      step_size: alpha
      constant: Share of the generations after which the step size declines, to a tenth at the end.
      policy_error: Root mean square of an episode's error, in units of the action's bound; for
        discrete actions, in units of the policy's own outputs.
      alive_bonus: Subtracted from each step's reward in the search; the commands set it to the
        task's reward for being healthy.
      num_tests: episodes without the error
      until_solved: Whether the search ends as soon as a tested policy solves the task.
    """

    group: ClassVar[str] = "search"

    generations: Count = 100
    num_starts: Count = 3
    start_generations: Count = 40
    num_directions: Count = 32
    num_top: Count = 16
    noise_std: Positive = 0.03
    step_size: Positive = 0.02
    constant: NonNegative = 0.5
    policy_error: NonNegative = 0.1
    alive_bonus: Finite = 0.0
    num_tests: Count = 5
    test_every: Count = 10
    until_solved: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        limit, top = self.num_directions, self.num_top
        require(top <= limit, "search.num_top", "must fit num_directions", got=top, use=limit)


class Policy(NamedTuple):
    """A linear policy, and the moments of its observations.

    Attributes:
      weights: `[action_dim, obs_dim + 1]`, the last column a bias. They map observations, less the
        mean and over the deviation, to actions in units of the bound.
      num_seen: number of observations in the moments.
      mean: `[obs_dim]`.
      square: `[obs_dim]`, sum of squared differences from the mean.
    """

    weights: Float[Array, "action_dim inputs"]
    num_seen: Float[Array, ""]
    mean: Float[Array, " obs_dim"]
    square: Float[Array, " obs_dim"]

    @property
    def std(self) -> Float[Array, " obs_dim"]:
        """Deviation of each observation, at least 0.01; 1 before there are any."""
        variance = jnp.maximum(self.square / jnp.maximum(self.num_seen, 1.0), 1e-4)
        return jnp.where(self.num_seen > 0, jnp.sqrt(variance), 1.0)

    def layers(self, max_action: float) -> list[Layer]:
        """The policy as one affine map of the observation, as of `sejax.proxies.exact`."""
        weights, mean, std = (np.asarray(x, float) for x in (self.weights, self.mean, self.std))
        kernel = max_action * weights[:, :-1] / std
        return [(kernel, max_action * weights[:, -1] - kernel @ mean)]


class Search(NamedTuple):
    """The pure functions of a search.

    Attributes:
      generation: `(key, policy, number) -> (policy, returns, num_steps)`: the next policy, the
        returns of the episodes of all directions, `[2 * num_directions]`, bonuses included, and the
        number of steps on the real task.
      test: `(key, policy) -> Tests`, episodes without the emulated error.
      record: `(key, policy) -> Steps`, every step of the same episodes.
    """

    generation: Callable[[Array, Policy, Array | int], tuple[Policy, Array, Array]]
    test: Callable[[Array, Policy], Tests]
    record: Callable[[Array, Policy], Steps]


def first_policy(task: Task) -> Policy:
    """The policy that a search begins with, which does nothing."""
    zeros = jnp.zeros(task.obs_dim)
    return Policy(jnp.zeros((task.action_dim, task.obs_dim + 1)), jnp.float32(0), zeros, zeros)


def linear_agent(task: Task) -> Agent:
    """An agent whose state is a `Policy`, and which learns nothing."""

    def act(key: Array, policy: Policy, obs: Float[Array, " obs_dim"]) -> Array:
        outputs = policy.weights @ jnp.append((obs - policy.mean) / policy.std, 1.0)
        if task.num_actions is not None:
            return jnp.argmax(outputs).astype(jnp.int32)
        return task.max_action * jnp.clip(outputs, -1.0, 1.0)

    return make_fixed(task, act)


def make_search(config: PolicySearchConfig, task: Task, devices: int | None = None) -> Search:
    """Builds the functions of a search.

    Args:
      config: the search's configuration.
      task: the real task.
      devices: number of devices that episodes are spread over; None for all.

    Raises:
      ConfigError: for a task whose observations are not vectors.

    Example:
      >>> import sejax
      >>> task = sejax.envs.make("mountain_car")
      >>> search = make_search(PolicySearchConfig(num_directions=4, num_top=2), task, devices=1)
      >>> policy, returns, _ = jax.eval_shape(
      ...     search.generation, jax.random.key(0), first_policy(task), 0)
      >>> policy.weights.shape, returns.shape
      ((3, 3), (8,))
    """
    require_vectors(task, task.name)
    agent = linear_agent(task)
    shape = (task.action_dim, task.obs_dim + 1)
    play, record_one = make_tester(agent, task, 1), make_recorder(agent, task, 1)
    width = 1 if task.num_actions is None else None

    def generation(key: Array, policy: Policy, number: Array | int) -> tuple[Policy, Array, Array]:
        key_directions, key_episodes, key_record = jax.random.split(key, 3)
        directions = jax.random.normal(key_directions, (config.num_directions, *shape))
        weights = policy.weights + config.noise_std * jnp.concatenate([directions, -directions])
        # Both ways of a direction have the same initial state and error.
        keys = jnp.tile(jax.random.split(key_episodes, config.num_directions), 2)
        size = jnp.float32(config.policy_error)
        if task.num_actions is not None:  # only the outputs' relative size counts
            size = size * jnp.sqrt(jnp.mean(policy.weights**2) * task.obs_dim)

        def episode(key: Array, weights: Array) -> tuple[Array, Array]:
            """The return of an episode with these weights and an error, and its steps."""
            key_error, key_play = jax.random.split(key)
            weights = weights + size * random_map(key_error, shape)
            tests = play(key_play, policy._replace(weights=weights))
            return tests.returns[0], tests.num_steps[0]

        spread = spread_over_devices(episode, num_devices=devices, cpu_num_parallel=width)
        returns, num_steps = spread(keys, weights)
        plus, minus = jnp.split(or_lowest_finite(returns - config.alive_bonus * num_steps), 2)
        _, top = jax.lax.top_k(jnp.maximum(plus, minus), config.num_top)
        deviation = jnp.concatenate([plus[top], minus[top]]).std() + 1e-6
        slope = jnp.tensordot((plus - minus)[top], directions[top], 1)
        step = step_size(config, number) / (config.num_top * deviation) * slope
        seen = record_one(key_record, policy)  # an episode of the policy itself gives the moments
        policy = with_moments(policy._replace(weights=policy.weights + step), seen.obs, seen.valid)
        return policy, returns, num_steps.sum() + seen.valid.sum()

    test = make_tester(agent, task, config.num_tests)
    record = make_recorder(agent, task, config.num_tests)
    return Search(generation=generation, test=test, record=record)


def random_map(key: Array, shape: tuple[int, ...]) -> Float[Array, "... inputs"]:
    """A random linear map of whitened observations, the last column a bias.

    Its outputs have a root mean square of 1 over maps and observations; the bias makes a fifth of
    their variance.
    """
    scale = jnp.full(shape[-1], (0.8 / (shape[-1] - 1)) ** 0.5).at[-1].set(0.2**0.5)
    return scale * jax.random.normal(key, shape)


def step_size(config: PolicySearchConfig, number: Array | int) -> Array:
    """The step size of a generation: constant at first, then a straight line to a tenth."""
    first = config.constant * config.generations
    left = (config.generations - number) / max(config.generations - first, 1.0)
    return config.step_size * jnp.clip(left, 0.1, 1.0)


def with_moments(policy: Policy, obs: Float[Array, "step obs_dim"], valid: Array) -> Policy:
    """The policy with observations added to its moments; its weights stay."""
    count = valid.sum()
    mean = jnp.where(valid[:, None], obs, 0.0).sum(0) / jnp.maximum(count, 1)
    square = jnp.where(valid[:, None], (obs - mean) ** 2, 0.0).sum(0)
    return Policy(policy.weights, *merged_moments(policy[1:], (count, mean, square)))


# --- a whole search, kept on disk ----------------------------------------------------------------


class Lesson(NamedTuple):
    """A policy that an SE is to teach.

    Attributes:
      generation: the policy's generation in its search; 0 for a copy.
      layers: as in `sejax.proxies.exact`.
      states: observations that it visited, `[state, obs_dim]`.
      policy_return: its mean return on the real task.
    """

    generation: int
    layers: Sequence[Layer]
    states: np.ndarray
    policy_return: float


def search_policies(
    config: PolicySearchConfig,
    task: Task,
    num_lessons: int,
    keys: dict[str, Array],
    store: Store,
    devices: int | None = None,
) -> tuple[list[Lesson], pd.DataFrame]:
    """The best tested policy of each of `num_lessons` equal parts of a search.

    Args:
      config: the search's configuration.
      task: the real task.
      num_lessons: number of parts; fewer if fewer policies are tested.
      keys: `search`, `test` and `record`.
      store: where each step of the search is kept.
      devices: number of devices that episodes are spread over; None for all.

    Returns:
      The lessons, and a row of `COLUMNS` for each policy that was tested.
    """
    search = Search(*(jax.jit(function) for function in make_search(config, task, devices)))
    rows: list[Arrays] = []  # of tested policies, in their order

    def climb(start: int, first: int, policy: Policy) -> Arrays:
        """The policy after the generations from `first` up to its next test, and its row."""
        started = time.process_time()
        num_steps = 0
        last = min(first + config.test_every, config.generations)
        key_search, key_test = (jax.random.fold_in(keys[use], start) for use in ("search", "test"))
        for number in range(first, last):
            key = jax.random.fold_in(key_search, number)
            policy, _, num_taken = search.generation(key, policy, number)
            num_steps += int(num_taken)
        tests = search.test(jax.random.fold_in(key_test, last), policy)
        num_steps += int(tests.num_steps.sum())
        mean, std = float(tests.returns.mean()), float(tests.returns.std())
        cpu_s = time.process_time() - started
        print(f"start {start}, generation {last}: policy {mean:.1f} ± {std:.1f}", flush=True)
        row = dict(zip(COLUMNS, (start, last, mean, std, num_steps, cpu_s), strict=True))
        return {name: np.asarray(value) for name, value in (policy._asdict() | row).items()}

    def advance(start: int, firsts: Sequence[int], policy: Policy) -> Policy:
        """A start's policy after the blocks of generations that begin at `firsts`."""
        for first in firsts:
            if config.until_solved and rows and reaches(_test_mean(rows[-1]), task.solved_reward):
                break
            compute = functools.partial(climb, start, first, policy)
            rows.append(store.once(f"search/start{start}-{first}", compute))
            policy = _policy_of(rows[-1])
        return policy

    firsts = range(0, config.generations, config.test_every)
    num_tried = -(-min(config.start_generations, config.generations) // config.test_every)
    ends = [advance(i, firsts[:num_tried], first_policy(task)) for i in range(config.num_starts)]
    best = int(max(rows, key=_test_mean)["start"])
    advance(best, firsts[num_tried:], ends[best])
    tested = [row for row in rows if row["start"] == best]
    parts = np.array_split(np.array(tested), min(num_lessons, len(tested)))
    chosen = [max(part, key=_test_mean) for part in parts]
    lessons = [_lesson(config.num_tests, search, task, keys["record"], row) for row in chosen]
    return lessons, pd.DataFrame([{name: row[name].item() for name in COLUMNS} for row in rows])


def _lesson(num_tests: int, search: Search, task: Task, key: Array, row: Arrays) -> Lesson:
    """A tested policy, with the states that it visits in new episodes, as the tests chose it.

    The cost of the new episodes is added to the row.
    """
    started = time.process_time()
    generation = int(row["generation"])
    policy = _policy_of(row)
    seen = jax.device_get(search.record(jax.random.fold_in(key, generation), policy))
    states = seen.obs[seen.valid]
    policy_return = float(seen.reward[seen.valid].sum()) / num_tests
    row["real_steps"] = row["real_steps"] + len(states)
    row["cpu_s"] = row["cpu_s"] + time.process_time() - started
    return Lesson(generation, policy.layers(task.max_action), states, policy_return)


def _policy_of(tested: Arrays) -> Policy:
    return Policy(*(jnp.asarray(tested[name]) for name in Policy._fields))


def _test_mean(tested: Arrays) -> float:
    """The mean return of a policy's tests; the lowest number if it is nan."""
    return float(np.nan_to_num(tested["test_mean"], nan=-np.inf))
