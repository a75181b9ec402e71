"""evosax's distribution-based algorithms in place of NES.

Only this module turns a sign: evosax minimises a fitness, and sejax maximises scores.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from sejax.es.base import NumMembers, Scale, Strategy, StrategyOptions, StrategyState
from sejax.ops.scores import below_all
from sejax.options import LEAST, Count, Decay, require, require_known

if TYPE_CHECKING:  # importing evosax takes a second
    from evosax.algorithms.distribution_based.base import DistributionBasedAlgorithm, Params


class EvosaxClass(NamedTuple):
    """A class of evosax's.

    Attributes:
      cls: its name.
      mirrored: whether the second half of its candidates mirrors the first.
      optimizer: of its mean: "adam", "sgd" (if its steps have a natural scale), or None if it takes
        no optimizer.
    """

    cls: str
    mirrored: bool = False
    optimizer: str | None = None


ALGORITHMS = {
    "cma_es": EvosaxClass("CMA_ES"),
    "cr_fm_nes": EvosaxClass("CR_FM_NES", mirrored=True),
    "open_es": EvosaxClass("Open_ES", mirrored=True, optimizer="adam"),
    "pgpe": EvosaxClass("PGPE", mirrored=True, optimizer="adam"),
    "sep_cma_es": EvosaxClass("Sep_CMA_ES"),
    "snes": EvosaxClass("SNES", optimizer="sgd"),
    "xnes": EvosaxClass("xNES", optimizer="sgd"),
}


@dataclass(frozen=True, kw_only=True)
class EvosaxConfig(StrategyOptions):
    """One of evosax's distribution-based algorithms, with our std and step size.

    Std and step size are set explicitly, because evosax's defaults (std 1, learning rate 1e-3)
    either destroy a small network or hardly move it. For other algorithms see `from_evosax`.

    Attributes:
      num_incumbent_evals: Agents trained on the distribution's mean.
      noise_std: Initial std of the search distribution.
      noise_std_decay: Factor on the std after each generation, for open_es only.
      step_size: Learning rate of Adam on the mean, for open_es and pgpe only.
    """

    name: str = "open_es"
    population_size: NumMembers = 32
    num_incumbent_evals: Count = 16
    noise_std: Scale = 0.05
    noise_std_decay: Decay = 1.0
    step_size: Scale = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        require_known("es.name", self.name, ALGORITHMS)
        _, mirrored, optimizer = ALGORITHMS[self.name]
        size = self.population_size
        is_fit = size % 2 == 0 or not mirrored
        require(is_fit, "es.population_size", "must be even", got=size, use=size + 1)
        has = {"noise_std_decay": self.name == "open_es", "step_size": optimizer == "adam"}
        for name, has_it in has.items():
            value = getattr(self, name)
            is_fit = has_it or value == getattr(type(self), name)
            message = f"must be left out with es={self.name}, which has none; got {value}."
            require(is_fit, f"es.{name}", message)

    def make(self, num_dims: int) -> Strategy:
        """The algorithm over vectors of `num_dims` numbers."""
        from evosax.algorithms import distribution_based_algorithms

        cls, mirrored, optimizer = ALGORITHMS[self.name]
        options: dict[str, Any] = {}
        if optimizer == "adam":
            options["optimizer"] = optax.adam(self.step_size)
        elif optimizer == "sgd":
            options["optimizer"] = optax.sgd(1.0)
        if self.name == "open_es":
            # evosax computes the next generation's std from the number of the current generation.
            decay = self.noise_std_decay
            schedule = optax.exponential_decay(self.noise_std * decay, 1, decay)
            # It divides by the std, which after many generations would be 0 in 32 bits.
            options["std_schedule"] = lambda number: jnp.maximum(schedule(number), LEAST)
        algorithm = distribution_based_algorithms[cls](
            population_size=self.population_size, solution=jnp.zeros(num_dims), **options
        )
        params = algorithm.default_params
        if self.name != "open_es":
            params = params.replace(std_init=self.noise_std)
        fields = {"mirrored": mirrored, "num_incumbent_evals": self.num_incumbent_evals}
        strategy = from_evosax(algorithm, params, **fields, **self.shared())
        if self.name not in ("open_es", "xnes"):
            return strategy

        def init(key: Array, mean: Float[Array, " dims"]) -> StrategyState:
            state = strategy.init(key, mean)
            if self.name == "open_es":  # evosax begins with the second generation's std
                return state.replace(std=state.std / self.noise_std_decay)
            return state.replace(B=state.B / self.noise_std)  # evosax puts std_init into B as well

        return replace(strategy, init=init)


def from_evosax(
    algorithm: "DistributionBasedAlgorithm", params: "Params | None" = None, **fields: Any
) -> Strategy:
    """A strategy from an algorithm of evosax. The algorithm's mean is the incumbent.

    A generation in which all scores are equal, or none is finite, changes nothing.

    Args:
      algorithm: a distribution-based algorithm for vectors `[num_dims]`.
      params: of the algorithm; its `default_params` if not given.
      **fields: further fields of `Strategy`: `mirrored`, and how often candidates are evaluated.

    Example:
      >>> from evosax.algorithms import Rm_ES
      >>> def rm_es(num_dims: int, std: float = 0.05) -> Strategy:  # es=my_module:rm_es
      ...     algorithm = Rm_ES(population_size=16, solution=jnp.zeros(num_dims))
      ...     return from_evosax(algorithm, algorithm.default_params.replace(std_init=std))
      >>> rm_es(3).num_candidates
      16
    """
    params = algorithm.default_params if params is None else params

    def tell(
        key: Array, population: Array, scores: Array, incumbent_score: Array, state: StrategyState
    ) -> StrategyState:
        # An infinity would poison algorithms that standardise. So a score that is not finite
        # becomes worse than the worst.
        fitness = -jnp.where(jnp.isfinite(scores), scores, below_all(scores))
        updated = algorithm.tell(key, population, fitness, state, params)[0]
        # Some algorithms move, or shrink their std, where no candidate is better than another.
        is_informative = fitness.max() > fitness.min()
        return jax.tree.map(lambda new, old: jnp.where(is_informative, new, old), updated, state)

    return Strategy(
        init=lambda key, mean: algorithm.init(key, mean, params),
        ask=lambda key, state: algorithm.ask(key, state, params),
        tell=tell,
        incumbent=algorithm.get_mean,
        num_candidates=algorithm.population_size,
        **fields,
    )
