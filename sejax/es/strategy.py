"""One contract for every outer optimiser, and the place where the sign is turned.

evosax minimises a fitness; scores here are maximised.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from sejax.configs import EVOSAX_ALGORITHMS, EvosaxConfig, NESConfig
from sejax.es.nes import NES, aggregate


@dataclass(frozen=True, kw_only=True)
class Strategy:
    """An outer optimiser over flat parameter vectors `[dims]`; pure functions.

    Attributes:
      init: `(key, mean [dims]) -> state`.
      ask: `(key, state) -> (candidates [num_candidates, dims], state)`. The last
        `num_incumbent_evals` candidates are the incumbent.
      tell: `(key, candidates, scores [num_candidates], state) -> state`; higher scores are better,
        and scores that are not finite rank worst.
      incumbent: `(state) -> [dims]`, the proxy that the strategy stands for.
      seed_ids: `[num_candidates]`; candidates with the same number train with the same seed.
      num_candidates: trainings in a generation.
      num_incumbent_evals: how many of them are the incumbent's.
    """

    init: Callable[..., Any]
    ask: Callable[..., tuple[Array, Any]]
    tell: Callable[..., Any]
    incumbent: Callable[[Any], Array]
    seed_ids: np.ndarray
    num_candidates: int
    num_incumbent_evals: int


def make_strategy(config: NESConfig | EvosaxConfig, num_dims: int) -> Strategy:
    """The strategy that a configuration names, over vectors of `num_dims` numbers.

    Example:
      >>> import jax
      >>> strategy = make_strategy(NESConfig(population_size=4), num_dims=3)
      >>> state = strategy.init(jax.random.key(0), jnp.zeros(3))
      >>> strategy.ask(jax.random.key(1), state)[0].shape  # +eps, -eps and the incumbent
      (12, 3)
    """
    if isinstance(config, NESConfig):
        return _nes(config, num_dims)
    return _evosax(config, num_dims)


def _nes(config: NESConfig, num_dims: int) -> Strategy:
    algorithm = NES(config, jnp.zeros(num_dims))
    params = algorithm.default_params

    def tell(key: Array, candidates: Array, scores: Array, state: Any) -> Any:
        return algorithm.tell(key, candidates, -scores, state, params)[0]

    return Strategy(
        init=lambda key, mean: algorithm.init(key, mean, params),
        ask=lambda key, state: algorithm.ask(key, state, params),
        tell=tell,
        incumbent=lambda state: state.mean,
        seed_ids=_seed_ids(config, algorithm.num_perturbed, algorithm.num_incumbent_evals),
        num_candidates=algorithm.population_size,
        num_incumbent_evals=algorithm.num_incumbent_evals,
    )


def _evosax(config: EvosaxConfig, num_dims: int) -> Strategy:
    """An algorithm of evosax's, with evaluations of its mean appended to its population."""
    algorithm, params = _build_evosax(config, num_dims)
    num_perturbed = config.population_size * config.num_evals

    def ask(key: Array, state: Any) -> tuple[Array, Any]:
        population, state = algorithm.ask(key, state, params)
        incumbent = algorithm.get_mean(state)
        incumbents = jnp.broadcast_to(incumbent, (config.num_incumbent_evals, num_dims))
        perturbed = jnp.repeat(population, config.num_evals, axis=0)
        return jnp.concatenate([perturbed, incumbents]), state

    def tell(key: Array, candidates: Array, scores: Array, state: Any) -> Any:
        scores = scores[:num_perturbed].reshape(-1, config.num_evals)
        fitness = finite_fitness(-aggregate(scores, config.eval_aggregate))
        population = candidates[: num_perturbed : config.num_evals]
        return algorithm.tell(key, population, fitness, state, params)[0]

    return Strategy(
        init=lambda key, mean: algorithm.init(key, mean, params),
        ask=ask,
        tell=tell,
        incumbent=algorithm.get_mean,
        seed_ids=_seed_ids(config, num_perturbed, config.num_incumbent_evals),
        num_candidates=num_perturbed + config.num_incumbent_evals,
        num_incumbent_evals=config.num_incumbent_evals,
    )


def _build_evosax(config: EvosaxConfig, num_dims: int) -> tuple[Any, Any]:
    """The algorithm and its params, with our std and step size wherever it takes one.

    Set explicitly because evosax's defaults (std 1, learning rate 1e-3) either destroy a small
    network or hardly move it.
    """
    from evosax.algorithms import distribution_based_algorithms

    cls = distribution_based_algorithms[EVOSAX_ALGORITHMS[config.name]]
    accepted = inspect.signature(cls.__init__).parameters
    options: dict[str, Any] = {}
    if "std_schedule" in accepted:
        options["std_schedule"] = optax.exponential_decay(
            config.noise_std, transition_steps=1, decay_rate=config.noise_std_decay
        )
    if "optimizer" in accepted:
        natural = config.name in ("snes", "xnes", "des")  # their mean update has a natural scale
        options["optimizer"] = optax.sgd(1.0) if natural else optax.adam(config.step_size)
    algorithm = cls(population_size=config.population_size, solution=jnp.zeros(num_dims), **options)
    params = algorithm.default_params
    if hasattr(params, "std_init"):
        params = params.replace(std_init=config.noise_std)
    return algorithm, params


def finite_fitness(fitness: Float[Array, " pop"]) -> Float[Array, " pop"]:
    """Fitness (minimised) with entries that are not finite just worse than the worst finite one.

    An infinity would poison the algorithms that standardise, so the gap is that between best and
    worst, or 1.
    """
    finite = jnp.isfinite(fitness)
    worst = jnp.max(jnp.where(finite, fitness, -jnp.inf))
    best = jnp.min(jnp.where(finite, fitness, jnp.inf))
    replacement = worst + jnp.maximum(worst - best, 1.0)
    return jnp.where(finite, fitness, jnp.where(finite.any(), replacement, 0.0))


def _seed_ids(config: NESConfig | EvosaxConfig, num_perturbed: int, num_incumbent: int) -> Any:
    """With common random numbers, the r-th evaluation of every member has the same seed."""
    if not config.common_random_numbers:
        return np.arange(num_perturbed + num_incumbent)
    return np.concatenate([np.arange(num_perturbed) % config.num_evals, np.arange(num_incumbent)])
