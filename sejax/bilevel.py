"""The bilevel loop: NES outside, whole agent trainings inside, in one compiled program.

Assembles a proxy, an agent, a strategy and an objective; owns no maths of its own.

Source: paper, Algorithm 1.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from sejax import registry
from sejax.agents.base import Agent
from sejax.agents.mixture import Families
from sejax.envs.base import Task
from sejax.errors import require
from sejax.es.base import Strategy, Trials, finite_mean
from sejax.evaluation import make_evaluator, num_parallel_on_cpu, tested_throughout
from sejax.objectives import MaxReward, Objective, Outcome
from sejax.ops import flat
from sejax.ops.counters import exact, wide_add, wide_sum, wide_zeros
from sejax.ops.parallel import copy_to_devices, spread_groups_over_devices, spread_over_devices
from sejax.proxies.base import ProxyEnv
from sejax.training import TrainingConfig


@struct.dataclass
class LearnState:
    """Everything the next generation needs, and the best proxy so far. Leaves are `[seed, ...]`."""

    key: Array
    es_state: Any
    generation: Array
    incumbent: Float[Array, "seed dims"]  # as measured in the last generation, before its update
    incumbent_score: Array
    incumbent_scores: Float[Array, "seed family"]  # of which it is made
    best: Float[Array, "seed dims"]
    best_score: Array
    best_scores: Float[Array, "seed family"]
    best_generation: Array
    env_steps: Array  # a wide count, see `sejax.ops.counters`
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
    member_scores: Float[Array, "seed tried"]  # of each of the members' trials; no column
    families: "FamilyInfo"
    env_steps_wide: Array  # `[seed, 2]`; see `env_steps_total`
    train_steps_wide: Array  # `[seed, 2]`; see `train_steps_total`
    active: Array

    @property
    def env_steps_total(self) -> Any:
        """Steps on the real task so far, NumPy int64; for an info on the host."""
        return exact(self.env_steps_wide)

    @property
    def train_steps_total(self) -> Any:
        """Steps of all agents in this generation, NumPy int64; for an info on the host."""
        return exact(self.train_steps_wide)


@struct.dataclass
class FamilyInfo:
    """The same for each family of agents, `[seed, family]`."""

    incumbent_mean: Array
    population_mean: Array
    train_steps_mean: Array
    num_nonfinite: Array


@struct.dataclass
class LearnResult:
    """Result of a whole run.

    Attributes:
      weights: the best proxy's weights, as from its `init_weights`.
      score: its incumbent mean, `[]`.
      generation: the generation that measured it, `[]` int32.
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
    """The pure functions of a bilevel loop over `[seed]` independent runs.

    Attributes:
      init: `(keys [seed]) -> LearnState`.
      ask: `(LearnState) -> Asked`, what a generation tries.
      tell: `(LearnState, Asked, Outcome) -> (LearnState, GenerationInfo)`, the outcome of each
        trial with leaves `[seed, trials, ...]`.
      generation: `(LearnState) -> (LearnState, GenerationInfo)`: `ask`, a training for each trial,
        `tell`; a scan body over all seeds.
      test_steps: `(LearnState) -> [seed]`, how much of the test episodes is scored; None: all.
      share_of: `(family) -> evaluate`, where `evaluate(keys [n], candidates [n, dims], active [n],
        test_steps [n])` is the outcome of n trials of a family on one device, leaves `[n, ...]`:
        for processes that divide a generation's trials among themselves.
      unravel: flat parameters `[dims]` to the proxy's weights.
      proxy: what is learned.
      families: of agents that learn on it; one, if there is a single agent.
      family_of_trial: index of the family of each trial, `[trials]`.
      cpu_num_parallel: agents of each family that train in lockstep on a CPU core; None for all.
      strategy: that learns it.
      objective: that it is learned by.
      num_dims: length of a parameter vector.
    """

    init: Callable[[Array], LearnState]
    ask: Callable[[LearnState], "Asked"]
    tell: Callable[[LearnState, "Asked", Outcome], tuple[LearnState, GenerationInfo]]
    generation: Callable[[LearnState], tuple[LearnState, GenerationInfo]]
    test_steps: Callable[[LearnState], Array | None]
    share_of: Callable[[int], Callable[..., Outcome]]
    unravel: Callable[[Array], Any]
    proxy: ProxyEnv
    families: Families
    family_of_trial: np.ndarray
    cpu_num_parallel: tuple[int | None, ...]
    strategy: Strategy
    objective: Objective
    num_dims: int

    @property
    def task(self) -> Task:
        return self.proxy.task

    @property
    def agent(self) -> Agent:
        """The agent, or that of the first family."""
        return self.families.agents[0]

    @property
    def solved_score(self) -> float | None:
        """Incumbent mean at which the task counts as solved; None if no score says so."""
        if not (self.objective.scores_are_returns and self.task.is_solvable):
            return None
        return self.task.solved_reward


def make_learner(
    config: Any = None,
    *,
    task: Task | None = None,
    agent: Agent | Families | None = None,
    proxy: Any = None,
    es: Any = None,
    objective: Any = None,
    training: TrainingConfig | None = None,
    generations: int = 50,
    stop_when_solved: bool = False,
    devices: int | None = None,
    num_parallel: int | None = None,
) -> Callable[[Array], LearnResult]:
    """Builds `learn(key) -> LearnResult`: all of Algorithm 1 as one pure function.

    Jitted it is a single executable with the scan over generations inside; `vmap` it over keys for
    several runs at once.

    Args:
      config: from `sejax.config`, in the place of all others. Its `seed`, `num_seeds`, `run_dir`
        and `checkpoint_every` are the command's and play no part here.
      task: the real task.
      agent: that learns on the proxies, from `sejax.make_agent` or one of your own; or several of
        them (`sejax.Families`), among which the members of a generation take turns.
      proxy: a `ProxyEnv` of the task, or a configuration that makes one; an SE if not given.
      es: a `Strategy` over the proxy's weights, or a configuration with `make(num_dims) ->
        Strategy`; the paper's NES if not given.
      objective: an `Objective`, or a configuration that makes one; the mean test return if not
        given.
      training: how long each agent trains, and how it is tested.
      generations: n_o of Algorithm 1.
      stop_when_solved: whether a run ends at its first incumbent mean above the threshold.
      devices: to spread the population over; None for all.
      num_parallel: agents in lockstep on one device; None for what suits agent and device.

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
        return make_learner(**config.parts(), generations=config.generations)
    if task is None or agent is None:
        raise TypeError("make_learner needs a configuration, or a task and an agent.")
    program = make_program(
        task=task,
        agent=agent,
        proxy=proxy,
        es=es,
        objective=objective,
        training=training,
        stop_when_solved=stop_when_solved,
        devices=devices,
        num_parallel=num_parallel,
    )

    def learn(key: Array) -> LearnResult:
        state, info = jax.lax.scan(
            lambda state, _: program.generation(state),
            program.init(key[None]),
            length=generations,
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


def make_program(
    *,
    task: Task,
    agent: Agent | Families,
    proxy: Any = None,
    es: Any = None,
    objective: Any = None,
    training: TrainingConfig | None = None,
    stop_when_solved: bool = False,
    devices: int | None = None,
    num_parallel: int | None = None,
) -> Program:
    """Assembles the bilevel loop for `[seed]` independent runs; arguments as of `make_learner`."""
    proxy, objective = _proxy_of(proxy, task), _objective_of(objective, task)
    training = training or TrainingConfig()
    num_dims, unravel = _flat_weights(proxy)
    families, strategy = Families.of(agent), _strategy_of(es, num_dims)
    if objective.needs_tests:
        training = tested_throughout(training)
    trials = dataclasses.replace(
        strategy.trials,
        num_incumbent_evals=families.num_evals(strategy.trials.num_incumbent_evals),
    )
    strategy = dataclasses.replace(strategy, trials=trials)
    family_of_member = families.of_members(strategy.num_members, strategy.num_signs)
    family_of_trial = trials.families(family_of_member, families.size)
    evaluate_all = make_population_evaluator(
        families, proxy, training, unravel, family_of_trial, devices, num_parallel
    )
    cpu_num_parallel = tuple(num_parallel_on_cpu(agent, training) for agent in families.agents)
    seed_ids = jnp.asarray(trials.seed_ids(strategy.num_members))
    one_unit = families.size == 1 and objective.test_steps is None
    require(
        one_unit or not strategy.remembers_scores,
        "es",
        "be one that compares the members of a generation alone",
        "several families, or a curriculum, give each generation's scores a unit of its own",
        "one that remembers scores",
        "es=nes",
    )
    require(
        not stop_when_solved or (objective.scores_are_returns and task.is_solvable),
        "stop_when_solved",
        "be false with this objective and task",
        "nobody says which score solves it",
        "true",
        "stop_when_solved=false",
    )

    def init(keys: Array) -> LearnState:
        num_seeds = keys.shape[0]
        key_weights, key_es, key_run = (
            k for k in jax.vmap(lambda k: jax.random.split(k, 3))(keys).T
        )
        mean = jax.vmap(lambda key: flat.flatten(proxy.init_weights(key)))(key_weights)
        state = LearnState(
            key=key_run,
            es_state=jax.vmap(strategy.init)(key_es, mean),
            generation=jnp.zeros(num_seeds, jnp.int32),
            incumbent=mean,
            incumbent_score=jnp.full(num_seeds, -jnp.inf),
            incumbent_scores=jnp.full((num_seeds, families.size), -jnp.inf),
            best=mean,
            best_score=jnp.full(num_seeds, -jnp.inf),
            best_scores=jnp.full((num_seeds, families.size), -jnp.inf),
            best_generation=jnp.full(num_seeds, -1, jnp.int32),
            env_steps=wide_zeros(num_seeds),
            finished=jnp.zeros(num_seeds, bool),
        )
        return copy_to_devices(jax.tree.map(_strongly_typed, state), devices)

    def ask(state: LearnState) -> Asked:
        keys = jax.vmap(jax.random.fold_in)(state.key, state.generation)
        key_ask, key_inner, key_tell = (
            k for k in jax.vmap(lambda k: jax.random.split(k, 3))(keys).T
        )
        members, es_state = jax.vmap(strategy.ask)(key_ask, state.es_state)
        incumbent = jax.vmap(strategy.incumbent)(es_state)
        fold = jax.vmap(jax.vmap(jax.random.fold_in, (None, 0)), (0, None))
        return Asked(
            members=members,
            incumbent=incumbent,
            candidates=jax.vmap(trials.candidates)(members, incumbent),
            keys=fold(key_inner, seed_ids),
            key_tell=key_tell,
            es_state=es_state,
        )

    def tell(
        state: LearnState, asked: Asked, outcome: Outcome
    ) -> tuple[LearnState, GenerationInfo]:
        scores = Scores.of(objective(outcome), trials, families, family_of_trial)
        worth = scores
        if objective.test_steps is not None:  # which members are compared by
            worth = Scores.of(objective.of_whole_tests(outcome), trials, families, family_of_trial)
        members, incumbent = jax.vmap(
            lambda tried, means: families.comparable(
                trials.of_members(tried), family_of_member, means
            )
        )(scores.tried, scores.family_means)
        told = jax.vmap(strategy.tell)(
            asked.key_tell, asked.members, members, incumbent, asked.es_state
        )
        stepped = _advance(state, told, asked.incumbent, worth, outcome)
        if stop_when_solved:
            stepped = stepped.replace(finished=stepped.incumbent_score >= task.solved_reward)
        stepped = jax.tree.map(lambda new, old: _where(state.finished, old, new), stepped, state)
        return stepped, _summarise(state, stepped, worth, outcome, families, family_of_trial)

    def generation(state: LearnState) -> tuple[LearnState, GenerationInfo]:
        """One pass of Algorithm 1's outer loop for every seed; a scan body."""
        asked = ask(state)
        outcome = evaluate_all(asked.keys, asked.candidates, ~state.finished, test_steps(state))
        return tell(state, asked, outcome)

    def test_steps(state: LearnState) -> Array | None:
        return objective.test_steps and objective.test_steps(state.generation)

    def share_of(family: int) -> Callable[..., Outcome]:
        trial = make_trial(families.agents[family], proxy, training, unravel)
        return spread_over_devices(trial, 1, num_parallel, cpu_num_parallel[family])

    return Program(
        init=init,
        ask=ask,
        tell=tell,
        generation=generation,
        test_steps=test_steps,
        share_of=share_of,
        unravel=unravel,
        proxy=proxy,
        families=families,
        family_of_trial=family_of_trial,
        cpu_num_parallel=cpu_num_parallel,
        strategy=strategy,
        objective=objective,
        num_dims=num_dims,
    )


@struct.dataclass
class Asked:
    """What a generation tries, leaves `[seed, ...]`.

    Attributes:
      members: of the strategy, `[seed, members, dims]`.
      incumbent: `[seed, dims]`.
      candidates: what is tried, members and incumbent as often as they are, `[seed, trials, dims]`.
      keys: of the trainings, `[seed, trials]`.
      key_tell: `[seed]`.
      es_state: of the strategy.
    """

    members: Array
    incumbent: Array
    candidates: Array
    keys: Array
    key_tell: Array
    es_state: Any


@struct.dataclass
class Scores:
    """What a generation's trainings are worth, leaves `[seed, ...]`.

    Attributes:
      all: of all trials, in the task's unit or the objective's, `[seed, trials]`; not finite for
        agents that diverged.
      tried: of the members' trials, `[seed, tried]`.
      incumbent: of the incumbent's, with agents that diverged ranked last.
      family_means: means of these for each family, `[seed, family]`; nan where none survived.
      incumbent_mean: what the incumbent is worth, `[seed]`; nan if none survived of a family.
    """

    all: Array
    tried: Array
    incumbent: Array
    family_means: Array
    incumbent_mean: Array

    @classmethod
    def of(
        cls,
        scores: Float[Array, "seed trials"],
        trials: Trials,
        families: Families,
        family_of_trial: np.ndarray,
    ) -> "Scores":
        tried, incumbent = jax.vmap(trials.split)(scores)
        family_tried, family_incumbent = (
            family_of_trial[: tried.shape[1]],
            family_of_trial[tried.shape[1] :],
        )
        means = []
        for i in range(families.size):
            places = np.flatnonzero(family_incumbent == i)
            repaired, mean = jax.vmap(trials.of_incumbent)(
                incumbent[:, places], tried[:, family_tried == i]
            )
            incumbent = incumbent.at[:, places].set(repaired)
            means.append(mean)
        family_means = jnp.stack(means, axis=1)
        return cls(
            all=scores,
            tried=tried,
            incumbent=incumbent,
            family_means=family_means,
            incumbent_mean=jax.vmap(families.aggregated)(family_means),
        )


def _advance(
    state: LearnState, told: Any, incumbent: Array, scores: Scores, outcome: Outcome
) -> LearnState:
    """Records what this generation measured of its incumbent and keeps the best one.

    Of equally good incumbents the last stays: where the task's highest return ends the comparison,
    the search goes on to weights that teach under perturbation too.
    """
    score = scores.incumbent_mean
    score = jnp.where(jnp.isfinite(score), score, -jnp.inf)
    family_means = jnp.where(jnp.isfinite(scores.family_means), scores.family_means, -jnp.inf)
    better = (score >= state.best_score) & jnp.isfinite(score)
    return state.replace(
        es_state=told,
        generation=state.generation + 1,
        incumbent=incumbent,
        incumbent_score=score,
        incumbent_scores=family_means,
        best=_where(better, incumbent, state.best),
        best_score=jnp.where(better, score, state.best_score),
        best_scores=_where(better, family_means, state.best_scores),
        best_generation=jnp.where(better, state.generation, state.best_generation),
        env_steps=wide_add(state.env_steps, wide_sum(outcome.real_steps)),
    )


def _summarise(
    before: LearnState,
    after: LearnState,
    scores: Scores,
    outcome: Outcome,
    families: Families,
    family_of_trial: np.ndarray,
) -> GenerationInfo:
    diverged = ~jnp.isfinite(scores.all)
    num_tried = scores.tried.shape[1]

    def of_families(of_one: Callable[[np.ndarray], Array]) -> Array:
        return jnp.stack([of_one(family_of_trial == i) for i in range(families.size)], axis=1)

    return GenerationInfo(
        generation=before.generation,
        incumbent_mean=scores.incumbent_mean,
        incumbent_std=jnp.nanstd(scores.incumbent, axis=1),
        population_mean=jax.vmap(finite_mean)(scores.tried),
        population_max=jnp.nanmax(scores.tried, axis=1),
        best_so_far=after.best_score,
        train_steps_mean=outcome.train_steps.mean(axis=1),
        train_steps_max=outcome.train_steps.max(axis=1),
        train_episodes_mean=outcome.train_episodes.mean(axis=1),
        num_nonfinite=diverged.sum(axis=1),
        member_scores=scores.tried,
        families=FamilyInfo(
            incumbent_mean=scores.family_means,
            population_mean=of_families(
                lambda own: jax.vmap(finite_mean)(scores.tried[:, own[:num_tried]])
            ),
            train_steps_mean=of_families(lambda own: outcome.train_steps[:, own].mean(axis=1)),
            num_nonfinite=of_families(lambda own: diverged[:, own].sum(axis=1)),
        ),
        env_steps_wide=after.env_steps,
        train_steps_wide=wide_sum(outcome.train_steps),
        active=~before.finished,
    )


def make_population_evaluator(
    families: Families,
    proxy: ProxyEnv,
    training: TrainingConfig,
    unravel: Callable[[Array], Any],
    family_of_trial: np.ndarray,
    devices: int | None = None,
    num_parallel: int | None = None,
) -> Callable[..., Outcome]:
    """Builds `evaluate(keys, candidates, active, test_steps=None) -> Outcome`.

    Of `keys [seed, n]`, `candidates [seed, n, dims]`, `active [seed]` and how much of the test
    episodes is scored, `[seed]`. It trains one fresh agent on each candidate and tests it on the
    real task; leaves `[seed, n, ...]`. The trainings are spread over the devices, each device's
    family by family, as it is known when the program is built which family trains on which
    candidate: no training pays for another family's. Batches of `num_parallel` follow one another.
    """

    places = [np.flatnonzero(family_of_trial == i) for i in range(families.size)]
    order = np.argsort(np.concatenate(places))
    evaluate_groups = spread_groups_over_devices(
        [make_trial(agent, proxy, training, unravel) for agent in families.agents],
        devices,
        num_parallel,
        [num_parallel_on_cpu(agent, training) for agent in families.agents],
    )

    def evaluate_all(
        keys: Array, candidates: Array, active: Array, test_steps: Array | None = None
    ) -> Outcome:
        num_seeds, _, num_dims = candidates.shape
        of_seeds = (active, test_steps)
        outcomes = evaluate_groups(
            [
                (
                    keys[:, own].reshape(-1),
                    candidates[:, own].reshape(-1, num_dims),
                    *jax.tree.map(lambda x, n=own.size: jnp.repeat(x, n), of_seeds),
                )
                for own in places
            ]
        )

        def merged(*parts: Array) -> Array:
            by_seed = [x.reshape(num_seeds, -1, *x.shape[1:]) for x in parts]
            return jnp.concatenate(by_seed, axis=1)[:, order] if len(parts) > 1 else by_seed[0]

        return jax.tree.map(merged, *outcomes)

    return evaluate_all


def make_trial(
    agent: Agent, proxy: ProxyEnv, training: TrainingConfig, unravel: Callable[[Array], Any]
) -> Callable[..., Outcome]:
    """Builds `trial(key, candidate [dims], active, test_steps) -> Outcome`: one fresh agent's."""
    evaluate = make_evaluator(agent, proxy, proxy.task, training)
    return lambda key, candidate, active, test_steps: evaluate(
        key, proxy.params(unravel(candidate)), active, test_steps
    )


def _flat_weights(proxy: ProxyEnv) -> tuple[int, Callable[[Array], Any]]:
    """Length of a proxy's flat parameters, and what makes weights of them."""
    shapes = jax.eval_shape(proxy.init_weights, jax.random.key(0))
    return sum(x.size for x in jax.tree.leaves(shapes)), flat.inverse_of_flatten(shapes)


def _proxy_of(proxy: Any, task: Task) -> ProxyEnv:
    if proxy is None:
        from sejax.proxies.configs import SyntheticConfig

        proxy = SyntheticConfig()
    made = registry.make("proxy", proxy, task) if hasattr(proxy, "make") else proxy
    require(
        made.task is task,
        "proxy",
        "be one of the task given",
        "agents are tested there",
        f"one of another ({made.task.name})",
        "proxy to a configuration, or task to the proxy's",
    )
    return made


def _objective_of(objective: Any, task: Task) -> Objective:
    objective = MaxReward() if objective is None else objective
    return registry.make("objective", objective, task) if hasattr(objective, "make") else objective


def _strategy_of(es: Any, num_dims: int) -> Strategy:
    if es is None:
        from sejax.es.nes import NESConfig

        es = NESConfig()
    return es if isinstance(es, Strategy) else registry.make("es", es, num_dims)


def _strongly_typed(x: Array) -> Array:
    """As a generation returns it: a weak type would be another signature and compile anew."""
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return x if is_key else jax.lax.convert_element_type(x, x.dtype)


def _where(mask: Array, a: Array, b: Array) -> Array:
    """Selects along the leading axis; keys too."""
    return jax.vmap(jnp.where)(mask, a, b)
