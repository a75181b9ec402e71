"""TD3, and TD3 for discrete actions, whose policy is a Gumbel-Softmax.

The two differ only in how they use the actor's outputs.

Source: Fujimoto et al., "Addressing Function Approximation Error in Actor-Critic Methods" (2018);
Jang et al., "Categorical Reparameterization with Gumbel-Softmax" (2017); the paper's
hyperparameter tables; `docs/reference.md` 4.3 and 4.4.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree

from sejax.agents.base import Agent, Hparams
from sejax.agents.buffers import Transition
from sejax.agents.off_policy import ActorCritic, ActorCriticOptions, adam_step
from sejax.envs.base import Task
from sejax.ops.networks import MLP
from sejax.ops.optimizers import ADAM
from sejax.options import Activation, Count, Fraction, NonNegative, Positive, option

_MIN_TEMPERATURE = 1e-6


@dataclass(frozen=True, kw_only=True)
class TD3Config(ActorCriticOptions):
    """TD3's hyperparameters (paper, appendix "MountainCarContinuous-v0 and HalfCheetah-v3").

    Attributes:
      policy_delay: learning steps of the critics for each one of the actor and the targets
      action_noise_std: Exploration noise, in units of the largest action.
      target_noise_std: Noise that smooths the target policy, in the same units.

    Differs: the authors do not scale the target policy's noise by the largest action. There is no
    difference if the largest action is 1, as in all of the paper's tasks. They test with
    exploration noise; here tests take the best action.
    """

    actions: ClassVar[tuple[str, ...]] = ("continuous",)

    policy_delay: Count = 2
    action_noise_std: NonNegative = option(0.1, traced=True)
    target_noise_std: NonNegative = option(0.2, traced=True)
    target_noise_clip: NonNegative = option(0.5, traced=True)

    def make(self, task: Task) -> Agent:
        """The agent for a task's observations and actions."""
        return TD3(self, task.obs_dim, task.action_dim, task.max_action).agent()


@dataclass(frozen=True, kw_only=True)
class DiscreteTD3Config(TD3Config):
    """TD3 for discrete actions: the policy is a Gumbel-Softmax (paper, default agent table).

    The buffer keeps actions as vectors `[num_actions]`: samples of the Gumbel-Softmax with
    exploration noise. The environment takes the index of the largest entry.

    Attributes:
      layer_norm: after each hidden layer but the first, as in the authors' code
      temperature: Initial temperature of the Gumbel-Softmax.
      final_temperature: as a fraction of the initial temperature
      temperature_steps: updates in which the temperature falls linearly to the final one
      one_hot_actions: straight-through one-hot actions in place of soft ones

    Differs: the temperature reaches its final value after `temperature_steps` learning steps, in
    the authors' code one step earlier. Tests take the likeliest action.
    """

    actions: ClassVar[tuple[str, ...]] = ("discrete",)

    activation: Activation = "tanh"
    learning_rate: Positive = 1e-3
    layer_norm: bool = True
    temperature: Positive = option(1.0, traced=True)
    final_temperature: Fraction = option(0.05, traced=True)
    temperature_steps: Count = 2000
    one_hot_actions: bool = False

    def make(self, task: Task) -> Agent:
        assert task.num_actions is not None
        return DiscreteTD3(self, task.obs_dim, task.num_actions).agent()

    def mlp(self, num_outputs: int) -> MLP:
        return super().mlp(num_outputs).clone(layer_norm=self.layer_norm)


class TD3State(struct.PyTreeNode):
    """One agent. The leaves of the two critics are `[2, ...]`."""

    actor: PyTree
    critics: PyTree
    target_actor: PyTree
    target_critics: PyTree
    actor_opt_state: optax.OptState
    critic_opt_state: optax.OptState
    num_updates: Int[Array, ""]
    is_warming_up: Bool[Array, ""]
    hparams: Hparams


class LearningNoise(NamedTuple):
    """The random numbers of one learning step, each `[action_dim, batch]`.

    Attributes:
      smoothing: standard normal; scaled and clipped, it is added to the target policy's actions.
      target_policy: what the target policy draws for the next states; None for continuous actions.
      policy: what the policy draws for the states; likewise.
    """

    smoothing: Array
    target_policy: Array | None
    policy: Array | None


class TD3(ActorCritic):
    """The agent for observations `[obs_dim]` and continuous actions `max_action * tanh(outputs)`.

    Noisy actions are clipped to that range. Actions and the actor's outputs are
    `[action_dim, *batch]`; `max_action` is the unit of all Gaussian noise.

    Example:
      >>> agent = TD3(TD3Config(), obs_dim=3, action_dim=1, max_action=2.0).agent()
      >>> state = jax.jit(agent.init)(jax.random.key(0), agent.hparams)
      >>> agent.act(jax.random.key(1), state, jnp.zeros(3), explore=True).shape
      (1,)
    """

    config: TD3Config

    def init(self, key: Array, hparams: Hparams) -> TD3State:
        actor, critics = self.init_networks(key, hparams)
        return TD3State(
            actor=actor,
            critics=critics,
            target_actor=actor,
            target_critics=critics,
            actor_opt_state=ADAM.init(actor),
            critic_opt_state=ADAM.init(critics),
            num_updates=jnp.int32(0),
            is_warming_up=jnp.bool_(self.config.warmup_episodes > 0),
            hparams=hparams,
        )

    def act(self, key: Array, state: TD3State, obs: Array, explore: bool) -> Array:
        outputs = self.actor_outputs(state.actor, obs)
        if not explore:
            return self.best(outputs)
        key_policy, key_noise, key_warm_up = jax.random.split(key, 3)
        action = self.action(outputs, self.policy_noise(key_policy, outputs.shape), state)
        noise = self.max_action * jax.random.normal(key_noise, outputs.shape)
        action = self.restrict(action + state.hparams.action_noise_std * noise)
        return jnp.where(state.is_warming_up, self.warm_up(key_warm_up), action)

    def update(self, key: Array, state: TD3State, batch: Transition) -> TD3State:
        return self.learn(state, batch, self.learning_noise(key, batch.action.shape))

    def learning_noise(self, key: Array, shape: tuple[int, ...]) -> LearningNoise:
        """The random numbers of a learning step on actions `[action_dim, batch]`."""
        key_smoothing, key_target, key_policy = jax.random.split(key, 3)
        return LearningNoise(
            smoothing=jax.random.normal(key_smoothing, shape),
            target_policy=self.policy_noise(key_target, shape),
            policy=self.policy_noise(key_policy, shape),
        )

    def learn(self, state: TD3State, batch: Transition, noise: LearningNoise) -> TD3State:
        """A step of the critics and, every `policy_delay`-th time, of the actor and all targets.

        Source: Fujimoto et al. (2018), algorithm 1; `docs/reference.md` 4.3.
        """
        state = state.replace(num_updates=state.num_updates + 1)
        state = self.update_critics(state, batch, noise)
        if self.config.policy_delay == 1:
            return self.update_actor(state, batch, noise)
        return jax.lax.cond(
            state.num_updates % self.config.policy_delay == 0,
            lambda state: self.update_actor(state, batch, noise),
            lambda state: state,
            state,
        )

    def update_critics(self, state: TD3State, batch: Transition, noise: LearningNoise) -> TD3State:
        hp = state.hparams
        q_values = jax.vmap(self.q_value, (0, None, None))

        def sum_of_losses(critics: PyTree, batch: Transition, noise: LearningNoise) -> Array:
            next_action = self.smoothed_target_action(state, batch.next_obs, noise)
            next_q = jnp.min(q_values(state.target_critics, batch.next_obs, next_action), axis=0)
            targets = batch.reward + hp.discount * batch.discount * next_q
            errors = q_values(critics, batch.obs, batch.action) - targets[None]
            return jnp.sum(batch.weight * jnp.sum(errors**2, axis=0))

        critics, opt_state = adam_step(
            sum_of_losses, state.critics, state.critic_opt_state, (batch, noise), hp
        )
        return state.replace(critics=critics, critic_opt_state=opt_state)

    def update_actor(self, state: TD3State, batch: Transition, noise: LearningNoise) -> TD3State:
        hp = state.hparams
        critic = jax.tree.map(lambda x: x[0], state.critics)

        def sum_of_losses(actor: PyTree, batch: Transition, noise: LearningNoise) -> Array:
            action = self.action(self.actor_outputs(actor, batch.obs), noise.policy, state)
            return -jnp.sum(batch.weight * self.q_value(critic, batch.obs, action))

        actor, opt_state = adam_step(
            sum_of_losses, state.actor, state.actor_opt_state, (batch, noise), hp
        )
        return state.replace(
            actor=actor,
            actor_opt_state=opt_state,
            target_actor=optax.incremental_update(actor, state.target_actor, hp.tau),
            target_critics=optax.incremental_update(state.critics, state.target_critics, hp.tau),
        )

    def q_value(self, critic: PyTree, obs: Array, action: Array) -> Float[Array, "*batch"]:
        """One critic's value of an action."""
        return cast(Array, self.critic.apply(critic, jnp.concatenate([obs, action])))[0]

    def smoothed_target_action(self, state: TD3State, obs: Array, noise: LearningNoise) -> Array:
        r"""The target policy's action plus :math:`\mathrm{clip}(\epsilon, -c, c)`, restricted.

        Source: Fujimoto et al. (2018), eq. 14.
        """
        hp = state.hparams
        clip = hp.target_noise_clip
        smoothing = jnp.clip(hp.target_noise_std * noise.smoothing, -clip, clip)
        outputs = self.actor_outputs(state.target_actor, obs)
        action = self.action(outputs, noise.target_policy, state)
        return self.restrict(action + self.max_action * smoothing)

    # Methods that discrete actions override.

    def policy_noise(self, key: Array, shape: tuple[int, ...]) -> Array | None:
        """The randomness of `action`, for outputs of this shape; None if it has none."""
        return None

    def action(self, outputs: Array, noise: Array | None, state: TD3State) -> Array:
        """The policy's action for an actor's outputs."""
        return self.best(outputs)

    def restrict(self, action: Array) -> Array:
        """Makes an action with Gaussian noise an allowed one."""
        return jnp.clip(action, -self.max_action, self.max_action)

    def warm_up(self, key: Array) -> Array:
        """A uniformly random action, `[action_dim]`."""
        low, high = -self.max_action, self.max_action
        return jax.random.uniform(key, (self.action_dim,), minval=low, maxval=high)

    def best(self, outputs: Array) -> Array:
        """The action without any randomness."""
        return self.max_action * jnp.tanh(outputs)


class DiscreteTD3(TD3):
    """The agent for discrete actions as relaxed one-hot vectors; noise is not restricted."""

    config: DiscreteTD3Config

    def policy_noise(self, key: Array, shape: tuple[int, ...]) -> Array | None:
        return jax.random.gumbel(key, shape)

    def action(self, outputs: Array, noise: Array | None, state: TD3State) -> Array:
        assert noise is not None
        steps = self.config.temperature_steps
        temperature = annealed_temperature(state.hparams, state.num_updates, steps)
        return gumbel_softmax(outputs, noise, temperature, self.config.one_hot_actions)

    def restrict(self, action: Array) -> Array:
        return action

    def warm_up(self, key: Array) -> Array:
        return jax.nn.one_hot(jax.random.randint(key, (), 0, self.action_dim), self.action_dim)

    def best(self, outputs: Array) -> Array:
        return _one_hot_of_largest(outputs)

    def env_action(self, action: Array) -> Array:
        return jnp.argmax(action, axis=0).astype(jnp.int32)


def gumbel_softmax(
    logits: Float[Array, "actions *batch"],
    gumbel: Float[Array, "actions *batch"],
    temperature: Array | float,
    one_hot: bool,
) -> Float[Array, "actions *batch"]:
    """A relaxed sample of the categorical distribution, one in each column.

    Args:
      logits: unnormalised log-probabilities.
      gumbel: standard Gumbel noise.
      temperature: towards 0, samples become one-hot.
      one_hot: round to one-hot, with the gradient of the relaxed sample ("straight-through").

    Source: Jang et al. (2017), eq. 2.
    """
    perturbed = logits + gumbel
    soft = jax.nn.softmax(perturbed / temperature, axis=0)
    if not one_hot:
        return soft
    return _one_hot_of_largest(perturbed) + (soft - jax.lax.stop_gradient(soft))


def annealed_temperature(hparams: Hparams, num_updates: Array, num_steps: int) -> Array:
    """Temperature in the `num_updates`-th learning step and until the next one.

    It falls linearly from `hparams.temperature` to `hparams.final_temperature` times that, in
    `num_steps` learning steps, and stays there.

    Source: `docs/reference.md` 4.4.
    """
    progress = jnp.minimum(num_updates / num_steps, 1.0)
    factor = 1 + progress * (hparams.final_temperature - 1)
    return jnp.maximum(hparams.temperature * factor, _MIN_TEMPERATURE)


def _one_hot_of_largest(x: Float[Array, "actions *batch"]) -> Float[Array, "actions *batch"]:
    return jax.nn.one_hot(jnp.argmax(x, axis=0), x.shape[0], axis=0)
