"""Intrinsic curiosity: a bonus for steps whose outcome the agent cannot yet predict.

Source: Pathak et al., "Curiosity-driven Exploration by Self-supervised Prediction" (2017); paper,
appendix, tables of ICM; `reference_details.md` 4.8. The forward model's residual blocks are those
of Burda et al., "Large-Scale Study of Curiosity-Driven Learning" (2019).
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from sejax.agents.agent import Agent
from sejax.agents.configs import ICMConfig
from sejax.agents.memory import Rollout
from sejax.agents.replay import Transition, unpack
from sejax.networks import MLP, Dense

_REWARD = -3  # column of a rollout's rows; the discount and `ended` follow


class ICMHparams(NamedTuple):
    """The module's traced hyperparameters."""

    learning_rate: Array | float
    forward_weight: Array | float  # beta
    reward_scale: Array | float  # eta


class CuriousHparams(NamedTuple):
    """Traced hyperparameters of a curious agent: those of the agent inside, and the module's."""

    agent: Any
    icm: ICMHparams


class CuriousState(struct.PyTreeNode):
    """One curious agent: the state of the agent inside, and the module's."""

    agent_state: Any
    params: Float[Array, " num_params"]
    opt_state: optax.OptState
    hparams: ICMHparams


class ICMOutputs(NamedTuple):
    """What the module makes of a batch of transitions, feature-major."""

    next_features: Float[Array, "feature batch"]
    predicted_next_features: Float[Array, "feature batch"]
    predicted_action: Float[Array, "action batch"]  # logits where actions are indices


class ForwardModel(nn.Module):
    """Predicts the next state's features from the state's features and the action.

    An MLP on both, residual blocks that see the action twice, and an MLP with one hidden layer.
    """

    feature_dim: int
    hidden_size: int
    num_layers: int
    num_residual_blocks: int

    @nn.compact
    def __call__(
        self, features: Float[Array, "feature *batch"], action: Float[Array, "action *batch"]
    ) -> Float[Array, "feature *batch"]:
        def with_action(x: Array) -> Array:
            return jnp.concatenate([x, action])

        def mlp(num_layers: int) -> MLP:
            return MLP(self.feature_dim, self.hidden_size, num_layers, "leaky_relu")

        x = mlp(self.num_layers)(with_action(features))
        for _ in range(self.num_residual_blocks):
            hidden = nn.leaky_relu(Dense(self.feature_dim)(with_action(x)))
            x = x + Dense(self.feature_dim)(with_action(hidden))
        return mlp(1)(x)


class ICM(nn.Module):
    """The three models on feature-major batches.

    `action_width` is the length of an action vector, or the number of actions that are one-hot.
    """

    action_width: int
    feature_dim: int
    hidden_size: int
    num_layers: int
    num_residual_blocks: int

    @nn.compact
    def __call__(
        self,
        obs: Float[Array, "obs_dim *batch"],
        action: Float[Array, "action *batch"],
        next_obs: Float[Array, "obs_dim *batch"],
    ) -> ICMOutputs:
        size = (self.hidden_size, self.num_layers)
        encode = MLP(self.feature_dim, *size, "leaky_relu", name="features")
        features, next_features = encode(obs), encode(next_obs)
        inverse = MLP(self.action_width, *size, "relu", name="inverse")
        forward = ForwardModel(self.feature_dim, *size, self.num_residual_blocks, name="forward")
        return ICMOutputs(
            next_features=next_features,
            predicted_next_features=forward(features, action),
            predicted_action=inverse(jnp.concatenate([features, next_features])),
        )


@functools.cache
def with_icm(
    agent: Agent, config: ICMConfig, obs_dim: int, num_actions: int | None, action_dim: int | None
) -> Agent:
    """The same agent, learning from rewards with an intrinsic bonus.

    Before each learning step on `Transition`s the module takes one step of Adam on the batch; then
    its bonus for that batch, by the models as updated, is added to the rewards that the agent sees.
    On a `Rollout`, where it is full, the bonus comes first and the module's one step after it; the
    agent inside must leave its state as it is at all other times. What is remembered stays without
    a bonus, so that it is made anew whenever a step is learned from.

    Args:
      agent: one that learns from batches of `Transition`s, or from a `Rollout`.
      config: the module's sizes and numbers.
      obs_dim: length of an observation.
      num_actions: number of discrete actions, or None if they are continuous. Actions that are
        indices enter the models as one-hot vectors; an agent's own vectors of that length, as those
        of discrete TD3, enter as they are.
      action_dim: length of a continuous action; not used where there is `num_actions`.

    Differs: two discrete actions are treated as any other number of them, with two logits and a
    softmax, where the authors' have the number 0 or 1 and one logit. Vectors of discrete actions
    are not one-hot, so that the inverse model learns them by their squared error.

    Source: `reference_details.md` 4.8.

    Example:
      >>> from sejax.agents.configs import DDQNConfig
      >>> from sejax.agents.ddqn import make_ddqn
      >>> plain = make_ddqn(DDQNConfig(), obs_dim=4, num_actions=2)
      >>> agent = with_icm(plain, ICMConfig(), obs_dim=4, num_actions=2, action_dim=None)
      >>> state = agent.init(jax.random.key(0), agent.hparams)
      >>> int(agent.act(jax.random.key(1), state, jnp.zeros(4), explore=False)) in (0, 1)
      True
    """
    action_width = num_actions or action_dim
    assert action_width is not None, "an action has a number of choices or a length"
    model = ICM(
        action_width, config.feature_dim, config.hidden_size, config.num_layers,
        config.num_residual_blocks,
    )  # fmt: skip
    example = (jnp.zeros(obs_dim), jnp.zeros(action_width), jnp.zeros(obs_dim))
    template = jax.eval_shape(model.init, jax.random.key(0), *example)
    _, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape), template))
    adam = optax.scale_by_adam()

    def init(key: Array, hparams: CuriousHparams) -> CuriousState:
        key_agent, key_icm = jax.random.split(key)
        params, _ = ravel_pytree(model.init(key_icm, *example))
        return CuriousState(
            agent_state=agent.init(key_agent, hparams.agent),
            params=params,
            opt_state=adam.init(params),
            hparams=jax.tree.map(jnp.float32, hparams.icm),
        )

    def begin_episode(state: CuriousState, episode: Array) -> CuriousState:
        return state.replace(agent_state=agent.begin_episode(state.agent_state, episode))

    def act(key: Array, state: CuriousState, obs: Array, explore: bool) -> Array:
        return agent.act(key, state.agent_state, obs, explore)

    def outputs(params: Any, batch: Transition) -> ICMOutputs:
        action = as_vectors(batch.action, action_width)
        made: Any = model.apply(params, batch.obs, action, batch.next_obs)
        return made

    def train_models(state: CuriousState, batch: Transition) -> CuriousState:
        def loss_fn(params: Any) -> Array:
            beta = state.hparams.forward_weight
            return icm_loss(outputs(params, batch), batch.action, beta, batch.weight)

        gradient, _ = ravel_pytree(jax.grad(loss_fn)(unravel(state.params)))
        direction: Any
        direction, opt_state = adam.update(gradient, state.opt_state)
        params = state.params - state.hparams.learning_rate * direction
        return state.replace(params=params, opt_state=opt_state)

    def bonus(state: CuriousState, batch: Transition) -> Float[Array, " batch"]:
        error = prediction_error(outputs(unravel(state.params), batch))
        return state.hparams.reward_scale * jax.lax.stop_gradient(error)

    def update(key: Array, state: CuriousState, batch: Transition | Rollout) -> CuriousState:
        if isinstance(batch, Rollout):
            return update_from_rollout(key, state, batch)
        state = train_models(state, batch)
        batch = batch._replace(reward=batch.reward + bonus(state, batch))
        return state.replace(agent_state=agent.update(key, state.agent_state, batch))

    def update_from_rollout(key: Array, state: CuriousState, rollout: Rollout) -> CuriousState:
        """A loop of one or no turns is skipped under `vmap` too, where a `cond` takes both sides.

        The agent's update is inside, as its rows with the bonus would otherwise be made each step.
        """

        def learn(carry: tuple[Array, CuriousState]) -> tuple[Array, CuriousState]:
            _, state = carry
            batch = _transitions(rollout, obs_dim, num_actions)
            rows = rollout.rows.at[:, _REWARD].add(bonus(state, batch))
            state = train_models(state, batch)
            augmented = rollout._replace(rows=rows)
            state = state.replace(agent_state=agent.update(key, state.agent_state, augmented))
            return jnp.bool_(False), state

        _, state = jax.lax.while_loop(lambda carry: carry[0], learn, (rollout.is_full, state))
        return state

    hparams = ICMHparams(**{name: getattr(config, name) for name in ICMHparams._fields})
    return dataclasses.replace(
        agent,
        init=init,
        begin_episode=begin_episode,
        act=act,
        update=update,
        hparams=CuriousHparams(agent=agent.hparams, icm=hparams),
        discount=lambda hparams: agent.discount(hparams.agent),
        batch_size=lambda state: agent.batch_size(state.agent_state),
    )


def icm_loss(
    outputs: ICMOutputs,
    action: Array,
    forward_weight: Array | float,
    weight: Array | float = 1.0,
) -> Array:
    r"""What the three models minimise together.

    .. math:: (1 - \beta) L_I + \beta \, \overline{(\hat\phi(s') - \phi(s'))^2}

    with the inverse model's loss :math:`L_I`: softmax cross-entropy where actions are indices, the
    mean squared error where they are vectors. The gradient reaches the features through the target
    of the forward model too, as in the authors' code.

    Args:
      outputs: of the models.
      action: `[batch]` int32 indices or `[action, batch]` vectors.
      forward_weight: beta in [0, 1].
      weight: `[batch]`; 0 in columns that do not count.

    Returns:
      `[]`, the mean over the columns that count.

    Source: Pathak et al. (2017), eq. 2 to 7; `reference_details.md` 4.8.
    """
    predicted = outputs.predicted_action
    if _is_index(action):
        chosen = as_vectors(action, predicted.shape[0])
        inverse = jax.nn.logsumexp(predicted, axis=0) - jnp.sum(chosen * predicted, axis=0)
    else:
        inverse = jnp.mean((predicted - action) ** 2, axis=0)
    losses = (1 - forward_weight) * inverse + forward_weight * prediction_error(outputs)
    return jnp.mean(weight * losses) / jnp.mean(weight)


def prediction_error(outputs: ICMOutputs) -> Float[Array, " batch"]:
    """Mean over the features of the forward model's squared error, for each column."""
    error = outputs.predicted_next_features - outputs.next_features
    return jnp.mean(error**2, axis=0)


def as_vectors(action: Array, width: int) -> Float[Array, "width batch"]:
    """Actions as the models take them: indices `[batch]` become one-hot, vectors stay."""
    if not _is_index(action):
        return action
    return (jnp.arange(width)[:, None] == action[None, :]).astype(jnp.float32)


def _is_index(action: Array) -> bool:
    """Whether a feature-major batch of actions holds indices."""
    return action.ndim == 1


def _transitions(rollout: Rollout, obs_dim: int, num_actions: int | None) -> Transition:
    """The steps of a rollout, feature-major. Discrete actions in one column are indices."""
    steps = rollout.rows[:, :-1].T  # without `ended`
    action_dim = steps.shape[0] - 2 * obs_dim - 2
    is_index = num_actions is not None and action_dim == 1
    return unpack(steps, None if is_index else action_dim)
