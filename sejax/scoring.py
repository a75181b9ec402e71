"""From the outcomes of a generation to the scores of its candidates.

`Scoring` applies an objective to both groups of a generation, the population and the incumbent. It
gives the scores that the strategy compares, one for each candidate, and the scores that people see,
one for each training. A mixture puts the first ones in one unit. An objective may also show people
another score (`Objective.shown`), as `MaxReward.first_eval_steps` does.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Shaped

from sejax.generation import Layout
from sejax.objectives import Objective, Outcome
from sejax.ops.scores import finite_mean


class Scores(struct.PyTreeNode):
    """Scores of a generation.

    Attributes:
      population: one for each training, candidate by candidate; nan for agents that diverged.
      incumbent: one for each training, `[turn, agent]` flattened; agents that diverged rank last.
      agent_means: the incumbent's mean with each agent of a mixture; nan if all of them diverged.
      incumbent_mean: the incumbent's score; nan if all trainings with one of the agents diverged.
      diverged: whether the agent of a training diverged; the incumbent's trainings come last.
    """

    population: Float[Array, " on_candidates"]
    incumbent: Float[Array, " turn_agent"]
    agent_means: Float[Array, " agent"]
    incumbent_mean: Float[Array, ""]
    diverged: Bool[Array, " training"]


class AgentInfo(struct.PyTreeNode):
    """Statistics for each agent of a mixture, `[agent]`."""

    incumbent_mean: Array
    population_mean: Array
    train_steps_mean: Array
    num_nonfinite: Array


class GenerationInfo(struct.PyTreeNode):
    """Statistics of a generation: numbers of a row of `metrics.csv`, and what they are made of.

    A row begins with `generation` and the run's `seed`, then has the fields before `by_agent`,
    `env_steps_total` (real steps so far) and `wall_s`; `pandas.read_csv` reads the file.

    Scores are those that people see (`Objective.shown_scores`). Those of the population leave out
    agents that diverged; among the incumbent's such agents rank last. Where `active` is False
    nothing was trained: the other numbers are of trainings without a step, and mean nothing.
    """

    generation: Array  # int32
    incumbent_mean: Array  # `Scores.incumbent_mean`, from before the update
    incumbent_std: Array  # over all trainings on the incumbent
    population_mean: Array  # over all trainings on candidates
    population_max: Array  # of one training, not of a candidate's mean
    best_so_far: Array  # the best `incumbent_mean`, this one included
    train_steps_mean: Array  # over all trainings, as in the next two
    train_steps_max: Array
    train_episodes_mean: Array
    num_nonfinite: Array  # trainings that diverged
    by_agent: AgentInfo  # the same for each agent of a mixture
    population_scores: Float[Array, " on_candidates"]
    train_steps: Array  # `[training]` int32; sums may exceed 32 bits and are made on the host
    real_steps: Array  # in the same form: steps on the real task
    active: Array  # False if the run was over before this generation


@dataclass(frozen=True, kw_only=True)
class Scoring:
    """How outcomes become scores, with one agent or a mixture.

    Attributes:
      objective: the score of one outcome.
      layout: which training belongs to which candidate and agent.
    """

    objective: Objective
    layout: Layout

    def candidate_scores(self, outcome: Outcome) -> tuple[Float[Array, " pop"], Float[Array, ""]]:
        """Scores of the population and of the incumbent in one unit, for `Strategy.tell`.

        The scores of a candidate's trainings become one score here.

        Args:
          outcome: of all trainings, as returned by `sejax.generation.GenerationEvaluator`.
        """
        layout = self.layout
        scores = self._scores(self.objective.search_scores(outcome))
        aggregate = jnp.mean if layout.strategy.eval_aggregate == "mean" else jnp.min
        by_candidate = scores.population.reshape(-1, layout.strategy.num_evals)
        population = aggregate(by_candidate, axis=1)  # nan if the agent of one training diverged
        return layout.mixture.comparable(population, layout.candidate_indices, scores.agent_means)

    def shown_scores(self, outcome: Outcome) -> Scores:
        """The scores that people see, of all trainings."""
        return self._scores(self.objective.shown_scores(outcome))

    def info(
        self, scores: Scores, outcome: Outcome, generation: Array, best: Array, active: Array
    ) -> GenerationInfo:
        """The statistics of a generation.

        Args:
          scores: `shown_scores` of the outcome.
          outcome: of all trainings.
          generation: its number.
          best: score of the best incumbent so far, with this one.
          active: whether the run was not over before this generation.
        """
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
                population_mean=self._by_agent(finite_mean, scores.population),
                train_steps_mean=self._by_agent(jnp.mean, outcome.train_steps),
                num_nonfinite=self._by_agent(jnp.sum, scores.diverged),
            ),
            population_scores=scores.population,
            train_steps=outcome.train_steps,
            real_steps=outcome.real_steps,
            active=active,
        )

    def _scores(self, of_trainings: Float[Array, " training"]) -> Scores:
        """The scores of a generation's two groups, and their means, from one for each training.

        The incumbent's come turn by turn, one of each agent in a turn. Each agent's turns are
        repaired by the scores of the same agent alone, so they are taken apart by agent for it.
        """
        population, incumbent = jnp.split(of_trainings, [self.layout.num_on_candidates])
        turns = incumbent.reshape(-1, self.layout.mixture.size).T  # [agent, turn]
        pairs = zip(turns, self._of_agents(population), strict=True)
        by_agent = [with_diverged_last(scores, evaluations) for scores, evaluations in pairs]
        incumbent, agent_means = map(jnp.stack, zip(*by_agent, strict=True))  # [agent, *turn]
        aggregate = jnp.mean if self.layout.mixture.aggregate == "mean" else jnp.min
        return Scores(
            population=population,
            incumbent=incumbent.T.ravel(),
            agent_means=agent_means,
            incumbent_mean=aggregate(agent_means),
            diverged=jnp.isnan(of_trainings),
        )

    def _by_agent(
        self, statistic: Callable[[Array], Array], values: Shaped[Array, " training"]
    ) -> Shaped[Array, " agent"]:
        """A statistic of each agent's trainings."""
        return jnp.stack([*map(statistic, self._of_agents(values))])

    def _of_agents(self, values: Shaped[Array, " training"]) -> list[Shaped[Array, " of_agent"]]:
        """The values of each agent's trainings; `values` may lack those on the incumbent.

        These are numbered last. So their numbers lie beyond values that lack them, and drop out.
        """
        return [values[x[x < values.size]] for x in self.layout.training_indices]


def with_diverged_last(
    scores: Float[Array, " turn"], population: Float[Array, " on_candidates"]
) -> tuple[Float[Array, " turn"], Float[Array, ""]]:
    """The incumbent's scores with one agent, diverged ones ranked last, and their mean.

    Agents that diverged have the score nan. They get the lowest score of their algorithm in the
    generation: a mean without them would rank an incumbent by its other agents alone. If all
    diverged, the mean is nan.
    """
    lowest = jnp.nanmin(jnp.concatenate([population, scores]))
    diverged = jnp.isnan(scores)
    repaired = jnp.where(diverged & ~diverged.all(), lowest, scores)
    return repaired, finite_mean(repaired)
