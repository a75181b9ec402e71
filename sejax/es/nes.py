"""The paper's natural evolution strategy.

Source: paper, Algorithm 1 and appendix "NES Score Transformation"; `docs/reference.md` 2.
"""

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from sejax.es.base import NumMembers, Scale, Strategy, StrategyOptions
from sejax.es.score_transforms import FIELD, TRANSFORMS, OwnTransform, transform_of
from sejax.ops.scores import or_minus_inf
from sejax.options import LEAST, Count, Decay, Fraction, registry, require_known


@dataclass(frozen=True, kw_only=True)
class NESConfig(StrategyOptions):
    """NES with mirrored sampling and evaluation of the search mean (Algorithm 1).

    The defaults were measured to work for SEs (docs/defaults.md); `preset=paper` has the paper's.

    Attributes:
      population_size: n_p: perturbations of a generation; if mirrored, two candidates each
      num_incumbent_evals: Agents on the search mean; null: one for each perturbation, as in the
        paper.
      noise_std: sigma: std of the weight perturbation
      noise_std_decay: factor on sigma after each generation
      step_size: alpha: step size of the update
      step_size_decay: factor on alpha after each generation
      mirrored: each perturbation is tried as +eps and -eps and keeps its better sign
      score_transform: A name, or my_module:my_function that maps scores `[pop]` to weights `[pop]`.
      update_rule: authors: psi += alpha sum F eps, eps ~ N(0, sigma^2 I); paper: the same sum
        divided by n_p sigma
      weight_decay: psi shrinks by this fraction before each update
    """

    population_size: NumMembers = 64
    num_incumbent_evals: Count | None = 16
    noise_std: Scale = 0.06
    noise_std_decay: Decay = 0.97
    step_size: Scale = 1.0
    step_size_decay: Decay = 1.0
    mirrored: bool = True
    score_transform: str | OwnTransform = "all_better_2"
    update_rule: Literal["authors", "paper"] = "authors"
    weight_decay: Fraction = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        choice = self.score_transform
        if isinstance(choice, str) and ":" in choice:
            registry.require_path(FIELD, choice)
        elif not callable(choice):
            require_known(FIELD, choice, TRANSFORMS)

    def make(self, num_dims: int) -> Strategy:
        r"""NES over vectors `[num_dims]`.

        The population is psi + eps_i, eps_i ~ N(0, sigma^2 I), for `population_size` perturbations,
        then psi - eps_i if sampling is mirrored. A mirrored pair takes the score and the eps of its
        better sign; in a tie, of the plus sign.

        .. math:: \psi \leftarrow (1 - \lambda) \psi + \alpha \sum_i F_i \epsilon_i

        with the weights F of the score transform, divided by :math:`n_p \sigma` with
        `update_rule="paper"`.

        Source: paper, Algorithm 1; `docs/reference.md` 2.

        Example:
          >>> strategy = NESConfig(population_size=4).make(num_dims=3)
          >>> state = strategy.init(jax.random.key(0), jnp.zeros(3))
          >>> strategy.ask(jax.random.key(1), state)[0].shape  # +eps and -eps
          (8, 3)
        """
        num_noises = self.population_size
        transform = transform_of(self.score_transform, num_noises)

        def init(key: Array, mean: Float[Array, " dims"]) -> NESState:
            return NESState(
                mean=mean,
                noise_std=jnp.float32(self.noise_std),
                step_size=jnp.float32(self.step_size),
            )

        def ask(key: Array, state: NESState) -> tuple[Float[Array, "pop dims"], NESState]:
            noise = state.noise_std * jax.random.normal(key, (num_noises, num_dims))
            signed = jnp.concatenate([noise, -noise]) if self.mirrored else noise
            return state.mean + signed, state

        def tell(
            key: Array, population: Array, scores: Array, incumbent_score: Array, state: NESState
        ) -> NESState:
            noise = population - state.mean
            if self.mirrored:
                scores, noise = better_signs(scores, noise)
            weights = transform(scores, incumbent_score)
            step = state.step_size * weights @ noise
            if self.update_rule == "paper":
                # After many generations a decaying std is 0 in 32 bits.
                step = step / (num_noises * jnp.maximum(state.noise_std, LEAST))
            return state.replace(
                mean=(1 - self.weight_decay) * state.mean + step,
                noise_std=state.noise_std * self.noise_std_decay,
                step_size=state.step_size * self.step_size_decay,
            )

        return Strategy(
            init=init,
            ask=ask,
            tell=tell,
            incumbent=lambda state: state.mean,
            num_candidates=2 * num_noises if self.mirrored else num_noises,
            mirrored=self.mirrored,
            num_incumbent_evals=self.num_incumbent_evals or num_noises,
            **self.shared(),
        )


class NESState(struct.PyTreeNode):
    """The search distribution of a generation, and the size of its step."""

    mean: Float[Array, " dims"]  # psi
    noise_std: Array  # sigma
    step_size: Array  # alpha


def better_signs(
    scores: Float[Array, " pop"], noise: Float[Array, "pop dims"]
) -> tuple[Float[Array, " half"], Float[Array, "half dims"]]:
    """Score and noise of each perturbation's better sign; the plus signs are the first half."""
    plus, minus = scores.reshape(2, -1)
    use_minus = or_minus_inf(minus) > or_minus_inf(plus)
    sign = jnp.where(use_minus, -1.0, 1.0)
    return jnp.where(use_minus, minus, plus), sign[:, None] * noise[: plus.shape[0]]
