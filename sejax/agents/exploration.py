"""Intrinsic rewards: an agent learns from rewards with a bonus for what is new to it.

Curiosity (ICM) pays for steps whose outcome the agent cannot yet predict. Count-based exploration
pays for actions from which a tabular agent has rarely learned.

Source: Pathak et al., "Curiosity-driven Exploration by Self-supervised Prediction" (2017); Burda
et al., "Large-Scale Study of Curiosity-Driven Learning" (2019), for the forward model's residual
blocks; Strehl and Littman, "An Analysis of Model-Based Interval Estimation for Markov Decision
Processes" (2008); paper, appendix, tables of ICM and of count-based Q-learning, and section
"Experiments with Reward Networks", paragraph "Baselines"; `docs/reference.md` 4.7 and 4.8.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct
from jaxtyping import Array, Float, Int, PyTree
from pydantic import Field

from sejax.agents.base import Agent, AgentState, ExplorationConfig, Hparams, traced
from sejax.agents.buffers import Rollout, Transition
from sejax.agents.tabular import mask_of
from sejax.envs.base import Task
from sejax.ops.networks import MLP, Dense
from sejax.ops.optimizers import ADAM, apply_gradient
from sejax.options import Count, Depth, Fraction, NonNegative, Positive, option, require


def _wrapped(agent: Agent, config: ExplorationConfig, **changes: Any) -> Agent:
    """An agent that does as the inner `agent`, but for these changes of `Agent`'s fields.

    Its state holds the inner agent's state as `agent_state`. Its hyperparameters are those of
    `config`, and hold the inner agent's as `agent`. So `init` and `update` must be among the
    changes: they make such a state, and give the bonus.
    """
    require(agent.varied is None, "agent", "must be varied last, by sejax.make_agent(varied=True).")

    def begin_episode(state: AgentState, episode: Array) -> AgentState:
        return state.replace(agent_state=agent.begin_episode(state.agent_state, episode))

    return replace(
        agent,
        begin_episode=begin_episode,
        act=lambda key, state, obs, explore: agent.act(key, state.agent_state, obs, explore),
        hparams=traced(config).replace(agent=agent.hparams),
        discount=lambda hparams: agent.discount(hparams.agent),
        batch_size=lambda state: agent.batch_size(state.agent_state),
        **changes,
    )


# --- curiosity -----------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ICMConfig(ExplorationConfig):
    """Intrinsic curiosity module (paper, appendix, tables of ICM).

    The defaults are the paper's values optimized for CartPole, as in the authors' scripts. The
    paper's text says that all experiments use its defaults: 1e-4, 0.2, 0.5 and 64 features.

    Attributes:
      forward_weight: beta: the forward model's share of the loss
      reward_scale: eta: intrinsic reward for each unit of prediction error
    """

    states: ClassVar[str | None] = "vector"

    learning_rate: Positive = option(1e-5, traced=True)
    forward_weight: Fraction = option(0.05, traced=True)
    reward_scale: NonNegative = option(0.03, traced=True)
    feature_dim: Count = 32
    hidden_size: Count = 128
    num_layers: Depth = 2
    num_residual_blocks: Annotated[int, Field(ge=0, le=100)] = 4

    def make(self, agent: Agent, task: Task) -> Agent:
        """The same agent, learning from rewards with an intrinsic bonus.

        Before each learning step on `Transition`s the module takes one step of Adam on the batch.
        The updated models give the bonus, which is added to the rewards that the agent sees. On a
        `Rollout` the bonus comes first, and then the module's one step. The buffer keeps rewards
        without the bonus; each learning step computes it anew.

        Discrete actions enter the models as one-hot vectors. An agent's own vectors for discrete
        actions, such as those of discrete TD3, enter as they are.

        Args:
          agent: one that learns from batches of `Transition`s, or from a `Rollout`.
          task: the agent's task; its observations are vectors.

        Differs: two discrete actions are treated as any other number of actions, with two logits
        and a softmax; the authors use the number 0 or 1 and one logit. An agent's own vectors for
        discrete actions are not one-hot, so that the inverse model learns them by squared error.

        Source: `docs/reference.md` 4.8.

        Example:
          >>> import sejax
          >>> task = sejax.envs.make("cartpole")
          >>> agent = ICMConfig().make(sejax.make_agent(sejax.DDQNConfig(), task), task)
          >>> state = agent.init(jax.random.key(0), agent.hparams)
          >>> int(agent.act(jax.random.key(1), state, jnp.zeros(4), explore=False)) in (0, 1)
          True
        """
        module = ICM(self, task.action_dim)
        curious = Curious(agent, module, task.obs_dim, is_discrete=task.num_actions is not None)
        # The module's networks keep a core busy, whatever agent is inside.
        spec = replace(agent.spec, cpu_num_parallel=1)
        return _wrapped(agent, self, init=curious.init, update=curious.update, spec=spec)


class CuriousState(struct.PyTreeNode):
    """One curious agent: the state of the agent inside, and the module's."""

    agent_state: AgentState
    params: PyTree
    opt_state: optax.OptState
    hparams: Hparams


class ICMOutputs(NamedTuple):
    """What the module makes of a batch of transitions, feature-major."""

    next_features: Float[Array, "feature batch"]
    predicted_next_features: Float[Array, "feature batch"]
    predicted_action: Float[Array, "action batch"]  # logits where actions are indices


class ForwardModel(nn.Module):
    """Predicts the next state's features from the state's features and the action.

    An MLP on both, residual blocks that see the action twice, and an MLP with one hidden layer.
    """

    config: ICMConfig

    @nn.compact
    def __call__(
        self, features: Float[Array, "feature *batch"], action: Float[Array, "action *batch"]
    ) -> Float[Array, "feature *batch"]:
        config = self.config

        def mlp(num_layers: int) -> MLP:
            return MLP(config.feature_dim, config.hidden_size, num_layers, "leaky_relu")

        x = mlp(config.num_layers)(jnp.concatenate([features, action]))
        for _ in range(config.num_residual_blocks):
            hidden = nn.leaky_relu(Dense(config.feature_dim)(jnp.concatenate([x, action])))
            x = x + Dense(config.feature_dim)(jnp.concatenate([hidden, action]))
        return mlp(1)(x)


class ICM(nn.Module):
    """The three models on feature-major batches.

    `action_width` is the length of an action vector, or the number of actions that are one-hot.
    """

    config: ICMConfig
    action_width: int

    @nn.compact
    def __call__(
        self,
        obs: Float[Array, "obs_dim *batch"],
        action: Float[Array, "action *batch"],
        next_obs: Float[Array, "obs_dim *batch"],
    ) -> ICMOutputs:
        config = self.config
        size = (config.hidden_size, config.num_layers)
        encode = MLP(config.feature_dim, *size, "leaky_relu", name="features")
        features, next_features = encode(obs), encode(next_obs)
        inverse = MLP(self.action_width, *size, "relu", name="inverse")
        forward = ForwardModel(config, name="forward")
        return ICMOutputs(
            next_features=next_features,
            predicted_next_features=forward(features, action),
            predicted_action=inverse(jnp.concatenate([features, next_features])),
        )


@dataclass(frozen=True, eq=False)
class Curious:
    """The pure functions of a curious agent.

    Attributes:
      agent: the one inside, which gets the bonus.
      model: the networks.
      obs_dim: length of an observation.
      is_discrete: whether the task's actions are indices.
    """

    agent: Agent
    model: ICM
    obs_dim: int
    is_discrete: bool

    def init(self, key: Array, hparams: Hparams) -> CuriousState:
        key_agent, key_icm = jax.random.split(key)
        obs, action = jnp.zeros(self.obs_dim), jnp.zeros(self.model.action_width)
        params = self.model.init(key_icm, obs, action, obs)
        return CuriousState(
            agent_state=self.agent.init(key_agent, hparams.agent),
            params=params,
            opt_state=ADAM.init(params),
            hparams=jax.tree.map(jnp.float32, hparams.replace(agent=None)),
        )

    def outputs(self, params: PyTree, batch: Transition) -> ICMOutputs:
        """What the module makes of a batch, with actions as vectors."""
        action = action_vectors(batch.action, self.model.action_width)
        return cast(ICMOutputs, self.model.apply(params, batch.obs, action, batch.next_obs))

    def train(self, state: CuriousState, batch: Transition) -> CuriousState:
        """One step of Adam for the module; the agent inside stays as it is."""
        hp = state.hparams

        def loss_fn(params: PyTree) -> Array:
            outputs = self.outputs(params, batch)
            return icm_loss(outputs, batch.action, hp.forward_weight, batch.weight)

        gradient = jax.grad(loss_fn)(state.params)
        params, opt_state = apply_gradient(
            state.params, state.opt_state, gradient, hp.learning_rate
        )
        return state.replace(params=params, opt_state=opt_state)

    def bonus(self, state: CuriousState, batch: Transition) -> Float[Array, " batch"]:
        """The intrinsic reward of each step: eta times the forward model's error there."""
        error = prediction_error(self.outputs(state.params, batch))
        return state.hparams.reward_scale * jax.lax.stop_gradient(error)

    def update(self, key: Array, state: CuriousState, batch: Transition | Rollout) -> CuriousState:
        """The module's step, and the inner agent's on the batch with the bonus in its rewards.

        On `Transition`s the module learns first, on a `Rollout` last; see `ICMConfig.make`.
        """
        if isinstance(batch, Rollout):
            steps = batch.transitions(self.obs_dim, self.is_discrete)
            batch = batch.with_bonus(self.bonus(state, steps))
            state = self.train(state, steps)
        else:
            state = self.train(state, batch)
            batch = batch._replace(reward=batch.reward + self.bonus(state, batch))
        return state.replace(agent_state=self.agent.update(key, state.agent_state, batch))


def icm_loss(
    outputs: ICMOutputs, action: Array, forward_weight: Array, weight: Array | float = 1.0
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

    Source: Pathak et al. (2017), eq. 2 to 7; `docs/reference.md` 4.8.
    """
    predicted = outputs.predicted_action
    if action.ndim == 1:  # indices
        chosen = action_vectors(action, predicted.shape[0])
        inverse = jax.nn.logsumexp(predicted, axis=0) - jnp.sum(chosen * predicted, axis=0)
    else:
        inverse = jnp.mean((predicted - action) ** 2, axis=0)
    losses = (1 - forward_weight) * inverse + forward_weight * prediction_error(outputs)
    return jnp.mean(weight * losses) / jnp.mean(weight)


def prediction_error(outputs: ICMOutputs) -> Float[Array, " batch"]:
    """Mean over the features of the forward model's squared error, for each column."""
    return jnp.mean((outputs.predicted_next_features - outputs.next_features) ** 2, axis=0)


def action_vectors(action: Array, width: int) -> Float[Array, "width batch"]:
    """Actions as the models take them: indices `[batch]` become one-hot, vectors stay."""
    return action if action.ndim > 1 else jax.nn.one_hot(jnp.int32(action), width, axis=0)


# --- counts --------------------------------------------------------------------------------------


class CountingState(struct.PyTreeNode):
    """One counting agent: the inner agent's state, and the learning steps on each pair."""

    agent_state: AgentState
    counts: Int[Array, "num_states num_actions"]
    reward_scale: Array


@dataclass(frozen=True, kw_only=True)
class CountBasedConfig(ExplorationConfig):
    r"""A bonus :math:`\beta / n(s, a)^p` for rarely taken actions.

    Attributes:
      reward_scale: beta
      count_power: p: 1 in the paper's text, 0.5 in the authors' code
    """

    states: ClassVar[str | None] = "discrete"

    reward_scale: NonNegative = option(0.1, traced=True)
    count_power: Positive = 1.0

    def make(self, agent: Agent, task: Task) -> Agent:
        r"""The same agent, learning from rewards with a bonus for rare pairs of state and action.

        .. math:: n(s, a) \leftarrow n(s, a) + 1, \quad r \leftarrow r + \beta / n(s, a)^p

        for the current step, before the inner agent's learning step.

        Args:
          agent: one that learns from single steps with indices as observations and actions, from
            `sejax.agents.tabular`.
          task: the agent's task.

        Example:
          >>> import sejax
          >>> task = sejax.envs.make("cliff_walking")
          >>> plain = sejax.make_agent(sejax.QLearningConfig(), task)
          >>> agent = CountBasedConfig().make(plain, task)
          >>> state = agent.init(jax.random.key(0), agent.hparams)
          >>> int(agent.act(jax.random.key(1), state, jnp.int32(36), explore=False))
          0
        """
        shape: Any = task.num_states, task.num_actions

        def init(key: Array, hparams: Hparams) -> CountingState:
            return CountingState(
                agent_state=agent.init(key, hparams.agent),
                counts=jnp.zeros(shape, jnp.int32),
                reward_scale=jnp.float32(hparams.reward_scale),
            )

        def update(key: Array, state: CountingState, transition: Transition) -> CountingState:
            obs, action = transition.obs, transition.action
            count = state.counts.at[obs, action].get(mode="promise_in_bounds") + 1
            is_visited = mask_of(obs, action, shape)
            bonus = state.reward_scale * count.astype(jnp.float32) ** -self.count_power
            transition = transition._replace(reward=transition.reward + bonus)
            return state.replace(
                agent_state=agent.update(key, state.agent_state, transition),
                counts=jnp.where(is_visited, count, state.counts),
            )

        return _wrapped(agent, self, init=init, update=update)
