"""TD3, and TD3 for discrete actions, whose policy is a Gumbel-Softmax.

The two share everything but a `Policy`: what becomes of the actor's outputs.

Source: Fujimoto et al., "Addressing Function Approximation Error in Actor-Critic Methods" (2018);
Jang et al., "Categorical Reparameterization with Gumbel-Softmax" (2017); the paper's
hyperparameter tables; `docs/reference.md` 4.3 and 4.4.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from sejax.agents.base import Agent, Number, traced
from sejax.agents.buffers import Transition
from sejax.agents.networks import flat_network
from sejax.agents.off_policy import ActorCriticOptions, adam_step, off_policy_agent, soft_update
from sejax.envs.base import Task
from sejax.ops import flat
from sejax.ops.networks import MLP
from sejax.options import MOVES, counts, fraction, not_negative, option, positive

_MIN_TEMPERATURE = 1e-6


@dataclass(frozen=True, kw_only=True)
class TD3Config(ActorCriticOptions):
    """TD3's hyperparameters (paper, appendix "MountainCarContinuous-v0 and HalfCheetah-v3").

    Attributes:
      policy_delay: learning steps for each one of actor and targets
      action_noise_std: Exploration, in units of the largest action.
      target_noise_std: Smoothing of the target policy, likewise.
      noisy_tests: exploration noise in tests too, as in the authors' code

    Differs: the authors do not scale the target policy's noise by the largest action. That is the
    same wherever it is 1, as in all of the paper's tasks. Tests are without exploration noise
    unless `noisy_tests` is set.
    """

    policy_delay: int = option(2, counts())
    action_noise_std: float = option(0.1, not_negative(), traced=True)
    target_noise_std: float = option(0.2, not_negative(), traced=True)
    target_noise_clip: float = option(0.5, not_negative(), traced=True)
    noisy_tests: bool = False

    def make(self, task: Task) -> Agent:
        """The agent for a task's observations and actions."""
        return make_td3(self, task.obs_dim, tanh_policy(task.action_dim, task.max_action))


@dataclass(frozen=True, kw_only=True)
class DiscreteTD3Config(TD3Config):
    """TD3 for discrete actions: the policy is a Gumbel-Softmax (paper, default agent table).

    The buffer keeps actions as vectors `[num_actions]`: samples of the Gumbel-Softmax with
    exploration noise. The environment takes the index of the largest entry.

    Attributes:
      layer_norm: after each hidden layer but the first, as in the authors' code
      temperature: Of the Gumbel-Softmax at the start.
      final_temperature: as a fraction of it, ...
      temperature_steps: ... reached linearly after so many updates
      one_hot_actions: straight-through one-hot actions in place of soft ones

    Differs: the temperature reaches its end after `temperature_steps` learning steps, in the
    authors' code after one less. Tests take the likeliest action unless `noisy_tests` is set.
    """

    actions: ClassVar[tuple[str, ...]] = ("discrete",)

    activation: str = "tanh"
    learning_rate: float = 1e-3
    layer_norm: bool = True
    temperature: float = option(1.0, positive(MOVES), traced=True)
    final_temperature: float = option(0.05, fraction(), traced=True)
    temperature_steps: int = option(2000, counts())
    one_hot_actions: bool = False

    def make(self, task: Task) -> Agent:
        assert task.num_actions is not None
        policy = gumbel_softmax_policy(
            task.num_actions, self.temperature_steps, self.one_hot_actions
        )
        return make_td3(self, task.obs_dim, policy)

    def mlp(self, num_outputs: int) -> MLP:
        return super().mlp(num_outputs).clone(layer_norm=self.layer_norm, may_narrow=True)


class TD3Hparams(NamedTuple):
    """Traced hyperparameters; of sizes what is in use, None for all."""

    learning_rate: Number
    tau: Number
    discount: Number
    action_noise_std: Number
    target_noise_std: Number
    target_noise_clip: Number
    temperature: Number | None = None  # of discrete actions, as the next
    final_temperature: Number | None = None
    hidden_size: Array | None = None
    batch_size: Array | None = None


class TD3State(struct.PyTreeNode):
    """One agent. Parameters are flat; the two critics' are the rows of one array."""

    actor: Float[Array, " num_actor_params"]
    critics: Float[Array, "2 num_critic_params"]
    target_actor: Float[Array, " num_actor_params"]
    target_critics: Float[Array, "2 num_critic_params"]
    actor_opt_state: optax.OptState
    critic_opt_state: optax.OptState
    num_updates: Int[Array, ""]
    is_warming_up: Bool[Array, ""]
    hparams: TD3Hparams


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


@dataclass(frozen=True, kw_only=True)
class Policy:
    """What the two variants differ in. Actions and outputs are `[action_dim, *batch]`.

    Attributes:
      action_dim: length of an action.
      max_action: the unit of all Gaussian noise.
      draw: `(key, shape) -> noise`, the randomness of `action`.
      action: `(outputs, noise, state) -> action` for an actor's outputs.
      restrict: `action -> action` as it is allowed to be once Gaussian noise was added.
      warm_up: `key -> action`, `[action_dim]`, uniformly random.
      best: `outputs -> action` without any randomness.
      env_action: `action -> action` as the environment takes it.
    """

    action_dim: int
    max_action: float
    draw: Callable[[Array, tuple[int, ...]], Array | None]
    action: Callable[[Array, Array | None, TD3State], Array]
    restrict: Callable[[Array], Array]
    warm_up: Callable[[Array], Array]
    best: Callable[[Array], Array]
    env_action: Callable[[Array], Array]


def make_td3(config: TD3Config, obs_dim: int, policy: Policy) -> Agent:
    """Builds the agent for observations `[obs_dim]` and a policy's actions.

    Example:
      >>> agent = make_td3(TD3Config(), obs_dim=3, policy=tanh_policy(1, max_action=2.0))
      >>> state = jax.jit(agent.init)(jax.random.key(0), agent.hparams)
      >>> agent.act(jax.random.key(1), state, jnp.zeros(3), explore=True).shape
      (1,)
    """
    networks = make_networks(config, obs_dim, policy.action_dim)
    learn = make_learning_step(config, networks, policy)

    def init(key: Array, hparams: TD3Hparams) -> TD3State:
        actor, critics = networks.init(key, hparams.hidden_size)
        return TD3State(
            actor=actor,
            critics=critics,
            target_actor=actor,
            target_critics=critics,
            actor_opt_state=flat.ADAM.init(actor),
            critic_opt_state=flat.ADAM.init(critics),
            num_updates=jnp.int32(0),
            is_warming_up=jnp.bool_(config.warmup_episodes > 0),
            hparams=jax.tree.map(jnp.float32, hparams),
        )

    def act(key: Array, state: TD3State, obs: Float[Array, " obs_dim"], explore: bool) -> Array:
        outputs = networks.actor(state.actor, obs)
        if not explore and not config.noisy_tests:
            return policy.best(outputs)
        key_policy, key_noise, key_warm_up = jax.random.split(key, 3)
        action = policy.action(outputs, policy.draw(key_policy, outputs.shape), state)
        noise = policy.max_action * jax.random.normal(key_noise, outputs.shape)
        action = policy.restrict(action + state.hparams.action_noise_std * noise)
        if not explore:
            return action
        return jnp.where(state.is_warming_up, policy.warm_up(key_warm_up), action)

    def update(key: Array, state: TD3State, batch: Transition) -> TD3State:
        return learn(state, batch, draw_learning_noise(key, policy, batch.action.shape))

    return off_policy_agent(
        config,
        hparams=traced(config, TD3Hparams),
        init=init,
        begin_episode=config.begin_episode,
        act=act,
        update=update,
        env_action=policy.env_action,
    )


# --- networks ------------------------------------------------------------------------------------


class Networks(NamedTuple):
    """The actor and the critics as functions of flat parameters.

    Attributes:
      init: `(key, hidden_size) -> (actor, critics)`, parameters `[n]` and `[2, m]`. `hidden_size`
        is the number of units in use, or None for all.
      actor: `(actor, obs) -> outputs`, `[action_dim, *batch]`, before the policy.
      critic: `(critic, obs, action) -> q_values`, `[*batch]`, of one of the critics.
    """

    init: Callable[[Array, Array | None], tuple[Array, Array]]
    actor: Callable[[Array, Array], Array]
    critic: Callable[[Array, Array, Array], Array]


def make_networks(config: TD3Config, obs_dim: int, action_dim: int) -> Networks:
    """An actor `s -> [action_dim]` and critics `[s, a] -> Q` of the same hidden layers."""
    actor = flat_network(config.mlp(action_dim), obs_dim)
    critic = flat_network(config.mlp(1), obs_dim + action_dim)

    def init(key: Array, hidden_size: Array | None = None) -> tuple[Array, Array]:
        key_actor, key_critics = jax.random.split(key)
        init_critics = jax.vmap(critic.init, (0, None))
        critics = init_critics(jax.random.split(key_critics), hidden_size)
        return actor.init(key_actor, hidden_size), critics

    return Networks(
        init=init,
        actor=actor.apply,
        critic=lambda params, obs, action: critic.apply(params, jnp.concatenate([obs, action]))[0],
    )


# --- learning ------------------------------------------------------------------------------------


def make_learning_step(
    config: TD3Config, networks: Networks, policy: Policy
) -> Callable[[TD3State, Transition, LearningNoise], TD3State]:
    """Builds `learn(state, batch, noise) -> state`, one step of both variants.

    The critics move in every step, the actor and all targets in every `config.policy_delay`-th.

    Source: Fujimoto et al. (2018), algorithm 1; `docs/reference.md` 4.3.
    """

    def both_q(critics: Array, obs: Array, action: Array) -> Float[Array, "2 batch"]:
        return jax.vmap(networks.critic, (0, None, None))(critics, obs, action)

    def update_critics(state: TD3State, batch: Transition, noise: LearningNoise) -> TD3State:
        hp = state.hparams

        def sum_of_losses(critics: Array, batch: Transition, noise: LearningNoise) -> Array:
            next_action = smoothed_target_action(
                networks.actor(state.target_actor, batch.next_obs), noise, state, policy
            )
            next_q = jnp.min(both_q(state.target_critics, batch.next_obs, next_action), axis=0)
            targets = batch.reward + hp.discount * batch.discount * next_q
            errors = both_q(critics, batch.obs, batch.action) - targets[None]
            return jnp.sum(batch.weight * jnp.sum(errors**2, axis=0))

        critics, opt_state = adam_step(
            sum_of_losses, state.critics, state.critic_opt_state, (batch, noise), hp
        )
        return state.replace(critics=critics, critic_opt_state=opt_state)

    def update_actor(state: TD3State, batch: Transition, noise: LearningNoise) -> TD3State:
        hp = state.hparams

        def sum_of_losses(actor: Array, batch: Transition, noise: LearningNoise) -> Array:
            action = policy.action(networks.actor(actor, batch.obs), noise.policy, state)
            return -jnp.sum(batch.weight * networks.critic(state.critics[0], batch.obs, action))

        actor, opt_state = adam_step(
            sum_of_losses, state.actor, state.actor_opt_state, (batch, noise), hp
        )
        return state.replace(
            actor=actor,
            actor_opt_state=opt_state,
            target_actor=soft_update(state.target_actor, actor, hp.tau),
            target_critics=soft_update(state.target_critics, state.critics, hp.tau),
        )

    def learn(state: TD3State, batch: Transition, noise: LearningNoise) -> TD3State:
        state = state.replace(num_updates=state.num_updates + 1)
        state = update_critics(state, batch, noise)
        if config.policy_delay == 1:
            return update_actor(state, batch, noise)
        return jax.lax.cond(
            state.num_updates % config.policy_delay == 0,
            lambda state: update_actor(state, batch, noise),
            lambda state: state,
            state,
        )

    return learn


def draw_learning_noise(key: Array, policy: Policy, shape: tuple[int, ...]) -> LearningNoise:
    """The random numbers of a learning step on actions `[action_dim, batch]`."""
    key_smoothing, key_target, key_policy = jax.random.split(key, 3)
    return LearningNoise(
        smoothing=jax.random.normal(key_smoothing, shape),
        target_policy=policy.draw(key_target, shape),
        policy=policy.draw(key_policy, shape),
    )


def smoothed_target_action(
    outputs: Float[Array, "actions batch"], noise: LearningNoise, state: TD3State, policy: Policy
) -> Float[Array, "actions batch"]:
    r"""The target policy's action plus :math:`\mathrm{clip}(\epsilon, -c, c)`, as allowed.

    Source: Fujimoto et al. (2018), eq. 14.
    """
    hp = state.hparams
    smoothing = jnp.clip(
        hp.target_noise_std * noise.smoothing, -hp.target_noise_clip, hp.target_noise_clip
    )
    action = policy.action(outputs, noise.target_policy, state)
    return policy.restrict(action + policy.max_action * smoothing)


# --- policies ------------------------------------------------------------------------------------


def tanh_policy(action_dim: int, max_action: float) -> Policy:
    """Continuous actions `max_action * tanh(outputs)`; noise does not lead out of their range."""

    def squash(outputs: Array) -> Array:
        return max_action * jnp.tanh(outputs)

    return Policy(
        action_dim=action_dim,
        max_action=max_action,
        draw=lambda key, shape: None,
        action=lambda outputs, noise, state: squash(outputs),
        restrict=lambda action: jnp.clip(action, -max_action, max_action),
        warm_up=lambda key: jax.random.uniform(
            key, (action_dim,), minval=-max_action, maxval=max_action
        ),
        best=squash,
        env_action=lambda action: action,
    )


def gumbel_softmax_policy(num_actions: int, temperature_steps: int, one_hot: bool) -> Policy:
    """Discrete actions as relaxed one-hot vectors; noise may lead anywhere.

    Args:
      num_actions: length of the vector.
      temperature_steps: learning steps until the final temperature.
      one_hot: whether the vectors are exactly one-hot, with the relaxed ones' gradients.
    """

    def action(outputs: Array, noise: Array | None, state: TD3State) -> Array:
        assert noise is not None
        temperature = annealed_temperature(state.hparams, state.num_updates, temperature_steps)
        return gumbel_softmax(outputs, noise, temperature, one_hot)

    def warm_up(key: Array) -> Array:
        return jax.nn.one_hot(jax.random.randint(key, (), 0, num_actions), num_actions)

    return Policy(
        action_dim=num_actions,
        max_action=1.0,
        draw=jax.random.gumbel,
        action=action,
        restrict=lambda action: action,
        warm_up=warm_up,
        best=_one_hot_of_largest,
        env_action=lambda action: jnp.argmax(action, axis=0).astype(jnp.int32),
    )


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


def annealed_temperature(hparams: TD3Hparams, num_updates: Array, num_steps: int) -> Array:
    """Temperature in the `num_updates`-th learning step and until the next one.

    It falls linearly from `hparams.temperature` to its `hparams.final_temperature`-fold in
    `num_steps` learning steps, and stays there.

    Source: `docs/reference.md` 4.4.
    """
    progress = jnp.minimum(num_updates / num_steps, 1.0)
    assert hparams.temperature is not None and hparams.final_temperature is not None
    factor = 1 + progress * (hparams.final_temperature - 1)
    return jnp.maximum(hparams.temperature * factor, _MIN_TEMPERATURE)


def _one_hot_of_largest(x: Float[Array, "actions *batch"]) -> Float[Array, "actions *batch"]:
    return jax.nn.one_hot(jnp.argmax(x, axis=0), x.shape[0], axis=0)
