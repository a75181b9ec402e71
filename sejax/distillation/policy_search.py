"""Augmented random search: a linear policy of a task, found by rollouts alone.

A generation tries a few random directions of the policy's weights, both ways, an episode each, and
moves along those that made the largest difference. It is one compiled program.

A policy that is to be taught to agents must bear that they learn it roughly. So each episode may be
played with an error of its own, a random linear map of the observation that is added to the policy.

Source: Mania et al., "Simple random search of static linear policies is competitive for
reinforcement learning" (2018), Algorithm 2 (V2-t). The emulated error is ours.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sejax.agents.fixed import make_fixed
from sejax.envs.base import Task
from sejax.evaluation import make_recorder, make_tester
from sejax.ops.parallel import spread_over_devices
from sejax.options import Options, counts, finite, not_negative, option, positive, require
from sejax.proxies.exact import Layer


@dataclass(frozen=True, kw_only=True)
class SearchConfig(Options):
    """How a linear policy is searched. Weights are those of observations with mean 0, variance 1,
    and of actions in units of the task's bound."""

    group: ClassVar[str] = "search"

    generations: int = option(100, counts("something must be searched"))
    num_starts: int = option(
        3,
        counts("a search begins"),
        help=(
            "Searches that begin, each for so many generations (up to a test); the one whose "
            "policy was tested best goes on. A search may stop at a poor gait, which shows early."
        ),
    )
    start_generations: int = option(40, counts("a start must be tried"))
    num_directions: int = option(32, counts("something must be tried"), help="N, two episodes each")
    num_top: int = option(
        16, counts("something must be learned from"), help="b: directions that count"
    )
    noise_std: float = option(0.03, positive("directions must differ"), help="nu")
    step_size: float = option(0.02, positive("the policy would not move"), help="alpha")
    constant: float = option(
        0.5,
        not_negative("it is a share of the generations"),
        help="Share of the generations after which the step size declines, to a tenth at the end.",
    )
    policy_error: float = option(
        0.1,
        not_negative("it is a size"),
        help=(
            "Root mean square of the error of an episode's policy, in units of the action's "
            "bound; of discrete actions in units of the policy's own outputs."
        ),
    )
    alive_bonus: float | None = option(
        None,
        finite("it is a reward"),
        help=(
            "Subtracted from each step's reward while searching; null: the task's reward for "
            "being healthy."
        ),
    )
    short_steps: int | None = option(
        None, counts("an episode has steps"), help="The first generations have shorter episodes."
    )
    short_generations: int = option(0, counts("it counts generations", least=0))
    num_tests: int = option(5, counts("a policy must be tested"), help="episodes without the error")
    test_every: int = option(10, counts("it counts generations"))

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.num_top <= self.num_directions,
            "search.num_top",
            f"must be at most search.num_directions; got {self.num_top} of "
            f"{self.num_directions}. Set search.num_top={self.num_directions}.",
        )


class Policy(NamedTuple):
    """A linear policy, and the moments of observations that it is a map of.

    Attributes:
      weights: `[action_dim, obs_dim + 1]`, the last column a bias; of observations less the mean
        over the deviation, to actions in units of the bound.
      num_seen: observations that the moments are of.
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


class Generation(NamedTuple):
    """What a generation was.

    Attributes:
      returns: of the episodes of all directions, `[2 * num_directions]`, bonuses included.
      num_steps: on the real task.
    """

    returns: Float[Array, " episode"]
    num_steps: Int[Array, ""]


@dataclass(frozen=True, eq=False)
class Search:
    """The functions of a search; each is pure.

    Attributes:
      init: `() -> Policy`, one that does nothing.
      generation: `(key, policy, number) -> (Policy, Generation)`.
      test: `(key, policy) -> Tests`, episodes without the emulated error.
      record: `(key, policy) -> Steps`, every step of the same episodes.
    """

    init: Callable[[], Policy]
    generation: Callable[[Array, Policy, Array | int], tuple[Policy, Generation]]
    test: Callable[[Array, Policy], Any]
    record: Callable[[Array, Policy], Any]


def linear_act(task: Task, policy: Policy, obs: Float[Array, " obs_dim"]) -> Array:
    """What a linear policy does."""
    outputs = policy.weights @ jnp.append((obs - policy.mean) / policy.std, 1.0)
    if task.num_actions is not None:
        return jnp.argmax(outputs).astype(jnp.int32)
    return task.max_action * jnp.clip(outputs, -1.0, 1.0)


def make_search(config: SearchConfig, task: Task, devices: int | None = None) -> Search:
    """Builds the functions of a search.

    Args:
      config: of the search; `alive_bonus` None is 0 here.
      task: the real task.
      devices: that episodes are spread over; None for all.

    Raises:
      ConfigError: for a task whose observations are no vectors.

    Example:
      >>> import sejax
      >>> task = sejax.envs.make("mountain_car")
      >>> search = make_search(SearchConfig(num_directions=4, num_top=2), task, devices=1)
      >>> policy, tried = jax.eval_shape(search.generation, jax.random.key(0), search.init(), 0)
      >>> policy.weights.shape, tried.returns.shape
      ((3, 3), (8,))
    """
    require(
        task.num_states is None,
        "env",
        f"must have vectors as observations; got {task.name}. Set env=cartpole.",
    )
    agent = make_fixed(task, lambda key, policy, obs: linear_act(task, policy, obs))
    shape = task.action_dim, task.obs_dim + 1
    play = make_tester(agent, task, 1)
    record_one = make_recorder(agent, task, 1)
    bonus = config.alive_bonus or 0.0

    def init() -> Policy:
        zeros = jnp.zeros(task.obs_dim)
        return Policy(jnp.zeros(shape), jnp.float32(0), zeros, zeros)

    def episode(key: Array, policy: Policy, size: Array, limit: Array) -> tuple[Array, Array]:
        """The return of an episode with an error of its own, and its steps."""
        key_error, key_play = jax.random.split(key)
        error = size * random_map(key_error, shape)
        policy = policy._replace(weights=policy.weights + error)
        tests = play(key_play, policy, params=task.params.replace(max_steps_in_episode=limit))
        return tests.returns[0], tests.num_steps[0]

    def error_size(policy: Policy) -> Array:
        size = jnp.float32(config.policy_error)
        if task.num_actions is not None:  # only the outputs' relative size counts
            size = size * jnp.sqrt(jnp.mean(policy.weights**2) * task.obs_dim)
        return jnp.broadcast_to(size, 2 * config.num_directions)

    width = 1 if task.num_actions is None else None
    spread = spread_over_devices(episode, devices, cpu_num_parallel=width)

    def generation(key: Array, policy: Policy, number: Array | int) -> tuple[Policy, Generation]:
        key_directions, key_episodes, key_record = jax.random.split(key, 3)
        directions = jax.random.normal(key_directions, (config.num_directions, *shape))
        weights = policy.weights + config.noise_std * jnp.concatenate([directions, -directions])
        # Both ways of a direction have the same initial state and error.
        keys = jnp.tile(jax.random.split(key_episodes, config.num_directions), 2)
        tried = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(weights), *x.shape)), policy)
        limit = jnp.int32(task.max_steps)
        if config.short_steps is not None:
            is_short = number < config.short_generations
            limit = jnp.where(is_short, min(config.short_steps, task.max_steps), limit)
        limits = jnp.broadcast_to(limit, len(weights))
        returns, num_steps = spread(
            keys, tried._replace(weights=weights), error_size(policy), limits
        )
        plus, minus = jnp.split(_finite(returns - bonus * num_steps), 2)
        _, top = jax.lax.top_k(jnp.maximum(plus, minus), config.num_top)
        deviation = jnp.concatenate([plus[top], minus[top]]).std() + 1e-6
        slope = jnp.tensordot((plus - minus)[top], directions[top], 1)
        step = step_size(config, number) / (config.num_top * deviation) * slope
        seen = record_one(key_record, policy)  # an episode of the policy itself gives the moments
        policy = with_moments(policy._replace(weights=policy.weights + step), seen.obs, seen.valid)
        return policy, Generation(returns, num_steps.sum() + seen.valid.sum())

    return Search(
        init=init,
        generation=generation,
        test=make_tester(agent, task, config.num_tests),
        record=make_recorder(agent, task, config.num_tests),
    )


def random_map(key: Array, shape: tuple[int, ...]) -> Float[Array, "... inputs"]:
    """A random linear map of whitened observations, the last column a bias.

    Its outputs have a root mean square of 1 over maps and observations, a fifth of their variance
    by the bias.
    """
    scale = jnp.full(shape[-1], (0.8 / (shape[-1] - 1)) ** 0.5).at[-1].set(0.2**0.5)
    return scale * jax.random.normal(key, shape)


def step_size(config: SearchConfig, number: Array | int) -> Array:
    """That of a generation: constant at first, then a straight line to a tenth."""
    first = config.constant * config.generations
    left = (config.generations - number) / max(config.generations - first, 1.0)
    return config.step_size * jnp.clip(left, 0.1, 1.0)


def _finite(returns: Array) -> Array:
    """Returns of which one that is no number is as bad as the worst."""
    worst = jnp.min(jnp.where(jnp.isfinite(returns), returns, jnp.inf))
    return jnp.where(jnp.isfinite(returns), returns, jnp.where(jnp.isfinite(worst), worst, 0.0))


def with_moments(policy: Policy, obs: Float[Array, "step obs_dim"], valid: Array) -> Policy:
    """The policy with observations added to its moments; its weights stay.

    Source: Chan et al., "Updating formulae and a pairwise algorithm for computing sample variances"
    (1979).
    """
    count = valid.sum()
    rows = jnp.where(valid[:, None], obs, 0.0)
    mean = rows.sum(0) / jnp.maximum(count, 1)
    square = jnp.where(valid[:, None], (obs - mean) ** 2, 0.0).sum(0)
    total = policy.num_seen + count
    apart, share = mean - policy.mean, count / jnp.maximum(total, 1)
    return policy._replace(
        num_seen=total,
        mean=policy.mean + apart * share,
        square=policy.square + square + apart**2 * policy.num_seen * share,
    )
