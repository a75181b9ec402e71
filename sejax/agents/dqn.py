"""Double DQN with soft target updates and Adam, with a plain or a dueling network; DQN.

Source: van Hasselt et al., "Deep RL with Double Q-learning" (2016); Mnih et al., "Human-level
control through deep reinforcement learning" (2015); the paper's hyperparameter tables;
`docs/reference.md` 4.1 and 4.2.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct
from jaxtyping import Array, Float, Int, PyTree

from sejax.agents.base import Agent, AgentSpec, Number, TorsoOptions, traced
from sejax.agents.buffers import Transition
from sejax.agents.off_policy import OffPolicyOptions, adam_step, off_policy_agent, soft_update
from sejax.agents.policies import decayed_epsilon, epsilon_greedy, select_action
from sejax.envs.base import Task
from sejax.ops import cpu, flat
from sejax.ops.networks import DuelingMLP, init_narrowed
from sejax.options import MOST_LAYERS, counts, fraction, one_of, option

LOSSES = {"squared": jnp.square, "huber": optax.losses.huber_loss}


@dataclass(frozen=True, kw_only=True)
class DDQNConfig(OffPolicyOptions, TorsoOptions):
    """DDQN's hyperparameters.

    Attributes:
      epsilon_init: share of random actions
      epsilon_decay: factor for each episode
      exploration_steps: If given, epsilon falls linearly in so many steps from when the agent first
        learns, whatever the episodes: for environments whose episodes have one or two steps.
      double: the online network chooses a target's action; else the target network
      loss: of the error; huber: its gradient is clipped
      target_update_every: learning steps for each update of the target
      train_every: agent steps for each time that it learns, ...
      gradient_steps: ... in so many learning steps
    """

    epsilon_init: float = option(1.0, fraction(), traced=True)
    epsilon_min: float = option(0.01, fraction(), traced=True)
    epsilon_decay: float = option(0.9, fraction(), traced=True)
    exploration_steps: int | None = option(1000, counts("it counts steps"), traced=True)
    double: bool = True
    loss: str = option("squared", one_of(LOSSES))
    target_update_every: int = option(1, counts())
    train_every: int = option(1, counts())
    gradient_steps: int = option(1, counts())

    @property
    def learns_each_step(self) -> bool:
        return self.train_every == 1 and self.gradient_steps == 1

    @property
    def cpu_num_parallel(self) -> int:
        """The fastest `vmap` width on one CPU core."""
        product = self.hidden_size * self.batch_size
        is_small = self.torso is None and self.num_layers == 1 and product <= cpu.SMALL_PRODUCT
        return cpu.SMALL_NUM_PARALLEL if is_small else 1

    def spec(self) -> AgentSpec:
        return dataclasses.replace(super().spec(), cpu_num_parallel=self.cpu_num_parallel)

    def make(self, task: Task) -> Agent:
        """The agent for a task's observations and actions."""
        assert task.num_actions is not None
        return make_ddqn(self, task.obs_dim, task.num_actions, task.image)

    def network(self, num_actions: int) -> nn.Module:
        """Maps observations `[obs_dim, *batch]` to Q values `[num_actions, *batch]`."""
        return self.mlp(num_actions)


@dataclass(frozen=True, kw_only=True)
class DuelingDDQNConfig(DDQNConfig):
    """DDQN with a dueling network (paper, appendix, tables of DDQN and Dueling DDQN).

    Attributes:
      feature_dim: outputs of the part that both streams share
      stream_num_layers: Hidden layers of the value and of the advantage stream.
    """

    cpu_num_parallel = 1  # under vmap its two streams make a step 1.5 times as long

    feature_dim: int = option(64, counts())
    stream_num_layers: int = option(1, counts("it counts layers", 0, MOST_LAYERS))
    stream_hidden_size: int = option(32, counts())

    def network(self, num_actions: int) -> nn.Module:
        return DuelingMLP(
            num_actions,
            self.feature_dim,
            self.hidden_size,
            self.num_layers,
            self.stream_hidden_size,
            self.stream_num_layers,
            self.activation,
        )


@dataclass(frozen=True, kw_only=True)
class DQNConfig(DDQNConfig):
    """DQN: without double Q-learning."""

    double: bool = False
    epsilon_min: float = 0.05


class DDQNHparams(NamedTuple):
    """Traced hyperparameters; of sizes what is in use, None for all."""

    learning_rate: Number
    tau: Number
    discount: Number
    epsilon_init: Number
    epsilon_min: Number
    epsilon_decay: Number
    exploration_steps: Number | None
    hidden_size: Array | None = None
    batch_size: Array | None = None


class DDQNState(struct.PyTreeNode):
    """One agent."""

    params: Float[Array, " num_params"]
    target_params: Float[Array, " num_params"]
    opt_state: optax.OptState
    epsilon: Array
    num_steps: Int[Array, ""]  # agent steps since it first learned
    hparams: DDQNHparams


def make_ddqn(
    config: DDQNConfig, obs_dim: int, num_actions: int, image: tuple[int, ...] = ()
) -> Agent:
    """Builds the agent for observations `[obs_dim]` and actions `0..num_actions-1`.

    A `DuelingDDQNConfig` makes its network a dueling one. `image` are rows, columns and channels of
    observations that are images, for a config with a torso.

    Example:
      >>> agent = make_ddqn(DDQNConfig(), obs_dim=4, num_actions=2)
      >>> state = agent.init(jax.random.key(0), agent.hparams)
      >>> int(agent.act(jax.random.key(1), state, jnp.zeros(4), explore=False)) in (0, 1)
      True
    """
    network = config.with_torso(config.network(num_actions), image)
    unflatten = flat.unflattener(network.init, jnp.zeros(obs_dim))

    def init(key: Array, hparams: DDQNHparams) -> DDQNState:
        params = flat.flatten(init_narrowed(network, key, obs_dim, hparams.hidden_size))
        hparams = jax.tree.map(jnp.float32, hparams)
        return DDQNState(
            params=params,
            target_params=params,
            opt_state=flat.ADAM.init(params),
            epsilon=jnp.float32(hparams.epsilon_init),
            num_steps=jnp.int32(0),
            hparams=hparams,
        )

    def act(key: Array, state: DDQNState, obs: Float[Array, " obs_dim"], explore: bool) -> Array:
        q_values: Any = network.apply(unflatten(state.params), obs)
        if not explore:
            return jnp.argmax(q_values).astype(jnp.int32)
        return epsilon_greedy(key, q_values, state.epsilon)

    return off_policy_agent(
        config,
        batches=config.gradient_steps,
        hparams=traced(config, DDQNHparams),
        init=init,
        begin_episode=begin_episode,
        act=act,
        update=make_update(config, make_learning_step(config, network, unflatten)),
    )


def begin_episode(state: DDQNState, episode: Array) -> DDQNState:
    """The share of random actions in the episode, unless it falls with steps."""
    hp = state.hparams
    if hp.exploration_steps is not None:
        return state
    epsilon = decayed_epsilon(hp.epsilon_init, hp.epsilon_min, hp.epsilon_decay, episode)
    return state.replace(epsilon=epsilon)


def linear_epsilon(hparams: DDQNHparams, num_steps: Array) -> Array:
    """The share of random actions `num_steps` after the agent first learned, `[]`.

    It falls from `hparams.epsilon_init` to its `epsilon_min` in `exploration_steps` and stays.

    Source: Mnih et al. (2015), extended data table 1 (final exploration frame).
    """
    assert hparams.exploration_steps is not None
    progress = jnp.minimum(num_steps / hparams.exploration_steps, 1.0)
    return hparams.epsilon_init + progress * (hparams.epsilon_min - hparams.epsilon_init)


def make_update(
    config: DDQNConfig, learn: Callable[[DDQNState, Transition], DDQNState]
) -> Callable[[Array, DDQNState, Transition], DDQNState]:
    """Builds `update(key, state, batch) -> state`: when to learn, how often, and epsilon."""

    def learn_all(state: DDQNState, batch: Transition) -> DDQNState:
        if config.gradient_steps == 1:
            return learn(state, batch)
        batches = split_batch(batch, config.gradient_steps)
        return jax.lax.scan(lambda state, batch: (learn(state, batch), None), state, batches)[0]

    def update(key: Array, state: DDQNState, batch: Transition) -> DDQNState:
        state = state.replace(num_steps=state.num_steps + 1)
        if state.hparams.exploration_steps is not None:
            state = state.replace(epsilon=linear_epsilon(state.hparams, state.num_steps))
        if config.train_every == 1:
            return learn_all(state, batch)
        is_due = state.num_steps % config.train_every == 0
        return jax.lax.cond(is_due, learn_all, lambda state, _: state, state, batch)

    return update


def split_batch(batch: Transition, num_parts: int) -> Transition:
    """A batch as `num_parts` of them, leaves `[part, *feature, column]`.

    They take turns in columns, so that each has its share of those that count.
    """
    batch = batch._replace(weight=jnp.broadcast_to(batch.weight, batch.reward.shape))

    def split(x: Array) -> Array:
        missing = -x.shape[-1] % num_parts
        padded = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, missing)])
        return jnp.moveaxis(padded.reshape(*x.shape[:-1], -1, num_parts), -1, 0)

    return jax.tree.map(split, batch)


def make_learning_step(
    config: DDQNConfig, network: nn.Module, unflatten: Callable[[Array], PyTree]
) -> Callable[[DDQNState, Transition], DDQNState]:
    """Builds `learn(state, batch) -> state`: Adam on the loss of the error to double-Q targets.

    Source: van Hasselt et al. (2016), eq. 4; `docs/reference.md` 4.1.
    """
    loss_fn = LOSSES[config.loss]

    def learn(state: DDQNState, batch: Transition) -> DDQNState:
        hp = state.hparams

        tree, target_params = unflatten(state.params), unflatten(state.target_params)

        def sum_of_losses(params: PyTree, batch: Transition) -> Array:
            q_values: Any = network.apply(params, batch.obs)  # [actions, batch]
            target_next_q: Any = network.apply(target_params, batch.next_obs)
            next_q: Any = network.apply(params, batch.next_obs) if config.double else target_next_q
            discount = hp.discount * batch.discount
            targets = double_q_targets(next_q, target_next_q, batch.reward, discount)
            error = select_action(q_values, batch.action) - jax.lax.stop_gradient(targets)
            return jnp.sum(batch.weight * loss_fn(error))

        params, opt_state = adam_step(
            sum_of_losses, state.params, state.opt_state, (batch,), hp, tree
        )
        tau = hp.tau
        if config.target_update_every > 1:
            tau = jnp.where(opt_state.count % config.target_update_every == 0, tau, 0.0)
        return state.replace(
            params=params,
            target_params=soft_update(state.target_params, params, tau),
            opt_state=opt_state,
        )

    return learn


def double_q_targets(
    online_next_q: Float[Array, "actions batch"],
    target_next_q: Float[Array, "actions batch"],
    reward: Float[Array, " batch"],
    discount: Float[Array, " batch"],
) -> Float[Array, " batch"]:
    r"""Targets :math:`r + \gamma\, Q'(s', \arg\max_a Q(s', a))`.

    Args:
      online_next_q: Q of the online network at the next states, by which actions are chosen. With
        Q' in its place the targets are DQN's.
      target_next_q: Q' of the target network at the next states.
      reward: in the task's units.
      discount: gamma times the transition's own discount.

    Source: van Hasselt et al. (2016), eq. 4.
    """
    best = jnp.argmax(online_next_q, axis=0)
    return reward + discount * select_action(target_next_q, best)
