"""Algorithm 1: an evolution strategy outside, agent trainings inside, in one compiled program.

    for each generation:
      ask       the strategy for a population around the incumbent proxy
      evaluate  train one fresh agent on each candidate, test it on the real task
      tell      the strategy the scores, which moves the incumbent (the search mean)

Source: paper, Algorithm 1.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from sejax.agents.base import Agent
from sejax.agents.mixture import Mixture
from sejax.envs.base import Task
from sejax.es.base import Strategy, StrategyState
from sejax.es.nes import NESConfig
from sejax.generation import Candidates, GenerationEvaluator, Layout
from sejax.objectives import MaxReward, Objective, Outcome
from sejax.ops.parallel import copy_to_devices
from sejax.ops.scores import or_minus_inf, reaches
from sejax.options import LARGEST, Count, checked, require
from sejax.options.registry import Makes, make, require_part
from sejax.proxies.base import ProxyEnv
from sejax.proxies.synthetic import SyntheticConfig
from sejax.scoring import GenerationInfo, Scoring
from sejax.training import TrainingConfig


class ScoredProxy(struct.PyTreeNode):
    """An incumbent, and what the generation that measured it found."""

    weights: Float[Array, " dims"]
    score: Array  # `Scores.incumbent_mean`, or -inf
    by_agent: Float[Array, " agent"]  # `Scores.agent_means`, or -inf
    generation: Array  # int32; -1 if none has measured it


class LearnState(struct.PyTreeNode):
    """What the next generation needs, and the best proxy so far."""

    key: Array
    es_state: StrategyState
    generation: Array
    last: ScoredProxy  # the incumbent of the last generation, before its update
    best: ScoredProxy
    solved: Array  # `stop_when_solved` has ended the run: later generations train nothing


class LearnResult(struct.PyTreeNode):
    """Result of a whole run."""

    weights: PyTree  # of the best proxy, in the form of its `init_weights`
    score: Array  # incumbent mean of the best proxy
    generation: Array  # int32, the generation that measured the best proxy
    last_weights: PyTree  # of the last measured proxy
    info: GenerationInfo  # history, leaves [generation, ...]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Bilevel:
    """Algorithm 1 for one seed, as pure functions of its state; made by `make_bilevel`."""

    proxy: ProxyEnv
    layout: Layout  # the strategy and the agents
    scoring: Scoring
    evaluate: GenerationEvaluator
    unravel: Callable[[Array], PyTree]  # a flat vector [dims] to the proxy's weights
    stop_when_solved: bool

    @property
    def solved_score(self) -> float | None:
        """Incumbent mean at which the task counts as solved; None if scores cannot tell."""
        task = self.proxy.task
        can_tell = self.scoring.objective.scores_are_returns and task.is_solvable
        return task.solved_reward if can_tell else None

    def ends_run(self, score: Array) -> Array | bool:
        """Whether this incumbent mean ends the run."""
        return self.stop_when_solved and reaches(score, self.proxy.task.solved_reward)

    def init(self, key: Array) -> LearnState:
        """The state before the first generation, with random weights of the proxy."""
        key_weights, key_es, key_run = jax.random.split(key, 3)
        mean, _ = ravel_pytree(self.proxy.init_weights(key_weights))
        start = ScoredProxy(
            weights=mean,
            score=jnp.float32(-jnp.inf),
            by_agent=jnp.full(self.layout.mixture.size, -jnp.inf),
            generation=jnp.int32(-1),
        )
        state = LearnState(
            key=key_run,
            es_state=self.layout.strategy.init(key_es, mean),
            generation=jnp.int32(0),
            last=start,
            best=start,
            solved=jnp.bool_(False),
        )
        return copy_to_devices(state, self.evaluate.devices)

    def generation(self, state: LearnState) -> tuple[LearnState, GenerationInfo]:
        """One pass of Algorithm 1's outer loop."""
        candidates = self.ask(state)
        return self.tell(state, candidates, self.evaluate(candidates))

    def generations(self, state: LearnState, length: int) -> tuple[LearnState, GenerationInfo]:
        """Several passes; leaves of the info are `[length, ...]`."""
        return jax.lax.scan(lambda state, _: self.generation(state), state, length=length)

    def ask(self, state: LearnState) -> Candidates:
        """The population around the incumbent, and a key for each of their trainings."""
        key = jax.random.fold_in(state.key, state.generation)
        key_ask, key_inner, key_tell = jax.random.split(key, 3)
        population, es_state = self.layout.strategy.ask(key_ask, state.es_state)
        return Candidates(
            population=population,
            incumbent=self.layout.strategy.incumbent(es_state),
            keys=self.layout.keys(key_inner),
            active=~state.solved,
            test_params=self.scoring.objective.test_params(state.generation),
            key_tell=key_tell,
            es_state=es_state,
        )

    def tell(
        self, state: LearnState, candidates: Candidates, outcome: Outcome
    ) -> tuple[LearnState, GenerationInfo]:
        """Scores the outcomes, moves the incumbent, and keeps the best one so far.

        The strategy compares other numbers (`Scoring.candidate_scores`) than are kept and shown
        (`Scoring.shown_scores`). After a run is over nothing changes: each new leaf is dropped.

        Of equally good incumbents it keeps the last. Reason: once incumbents reach the task's
        highest return, the search still moves to weights that also teach when perturbed.
        """
        # XLA must not fuse the sums below into the program of the outcome: they would round
        # differently in another program.
        outcome = jax.lax.optimization_barrier(outcome)
        scores, incumbent_score = self.scoring.candidate_scores(outcome)
        es_state = self.layout.strategy.tell(
            candidates.key_tell, candidates.population, scores, incumbent_score, candidates.es_state
        )
        shown = self.scoring.shown_scores(outcome)
        measured = ScoredProxy(
            weights=candidates.incumbent,
            score=or_minus_inf(shown.incumbent_mean),
            by_agent=or_minus_inf(shown.agent_means),
            generation=state.generation,
        )
        is_best = (measured.score >= state.best.score) & jnp.isfinite(measured.score)
        after = state.replace(
            es_state=es_state,
            generation=state.generation + 1,
            last=measured,
            best=jax.tree.map(partial(jnp.where, is_best), measured, state.best),
            solved=state.solved | self.ends_run(measured.score),
        )
        after = jax.tree.map(lambda old, new: jnp.where(state.solved, old, new), state, after)
        active = ~state.solved
        return after, self.scoring.info(shown, outcome, state.generation, after.best.score, active)


def make_learner(
    config: Any = None, *, generations: int | None = None, **parts: Any
) -> Callable[[Array], LearnResult]:
    """Builds `learn(key) -> LearnResult`: all of Algorithm 1 as one pure function.

    `jax.jit` makes it one executable with the scan inside; `vmap` over keys makes several runs:
    each device then trains its part of the agents of every run, until the slowest has ended. The
    numbers are those of separate runs up to rounding.

    With `proxy = config.parts()["proxy"]` agents train on `proxy, proxy.params(result.weights)`,
    and `sejax.save(path, proxy, result.weights)` keeps what was learned.

    Args:
      config: from `sejax.config`, with all parts and `generations`. What is for the command, such
        as `seed` and `run_dir`, has no effect here.
      generations: n_o of Algorithm 1; by default the configuration's, or 100.
      **parts: arguments of `make_bilevel`: `task`, `agent`, and any others. No preset applies to
        them, and the proxy chooses none of the others: with a `RewardConfig` pass what the command
        takes, such as `objective=RewardThreshold()`.

    Raises:
      ConfigError: if the parts do not fit each other, or there are too few devices.
      TypeError: if neither a configuration nor a task and an agent are given.

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
        if not callable(getattr(config, "parts", None)):
            raise TypeError(f"config must be of sejax.config([...]); got {config!r:.60}.")
        if parts:
            raise TypeError(f"{', '.join(parts)} must be set in sejax.config([...]).")
        parts = config.parts()
        generations = config.generations if generations is None else generations
    generations = checked(100 if generations is None else generations, Count, "generations", 100)
    bilevel = make_bilevel(**parts)

    def learn(key: Array) -> LearnResult:
        state, info = bilevel.generations(bilevel.init(key), generations)
        return LearnResult(
            weights=bilevel.unravel(state.best.weights),
            score=state.best.score,
            generation=state.best.generation,
            last_weights=bilevel.unravel(state.last.weights),
            info=info,
        )

    return learn


def make_bilevel(
    *,
    task: Task,
    agent: Agent | Mixture,
    proxy: ProxyEnv | Makes[ProxyEnv] = SyntheticConfig(),
    es: Strategy | Makes[Strategy] = NESConfig(),
    objective: Objective | Makes[Objective] = MaxReward(),
    training: TrainingConfig = TrainingConfig(),
    stop_when_solved: bool = False,
    devices: int | None = None,
    num_parallel: int | None = None,
) -> Bilevel:
    """Builds Algorithm 1 from its parts; proxy, es and objective may be configurations.

    Args:
      task: the real task.
      agent: the agent that learns on the proxies, from `sejax.make_agent` or one of your own; or a
        mixture of agents (`sejax.Mixture`), which share the candidates.
      proxy, es, objective: by default a one-step SE, NES, and the mean test return.
      training: how long each agent trains, and how it is tested.
      stop_when_solved: whether a run ends at its first incumbent mean that solves the task.
      devices: devices to spread the candidates over; None for all.
      num_parallel: agents in one vmapped batch on a device; None: chosen by agent and device.

    Raises:
      ConfigError: if the parts do not fit each other, or there are too few devices.
    """
    require_part("task", Task, task)
    proxy = make("proxy", proxy, task)
    require(proxy.task is task, "proxy", "must be of the given task object. Set task=proxy.task.")
    objective = make("objective", objective, task)
    shapes = jax.eval_shape(proxy.init_weights, jax.random.key(0))
    size = sum(x.size for x in jax.tree.leaves(shapes))
    require(size <= LARGEST, "proxy", f"must have at most {LARGEST} weights", got=size)
    example, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, shapes))
    strategy = make("es", es, example.size)
    _require_population(strategy, example)
    layout = Layout(strategy=strategy, mixture=Mixture.of(agent))
    bilevel = Bilevel(
        proxy=proxy,
        layout=layout,
        scoring=Scoring(objective=objective, layout=layout),
        evaluate=GenerationEvaluator(
            proxy, unravel, training, objective, layout, devices=devices, num_parallel=num_parallel
        ),
        unravel=unravel,
        stop_when_solved=stop_when_solved,
    )
    can_stop = bilevel.solved_score is not None or not stop_when_solved
    require(can_stop, "stop_when_solved", "must be false, as these scores cannot say solved.")
    return bilevel


def _require_population(strategy: Strategy, example: Float[Array, " dims"]) -> None:
    """Checks that a strategy, which may be the user's own, asks for the population that it says."""

    def population(key: Array) -> Array:
        return strategy.ask(key, strategy.init(key, example))[0]

    shape = jax.eval_shape(population, jax.random.key(0)).shape
    expected = (strategy.num_candidates, example.size)
    require(shape == expected, "es", f"must ask for candidates {expected}", got=shape)
    least = min(strategy.num_evals, strategy.num_incumbent_evals)
    require(least > 0, "es", "must have num_evals and num_incumbent_evals of 1 or more", got=least)
    is_paired = not strategy.mirrored or shape[0] % 2 == 0
    require(is_paired, "es", "must ask for candidates in pairs, as mirrored ones", got=shape[0])
