"""Soft actor-critic, for continuous actions and for discrete ones.

The two share everything but the policy. Continuous actions have a Gaussian squashed by tanh; one
drawn action stands for each expectation. Discrete actions have a softmax; expectations are sums.

Source: Haarnoja et al., "Soft Actor-Critic Algorithms and Applications" (2018); Christodoulou,
"Soft Actor-Critic for Discrete Action Settings" (2019).
"""

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, PyTree

from sejax.agents.base import Agent, Hparams
from sejax.agents.buffers import Transition
from sejax.agents.off_policy import ActorCritic, ActorCriticOptions, adam_step
from sejax.agents.policies import value_of_action
from sejax.envs.base import Task
from sejax.ops.optimizers import ADAM
from sejax.options import Finite, Fraction, NonNegative, Positive, option, require

_MIN_LOG_STD, _MAX_LOG_STD = -20.0, 2.0  # of the Gaussian, as in the authors' code


@dataclass(frozen=True, kw_only=True)
class SACConfig(ActorCriticOptions):
    """SAC's hyperparameters.

    Attributes:
      alpha: Temperature: the worth of a nat of entropy, in reward units. null: learned so that the
        entropy meets its target, as the authors do.
      target_entropy: Target for actions in [-1, 1], in nats for each dimension. Uniform actions
        have the largest entropy, log 2.
      target_entropy_fraction: Target for discrete actions, as a fraction of the largest entropy,
        log |A|: see docs/agents.md.

    Differs: Haarnoja et al. (2018) have two layers of 256 units, batches of 256 out of a million
    steps, a learning rate of 0.0003 and a tau of 0.005 (table 1). Christodoulou (2019)
    has a target entropy of 0.98 of the largest; with this target SAC does not learn CartPole.
    """

    actions: ClassVar[tuple[str, ...]] = ("discrete", "continuous")

    alpha: NonNegative | None = option(None, traced=True)
    init_alpha: Positive = option(1.0, traced=True)
    target_entropy: Finite = option(-1.0, traced=True)
    target_entropy_fraction: Fraction = option(0.2, traced=True)

    def make(self, task: Task) -> Agent:
        """The agent for a task's observations and actions.

        Raises:
          ConfigError: if the target entropy of the other kind of actions is set.
        """
        unused = "target_entropy_fraction" if task.num_actions is None else "target_entropy"
        is_default = getattr(self, unused) == getattr(type(self), unused)
        require(is_default, f"agent.{unused}", f"must be left out for {task.name}'s actions.")
        algorithm = SAC if task.num_actions is None else DiscreteSAC
        return algorithm(self, task.obs_dim, task.action_dim, task.max_action).agent()


class SACState(struct.PyTreeNode):
    """One agent."""

    params: "Params"
    target_critics: PyTree
    opt_state: optax.OptState
    is_warming_up: Bool[Array, ""]
    hparams: Hparams


class LearningNoise(NamedTuple):
    """Standard normal numbers of one learning step, `[action_dim, batch]`; None if discrete.

    Attributes:
      next_action: noise of the actions drawn for the next states.
      action: noise of the actions drawn for the states.
    """

    next_action: Array | None
    action: Array | None


class Params(NamedTuple):
    """Parameters of an agent; the leaves of `critics` are `[2, ...]`."""

    actor: PyTree
    critics: PyTree
    log_alpha: Array


class SAC(ActorCritic):
    """The agent for observations `[obs_dim]` and continuous actions.

    Its policy is the tanh of a Gaussian whose mean and log std are the actor's outputs. Critics
    have the action as input. Actions and outputs are `[feature, *batch]`.

    Example:
      >>> agent = SAC(SACConfig(), obs_dim=4, action_dim=2, max_action=1.0).agent()
      >>> state = jax.jit(agent.init)(jax.random.key(0), agent.hparams)
      >>> agent.act(jax.random.key(1), state, jnp.zeros(4), explore=True).shape
      (2,)
    """

    config: SACConfig

    def init(self, key: Array, hparams: Hparams) -> SACState:
        actor, critics = self.init_networks(key, hparams)
        params = Params(actor, critics, log_alpha=jnp.log(hparams.init_alpha))
        return SACState(
            params=params,
            target_critics=params.critics,
            opt_state=ADAM.init(params),
            is_warming_up=jnp.bool_(self.config.warmup_episodes > 0),
            hparams=hparams,
        )

    def critic_outputs(self, critics: PyTree, inputs: Array) -> Float[Array, "2 outputs *batch"]:
        """Both critics' outputs."""
        return cast(Array, jax.vmap(self.critic.apply, (0, None))(critics, inputs))

    def act(self, key: Array, state: SACState, obs: Array, explore: bool) -> Array:
        outputs = self.actor_outputs(state.params.actor, obs)
        return self.sample(key, outputs, state.is_warming_up) if explore else self.best(outputs)

    def update(self, key: Array, state: SACState, batch: Transition) -> SACState:
        return self.learn(state, batch, self.learning_noise(key, batch.reward.size))

    def learn(self, state: SACState, batch: Transition, noise: LearningNoise) -> SACState:
        """One step of Adam on all three losses from the same parameters, as in the authors' code.

        Source: Haarnoja et al. (2018), algorithm 1; Christodoulou (2019), algorithm 1.
        """

        def sum_of_losses(params: Params, batch: Transition, noise: LearningNoise) -> Array:
            return jnp.sum(batch.weight * self.losses(params, state, batch, noise))

        hp = state.hparams
        params, opt_state = adam_step(
            sum_of_losses, state.params, state.opt_state, (batch, noise), hp
        )
        return state.replace(
            params=params,
            opt_state=opt_state,
            target_critics=optax.incremental_update(params.critics, state.target_critics, hp.tau),
        )

    def losses(
        self, params: Params, state: SACState, batch: Transition, noise: LearningNoise
    ) -> Float[Array, " batch"]:
        r"""Sum of the three losses for each column; each has a gradient for its parameters alone.

        .. math::
          y &= r + \gamma d\, E[\min_i Q'_i(s', a') - \alpha \log \pi(a'|s')] \\
          J_Q &= \tfrac12 \sum_i (Q_i(s, a) - y)^2 \\
          J_\pi &= E[\alpha \log \pi(a|s) - \min_i Q_i(s, a)] \\
          J_\alpha &= \log \alpha\, (E[-\log \pi(a|s)] - \bar H)

        Differs: the factor in the paper's temperature loss is alpha. Here and in the authors' code
        it is log alpha; alpha then falls and rises at a rate that does not depend on its value.

        Source: Haarnoja et al. (2018), eq. 5, 7 and 18; Christodoulou (2019), eq. 10 to 12.
        """
        hp = state.hparams
        fixed = jax.lax.stop_gradient(params)
        alpha = jnp.exp(fixed.log_alpha) if hp.alpha is None else hp.alpha
        next_outputs = self.actor_outputs(fixed.actor, batch.next_obs)
        next_q, next_entropy = self.expected(
            state.target_critics, batch.next_obs, next_outputs, noise.next_action
        )
        targets = batch.reward + hp.discount * batch.discount * (next_q + alpha * next_entropy)
        errors = self.q_values(params.critics, batch.obs, batch.action) - targets
        q_value, entropy = self.expected(
            fixed.critics, batch.obs, self.actor_outputs(params.actor, batch.obs), noise.action
        )
        losses = 0.5 * jnp.sum(errors**2, axis=0) - (q_value + alpha * entropy)
        if hp.alpha is None:
            excess = jax.lax.stop_gradient(entropy) - self.target_entropy(hp)
            losses = losses + params.log_alpha * excess
        return losses

    # Methods that discrete actions override.

    def network_sizes(self) -> tuple[int, int, int]:
        return 2 * self.action_dim, self.action_dim, 1

    def target_entropy(self, hparams: Hparams) -> Array:
        """The target of the entropy, in nats."""
        return hparams.target_entropy * self.action_dim

    def learning_noise(self, key: Array, batch: int) -> LearningNoise:
        """The random numbers of a learning step, for `batch` columns."""
        return LearningNoise(*jax.random.normal(key, (2, self.action_dim, batch)))

    def sample(self, key: Array, outputs: Array, is_uniform: Array) -> Array:
        """An action of the policy, or a uniform one, for one observation."""
        noise = jax.random.normal(key, (self.action_dim,))
        uniform = jax.lax.erf(noise / math.sqrt(2))  # the same noise made uniform: 2 F(noise) - 1
        return jnp.where(is_uniform, uniform, squashed_gaussian(outputs, noise)[0])

    def best(self, outputs: Array) -> Array:
        """The action without any randomness."""
        return jnp.tanh(outputs[: self.action_dim])

    def q_values(self, critics: PyTree, obs: Array, action: Array) -> Float[Array, "2 batch"]:
        """Both critics' values of the actions that were taken."""
        return self.critic_outputs(critics, jnp.concatenate([obs, action]))[:, 0]

    def expected(
        self, critics: PyTree, obs: Array, outputs: Array, noise: Array | None
    ) -> tuple[Array, Array]:
        """The lesser critic's value and the entropy, `[batch]` each, for an action drawn by noise.

        For a softmax policy they are expectations over the actions.
        """
        assert noise is not None
        action, log_p = squashed_gaussian(outputs, noise)
        return lesser(self.q_values(critics, obs, action)), -log_p

    def env_action(self, action: Array) -> Array:
        """An action as the environment takes it."""
        return self.max_action * action


class DiscreteSAC(SAC):
    """The agent for actions `0..num_actions-1`, whose logits are the actor's outputs.

    Critics have an output for each action, and expectations are sums over all of them. `action_dim`
    is the number of actions.
    """

    def network_sizes(self) -> tuple[int, int, int]:
        return self.action_dim, 0, self.action_dim

    def target_entropy(self, hparams: Hparams) -> Array:
        return hparams.target_entropy_fraction * math.log(self.action_dim)

    def learning_noise(self, key: Array, batch: int) -> LearningNoise:
        return LearningNoise(None, None)

    def sample(self, key: Array, outputs: Array, is_uniform: Array) -> Array:
        return jax.random.categorical(key, jnp.where(is_uniform, 0.0, outputs)).astype(jnp.int32)

    def best(self, outputs: Array) -> Array:
        return jnp.argmax(outputs).astype(jnp.int32)

    def q_values(self, critics: PyTree, obs: Array, action: Array) -> Float[Array, "2 batch"]:
        return jax.vmap(value_of_action, (0, None))(self.critic_outputs(critics, obs), action)

    def expected(
        self, critics: PyTree, obs: Array, outputs: Array, noise: Array | None
    ) -> tuple[Array, Array]:
        log_p = jax.nn.log_softmax(outputs, axis=0)
        p = jnp.exp(log_p)
        q_values = lesser(self.critic_outputs(critics, obs))
        return jnp.sum(p * q_values, axis=0), -jnp.sum(p * log_p, axis=0)

    def env_action(self, action: Array) -> Array:
        return action


def lesser(q_values: Float[Array, "2 *values"]) -> Float[Array, "*values"]:
    """The lesser of the two critics' values.

    `jnp.min` would not do. Its gradient divides by the number of values that equal the minimum.
    That number is 0 if the compiler computes a value twice and rounds it differently.
    """
    return jnp.minimum(q_values[0], q_values[1])


def squashed_gaussian(
    outputs: Float[Array, "two_actions *batch"], noise: Float[Array, "actions *batch"]
) -> tuple[Float[Array, "actions *batch"], Float[Array, "*batch"]]:
    r"""Actions :math:`\tanh(\mu + \sigma \epsilon)` and the logarithms of their densities.

    Args:
      outputs: mean and log std; the log std is clipped.
      noise: standard normal, `[actions, *batch]`.

    Source: Haarnoja et al. (2018), appendix C, eq. 26.
    """
    mean, log_std = jnp.split(outputs, 2)
    log_std = jnp.clip(log_std, _MIN_LOG_STD, _MAX_LOG_STD)
    u = mean + jnp.exp(log_std) * noise
    log_normal = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
    log_slope = 2 * (math.log(2) - u - jax.nn.softplus(-2 * u))  # log(1 - tanh(u)^2), stably
    return jnp.tanh(u), jnp.sum(log_normal - log_slope, axis=0)
