"""From the outcomes of a generation to the scores of its candidates.

`Scoring` applies an objective to both groups of a generation, the population and the incumbent, and
says which scores the strategy compares, and what people see.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from sejax.agents.mixture import Mixture
from sejax.es.base import Evaluations, Groups, Strategy
from sejax.objectives import Objective, Outcome
from sejax.ops.scores import finite_mean
from sejax.options import require


@struct.dataclass
class Scores:
    """Scores of a generation.

    Attributes:
      population: one for each training; not finite for agents that diverged.
      incumbent: one for each training, agents that diverged ranked last.
      agent_means: the incumbent's mean with each agent of a mixture; nan where none survived.
      incumbent_mean: the incumbent's score; nan if no training with one agent survived.
      diverged: whether the score of a training is not finite.
    """

    population: Float[Array, "pop evaluation"]
    incumbent: Float[Array, "turn agent"]
    agent_means: Float[Array, " agent"]
    incumbent_mean: Float[Array, ""]
    diverged: Groups[Array]


@struct.dataclass
class AgentInfo:
    """Statistics for each agent of a mixture, `[agent]`."""

    incumbent_mean: Array
    population_mean: Array
    train_steps_mean: Array
    num_nonfinite: Array


@struct.dataclass
class GenerationInfo:
    """Statistics of a generation."""

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
    train_steps: Array  # `[training]` int32; sums may exceed 32 bits and are made on the host
    real_steps: Array  # likewise: steps on the real task
    active: Array  # False for a generation of a run that was over


@dataclass(frozen=True, kw_only=True)
class Scoring:
    """How outcomes become scores, with one agent or a mixture.

    Attributes:
      objective: the score of one outcome.
      mixture: the agents.
      candidates: the numbers of those that each agent trains on.
      evaluations: how often each candidate is evaluated, the incumbent equally often by each agent.
    """

    objective: Objective
    mixture: Mixture
    candidates: tuple[np.ndarray, ...]
    evaluations: Evaluations

    @classmethod
    def of(cls, objective: Objective, strategy: Strategy, mixture: Mixture) -> "Scoring":
        """The scoring of a strategy's population.

        Raises:
          ConfigError: if the population is too small for the mixture, or the strategy compares
            scores of several generations where their units differ.
        """
        has_one_unit = mixture.size == 1 and objective.shown is None
        require(
            has_one_unit or not strategy.remembers_scores,
            "es",
            "must compare scores within a generation with several agents or a curriculum; got one "
            "that remembers scores. Set es=nes.",
        )
        num_evals = mixture.num_evals(strategy.evaluations.num_incumbent_evals)
        return cls(
            objective=objective,
            mixture=mixture,
            candidates=mixture.deal(strategy.population_size, strategy.antithetic),
            evaluations=dataclasses.replace(strategy.evaluations, num_incumbent_evals=num_evals),
        )

    def for_strategy(
        self, outcomes: Groups[Outcome]
    ) -> tuple[Float[Array, " pop"], Float[Array, ""]]:
        """Scores of the population and of the incumbent in one unit, for `Strategy.tell`."""
        scores = self._scores(self.objective, outcomes)
        population = self.evaluations.population_scores(scores.population)
        return self.mixture.comparable(population, self.candidates, scores.agent_means)

    def judged(self, outcomes: Groups[Outcome]) -> Scores:
        """The scores that people see."""
        return self._scores(self.objective.judged, outcomes)

    def info(
        self,
        scores: Scores,
        outcomes: Groups[Outcome],
        generation: Array,
        best: Array,
        active: Array,
    ) -> GenerationInfo:
        """The statistics of a generation."""
        population = scores.population.ravel()
        train_steps = _each(lambda outcome: outcome.train_steps, outcomes)
        num_steps = _flat(train_steps)
        return GenerationInfo(
            generation=generation,
            incumbent_mean=scores.incumbent_mean,
            incumbent_std=jnp.nanstd(scores.incumbent.ravel()),
            population_mean=finite_mean(population),
            population_max=jnp.nanmax(population),
            best_so_far=best,
            train_steps_mean=num_steps.mean(),
            train_steps_max=num_steps.max(),
            train_episodes_mean=_flat(
                _each(lambda outcome: outcome.train_episodes, outcomes)
            ).mean(),
            num_nonfinite=_flat(scores.diverged).sum(),
            by_agent=AgentInfo(
                incumbent_mean=scores.agent_means,
                population_mean=jnp.stack(
                    [finite_mean(scores.population[numbers].ravel()) for numbers in self.candidates]
                ),
                train_steps_mean=self._by_agent(jnp.mean, train_steps),
                num_nonfinite=self._by_agent(jnp.sum, scores.diverged),
            ),
            population_scores=population,
            train_steps=num_steps,
            real_steps=_flat(_each(lambda outcome: outcome.real_steps, outcomes)),
            active=active,
        )

    def _scores(self, score: Callable[[Outcome], Array], outcomes: Groups[Outcome]) -> Scores:
        population, incumbent = _each(lambda outcome: _scored(score, outcome), outcomes)
        repaired, means = zip(
            *(
                self.evaluations.incumbent_scores(incumbent[:, agent], population[numbers].ravel())
                for agent, numbers in enumerate(self.candidates)
            ),
            strict=True,
        )
        agent_means = jnp.stack(means)
        return Scores(
            population=population,
            incumbent=jnp.stack(repaired, axis=1),
            agent_means=agent_means,
            incumbent_mean=self.mixture.aggregated(agent_means),
            diverged=Groups(~jnp.isfinite(population), ~jnp.isfinite(incumbent)),
        )

    def _by_agent(
        self, statistic: Callable[[Array], Array], values: Groups[Array]
    ) -> Float[Array, " agent"]:
        """A statistic of each agent's trainings."""
        return jnp.stack(
            [
                statistic(_flat(Groups(values.population[numbers], values.incumbent[:, agent])))
                for agent, numbers in enumerate(self.candidates)
            ]
        )


def _each(function: Callable[[Outcome], Array], outcomes: Groups[Outcome]) -> Groups[Array]:
    return Groups(function(outcomes.population), function(outcomes.incumbent))


def _flat(values: Groups[Array]) -> Array:
    """The values of all trainings, `[training]`; the incumbent's come last."""
    return jnp.concatenate([values.population.ravel(), values.incumbent.ravel()])


def _scored(score: Callable[[Outcome], Array], outcome: Outcome) -> Float[Array, "i j"]:
    """Scores of outcomes with two leading axes, of a function for outcomes with one."""
    shape = outcome.nonfinite.shape
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(shape) :]), outcome)
    return score(flat).reshape(shape)
