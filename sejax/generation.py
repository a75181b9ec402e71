"""The trainings of a generation: fresh agents on the population and on the incumbent.

Source: paper, Algorithm 1 (TrainAgent and EvaluateAgent, for all candidates).
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PyTree

from sejax.agents.base import Agent
from sejax.agents.mixture import Mixture
from sejax.es.base import Strategy, StrategyState
from sejax.evaluation import make_evaluator, tested_throughout
from sejax.objectives import Objective, Outcome
from sejax.ops.parallel import spread_groups_over_devices
from sejax.proxies.base import ProxyEnv
from sejax.training import TrainingConfig, cpu_num_parallel_of


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Which training of a generation belongs to which candidate and agent, and its key.

    Trainings are numbered candidate by candidate, and then come those on the incumbent. So two
    agents, two mirrored pairs of candidates (0 and 2, 1 and 3), two evaluations of each candidate
    and two of the incumbent give:

    ========= ===== ===== ===== ===== =========
    candidate 0     1     2     3     incumbent
    trainings 0, 1  2, 3  4, 5  6, 7  8, 9
    agent     0     1     0     1     0, 1
    ========= ===== ===== ===== ===== =========

    Attributes:
      strategy: how many candidates a generation has, and how often each is evaluated.
      mixture: the agents.
    """

    strategy: Strategy
    mixture: Mixture

    @property
    def num_on_incumbent(self) -> int:
        """Trainings on the incumbent, rounded up to equally many with each agent."""
        return -(-self.strategy.num_incumbent_evals // self.mixture.size) * self.mixture.size

    @functools.cached_property
    def candidate_indices(self) -> tuple[np.ndarray, ...]:
        """For each agent, the indices of the candidates that it trains on.

        Raises:
          ConfigError: if the population is too small for the mixture.
        """
        return self.mixture.deal(self.strategy.num_candidates, self.strategy.mirrored)

    @property
    def num_on_candidates(self) -> int:
        """Trainings on candidates; those on the incumbent come after them."""
        return self.strategy.num_candidates * self.strategy.num_evals

    @functools.cached_property
    def training_indices(self) -> tuple[np.ndarray, ...]:
        """For each agent, the indices of all its trainings, ascending; see the table above."""
        by_candidate = np.arange(self.num_on_candidates).reshape(-1, self.strategy.num_evals)
        on_incumbent = self.num_on_candidates + np.arange(self.num_on_incumbent)
        turns = on_incumbent.reshape(-1, self.mixture.size).T  # [agent, turn]
        pairs = zip(self.candidate_indices, turns, strict=True)
        return tuple(np.append(by_candidate[candidates], turn) for candidates, turn in pairs)

    def keys(self, key: Array) -> Array:
        """A key for each training of a generation, `[training]`, from the generation's key."""
        of_population = np.arange(self.num_on_candidates)
        of_incumbent = np.arange(self.num_on_incumbent)
        if self.strategy.common_random_numbers:
            of_population = of_population % self.strategy.num_evals
            of_incumbent = of_incumbent // self.mixture.size
        else:
            of_incumbent = of_incumbent + of_population.size
        numbers = np.concatenate([of_population, of_incumbent])
        return jax.vmap(jax.random.fold_in, (None, 0))(key, numbers)


class Candidates(struct.PyTreeNode):
    """What `Bilevel.ask` gives: what a generation evaluates, and what `Strategy.tell` needs."""

    population: Float[Array, "pop dims"]
    incumbent: Float[Array, " dims"]
    keys: Array  # of the trainings
    active: Array  # whether anything is to be computed
    test_params: PyTree  # of `Objective.test_env`; None for the task's
    key_tell: Array
    es_state: StrategyState  # after `Strategy.ask`


class Trainings(struct.PyTreeNode):
    """The trainings of one agent in a generation, leaves `[training, ...]`."""

    key: Array
    weights: Float[Array, "training dims"]  # of the proxy, flat
    active: Array
    test_params: PyTree


class GenerationEvaluator:
    """`evaluate(candidates) -> Outcome`: all trainings of a generation, and their tests.

    Leaves are `[training, ...]`: candidate by candidate, and then the incumbent's trainings.

    One program holds them all. It spreads each agent's trainings, on candidates and on the
    incumbent, over the devices. Each device runs batches of `num_parallel` trainings one after the
    other; a batch has trainings of one agent alone.

    Args:
      proxy: the proxy; a candidate is a vector of its weights.
      unravel: turns a candidate into weights.
      training: how long each agent trains, and how it is tested.
      objective: the world of test episodes, and whether there are tests during training.
      layout: which agent trains on which candidate, and how often.
      devices: None for all.
      num_parallel: None: chosen for each agent.

    Attributes:
      devices: as given.
      evaluators: for each agent, `(training) -> Outcome`, for one of its `Trainings`.
      cpu_num_parallel: for each agent, the trainings in a vmapped batch of a CPU core; None: all.
      num_trainings: the number of trainings in a generation, with all agents.

    Raises:
      ConfigError: if there are fewer than `devices` devices.
    """

    def __init__(
        self,
        proxy: ProxyEnv,
        unravel: Callable[[Float[Array, " dims"]], PyTree],
        training: TrainingConfig,
        objective: Objective,
        layout: Layout,
        *,
        devices: int | None = None,
        num_parallel: int | None = None,
    ):
        self.devices = devices
        agents = layout.mixture.agents
        training = tested_throughout(training) if objective.needs_tests else training

        def evaluator_of(agent: Agent) -> Callable[[Trainings], Outcome]:
            evaluate = make_evaluator(
                agent, proxy, proxy.task, training, objective.test_env, in_batches=False
            )

            def evaluate_one(one: Trainings) -> Outcome:
                params = proxy.params(unravel(one.weights))
                return evaluate(one.key, params, one.active, one.test_params)

            return evaluate_one

        self.evaluators = [evaluator_of(agent) for agent in agents]
        # Not by the number of trainings: a population of any size gives the same bits.
        self.cpu_num_parallel = [cpu_num_parallel_of(agent, training) for agent in agents]
        self.num_trainings = layout.num_on_candidates + layout.num_on_incumbent
        self._layout = layout
        self._spread = spread_groups_over_devices(
            self.evaluators, self.cpu_num_parallel, num_devices=devices, num_parallel=num_parallel
        )

    def __call__(self, candidates: Candidates) -> Outcome:
        return self.joined(self._spread([(of_agent,) for of_agent in self.trainings(candidates)]))

    def trainings(self, candidates: Candidates) -> list[Trainings]:
        """The trainings of each agent: on its candidates, and then on the incumbent."""
        weights = jnp.concatenate([candidates.population, candidates.incumbent[None]])
        shared = candidates.active, candidates.test_params

        def of_agent(indices: np.ndarray) -> Trainings:
            # The incumbent's weights are the last.
            rows = np.minimum(indices // self._layout.strategy.num_evals, len(weights) - 1)
            active, test_params = jax.tree.map(
                lambda x: jnp.broadcast_to(x, (indices.size, *jnp.shape(x))), shared
            )
            return Trainings(candidates.keys[indices], weights[rows], active, test_params)

        return [of_agent(indices) for indices in self._layout.training_indices]

    def joined(self, by_agent: Sequence[Outcome]) -> Outcome:
        """The outcomes of all `trainings`: by candidate, and then by turn of the incumbent.

        A single agent's outcomes are not copied: XLA would round sums over a copy differently.
        """
        if len(by_agent) == 1:
            return by_agent[0]
        order = np.argsort(np.concatenate(self._layout.training_indices))
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[order], *by_agent)
