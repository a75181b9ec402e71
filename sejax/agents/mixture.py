"""A mixture of agents. Each candidate of a generation trains one of them.

A proxy learned with one agent teaches that agent; whether it teaches others is left to chance. A
mixture divides the candidates of a generation among several agents. So a step of the outer loop
helps all agents, with the same number of trainings.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from sejax.agents.base import Agent
from sejax.ops.scores import finite_mean, is_tie
from sejax.options import LARGEST, Options, require
from sejax.options.registry import require_part

Weight = Annotated[float, Field(ge=0, le=1e6)]


@dataclass(frozen=True, kw_only=True)
class MixtureConfig(Options):
    """How a mixture of agents shares a generation; `agents=[ddqn,ppo]` on the command line.

    Attributes:
      aggregate: Each agent scores the search mean. The mean of these scores, or the worst, is
        shown, keeps the best proxy and ends a run. The search compares advantages either way.
      weights: share of the candidates that train each agent, 1 if left out; with 0 an agent only
        judges the search mean
    """

    group: ClassVar[str] = "mixture"

    aggregate: Literal["mean", "min"] = "mean"
    weights: dict[str, Weight] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """Agents that share the candidates of a generation.

    Attributes:
      agents: from `sejax.make_agent`, or your own.
      names: of the agents, for tables; their numbers if not given.
      weights: shares of the candidates that each agent trains on; equal if not given. An agent of
        weight 0 trains on the incumbent alone.
      aggregate: whether the mean of the agents' scores of the incumbent is shown and keeps the best
        proxy, or the worst. The strategy compares advantages either way.

    Raises:
      ConfigError: without agents, unless each has a name and a weight, for a weight below 0, if
        all weights are 0, or for what is no agent.

    Example:
      >>> import sejax
      >>> task = sejax.envs.make("cartpole")
      >>> ddqn, ppo = (sejax.make_agent(config, task)
      ...              for config in (sejax.DDQNConfig(), sejax.PPOConfig()))
      >>> mixture = Mixture(agents=(ddqn, ppo), names=("ddqn", "ppo"), weights=(2.0, 1.0))
      >>> mixture.deal(6)
      (array([0, 2, 3, 5]), array([1, 4]))
    """

    agents: tuple[Agent, ...]
    names: tuple[str, ...] = ()
    weights: tuple[float, ...] = ()
    aggregate: Literal["mean", "min"] = "mean"

    def __post_init__(self) -> None:
        size = len(self.agents)
        object.__setattr__(self, "names", self.names or tuple(str(i) for i in range(size)))
        object.__setattr__(self, "weights", self.weights or (1.0,) * size)
        sizes = {size, len(self.names), len(self.weights)}
        require(len(sizes) == 1, "agents", "must have a name and a weight each", got=self.names)
        is_weighted = all(0 <= x <= LARGEST for x in self.weights) and any(self.weights)
        require(is_weighted, "agents", "must have weights from 0, one above", got=self.weights)
        for agent in self.agents:
            fix = "sejax.make_agent makes one; sejax.Mixture(agents=...) joins several."
            require_part("agent", Agent, agent, fix)

    @classmethod
    def of(cls, agent: "Agent | Mixture") -> "Mixture":
        """A mixture of one agent; a mixture stays as it is.

        Raises:
          ConfigError: for anything else.
        """
        return agent if isinstance(agent, Mixture) else cls(agents=(agent,))

    @property
    def size(self) -> int:
        return len(self.agents)

    def deal(self, num_candidates: int, mirrored: bool = False) -> tuple[np.ndarray, ...]:
        """The candidates of each agent: their indices in the population, ascending.

        Each candidate in turn goes to the agent that is furthest behind its share; an agent of
        weight 0 gets none. The two candidates of a mirrored pair are compared with each other,
        so that they get the same agent.

        Raises:
          ConfigError: if an agent with a weight gets no candidate.
        """
        num_dealt = num_candidates // 2 if mirrored else num_candidates
        shares = np.array(self.weights) / sum(self.weights)
        hands: list[list[int]] = [[] for _ in self.agents]
        for candidate in range(num_dealt):
            behind = shares * (candidate + 1) - [len(hand) for hand in hands]
            hands[int(np.argmax(behind))].append(candidate)
        are_enough = all(hand for hand, share in zip(hands, shares, strict=True) if share > 0)
        # Enough in any case: doubled, as half of a mirrored population is dealt.
        size = 2 * int(1 / shares[shares > 0].min() + self.size + 1)
        rule = f"must be larger: {num_candidates} candidates do not suffice for the agents' shares"
        require(are_enough, "es.population_size", rule, use=size)
        offsets = (0, num_dealt) if mirrored else (0,)
        return tuple(np.add.outer(offsets, hand).ravel().astype(int) for hand in hands)

    def comparable(
        self,
        scores: Float[Array, " pop"],
        candidates: Sequence[np.ndarray],
        agent_means: Float[Array, " agent"],
    ) -> tuple[Float[Array, " pop"], Float[Array, ""]]:
        """Scores of candidates with different agents in one unit, and the incumbent's score.

        The scores become advantages over the incumbent's mean with the same agent. With a single
        agent they stay as they are.

        Args:
          scores: of the candidates; nan if training diverged, and stays so.
          candidates: of each agent, as returned by `deal`.
          agent_means: the incumbent's mean with each agent; nan if all evaluations with the
            agent diverged. The agent's candidates are then compared with their own mean.
        """
        if self.size == 1:
            return scores, agent_means[0]
        compared = scores
        for numbers, mean in zip(candidates, agent_means, strict=True):
            if numbers.size:
                of_agent = scores[numbers]
                mean = jnp.where(jnp.isfinite(mean), mean, finite_mean(of_agent))
                advantages = jnp.where(is_tie(of_agent, mean), 0.0, of_agent - mean)
                compared = compared.at[numbers].set(advantages)
        return compared, jnp.float32(0)
