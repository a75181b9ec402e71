"""SEs that rank: what configurations of an agent reach on the SE ranks them as the real task does.

The real returns of the configurations are measured once, in a landscape. A candidate is then scored
by the agreement of ranks: agents with each configuration train on it, and no real step is taken.

Source: the use is the paper's ("cheap-to-run environments for AutoML"); the objective is ours.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, PyTree

from sejax import landscapes
from sejax.agents import make_agent
from sejax.agents.base import Agent, AgentConfig, Hparams, with_hparams
from sejax.agents.mixture import Mixture
from sejax.envs.base import Task
from sejax.evaluation import make_proxy_tester, num_parallel_on_cpu
from sejax.landscapes import Landscape
from sejax.objectives import Agreement, Evaluator, Objective, Outcome
from sejax.ops.parallel import compiler_options, map_in_batches, on_cpu, spread_over_devices
from sejax.options import (
    Options,
    between,
    counts,
    marks,
    one_of,
    option,
    registry,
    require,
    shortened,
)
from sejax.options.plain import to_plain
from sejax.proxies.base import ProxyEnv
from sejax.proxies.header import agents_of
from sejax.proxies.io import ProxySet
from sejax.proxies.tuners import TRANSFER
from sejax.training import TrainingConfig, make_trainer, training_of

AGREEMENTS = ("spearman", "top")
MEASURES = ("both", "greedy", "training")
SIZES = ("hidden_size", "batch_size")  # options that an agent has room for, beside traced ones
CHUNK = 128  # most configurations of one call of a program, so that memory stays small


@dataclass(frozen=True, kw_only=True)
class Ranking(Options):
    """Agreement of the ranks of a landscape's configurations on the SE and on the real task."""

    group: ClassVar[str] = "objective"
    scores_are_returns: ClassVar[bool] = False
    scores_all_agents: ClassVar[bool] = True  # as one, with a candidate
    decimals: ClassVar[int] = 3  # of a score, for people

    landscape: str | None = None  # CSV file of `python -m sejax.landscape`
    # Of a training of the landscape; null: as its file says, which is then kept with the proxy.
    steps: int | None = option(None, counts("an agent must train"))
    # What an agent reaches on an SE: the return of greedy episodes, by which configurations are
    # ranked later, that of training episodes, or both, whose agreements are averaged.
    measure: str = option("greedy", one_of(MEASURES))
    # spearman: Pearson's correlation of ranks; top: of the squares of ranks, so that the best
    # configurations weigh more.
    agreement: str = option("spearman", one_of(AGREEMENTS))
    # Share of each agent's configurations, the last ones, that judge incumbents; no candidate is
    # learned from them.
    judging: float = option(0.25, between(0.05, 0.9, "some must learn and some must judge"))
    # Configurations of each agent that a generation draws anew to learn from; all with null, and if
    # these are fewer.
    num_configs: int | None = option(48, counts("ranks compare several", least=2))
    # Trainings of a configuration on an SE, whose mean is ranked: of learning and of judging.
    num_seeds: int = option(1, counts("an agent must train"))
    num_judging_seeds: int = option(4, counts("an agent must train"))
    num_tests: int = option(32, counts("an agent must be tested"))  # greedy episodes on the SE

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.landscape is not None and self.steps is None:
            found = landscapes.read(self.landscape, f"{self.group}.landscape")
            object.__setattr__(self, "steps", next(iter(found.values())).steps)

    def make(self, task: Task) -> Objective:
        """The objective on a task.

        Raises:
          ConfigError: for a landscape that cannot be read, of another task, or with too few
            configurations.
        """
        found = self.landscapes(task.name)

        def evaluators(
            mixture: Mixture, proxy: ProxyEnv, training: TrainingConfig
        ) -> tuple[Evaluator, Evaluator]:
            return make_evaluators(self, found, mixture, proxy, training)

        return Objective(
            score=lambda outcome: agreement_of(outcome).learned_from,
            judge=lambda outcome: agreement_of(outcome).judging,
            evaluators=evaluators,
            meaning="the agreement of ranks on configurations that no candidate is learned from",
        )

    def landscapes(self, task: str) -> dict[str, Landscape]:
        """The landscapes by agent.

        Raises:
          ConfigError: as `make`.
        """
        field = f"{self.group}.landscape"
        require(
            self.landscape is not None,
            field,
            "must be given; got none. Set objective.landscape=FILE.csv, from python -m "
            "sejax.landscape.",
        )
        found = landscapes.read(str(self.landscape), field)
        for each in found.values():
            require(
                each.task == task,
                field,
                f"must be of {task}; got one of {shortened(each.task)}. Set env={each.task}.",
            )
            require(
                each.steps == self.steps,
                f"{self.group}.steps",
                f"must be {each.steps}, of the landscape; got {self.steps}. Set "
                f"{self.group}.steps=null.",
            )
            num_judging = self.num_judging(each)
            require(
                min(num_judging, each.size - num_judging) > 1,
                field,
                f"must leave two configurations to learn from and two to judge; got {each.size} of "
                f"{each.agent}. Measure more, or set objective.judging=0.5.",
            )
        return found

    def num_judging(self, landscape: Landscape) -> int:
        """Configurations that judge."""
        return round(self.judging * landscape.size)

    def require_agents(
        self, agents: Mapping[str, AgentConfig], task: str, training: TrainingConfig
    ) -> None:
        """Checks that a run's agents are those of the landscape, with the same options.

        Args:
          agents: their configurations by name.
          task: name of the task.
          training: on the proxies.

        Raises:
          ConfigError: if they are not.
        """
        require(
            training.is_fixed_length,
            "training.stop_rule",
            "must be never with objective=ranking, which compares agents after as many steps; got "
            f"{training.stop_rule}. Set training.stop_rule=never training.max_steps=500 "
            "training.max_episodes=500.",
        )
        found = self.landscapes(task)
        names, known = ",".join(agents), ",".join(found)
        require(
            set(agents) == set(found),
            "agent",
            f"must be {known}, of the landscape; got {names}. Set "
            + (f"agents=[{known}]." if len(found) > 1 else f"agent={known}."),
        )
        for name, config in agents.items():
            require_same_options(config, found[name], training.max_steps or 1)


def agreement_of(outcome: Outcome) -> Agreement:
    """The agreement that `Ranking`'s evaluators have put there."""
    assert outcome.agreement is not None
    return outcome.agreement


# --- hyperparameters -----------------------------------------------------------------------------


def require_same_options(config: AgentConfig, landscape: Landscape, steps: int) -> None:
    """Checks that an agent is the one whose configurations a landscape has.

    Args:
      config: of the agent.
      landscape: of this kind of agent.
      steps: of a training on the SE. Options that count steps must be as large a part of it as they
        are of a training of the landscape.

    Raises:
      ConfigError: for an option that differs, or that the agent does not have.
    """
    cls, own = type(config), to_plain(config)
    for name, value in landscape.options.items():
        if name in landscape.values or name == "name":
            continue
        expected = scaled(cls, name, value, steps / landscape.steps)
        require(
            name in own and own[name] == expected,
            f"agent.{name}",
            f"must be {expected}, as in the landscape; got {shortened(own.get(name))}. Set "
            f"agent.{name}={expected}.",
        )
    for name, values in landscape.values.items():
        is_size = name in SIZES and name in own
        require(
            is_size or marks(cls, name).get("traced"),
            "objective.landscape",
            f"must set numbers that a compiled program takes as arguments; got {shortened(name)}. "
            "Measure one with space=wide.",
        )
        if is_size:
            require(
                own[name] >= values.max(),
                f"agent.{name}",
                f"must have room for all configurations; got {own[name]}. Set "
                f"agent.{name}={values.max():g}.",
            )


def scaled(cls: type, name: str, value: Any, factor: float) -> Any:
    """An option's value in a training that is `factor` times as long, if it counts its steps."""
    if value is None or not marks(cls, name).get("counts_steps"):
        return value
    return max(1, round(value * factor))


def hparams_of(agent: Agent, values: Mapping[str, Array]) -> Hparams:
    """An agent's traced hyperparameters with these values; other axes than its own may lead."""
    return with_hparams(
        jax.tree.map(jnp.float32, agent.hparams), {k: jnp.float32(x) for k, x in values.items()}
    )


# --- what configurations reach on an SE ----------------------------------------------------------


@struct.dataclass
class Reached:
    """What an agent reaches on an SE, and at what cost; leaves `[*agent]`.

    Attributes:
      greedy: mean return of greedy episodes; -inf where training diverged.
      training: mean return of its training episodes; likewise.
      train_steps: its training steps.
      train_episodes: its training episodes.
    """

    greedy: Array
    training: Array
    train_steps: Array
    train_episodes: Array


def make_measure(
    agent: Agent, proxy: ProxyEnv, training: TrainingConfig, num_tests: int
) -> Callable[..., Reached]:
    """Builds `measure(key, env_params, hparams, active=True) -> Reached` of one agent on an SE."""
    train = make_trainer(agent, proxy, training)
    test = make_proxy_tester(agent, proxy, num_tests)

    def measure(
        key: Array, env_params: PyTree, hparams: Hparams, active: Array | bool = True
    ) -> Reached:
        key_train, key_test = jax.random.split(key)
        result = train(key_train, env_params, hparams, active)
        greedy = test(key_test, result.agent_state, env_params, active).returns.mean()
        mean = jnp.nansum(result.returns) / jnp.maximum(1, result.episodes)
        survived = ~result.nonfinite & jnp.isfinite(greedy) & jnp.isfinite(mean)
        return Reached(
            greedy=jnp.where(survived, greedy, -jnp.inf),
            training=jnp.where(survived, mean, -jnp.inf),
            train_steps=result.train_steps,
            train_episodes=result.episodes,
        )

    return measure


class Configurations(NamedTuple):
    """Some configurations of one agent, with what they reach on the real task.

    Attributes:
      agent: with room for all of them.
      values: what each sets, `[config]`, in a training on the SE.
      returns: on the real task, `[config]`.
    """

    agent: Agent
    values: dict[str, Array]
    returns: Array

    def take(self, places: Array | np.ndarray) -> "Configurations":
        """Those at these places."""
        taken = jax.tree.map(lambda x: x[places], (self.values, self.returns))
        return Configurations(self.agent, *taken)


def configurations_of(
    landscape: Landscape, agent: Agent, cls: type, steps: int | None
) -> Configurations:
    """A landscape's configurations in a training of `steps` steps on an SE."""
    factor = (steps or landscape.steps) / landscape.steps
    values = scaled_values(cls, landscape.values, factor)
    return Configurations(agent, values, jnp.float32(landscape.mean_returns))


def scaled_values(cls: type, values: Mapping[str, np.ndarray], factor: float) -> dict[str, Array]:
    """Values of options, `[config]` each, in a training that is `factor` times as long."""
    counted = {name for name in values if marks(cls, name).get("counts_steps")}
    return {
        name: jnp.float32(np.maximum(1, np.round(x * factor)) if name in counted else x)
        for name, x in values.items()
    }


def reach(
    keys: Array,
    env_params: PyTree,
    active: Array | bool,
    configurations: Configurations,
    measure: Callable[..., Reached],
    num_parallel: int | None,
) -> Reached:
    """What each configuration reaches with each key: leaves `[config, seed]`.

    Args:
      keys: `[config, seed]`.
      env_params: of the SE.
      active: whether anything is computed.
      configurations: that are trained.
      measure: of `make_measure`.
      num_parallel: trainings in one vmapped batch; None for all.
    """
    num_configs, num_seeds = keys.shape
    places = jnp.repeat(jnp.arange(num_configs), num_seeds)

    def one(key: Array, place: Array) -> Reached:
        values = {name: x[place] for name, x in configurations.values.items()}
        return measure(key, env_params, hparams_of(configurations.agent, values), active)

    reached = map_in_batches(one, num_parallel, (keys.reshape(-1), places))
    return jax.tree.map(lambda x: x.reshape(num_configs, num_seeds), reached)


# --- tuning on an SE -----------------------------------------------------------------------------


def training_on(ses: ProxySet, kind: str, transfer: int = TRANSFER) -> TrainingConfig:
    """How agents of a kind train on SEs that rank.

    The number of steps suits the kinds that the SEs were learned with; others have more.

    Args:
      ses: from `sejax.load_set`.
      kind: name of the kind, such as `sac`.
      transfer: times as long trainings, if none of the SEs' agents is of this kind.

    Raises:
      ConfigError: for SEs that are not stored.

    Source: ours; docs/tuners.md has what was measured.
    """
    training = training_of(ses)
    learned = agents_of(ses.config).values()
    took_part = any(isinstance(x, Mapping) and x.get("name") == kind for x in learned)
    times = 1 if took_part else transfer
    return dataclasses.replace(
        training,
        max_steps=None if training.max_steps is None else times * training.max_steps,
        max_episodes=times * training.max_episodes,
    )


def reached_on(
    ses: ProxySet,
    agent: AgentConfig,
    values: Mapping[str, np.ndarray],
    *,
    steps: int | None = None,
    training: TrainingConfig | None = None,
    num_seeds: int = 4,
    num_tests: int = 32,
    seed: int = 0,
    devices: int | None = None,
    num_parallel: int | None = None,
) -> Reached:
    """What configurations reach on SEs that were learned with `objective=ranking`.

    `mean_rank` of the result orders them.

    Args:
      ses: from `sejax.load_set`.
      agent: with room for all configurations, as it trains on the SE: options that count steps are
        those of `training`.
      values: by option, what each configuration sets on the real task, `[config]`. Options that
        count steps are scaled to a training on the SE.
      steps: of a training on the real task; by default those of the SEs' landscape.
      training: on the SE, such as `training_on`; by default as the SEs were learned with.
      num_seeds: trainings of each configuration on each SE.
      num_tests: greedy episodes after each.
      seed: of all of them.
      devices: None for all.
      num_parallel: trainings in one vmapped batch; None for what suits the agent and the device.

    Returns:
      Leaves `[se, config, seed]`.

    Raises:
      ConfigError: for SEs that were not learned so, unless `steps` is given.
    """
    stored = ses.config.get("objective", {})
    steps = steps or (stored.get("steps") if stored.get("name") == "ranking" else None)
    require(
        steps,
        "proxy",
        f"must be learned with objective=ranking; got {shortened(ses.path)}. Learn one with "
        "preset=ranking objective.landscape=FILE.csv.",
    )
    assert steps is not None
    training = training or training_of(ses)
    factor = (training.max_steps or steps) / steps
    made = make_agent(agent, ses.task)
    own = scaled_values(type(agent), values, factor)
    measure = make_measure(made, ses.env, training, num_tests)
    size = len(next(iter(values.values())))
    num_chunks = -(-size // CHUNK)
    shape = (len(ses), -(-size // num_chunks), num_seeds)
    # The same keys on all SEs: their differences are those of the SEs.
    keys = jax.random.split(jax.random.key(seed), (size, num_seeds))

    def one(key: Array, weights: PyTree, values: dict[str, Array]) -> Reached:
        return measure(key, ses.env.params(weights, ses.discount), hparams_of(made, values))

    def all_of(keys: Array, weights: PyTree, own: dict[str, Array]) -> Reached:
        se, config, _ = (x.reshape(-1) for x in np.indices(shape))
        width = num_parallel_on_cpu(made, training)
        spread = spread_over_devices(one, devices, num_parallel, width)
        of_each = jax.tree.map(lambda x: x[se], weights), jax.tree.map(lambda x: x[config], own)
        reached = spread(jnp.broadcast_to(keys, shape).reshape(-1), *of_each)
        return jax.tree.map(lambda x: x.reshape(shape), reached)

    compiled = jax.jit(all_of, compiler_options=compiler_options())
    parts = []
    for start in range(0, size, shape[1]):
        places = np.arange(start, start + shape[1]) % size
        some = {name: x[places] for name, x in own.items()}
        parts.append(jax.device_get(compiled(keys[places], ses.weights, some)))
    found: Reached = jax.tree.map(lambda *x: np.concatenate(x, axis=1)[:, :size], *parts)
    return found


def mean_rank(reached: Reached, measure: str = "greedy") -> np.ndarray:
    """Mean over SEs and measures of the ranks of configurations in [0, 1], `[config]`.

    Args:
      reached: leaves `[se, config, seed]`.
      measure: as of `Ranking`.
    """
    kinds = measures_of(measure)
    means = jnp.concatenate([jnp.asarray(getattr(reached, kind)).mean(axis=-1) for kind in kinds])
    return np.asarray(jax.vmap(ranks)(means).mean(axis=0))


def measures_of(measure: str) -> tuple[str, ...]:
    """The fields of `Reached` that a measure looks at."""
    return ("greedy", "training") if measure == "both" else (measure,)


# --- agreement -----------------------------------------------------------------------------------


def ranks(values: Float[Array, " n"]) -> Float[Array, " n"]:
    """Shares of the others that are lower, in [0, 1]; ties count half. What is nan ranks last."""
    values = jnp.where(jnp.isnan(values), -jnp.inf, values)
    lower = (values[None, :] < values[:, None]).sum(axis=1)
    equal = (values[None, :] == values[:, None]).sum(axis=1) - 1
    return (lower + 0.5 * equal) / (values.shape[0] - 1)


def agreement(
    reached: Float[Array, " n"], returns: Float[Array, " n"], kind: str
) -> Float[Array, ""]:
    """Agreement of the ranks of two lists of numbers in [-1, 1]; 0 where one is constant."""
    x, y = (ranks(each) for each in (reached, returns))
    if kind == "top":
        x, y = x**2, y**2
    x, y = x - x.mean(), y - y.mean()
    norm = jnp.sqrt((x**2).sum() * (y**2).sum())
    return jnp.where(norm > 0, (x * y).sum() / jnp.where(norm > 0, norm, 1.0), 0.0)


def mean_agreement(
    reached: Sequence[Float[Array, " config"]],
    returns: Sequence[Float[Array, " config"]],
    kind: str,
) -> Float[Array, ""]:
    """The mean over agents, `[config]` each; of several, its mean with that of all pooled."""
    within = jnp.stack(
        [agreement(x, y, kind) for x, y in zip(reached, returns, strict=True)]
    ).mean()
    if len(reached) == 1:
        return within
    pooled = agreement(jnp.concatenate(list(reached)), jnp.concatenate(list(returns)), kind)
    return (within + pooled) / 2


def make_evaluators(
    options: Ranking,
    found: Mapping[str, Landscape],
    mixture: Mixture,
    proxy: ProxyEnv,
    training: TrainingConfig,
) -> tuple[Evaluator, Evaluator]:
    """How `Ranking` evaluates a candidate of the population, and the incumbent.

    All candidates of a generation train the same configurations with the same keys if
    `es.common_random_numbers` is set. The incumbent's agents train those and then the judging ones.
    """
    # A mixture has its agents in an order of its own; a single one may have no name.
    names = mixture.names if mixture.size > 1 else tuple(found)
    require(
        set(names) == set(found),
        "agent",
        f"must be {', '.join(found)}, of the landscape; got {', '.join(names)}. Pass "
        "sejax.Mixture(agents=..., names=...) with these names.",
    )
    require(
        not proxy.is_real,
        "proxy",
        "must be an SE with objective=ranking, which takes no real step; got one on real dynamics. "
        "Set proxy=se.",
    )
    learning, judging, measures, widths = [], [], [], []
    for name, agent in zip(names, mixture.agents, strict=True):
        landscape, cls = found[name], registry.find("agent", name)
        each = configurations_of(landscape, agent, cls, training.max_steps)
        places, first = np.arange(landscape.size), landscape.size - options.num_judging(landscape)
        learning.append(each.take(places[:first]))
        judging.append(each.take(places[first:]))
        measures.append(make_measure(agent, proxy, training, options.num_tests))
        widths.append(num_parallel_on_cpu(agent, training) if on_cpu() else None)
    kinds = measures_of(options.measure)

    def agree(
        key: Array,
        env_params: PyTree,
        active: Array | bool,
        groups: Sequence[Configurations],
        num_seeds: int,
    ) -> tuple[Array, list[Reached]]:
        reached = []
        for i, (group, measure, width) in enumerate(zip(groups, measures, widths, strict=True)):
            keys = jax.random.split(jax.random.fold_in(key, i), (len(group.returns), num_seeds))
            reached.append(reach(keys, env_params, active, group, measure, width))
        returns = [group.returns for group in groups]
        agreements = [
            mean_agreement(
                [getattr(x, kind).mean(axis=1) for x in reached], returns, options.agreement
            )
            for kind in kinds
        ]
        return jnp.stack(agreements).mean(), reached

    def drawn(key: Array) -> list[Configurations]:
        def part(i: int, each: Configurations) -> Configurations:
            most, size = options.num_configs, len(each.returns)
            if most is None or most >= size:
                return each
            places = jax.random.permutation(jax.random.fold_in(key, i), size)
            return each.take(places[:most])

        return [part(i, each) for i, each in enumerate(learning)]

    def make_run(judges: bool) -> Callable[..., Outcome]:
        def run(key: Array, env_params: PyTree, active: Array | bool, _: Any = None) -> Outcome:
            key_draw, key_learn, key_judge = jax.random.split(key, 3)
            learned, reached = agree(
                key_learn, env_params, active, drawn(key_draw), options.num_seeds
            )
            judged = learned
            if judges:
                judged, more = agree(
                    key_judge, env_params, active, judging, options.num_judging_seeds
                )
                reached += more
            return _outcome(Agreement(learned_from=learned, judging=judged), reached)

        return run

    return (
        Evaluator(run=make_run(judges=False), cpu_num_parallel=1),
        Evaluator(run=make_run(judges=True), cpu_num_parallel=1),
    )


def _outcome(agreement: Agreement, reached: Sequence[Reached]) -> Outcome:
    """An outcome without tests on the real task; it is not finite if all trainings diverged."""
    survived: Bool[Array, ""] = jnp.stack([jnp.isfinite(x.greedy).any() for x in reached]).any()
    return Outcome(
        test_returns=jnp.full(1, jnp.nan),
        scored_returns=jnp.full(1, jnp.nan),
        train_steps=sum((x.train_steps.sum() for x in reached), jnp.int32(0)),
        train_episodes=sum((x.train_episodes.sum() for x in reached), jnp.int32(0)),
        auc=jnp.float32(0),
        nonfinite=~survived,
        real_steps=jnp.int32(0),
        agreement=agreement,
    )


__all__ = ["Ranking", "Reached", "agreement", "mean_rank", "ranks", "reached_on"]
