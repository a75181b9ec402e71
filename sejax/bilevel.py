"""The bilevel loop: NES outside, whole agent trainings inside, in one compiled program.

Assembles proxies, agents and strategies; owns no maths of its own.

Source: paper, Algorithm 1.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from sejax import envs
from sejax.agents.hparams import make_varied_agents
from sejax.agents.registry import make_agent
from sejax.configs import LearnConfig
from sejax.es import make_strategy
from sejax.es.nes import finite_mean
from sejax.evaluation import evaluator_and_lanes
from sejax.objectives import Outcome, make_objective
from sejax.parallel import spread_over_devices
from sejax.proxies.registry import ProxyEnv, make_proxy


@struct.dataclass
class LearnState:
    """Everything the next generation needs, and the best proxy so far. Leaves are `[seed, ...]`."""

    key: Array
    es_state: Any
    generation: Array
    incumbent: Float[Array, "seed dims"]  # as measured in the last generation, before its update
    incumbent_score: Array
    best: Float[Array, "seed dims"]
    best_score: Array
    best_generation: Array
    env_steps: Array
    finished: Array  # stop_when_solved: the run is over and its generations cost nothing


@struct.dataclass
class GenerationInfo:
    """What a person wants to see of a generation: the columns of `metrics.csv`, `[seed]` each."""

    generation: Array
    incumbent_mean: Array
    incumbent_std: Array
    population_mean: Array
    population_max: Array
    best_so_far: Array
    train_steps_mean: Array
    train_steps_max: Array
    train_episodes_mean: Array
    num_nonfinite: Array
    env_steps_total: Array
    train_steps_total: Array
    active: Array


@struct.dataclass
class LearnResult:
    """Result of a whole run.

    Attributes:
      weights: the best proxy's weights.
      score: its incumbent mean.
      generation: the generation that measured it.
      last_weights: the last proxy that was measured.
      info: history, leaves `[generation]`.
    """

    weights: Any
    score: Array
    generation: Array
    last_weights: Any
    info: GenerationInfo


@dataclass(frozen=True, kw_only=True)
class Program:
    """The pure functions of a configured bilevel loop.

    Attributes:
      init: `(keys [seed]) -> LearnState`.
      generation: `(LearnState) -> (LearnState, GenerationInfo)`, a scan body over all seeds.
      unravel: flat parameters `[dims]` to the proxy's weights.
      env: the proxy.
      task: the real task.
      solved_score: incumbent mean at which the task counts as solved; None if the objective's
        scores are not returns.
      num_dims: length of a parameter vector.
      num_candidates: trainings in a generation of one seed.
    """

    init: Callable[[Array], LearnState]
    generation: Callable[[LearnState], tuple[LearnState, GenerationInfo]]
    unravel: Callable[[Array], Any]
    env: ProxyEnv
    task: envs.Task
    solved_score: float | None
    num_dims: int
    num_candidates: int


def make_learner(config: LearnConfig) -> Callable[[Array], LearnResult]:
    """Builds `learn(key) -> LearnResult`: all of Algorithm 1 as one pure function.

    Jitted it is a single executable with the scan over generations inside; `vmap` it over keys for
    several runs at once. `config.seed`, `num_seeds`, `run_dir` and `checkpoint_every` are the
    command's and play no part here.

    Args:
      config: from `sejax.config`.

    Raises:
      ConfigError: if the configuration asks for more devices than there are.

    Source: paper, Algorithm 1.
    """
    program = make_program(config)

    def learn(key: Array) -> LearnResult:
        state, info = jax.lax.scan(
            lambda state, _: program.generation(state),
            program.init(key[None]),
            length=config.generations,
        )
        state, info = jax.tree.map(lambda x: x[0], state), jax.tree.map(lambda x: x[:, 0], info)
        return LearnResult(
            weights=program.unravel(state.best),
            score=state.best_score,
            generation=state.best_generation,
            last_weights=program.unravel(state.incumbent),
            info=info,
        )

    return learn


def make_program(config: LearnConfig) -> Program:
    """Assembles the bilevel loop for `[seed]` independent runs. See `Program`."""
    task = config.env.make()
    env = make_proxy(task, config.proxy)
    flat, unravel = ravel_pytree(env.init_weights(jax.random.key(0)))
    strategy = make_strategy(config.es, flat.size)
    score_candidates = make_population_scorer(config, task, env, unravel)
    objective = make_objective(config.objective, task.solved_reward)
    solved_score = task.solved_reward if config.objective.name == "max_reward" else None

    def init(keys: Array) -> LearnState:
        num_seeds = keys.shape[0]
        key_weights, key_es, key_run = (
            k for k in jax.vmap(lambda k: jax.random.split(k, 3))(keys).T
        )
        mean = jax.vmap(lambda key: ravel_pytree(env.init_weights(key))[0])(key_weights)
        state = LearnState(
            key=key_run,
            es_state=jax.vmap(strategy.init)(key_es, mean),
            generation=jnp.zeros(num_seeds, jnp.int32),
            incumbent=mean,
            incumbent_score=jnp.full(num_seeds, -jnp.inf),
            best=mean,
            best_score=jnp.full(num_seeds, -jnp.inf),
            best_generation=jnp.full(num_seeds, -1, jnp.int32),
            env_steps=jnp.zeros(num_seeds, jnp.int32),
            finished=jnp.zeros(num_seeds, bool),
        )
        return jax.tree.map(_strongly_typed, state)

    def generation(state: LearnState) -> tuple[LearnState, GenerationInfo]:
        """One pass of Algorithm 1's outer loop for every seed; a scan body."""
        keys = jax.vmap(jax.random.fold_in)(state.key, state.generation)
        key_ask, key_inner, key_tell = (
            k for k in jax.vmap(lambda k: jax.random.split(k, 3))(keys).T
        )
        candidates, asked = jax.vmap(strategy.ask)(key_ask, state.es_state)
        outcome = score_candidates(strategy.seed_ids, key_inner, candidates, ~state.finished)
        scores = objective(outcome)  # [seed, candidates]
        num_nonfinite = (~jnp.isfinite(scores)).sum(axis=1)
        scores = jax.vmap(_rank_diverged_incumbents_last, (0, None))(
            scores, strategy.num_incumbent_evals
        )
        told = jax.vmap(strategy.tell)(key_tell, candidates, scores, asked)
        stepped = _advance(state, told, jax.vmap(strategy.incumbent)(asked), scores, outcome)
        stepped = jax.tree.map(lambda new, old: _where(state.finished, old, new), stepped, state)
        return stepped, _summarise(state, stepped, scores, outcome, num_nonfinite)

    def _advance(
        state: LearnState, told: Any, incumbent: Array, scores: Array, outcome: Outcome
    ) -> LearnState:
        """Records what this generation measured of its incumbent and keeps the best one."""
        score = jax.vmap(finite_mean)(scores[:, -strategy.num_incumbent_evals :])
        score = jnp.where(jnp.isfinite(score), score, -jnp.inf)
        better = score > state.best_score
        finished = state.finished
        if config.stop_when_solved and solved_score is not None:
            finished = score >= solved_score
        return LearnState(
            key=state.key,
            es_state=told,
            generation=state.generation + 1,
            incumbent=incumbent,
            incumbent_score=score,
            best=_where(better, incumbent, state.best),
            best_score=jnp.where(better, score, state.best_score),
            best_generation=jnp.where(better, state.generation, state.best_generation),
            env_steps=state.env_steps + outcome.real_steps.sum(axis=1),
            finished=finished,
        )

    def _summarise(
        before: LearnState,
        after: LearnState,
        scores: Array,
        outcome: Outcome,
        num_nonfinite: Array,
    ) -> GenerationInfo:
        num_perturbed = strategy.num_candidates - strategy.num_incumbent_evals
        perturbed, incumbent = scores[:, :num_perturbed], scores[:, num_perturbed:]
        return GenerationInfo(
            generation=before.generation,
            incumbent_mean=jax.vmap(finite_mean)(incumbent),
            incumbent_std=jnp.nanstd(incumbent, axis=1),
            population_mean=jax.vmap(finite_mean)(perturbed),
            population_max=jnp.nanmax(perturbed, axis=1),
            best_so_far=after.best_score,
            train_steps_mean=outcome.train_steps.mean(axis=1),
            train_steps_max=outcome.train_steps.max(axis=1),
            train_episodes_mean=outcome.train_episodes.mean(axis=1),
            num_nonfinite=num_nonfinite,
            env_steps_total=after.env_steps,
            train_steps_total=outcome.train_steps.sum(axis=1),
            active=~before.finished,
        )

    return Program(
        init=init,
        generation=generation,
        unravel=unravel,
        env=env,
        task=task,
        solved_score=solved_score,
        num_dims=flat.size,
        num_candidates=strategy.num_candidates,
    )


def make_population_scorer(
    config: LearnConfig, task: envs.Task, env: ProxyEnv, unravel: Callable[[Array], Any]
) -> Callable[..., Outcome]:
    """Builds `score(seed_ids [n], keys [seed], candidates [seed, n, dims], active [seed])`.

    It trains one fresh agent on each candidate, tests it on the real task, and returns an
    `Outcome` with leaves `[seed, n, ...]`. The trainings are spread over the devices; on each
    device groups of `config.lanes` of them follow one another.
    """
    make = make_varied_agents if config.agent_hparams == "varied" else make_agent
    agent = make(config.agent, task, config.exploration)
    # The area under a learning curve that ends when the task is solved would reward learning late.
    stop_reward = jnp.inf if config.objective.needs_curve else None
    evaluate, cpu_lanes = evaluator_and_lanes(agent, env, task, config.training, stop_reward)

    def evaluate_candidate(key: Array, candidate: Array, active: Array) -> Outcome:
        return evaluate(key, env.params(unravel(candidate)), active)

    evaluate_many = spread_over_devices(evaluate_candidate, config.devices, config.lanes, cpu_lanes)

    def score(seed_ids: Array, keys: Array, candidates: Array, active: Array) -> Outcome:
        num_seeds, num_candidates, num_dims = candidates.shape
        fold = jax.vmap(jax.vmap(jax.random.fold_in, (None, 0)), (0, None))
        outcome = evaluate_many(
            fold(keys, jnp.asarray(seed_ids)).reshape(-1),
            candidates.reshape(-1, num_dims),
            jnp.repeat(active, num_candidates),
        )
        return jax.tree.map(lambda x: x.reshape(num_seeds, num_candidates, *x.shape[1:]), outcome)

    return score


def _rank_diverged_incumbents_last(
    scores: Float[Array, " candidates"], num_incumbent_evals: int
) -> Float[Array, " candidates"]:
    """Gives the incumbent's agents that diverged the lowest finite score of the generation.

    A mean without them would rank an incumbent by the agents that survived it. One that none
    survived has no score. Members keep nan: the strategy ranks these last itself.
    """
    finite = jnp.isfinite(scores)
    lowest = jnp.nanmin(jnp.where(finite, scores, jnp.nan))
    is_incumbent = jnp.arange(scores.size) >= scores.size - num_incumbent_evals
    return jnp.where(is_incumbent & ~finite & (is_incumbent & finite).any(), lowest, scores)


def _strongly_typed(x: Array) -> Array:
    """As a generation returns it: a weak type would be another signature and compile anew."""
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return x if is_key else jax.lax.convert_element_type(x, x.dtype)


def _where(mask: Array, a: Array, b: Array) -> Array:
    """Selects along the leading axis; keys too."""
    return jax.vmap(jnp.where)(mask, a, b)


__all__ = ["LearnResult", "LearnState", "Program", "make_learner", "make_program"]
