"""Algorithm 1: an evolution strategy outside, agent trainings inside, in one compiled program.

    for each generation:
      ask       the strategy for a population around the incumbent proxy
      evaluate  train one fresh agent on each candidate, test it on the real task
      tell      the strategy the scores, which moves the incumbent

Source: paper, Algorithm 1.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from sejax.agents.base import Agent
from sejax.agents.mixture import Mixture
from sejax.envs.base import Task
from sejax.es.base import Strategy
from sejax.es.nes import NESConfig
from sejax.evaluation import make_population_evaluator, tested_throughout
from sejax.objectives import (
    GenerationInfo,
    MaxReward,
    Objective,
    Outcome,
    Scores,
    Scoring,
    generation_info,
)
from sejax.ops import flat
from sejax.ops.parallel import copy_to_devices
from sejax.options import counts, registry, require, shortened
from sejax.proxies.base import ProxyEnv
from sejax.proxies.configs import SyntheticConfig
from sejax.training import TrainingConfig


@struct.dataclass
class LearnState:
    """What the next generation needs, and the best proxy so far."""

    key: Array
    es_state: Any
    generation: Array
    incumbent: Float[Array, " dims"]  # as the last generation measured it, before its update
    incumbent_score: Array
    incumbent_scores: Float[Array, " agent"]  # one for each agent of a mixture
    best: Float[Array, " dims"]
    best_score: Array
    best_scores: Float[Array, " agent"]
    best_generation: Array
    finished: Array  # stop_when_solved: the run is over and its generations cost nothing


@struct.dataclass
class Candidates:
    """What a generation evaluates.

    Attributes:
      population: vectors of the strategy, `[pop, dims]`.
      incumbent: `[dims]`.
      params: one vector for each evaluation, first those of the population, `[evaluation, dims]`.
      keys: of the trainings, `[evaluation]`.
      active: whether anything is to be computed, `[]`.
      eval_steps: length of the test episodes that are scored, `[]`; None for the task's limit.
      key_tell: for the strategy.
      es_state: the strategy's state after `ask`.
    """

    population: Float[Array, "pop dims"]
    incumbent: Float[Array, " dims"]
    params: Float[Array, "evaluation dims"]
    keys: Array
    active: Array
    eval_steps: Array | None
    key_tell: Array
    es_state: Any


@struct.dataclass
class LearnResult:
    """Result of a whole run.

    Attributes:
      weights: the best proxy's weights, as from its `init_weights`.
      score: its incumbent mean, `[]`.
      generation: the generation that measured it, `[]` int32.
      last_weights: the last proxy that was measured.
      info: history, leaves `[generation, ...]`.
    """

    weights: Any
    score: Array
    generation: Array
    last_weights: Any
    info: GenerationInfo


class Bilevel(NamedTuple):
    """The pure functions of Algorithm 1, and the parts that they are made of.

    Attributes:
      init: `key -> LearnState`.
      ask: `LearnState -> Candidates`.
      evaluate: `Candidates -> Outcome`, leaves `[evaluation, ...]`.
      tell: `(LearnState, Candidates, Outcome) -> (LearnState, GenerationInfo)`.
      generation: `LearnState -> (LearnState, GenerationInfo)`, the three of them; a scan body.
      unravel: a flat vector `[dims]` to the proxy's weights.
      num_dims: length of that vector.
      proxy, mixture, training, strategy, objective: as they are used.
    """

    init: Callable[[Array], LearnState]
    ask: Callable[[LearnState], Candidates]
    evaluate: Callable[[Candidates], Outcome]
    tell: Callable[[LearnState, Candidates, Outcome], tuple[LearnState, GenerationInfo]]
    generation: Callable[[LearnState], tuple[LearnState, GenerationInfo]]
    unravel: Callable[[Array], Any]
    num_dims: int
    proxy: ProxyEnv
    mixture: Mixture
    training: TrainingConfig
    strategy: Strategy
    objective: Objective

    @property
    def task(self) -> Task:
        return self.proxy.task

    @property
    def solved_score(self) -> float | None:
        """Incumbent mean at which the task counts as solved; None if no score says so."""
        can_be_solved = self.objective.scores_are_returns and self.task.is_solvable
        return self.task.solved_reward if can_be_solved else None


def make_learner(
    config: Any = None, *, generations: int = 100, **parts: Any
) -> Callable[[Array], LearnResult]:
    """Builds `learn(key) -> LearnResult`: all of Algorithm 1 as one pure function.

    Jitted it is a single executable with the scan over generations inside. `vmap` it over keys for
    several runs at once.

    Args:
      config: from `sejax.config`, in the place of all others. Its `seed`, `run_dir` and
        `checkpoint_every` are the command's and play no part here.
      generations: n_o of Algorithm 1.
      **parts: of `make_bilevel`: `task` and `agent`, and what differs from the defaults.

    Raises:
      ConfigError: if the parts do not fit each other, or there are not so many devices.
      TypeError: if neither a configuration nor a task and an agent are given.

    Source: paper, Algorithm 1.

    Example:
      >>> import sejax
      >>> task = sejax.envs.make("gridworld_2x2")
      >>> learn = make_learner(
      ...     task=task, agent=sejax.make_agent(sejax.QLearningConfig(), task),
      ...     proxy=sejax.SyntheticConfig(hidden_size=8), es=sejax.NESConfig(population_size=4),
      ...     training=sejax.TrainingConfig(max_steps=100), generations=2, devices=1)
      >>> jax.eval_shape(learn, jax.random.key(0)).info.incumbent_mean.shape
      (2,)
    """
    if config is not None:
        if not hasattr(config, "parts"):
            raise TypeError(f"config must come from sejax.config([...]); got {config!r:.60}.")
        return make_learner(**config.parts(), generations=config.generations)
    if "task" not in parts or "agent" not in parts:
        raise TypeError("make_learner needs a configuration, or a task and an agent.")
    counts("a run has at least one", most=1_000_000)("generations", generations, 100)
    bilevel = make_bilevel(**parts)

    def learn(key: Array) -> LearnResult:
        state, info = jax.lax.scan(
            lambda state, _: bilevel.generation(state), bilevel.init(key), length=generations
        )
        return LearnResult(
            weights=bilevel.unravel(state.best),
            score=state.best_score,
            generation=state.best_generation,
            last_weights=bilevel.unravel(state.incumbent),
            info=info,
        )

    return learn


def make_bilevel(
    *,
    task: Task,
    agent: Agent | Mixture,
    proxy: Any = None,
    es: Any = None,
    objective: Any = None,
    training: TrainingConfig | None = None,
    stop_when_solved: bool = False,
    devices: int | None = None,
    num_parallel: int | None = None,
) -> Bilevel:
    """Builds the pure functions of Algorithm 1.

    Args:
      task: the real task.
      agent: the agent that learns on the proxies, from `sejax.make_agent` or one of your own; or a
        mixture of agents (`sejax.Mixture`), among which the candidates are divided.
      proxy: a `ProxyEnv` of the task, or a configuration that makes one; default: an SE.
      es: a `Strategy` over the proxy's weights, or a configuration with `make(num_dims) ->
        Strategy`; default: the paper's NES.
      objective: an `Objective`, or a configuration that makes one; default: the mean test return.
      training: how long each agent trains, and how it is tested.
      stop_when_solved: whether a run ends at its first incumbent mean that reaches the threshold.
      devices: devices to spread the candidates over; None for all.
      num_parallel: agents that train in one vmapped batch on a device; None for what suits both.

    Raises:
      ConfigError: if the parts do not fit each other, or there are not so many devices.

    Source: paper, Algorithm 1.
    """
    _require_kind("task", task, Task)
    _require_kind("agent", agent, Agent, Mixture)
    proxy = _proxy_of(proxy, task)
    objective = _made("objective", Objective, objective or MaxReward(), task)
    shapes = jax.eval_shape(proxy.init_weights, jax.random.key(0))
    num_dims = sum(x.size for x in jax.tree.leaves(shapes))
    unravel = flat.inverse_of_flatten(shapes)
    strategy = _made("es", Strategy, es or NESConfig(), num_dims)
    mixture = Mixture.of(agent)
    training = training or TrainingConfig()
    if objective.needs_tests:
        training = tested_throughout(training)
    scoring = Scoring.of(objective, strategy, mixture)
    evaluations = scoring.evaluations
    strategy = dataclasses.replace(strategy, evaluations=evaluations)
    evaluate_candidates = make_population_evaluator(
        mixture, proxy, training, unravel, scoring.agent_of_evaluation, devices, num_parallel
    )
    seed_ids = jnp.asarray(evaluations.seed_ids(strategy.population_size))
    require(
        not stop_when_solved or (objective.scores_are_returns and task.is_solvable),
        "stop_when_solved",
        "must be false with this objective and task, because no score is known to solve it; got "
        "true. Set stop_when_solved=false.",
    )

    def init(key: Array) -> LearnState:
        key_weights, key_es, key_run = jax.random.split(key, 3)
        mean = flat.flatten(proxy.init_weights(key_weights))
        unknown = jnp.full(mixture.size, -jnp.inf)
        state = LearnState(
            key=key_run,
            es_state=strategy.init(key_es, mean),
            generation=jnp.int32(0),
            incumbent=mean,
            incumbent_score=jnp.float32(-jnp.inf),
            incumbent_scores=unknown,
            best=mean,
            best_score=jnp.float32(-jnp.inf),
            best_scores=unknown,
            best_generation=jnp.int32(-1),
            finished=jnp.bool_(False),
        )
        return copy_to_devices(jax.tree.map(_strongly_typed, state), devices)

    def ask(state: LearnState) -> Candidates:
        key = jax.random.fold_in(state.key, state.generation)
        key_ask, key_inner, key_tell = jax.random.split(key, 3)
        population, es_state = strategy.ask(key_ask, state.es_state)
        incumbent = strategy.incumbent(es_state)
        return Candidates(
            population=population,
            incumbent=incumbent,
            params=evaluations.params(population, incumbent),
            keys=jax.vmap(jax.random.fold_in, (None, 0))(key_inner, seed_ids),
            active=~state.finished,
            eval_steps=objective.eval_steps(state.generation) if objective.eval_steps else None,
            key_tell=key_tell,
            es_state=es_state,
        )

    def evaluate(candidates: Candidates) -> Outcome:
        return evaluate_candidates(
            candidates.keys, candidates.params, candidates.active, candidates.eval_steps
        )

    def tell(
        state: LearnState, candidates: Candidates, outcome: Outcome
    ) -> tuple[LearnState, GenerationInfo]:
        # The same sums whatever the outcome was computed by: XLA must not fuse them into it.
        outcome = jax.lax.optimization_barrier(outcome)
        population_scores, incumbent_score = scoring.for_strategy(outcome)
        es_state = strategy.tell(
            candidates.key_tell,
            candidates.population,
            population_scores,
            incumbent_score,
            candidates.es_state,
        )
        scores = scoring.of_whole_tests(outcome)
        after = _record(state, es_state, candidates.incumbent, scores)
        if stop_when_solved:
            after = after.replace(finished=after.incumbent_score >= task.solved_reward)
        after = _select(state.finished, state, after)
        info = generation_info(
            scoring, scores, outcome, state.generation, after.best_score, ~state.finished
        )
        return after, info

    def generation(state: LearnState) -> tuple[LearnState, GenerationInfo]:
        """One pass of Algorithm 1's outer loop."""
        candidates = ask(state)
        return tell(state, candidates, evaluate(candidates))

    return Bilevel(
        init=init,
        ask=ask,
        evaluate=evaluate,
        tell=tell,
        generation=generation,
        unravel=unravel,
        num_dims=num_dims,
        proxy=proxy,
        mixture=mixture,
        training=training,
        strategy=strategy,
        objective=objective,
    )


def _record(state: LearnState, es_state: Any, incumbent: Array, scores: Scores) -> LearnState:
    """The next state: what this generation measured of its incumbent, and the best one so far.

    Of equally good incumbents the last one is kept: where the task's highest return ends the
    comparison, the search goes on to weights that teach under perturbation too.
    """
    score, by_agent = _or_lowest(scores.incumbent_mean), _or_lowest(scores.agent_means)
    better = (score >= state.best_score) & jnp.isfinite(score)
    return state.replace(
        es_state=es_state,
        generation=state.generation + 1,
        incumbent=incumbent,
        incumbent_score=score,
        incumbent_scores=by_agent,
        best=jnp.where(better, incumbent, state.best),
        best_score=jnp.where(better, score, state.best_score),
        best_scores=jnp.where(better, by_agent, state.best_scores),
        best_generation=jnp.where(better, state.generation, state.best_generation),
    )


def _proxy_of(proxy: Any, task: Task) -> ProxyEnv:
    made: ProxyEnv = _made("proxy", ProxyEnv, proxy or SyntheticConfig(), task)
    require(
        made.task is task,
        "proxy",
        "must be one of the task given, because agents are tested there; got one of another "
        f"({made.task.name}). Set proxy to a configuration, or task to the proxy's.",
    )
    return made


def _made(group: str, kind: type, part: Any, *arguments: Any) -> Any:
    """A part that is given as it is, or as a configuration that makes it."""
    if not isinstance(part, kind) and hasattr(part, "make"):
        return registry.make(group, part, *arguments)
    _require_kind(group, part, kind)
    return part


def _require_kind(name: str, part: Any, *kinds: type) -> None:
    words = " or a ".join(f"sejax.{kind.__name__}" for kind in kinds)
    require(
        isinstance(part, kinds),
        name,
        f"must be a {words}, or a configuration that makes one, because it is an object here, not "
        f"a name; got {shortened(repr(part))}. Set {name} to an object; sejax.config([...]) takes "
        "names.",
    )


def _or_lowest(scores: Array) -> Array:
    return jnp.where(jnp.isfinite(scores), scores, -jnp.inf)


def _select(condition: Array, a: LearnState, b: LearnState) -> LearnState:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _strongly_typed(x: Array) -> Array:
    """As a generation returns it: a weak type would be another signature and compile anew."""
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return x if is_key else jax.lax.convert_element_type(x, x.dtype)
