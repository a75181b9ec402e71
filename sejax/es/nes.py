"""The paper's natural evolution strategy as an evosax algorithm.

Source: paper, Algorithm 1 and appendix "NES Score Transformation"; `reference_details.md` 2.
"""

from typing import Any

import jax
import jax.numpy as jnp
from evosax.algorithms.distribution_based import base
from flax import struct
from jaxtyping import Array, Float

from sejax.configs import NESConfig
from sejax.es.score_transforms import TRANSFORMS


@struct.dataclass
class State(base.State):
    mean: Array  # psi
    noise_std: Array
    step_size: Array


@struct.dataclass
class Params(base.Params):
    """The traced numbers of Algorithm 1, which a population of runs may vary."""

    noise_std: Array | float  # sigma
    noise_std_decay: Array | float
    step_size: Array | float  # alpha
    step_size_decay: Array | float
    weight_decay: Array | float


class NES(base.DistributionBasedAlgorithm):
    """NES with mirrored sampling and evaluation of the incumbent.

    `ask` returns the candidates to score, `[num_candidates, num_dims]`: psi + eps_i for each of the
    `config.population_size` members, then psi - eps_i if sampling is mirrored, each of these
    `config.num_evals` times, and last the incumbent psi, once for each member unless
    `config.num_incumbent_evals` says otherwise. `tell` takes the fitness of all of them, which
    evosax minimises: the negative of the score.

    With mirrored sampling a member's score is that of its better sign, and its eps has that sign;
    a tie keeps the plus.
    """

    def __init__(self, config: NESConfig, solution: Any):
        num_signs = 2 if config.mirrored else 1
        self.num_perturbed = config.population_size * num_signs * config.num_evals
        self.num_incumbent_evals = config.num_incumbent_evals or config.population_size
        super().__init__(self.num_perturbed + self.num_incumbent_evals, solution)
        self.config = config
        self.num_signs = num_signs

    @property
    def _default_params(self) -> Params:  # type: ignore[override]
        return Params(**{name: getattr(self.config, name) for name in Params.__annotations__})

    def _init(self, key: Array, params: Params) -> State:
        return State(
            mean=jnp.full((self.num_dims,), jnp.nan),
            noise_std=jnp.float32(params.noise_std),
            step_size=jnp.float32(params.step_size),
            best_solution=jnp.full((self.num_dims,), jnp.nan),
            best_fitness=jnp.inf,
            generation_counter=0,
        )

    def _ask(
        self, key: Array, state: State, params: Params
    ) -> tuple[Float[Array, "candidates dims"], State]:
        num_members = self.config.population_size
        noise = state.noise_std * jax.random.normal(key, (num_members, self.num_dims))
        signed = jnp.concatenate([noise, -noise]) if self.config.mirrored else noise
        perturbed = jnp.repeat(state.mean + signed, self.config.num_evals, axis=0)
        incumbents = jnp.broadcast_to(state.mean, (self.num_incumbent_evals, self.num_dims))
        return jnp.concatenate([perturbed, incumbents]), state

    def _tell(
        self, key: Array, population: Array, fitness: Array, state: State, params: Params
    ) -> State:
        scores, incumbent_scores = -fitness[: self.num_perturbed], -fitness[self.num_perturbed :]
        num_evals = self.config.num_evals
        scores = aggregate(scores.reshape(-1, num_evals), self.config.eval_aggregate)
        noise = population[: self.num_perturbed : num_evals] - state.mean
        scores, noise = self._choose_sign(scores, noise)
        weights = TRANSFORMS[self.config.score_transform](scores, finite_mean(incumbent_scores))
        step = state.step_size * weights @ noise
        if self.config.update_rule == "paper":
            step = step / (self.config.population_size * state.noise_std)
        return state.replace(
            mean=(1 - params.weight_decay) * state.mean + step,
            noise_std=state.noise_std * params.noise_std_decay,
            step_size=state.step_size * params.step_size_decay,
        )

    def _choose_sign(self, scores: Array, noise: Array) -> tuple[Array, Array]:
        """Scores `[pop]` and signed noise `[pop, dims]` of each member's better sign."""
        if not self.config.mirrored:
            return scores, noise
        plus, minus = scores.reshape(2, -1)
        use_minus = jnp.where(jnp.isfinite(minus), minus, -jnp.inf) > jnp.where(
            jnp.isfinite(plus), plus, -jnp.inf
        )
        sign = jnp.where(use_minus, -1.0, 1.0)
        return jnp.where(use_minus, minus, plus), sign[:, None] * noise[: plus.shape[0]]


def aggregate(scores: Float[Array, "pop evals"], how: str) -> Float[Array, " pop"]:
    """Mean or minimum of each member's scores; not finite if one of them is not."""
    scores = jnp.where(jnp.isfinite(scores), scores, jnp.nan)
    return scores.mean(axis=1) if how == "mean" else scores.min(axis=1)


def finite_mean(scores: Float[Array, " n"]) -> Float[Array, ""]:
    """Mean of the finite scores; nan if there is none."""
    finite = jnp.isfinite(scores)
    return jnp.where(finite, scores, 0.0).sum() / finite.sum()
