"""From the outcomes of a generation to scores: what the strategy compares, what people see."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from sejax.agents.mixture import Mixture
from sejax.es.base import Evaluations, Strategy, finite_mean
from sejax.objectives import Objective, Outcome
from sejax.options import require


@struct.dataclass
class Scores:
    """Scores of a generation.

    Attributes:
      population: one for each evaluation of the population, `[evaluation]`; not finite for agents
        that diverged.
      incumbent: one for each evaluation of the incumbent, agents that diverged ranked last.
      agent_means: means of the incumbent's for each agent of a mixture, `[agent]`; nan where none
        survived.
      incumbent_mean: the incumbent's score, `[]`; nan if no evaluation with one agent survived.
      diverged: whether an evaluation's score is not finite, `[evaluation]`, the incumbent's last.
    """

    population: Float[Array, " evaluation"]
    incumbent: Float[Array, " incumbent"]
    agent_means: Float[Array, " agent"]
    incumbent_mean: Float[Array, ""]
    diverged: Bool[Array, " all"]


@dataclass(frozen=True, kw_only=True)
class Scoring:
    """How outcomes become scores, with one agent or a mixture, with or without a curriculum.

    Attributes:
      objective: the score of one outcome.
      mixture: the agents.
      evaluations: how often each candidate is evaluated.
      agent_of_candidate: index of the agent that trains on each candidate, `[pop]`.
      agent_of_evaluation: the same for each evaluation, `[evaluation]`.
    """

    objective: Objective
    mixture: Mixture
    evaluations: Evaluations
    agent_of_candidate: np.ndarray
    agent_of_evaluation: np.ndarray

    @classmethod
    def of(cls, objective: Objective, strategy: Strategy, mixture: Mixture) -> "Scoring":
        """The scoring of a strategy's population.

        Raises:
          ConfigError: if the population is too small for the mixture, or the strategy compares
            scores of several generations where their units differ.
        """
        one_unit = mixture.size == 1 and objective.eval_steps is None
        require(
            one_unit or not strategy.remembers_scores,
            "es",
            "compare scores within a generation only",
            "with several agents or a curriculum, scores of different generations are not "
            "comparable",
            "a strategy that remembers scores",
            "es=nes",
        )
        asked = strategy.evaluations
        evaluations = dataclasses.replace(
            asked, num_incumbent_evals=mixture.num_evals(asked.num_incumbent_evals)
        )
        agent_of_candidate = mixture.agent_of_candidate(
            strategy.population_size, strategy.antithetic
        )
        return cls(
            objective=objective,
            mixture=mixture,
            evaluations=evaluations,
            agent_of_candidate=agent_of_candidate,
            agent_of_evaluation=evaluations.agents(agent_of_candidate, mixture.size),
        )

    def for_strategy(self, outcome: Outcome) -> tuple[Float[Array, " pop"], Float[Array, ""]]:
        """Scores of the population and of the incumbent in one unit, for `Strategy.tell`."""
        scores = self._scores(self.objective(outcome))
        population = self.evaluations.population_scores(scores.population)
        return self.mixture.comparable(population, self.agent_of_candidate, scores.agent_means)

    def of_whole_tests(self, outcome: Outcome) -> Scores:
        """The scores that people see; with a curriculum, those of whole test episodes."""
        if self.objective.eval_steps is None:
            return self._scores(self.objective(outcome))
        return self._scores(self.objective.of_whole_tests(outcome))

    def by_agent(self, statistic: Callable[[Array], Array], values: Array) -> Array:
        """A statistic of the evaluations `[evaluation]` of each agent, `[agent]`."""
        agents = self.agent_of_evaluation[: values.shape[0]]
        return jnp.stack([statistic(values[agents == i]) for i in range(self.mixture.size)])

    def _scores(self, scores: Float[Array, " evaluation"]) -> Scores:
        population, incumbent = self.evaluations.split(scores)
        num_population = population.shape[0]
        of_population = self.agent_of_evaluation[:num_population]
        of_incumbent = self.agent_of_evaluation[num_population:]
        means = []
        for i in range(self.mixture.size):
            places = np.flatnonzero(of_incumbent == i)
            repaired, mean = self.evaluations.incumbent_scores(
                incumbent[places], population[of_population == i]
            )
            incumbent = incumbent.at[places].set(repaired)
            means.append(mean)
        agent_means = jnp.stack(means)
        return Scores(
            population=population,
            incumbent=incumbent,
            agent_means=agent_means,
            incumbent_mean=self.mixture.aggregated(agent_means),
            diverged=~jnp.isfinite(scores),
        )


@struct.dataclass
class AgentInfo:
    """Statistics for each agent of a mixture, `[agent]`."""

    incumbent_mean: Array
    population_mean: Array
    train_steps_mean: Array
    num_nonfinite: Array


@struct.dataclass
class GenerationInfo:
    """Statistics of a generation: the columns of `metrics.csv`, and what they are made of."""

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
    by_agent: AgentInfo
    population_scores: Float[Array, " evaluation"]
    train_steps: Array  # `[evaluation]` int32; sums may exceed 32 bits and are made on the host
    real_steps: Array  # likewise: steps on the real task
    active: Array  # False for a generation of a run that was over


def generation_info(
    scoring: Scoring, scores: Scores, outcome: Outcome, generation: Any, best: Any, active: Any
) -> GenerationInfo:
    """The statistics of `scores` and `outcome`."""
    return GenerationInfo(
        generation=generation,
        incumbent_mean=scores.incumbent_mean,
        incumbent_std=jnp.nanstd(scores.incumbent),
        population_mean=finite_mean(scores.population),
        population_max=jnp.nanmax(scores.population),
        best_so_far=best,
        train_steps_mean=outcome.train_steps.mean(),
        train_steps_max=outcome.train_steps.max(),
        train_episodes_mean=outcome.train_episodes.mean(),
        num_nonfinite=scores.diverged.sum(),
        by_agent=AgentInfo(
            incumbent_mean=scores.agent_means,
            population_mean=scoring.by_agent(finite_mean, scores.population),
            train_steps_mean=scoring.by_agent(jnp.mean, outcome.train_steps),
            num_nonfinite=scoring.by_agent(jnp.sum, scores.diverged),
        ),
        population_scores=scores.population,
        train_steps=outcome.train_steps,
        real_steps=outcome.real_steps,
        active=active,
    )
