"""The trainings of a generation: fresh agents on the population and on the incumbent.

Source: paper, Algorithm 1 (TrainAgent and EvaluateAgent, for all candidates).
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PyTree

from sejax.agents.base import Agent
from sejax.es.base import StrategyState
from sejax.evaluation import make_evaluator, tested_throughout
from sejax.objectives import Outcome
from sejax.ops.parallel import spread_groups_over_devices
from sejax.proxies.base import ProxyEnv
from sejax.scoring import Scoring
from sejax.training import TrainingConfig, num_parallel_on_cpu


@struct.dataclass
class Candidates:
    """What a generation evaluates, and what `Strategy.tell` needs beside the scores."""

    population: Float[Array, "pop dims"]
    incumbent: Float[Array, " dims"]
    keys: Array  # of the trainings
    active: Array  # whether anything is to be computed
    test_params: PyTree  # of `Objective.test_env`; None for the task's
    key_tell: Array
    es_state: StrategyState  # after `Strategy.ask`


@struct.dataclass
class Trainings:
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
      scoring: which agent trains on which candidate, how often, and the world of test episodes.
      devices: None for all.
      num_parallel: None: chosen for each agent.

    Attributes:
      devices: as given.
      evaluators: for each agent, `(training) -> Outcome`, for one of its `Trainings`.
      widths: for each agent, the trainings in a vmapped batch on a CPU core; None for all.
      num_trainings: for each agent, the number of trainings in a generation.

    Raises:
      ConfigError: if there are fewer than `devices` devices.
    """

    def __init__(
        self,
        proxy: ProxyEnv,
        unravel: Callable[[Float[Array, " dims"]], PyTree],
        training: TrainingConfig,
        scoring: Scoring,
        devices: int | None = None,
        num_parallel: int | None = None,
    ):
        self.devices = devices
        agents, objective = scoring.mixture.agents, scoring.objective
        training = tested_throughout(training) if objective.needs_tests else training

        def evaluator_of(agent: Agent) -> Callable[[Trainings], Outcome]:
            task, test_env = proxy.task, objective.test_env
            evaluate = make_evaluator(agent, proxy, task, training, test_env, in_batches=False)

            def run(one: Trainings) -> Outcome:
                params = proxy.params(unravel(one.weights))
                return evaluate(one.key, params, one.active, one.test_params)

            return run

        self.evaluators = [evaluator_of(agent) for agent in agents]
        self.widths = [num_parallel_on_cpu(agent, training) for agent in agents]
        self.num_trainings = [scoring.training_numbers(i).size for i in range(len(agents))]
        self._scoring = scoring
        self._spread = spread_groups_over_devices(
            self.evaluators, devices, num_parallel, self.widths
        )

    def __call__(self, candidates: Candidates) -> Outcome:
        return self.joined(self._spread([(of_agent,) for of_agent in self.trainings(candidates)]))

    def trainings(self, candidates: Candidates) -> list[Trainings]:
        """The trainings of each agent: on its candidates, and then on the incumbent."""
        shared, by_agent = (candidates.active, candidates.test_params), []
        weights = jnp.concatenate([candidates.population, candidates.incumbent[None]])
        num_evals = self._scoring.strategy.num_evals
        for agent_index, size in enumerate(self.num_trainings):
            numbers = self._scoring.training_numbers(agent_index)
            rows = np.minimum(numbers // num_evals, len(weights) - 1)  # the incumbent's is the last
            active, test_params = jax.tree.map(
                lambda x, size=size: jnp.broadcast_to(x, (size, *jnp.shape(x))), shared
            )
            trainings = Trainings(
                key=candidates.keys[numbers],
                weights=weights[rows],
                active=active,
                test_params=test_params,
            )
            by_agent.append(trainings)
        return by_agent

    def joined(self, by_agent: Sequence[Outcome]) -> Outcome:
        """The outcomes of all `trainings`: by candidate, and then by turn of the incumbent.

        A single agent's outcomes are not copied: XLA would round sums over a copy differently.
        """
        if len(by_agent) == 1:
            return by_agent[0]
        numbers = [self._scoring.training_numbers(i) for i in range(len(by_agent))]
        order = np.argsort(np.concatenate(numbers))
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[order], *by_agent)
