"""From the outcome of one agent's training to the scores of a generation.

An `Objective` turns an `Outcome` (one agent trained on a proxy, tested on the real task) into a
number. `Scoring` applies it to a generation: what the strategy compares, and what people see.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from sejax.agents.mixture import Mixture
from sejax.envs.base import Task
from sejax.es.base import Evaluations, Strategy, finite_mean
from sejax.options import Options, counts, not_negative, option, require


@struct.dataclass
class Outcome:
    """What came of one agent. Leaves are `[]` but for the first, and `[agent, ...]` for many.

    Attributes:
      test_returns: return of each test episode on the real task, in reward units; a single nan
        where there was no test.
      scored_returns: the same for the steps of each that the objective has asked for.
      train_steps: steps in the training world.
      train_episodes: episodes there.
      auc: sum over those episodes of their return times their length; the returns are those
        of the tests after each, where there are such tests. An episode that the step limit cut off
        counts with the test return.
      nonfinite: whether a number that is not finite was met in training; the score is then nan.
      real_steps: steps on the real task: tests, and training where its dynamics are real.
    """

    test_returns: Float[Array, "*agent episode"]
    scored_returns: Float[Array, "*agent episode"]
    train_steps: Int[Array, "*agent"]
    train_episodes: Int[Array, "*agent"]
    auc: Float[Array, "*agent"]
    nonfinite: Bool[Array, "*agent"]
    real_steps: Int[Array, "*agent"]

    @property
    def test_return(self) -> Float[Array, "*agent"]:
        """Mean over the test episodes."""
        return self.test_returns.mean(axis=-1)


@dataclass(frozen=True, kw_only=True)
class Objective:
    """What the outer loop maximises.

    Attributes:
      score: `outcome -> [agent]` float32, leaves of the outcome `[agent, ...]`. A training that
        diverged is worth nothing, whatever this says of it.
      needs_tests: whether it looks at tests between training episodes: then agents are tested after
        each of them, and none stops because it has solved the task.
      scores_are_returns: whether scores are mean returns, which the task's threshold can be held
        against.
      eval_steps: `generation -> steps`, how much of the test episodes it scores, if not all: a
        curriculum. People see the mean return of whole test episodes then, in place of scores.
      meaning: of a score, for people.
    """

    score: Callable[[Outcome], Float[Array, "*agent"]]
    needs_tests: bool = False
    scores_are_returns: bool = False
    eval_steps: Callable[[Array], Array] | None = None
    meaning: str = ""

    def __call__(self, outcome: Outcome) -> Float[Array, "*agent"]:
        """Scores; nan for trainings that diverged."""
        return jnp.where(outcome.nonfinite, jnp.nan, self.score(outcome))

    def judged(self, outcome: Outcome) -> Float[Array, "*agent"]:
        """The scores that people see; nan likewise."""
        scores = self.score(outcome) if self.eval_steps is None else outcome.test_return
        return jnp.where(outcome.nonfinite, jnp.nan, scores)


@dataclass(frozen=True, kw_only=True)
class MaxReward(Options):
    """The mean test return (SEs), of all of the test episodes or, at first, of other lengths.

    Short ones (a Pendulum is rewarded for where it goes at once) or long ones (a car that reaches
    the hill at all) tell proxies apart that a whole episode of the task's does not.

    Source: paper, Algorithm 1, EvaluateAgent; the curriculum: Liesen et al., "Discovering Minimal
    Reinforcement Learning Environments" (2024).
    """

    group: ClassVar[str] = "objective"
    scores_are_returns: ClassVar[bool] = True

    first_eval_steps: int | None = option(
        None,
        counts("there is nothing to score otherwise"),
        help=(
            "Steps of a test episode that are scored in the first generation; null: the task's "
            "limit."
        ),
    )
    curriculum_generations: int = option(
        50,
        counts("it is the length of a curriculum"),
        help="Generation from which on the task's limit counts; before, the steps change linearly.",
    )

    def make(self, task: Task) -> Objective:
        """The objective on a task."""
        objective = Objective(
            score=lambda outcome: outcome.test_return,
            scores_are_returns=True,
        )
        if self.first_eval_steps is None:
            return objective
        first, last = self.first_eval_steps, task.max_steps

        def eval_steps(generation: Array) -> Array:
            done = jnp.minimum(generation / self.curriculum_generations, 1.0)
            return jnp.round(first + done * (last - first)).astype(jnp.int32)

        return dataclasses.replace(
            objective,
            score=lambda outcome: outcome.scored_returns.mean(axis=-1),
            eval_steps=eval_steps,
        )


@dataclass(frozen=True, kw_only=True)
class RewardThreshold(Options):
    r"""How soon an agent solves the task (RNs).

    .. math:: -(n_{tr} + w_{sol} \max(0, C_{sol} - C_{fin}))

    Source: paper, section "Learning Reward Networks".
    """

    group: ClassVar[str] = "objective"
    scores_are_returns: ClassVar[bool] = False

    unsolved_weight: float = option(
        100.0,
        not_negative("a shortfall must not be rewarded"),
        help="w_sol: training steps that a unit of missing return is worth",
    )

    def make(self, task: Task) -> Objective:
        """The objective on a task.

        Raises:
          ConfigError: if nobody says when the task is solved.
        """
        require(
            task.is_solvable,
            "objective",
            "must need no threshold where the task has none; got reward_threshold. Set "
            "env.solved_reward, or objective=max_reward.",
        )

        def score(outcome: Outcome) -> Array:
            shortfall = jnp.maximum(0.0, task.solved_reward - outcome.test_return)
            return -(outcome.train_steps + self.unsolved_weight * shortfall)

        meaning = (
            f"minus the training steps of its agents, and {self.unsolved_weight:g} for each "
            f"unit of return below {task.solved_reward:g}"
        )
        return Objective(score=score, meaning=meaning)


@dataclass(frozen=True, kw_only=True)
class AUC(Options):
    """The area under the curve of test returns over training steps, by the number of these (RNs).

    Source: paper, appendix "Studying the Influence of Different Reward Network Optimization
    Objectives".
    """

    group: ClassVar[str] = "objective"
    scores_are_returns: ClassVar[bool] = False

    def make(self, task: Task) -> Objective:
        """The objective on a task."""
        return Objective(
            score=lambda outcome: outcome.auc / jnp.maximum(outcome.train_steps, 1),
            needs_tests=True,
            meaning="the mean of its agents' test returns over their training",
        )


@dataclass(frozen=True, kw_only=True)
class AUCSum(Options):
    """That area itself, as in the authors' code.

    Agents train a number of episodes, so that it rewards short ones where returns are negative, and
    long ones where they are positive.

    Source: `docs/reference.md` 5.5.
    """

    group: ClassVar[str] = "objective"
    scores_are_returns: ClassVar[bool] = False

    def make(self, task: Task) -> Objective:
        """The objective on a task."""
        return Objective(
            score=lambda outcome: outcome.auc,
            needs_tests=True,
            meaning="the sum of its agents' test returns times the steps between them",
        )


# --- scores of a generation ----------------------------------------------------------------------


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
            "must compare scores within a generation with several agents or a curriculum; got one "
            "that remembers scores. Set es=nes.",
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

    def judged(self, outcome: Outcome) -> Scores:
        """The scores that people see; with a curriculum, those of whole test episodes."""
        return self._scores(self.objective.judged(outcome))

    def info(
        self, scores: Scores, outcome: Outcome, generation: Array, best: Array, active: Array
    ) -> GenerationInfo:
        """The statistics of a generation."""
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
                population_mean=self.by_agent(finite_mean, scores.population),
                train_steps_mean=self.by_agent(jnp.mean, outcome.train_steps),
                num_nonfinite=self.by_agent(jnp.sum, scores.diverged),
            ),
            population_scores=scores.population,
            train_steps=outcome.train_steps,
            real_steps=outcome.real_steps,
            active=active,
        )

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
