"""evosax's distribution-based algorithms in the place of NES.

This is the one place where a sign is turned: evosax minimises a fitness, scores are maximised.
"""

import inspect
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from sejax.errors import require
from sejax.es.base import AGGREGATES, LARGEST, Strategy, trials_of
from sejax.options import MOST_MEMBERS, Options, counts, one_of, option, positive, shrinks

# Name -> evosax's class. Listed here because importing evosax takes a second; a test holds the list
# against evosax's own. Left out are RandomSearch and the two SV algorithms, which have no single
# mean that could be the incumbent, and GuidedES, which wants gradients.
ALGORITHMS = {
    "ars": "ARS",
    "asebo": "ASEBO",
    "cma_anchored_les": "CMAAnchoredLES",
    "cma_es": "CMA_ES",
    "cr_fm_nes": "CR_FM_NES",
    "des": "DES",
    "esmc": "ESMC",
    "evotf_es": "EvoTF_ES",
    "gradientless_descent": "GradientlessDescent",
    "hill_climbing": "HillClimbing",
    "iamalgam_full": "iAMaLGaM_Full",
    "iamalgam_univariate": "iAMaLGaM_Univariate",
    "les": "LES",
    "lm_ma_es": "LM_MA_ES",
    "ma_es": "MA_ES",
    "noise_reuse_es": "NoiseReuseES",
    "open_es": "Open_ES",
    "persistent_es": "PersistentES",
    "pgpe": "PGPE",
    "rm_es": "Rm_ES",
    "sep_cma_es": "Sep_CMA_ES",
    "simple_es": "SimpleES",
    "simulated_annealing": "SimulatedAnnealing",
    "snes": "SNES",
    "xnes": "xNES",
}

# Whose candidates are pairs of opposite perturbations, one half of them after the other.
PAIRED = ("ars", "asebo", "cr_fm_nes", "noise_reuse_es", "open_es", "persistent_es", "pgpe")
# Which hold scores against those of earlier generations.
REMEMBERING = (
    "gradientless_descent",
    "hill_climbing",
    "iamalgam_full",
    "iamalgam_univariate",
    "simulated_annealing",
)
# The step of whose mean has a natural scale.
NATURAL = ("des", "simple_es", "snes", "xnes")


@dataclass(frozen=True, kw_only=True)
class EvosaxConfig(Options):
    """One of evosax's distribution-based algorithms, with our std and step size.

    Set explicitly because evosax's defaults (std 1, learning rate 1e-3) either destroy a small
    network or hardly move it.
    """

    group: ClassVar[str] = "es"

    name: str = option("open_es", one_of(ALGORITHMS))
    # Candidates in a generation.
    population_size: int = option(
        32, counts("scores are compared within a generation", 2, MOST_MEMBERS)
    )
    # Agents trained on the distribution's mean.
    num_incumbent_evals: int = option(16, counts("the incumbent's score selects the proxy"))
    # Initial std of the search distribution.
    noise_std: float = option(0.05, positive("candidates must differ", LARGEST))
    # Factor for each generation, where the algorithm takes a schedule.
    noise_std_decay: float = option(1.0, shrinks())
    # Learning rate of Adam on the mean, where the algorithm takes one.
    step_size: float = option(0.05, positive("the mean would not move", LARGEST))
    num_evals: int = option(1, counts("a candidate needs a score"))
    eval_aggregate: str = option("mean", one_of(AGGREGATES))
    common_random_numbers: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.population_size % 2 == 0,
            "es.population_size",
            "be even",
            "evosax's algorithms pair opposite perturbations",
            self.population_size,
            f"es.population_size={self.population_size + 1}",
        )

    def make(self, num_dims: int) -> Strategy:
        """The algorithm over vectors of `num_dims` numbers."""
        return make_evosax(self, num_dims)


def make_evosax(config: EvosaxConfig, num_dims: int) -> Strategy:
    """Builds one of evosax's algorithms, whose mean is the incumbent, over vectors `[num_dims]`."""
    algorithm, params = _build(config, num_dims)

    def tell(key: Array, members: Array, scores: Array, incumbent_score: Array, state: Any) -> Any:
        fitness = finite_fitness(-scores, jnp.inf if remembers else 0.0)
        return algorithm.tell(key, members, fitness, state, params)[0]

    def init(key: Array, mean: Array) -> Any:
        return _with_std(config, algorithm, algorithm.init(key, mean, params))

    remembers = config.name in REMEMBERING
    return Strategy(
        init=init,
        ask=lambda key, state: algorithm.ask(key, state, params),
        tell=tell,
        incumbent=algorithm.get_mean,
        num_members=config.population_size,
        num_signs=2 if config.name in PAIRED else 1,
        remembers_scores=remembers,
        trials=trials_of(config, config.num_incumbent_evals),
    )


def _build(config: EvosaxConfig, num_dims: int) -> tuple[Any, Any]:
    """The algorithm and its params, with our std and step size wherever it takes one."""
    from evosax.algorithms import distribution_based_algorithms

    cls = distribution_based_algorithms[ALGORITHMS[config.name]]
    accepted = inspect.signature(cls.__init__).parameters
    options: dict[str, Any] = {}
    if "std_schedule" in accepted:
        own = not config.name.startswith("iamalgam")  # which add the schedule to a covariance
        # evosax asks for the next generation's with the number of the one before.
        options["std_schedule"] = optax.exponential_decay(
            own * config.noise_std * config.noise_std_decay, 1, config.noise_std_decay
        )
    if "optimizer" in accepted:
        natural = config.name in NATURAL
        options["optimizer"] = optax.sgd(1.0) if natural else optax.adam(config.step_size)
    algorithm = cls(population_size=config.population_size, solution=jnp.zeros(num_dims), **options)
    params = algorithm.default_params
    if hasattr(params, "std_init"):
        params = params.replace(std_init=config.noise_std)
    if hasattr(params, "radius_max"):  # candidates' radii, from a 200th of it
        params = params.replace(
            radius_max=config.noise_std,
            radius_min=config.noise_std * params.radius_min / params.radius_max,
        )
    return algorithm, params


def _with_std(config: EvosaxConfig, algorithm: Any, state: Any) -> Any:
    """A first state with our std where evosax has another, or another beside it."""
    if config.noise_std_decay != 1 and hasattr(algorithm, "std_schedule"):  # begins one too late
        state = state.replace(std=state.std / config.noise_std_decay)
    if config.name == "xnes":  # std_init stands in its shape matrix as well
        return state.replace(B=state.B / config.noise_std)
    if config.name.startswith("iamalgam"):
        return state.replace(C=config.noise_std**2 * state.C)
    return state


def finite_fitness(
    fitness: Float[Array, " pop"], of_none: Array | float = 0.0
) -> Float[Array, " pop"]:
    """Fitness (minimised) with entries that are not finite just worse than the worst finite one.

    An infinity would poison the algorithms that standardise, so the gap is that between best and
    worst, or 1. Where none is finite all are `of_none`.
    """
    finite = jnp.isfinite(fitness)
    worst = jnp.max(jnp.where(finite, fitness, -jnp.inf))
    best = jnp.min(jnp.where(finite, fitness, jnp.inf))
    replacement = worst + jnp.maximum(worst - best, 1.0)
    return jnp.where(finite, fitness, jnp.where(finite.any(), replacement, of_none))
