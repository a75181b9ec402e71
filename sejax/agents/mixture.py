"""Several families of agents, one of which each member of a generation trains.

A proxy learned with one agent teaches that agent; what others make of it is left to chance. Here
the members of a generation take turns among agents, so that a step of the outer loop helps all of
them, at the price of one training a member as before.
"""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sejax.agents.base import Agent
from sejax.errors import require
from sejax.es.base import AGGREGATES, finite_mean, is_tie
from sejax.options import Options, one_of, option

COMPARED_BY = ("advantage", "rank")


@dataclass(frozen=True, kw_only=True)
class FamiliesConfig(Options):
    """How families of agents share a generation; `agents=[ddqn,ppo]` on the command line."""

    group: ClassVar[str] = "agents"

    # What the incumbent is worth, given its mean score with each family: their mean, or the worst.
    aggregate: str = option("mean", one_of(AGGREGATES))
    # What makes scores of several families comparable. advantage: a member's score less the
    # incumbent's mean with its family; rank: its rank within its family, less the incumbent's.
    compared_by: str = option("advantage", one_of(COMPARED_BY))


@dataclass(frozen=True, kw_only=True)
class Families:
    """Agents among which the members of a generation take turns.

    Attributes:
      agents: from `sejax.make_agent`, or of one's own.
      names: of the families, for tables; their numbers if not given.
      weights: shares of the members that train each; equal if not given. A family of weight 0
        judges the incumbent alone.
      config: how their scores are put together.

    Raises:
      ConfigError: for no agents, other numbers of names and weights, negative weights, or none
        above 0.

    Example:
      >>> import sejax
      >>> task = sejax.envs.make("cartpole")
      >>> ddqn, ppo = (sejax.make_agent(config, task)
      ...              for config in (sejax.DDQNConfig(), sejax.PPOConfig()))
      >>> families = Families(agents=(ddqn, ppo), names=("ddqn", "ppo"), weights=(2.0, 1.0))
      >>> families.of_members(6).tolist()
      [0, 1, 0, 0, 1, 0]
    """

    agents: tuple[Agent, ...]
    names: tuple[str, ...] = ()
    weights: tuple[float, ...] = ()
    config: FamiliesConfig = FamiliesConfig()

    def __post_init__(self) -> None:
        size = len(self.agents)
        require(
            size > 0,
            "agents",
            "hold an agent",
            "proxies are told by what agents learn on them",
            "none",
            "agent=ddqn",
        )
        object.__setattr__(self, "names", self.names or tuple(str(i) for i in range(size)))
        object.__setattr__(self, "weights", self.weights or (1.0,) * size)
        for what in (self.names, self.weights):
            require(
                len(what) == size,
                "agents",
                f"have {size} names and weights",
                "each agent is a family",
                what,
                "names=() and weights=()",
            )
        require(
            min(self.weights) >= 0 and max(self.weights) > 0,
            "agents",
            "have weights of at least 0, and one above",
            "the members of a generation take turns among them",
            self.weights,
            "weights=()",
        )

    @classmethod
    def of(cls, agent: "Agent | Families") -> "Families":
        """One agent as a family."""
        return agent if isinstance(agent, Families) else cls(agents=(agent,))

    @property
    def size(self) -> int:
        return len(self.agents)

    def of_members(self, num_members: int, num_signs: int = 1) -> np.ndarray:
        """The family that each member trains, `[num_members]`.

        Places are dealt by the weights, each to the family that is furthest behind its share; a
        family of weight 0 gets none.
        Members that are the signs of one perturbation train the same family, as they are compared
        with each other.

        Raises:
          ConfigError: if there are more families than there are perturbations.
        """
        num_places = num_members // num_signs
        shares = np.array(self.weights) / sum(self.weights)
        num_trained = np.count_nonzero(shares)
        require(
            num_places >= num_trained,
            "es.population_size",
            f"be at least {num_trained}",
            "each family needs a member",
            num_places,
            f"es.population_size={num_trained}",
        )
        counts = np.zeros(self.size)
        places = []
        for place in range(num_places):
            family = int(np.argmax(shares * (place + 1) - counts))
            counts[family] += 1
            places.append(family)
        require(
            counts[shares > 0].all(),
            "agents",
            "have weights that leave each family a member",
            f"the proxy must be told by all of them; there are {num_places} perturbations",
            self.weights,
            "es.population_size larger",
        )
        return np.tile(places, num_signs)

    def num_evals(self, num_incumbent_evals: int) -> int:
        """Agents on the incumbent, as many of each family, at least as many as asked for."""
        return -(-num_incumbent_evals // self.size) * self.size

    def aggregated(self, means: Float[Array, " family"]) -> Float[Array, ""]:
        """What the incumbent is worth, given its means with each family; nan if one is."""
        return means.mean() if self.config.aggregate == "mean" else means.min()

    def comparable(
        self,
        scores: Float[Array, " members"],
        family: np.ndarray,
        incumbent_means: Float[Array, " family"],
    ) -> tuple[Float[Array, " members"], Float[Array, ""]]:
        """Scores of members of different families in one unit, and the incumbent's.

        Those of a single family stay as they are.

        Args:
          scores: of the members; not finite for those that diverged, which they stay.
          family: of each.
          incumbent_means: nan for a family none of whose agents on the incumbent survived; its
            members are then compared with their own mean.
        """
        if self.size == 1:
            return scores, incumbent_means[0]
        compare = _ranks if self.config.compared_by == "rank" else _advantages
        compared = scores
        for i in np.unique(family):
            places = np.flatnonzero(family == i)
            own = scores[places]
            mean = jnp.where(jnp.isfinite(incumbent_means[i]), incumbent_means[i], finite_mean(own))
            compared = compared.at[places].set(compare(own, mean))
        return compared, jnp.float32(0)


def _advantages(scores: Float[Array, " members"], incumbent: Array) -> Float[Array, " members"]:
    return jnp.where(is_tie(scores, incumbent), 0.0, scores - incumbent)


def _ranks(scores: Float[Array, " members"], incumbent: Array) -> Float[Array, " members"]:
    """Shares of the members that are worse, less that of the incumbent."""

    def share_below(score: Array, same: Array) -> Array:
        worse = (scores < score) & ~same  # False where either is not a number
        return (worse.sum() + 0.5 * same.sum()) / scores.shape[0]

    below = jax.vmap(lambda score: share_below(score, scores == score))(scores)
    shares = below - share_below(incumbent, is_tie(scores, incumbent))
    return jnp.where(jnp.isfinite(scores), shares, jnp.nan)
