"""PPO with a clipped ratio, for discrete and for continuous actions.

With Monte-Carlo returns and all of the rollout in each Adam step, as the paper's code has it, or
with generalised advantages and shuffled minibatches, as everybody else does.

Source: Schulman et al., "Proximal Policy Optimization Algorithms" (2017); Schulman et al.,
"High-Dimensional Continuous Control Using Generalized Advantage Estimation" (2016); the paper's
appendix, table of PPO; `docs/reference.md` 4.5.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int

from sejax.agents import flat
from sejax.agents.agent import Agent, AgentOptions, traced
from sejax.agents.ddqn import select_action
from sejax.agents.memory import Rollout, rollout_memory
from sejax.agents.replay import Transition
from sejax.errors import require
from sejax.networks import ACTIVATIONS, MLP, narrow
from sejax.options import MOST_LAYERS, counts, fraction, not_negative, one_of, option, positive

ADVANTAGES = ("monte_carlo", "gae")
MIN_STD = 0.01  # of the Gaussian policy, in units of the action
_MAX_LOG_RATIO = 20.0  # exp(20) is beyond any clip, and finite


@dataclass(frozen=True, kw_only=True)
class PPOConfig(AgentOptions):
    """PPO (clip) for discrete and continuous actions (paper, appendix, table of PPO).

    The defaults are the paper's for MountainCarContinuous, whose RNs add `action_repeat=5`.
    Whoever has few steps takes settings like those below (measured: `docs/agents.md`).

    Example:
      >>> quick = PPOConfig(
      ...     advantages="gae", rollout_steps=128, num_minibatches=4, epochs=10,
      ...     learning_rate=2e-3, max_grad_norm=0.5, adam_eps=1e-5, activation="tanh",
      ... )
    """

    actions: ClassVar[tuple[str, ...]] = ("discrete", "continuous")

    # PPO learns from the start; this only holds back the stop rule.
    init_episodes: int = option(1, counts("it counts episodes", least=0))
    hidden_size: int = option(64, counts(), varied="triple")
    num_layers: int = option(2, counts(most=MOST_LAYERS), varied="one_more_or_less")
    activation: str = option("relu", one_of(ACTIVATIONS))
    learning_rate: float = option(
        3e-4, positive("the agent would not move"), traced=True, varied="triple"
    )
    discount: float = option(0.99, fraction(), traced=True)
    update_episodes: int = option(10, counts())  # of full length, between two learning phases
    # Decisions between two learning phases; null: as `update_episodes` says.
    rollout_steps: int | None = option(None, counts())
    epochs: int = option(80, counts())  # passes over the rollout in a learning phase
    num_minibatches: int = option(1, counts())  # Adam steps in an epoch, each on its part of it
    advantages: str = option("monte_carlo", one_of(ADVANTAGES))
    gae_lambda: float = option(0.95, fraction(), traced=True)  # of advantages=gae
    clip_ratio: float = option(0.2, positive("the agent would not move"), traced=True)
    value_weight: float = option(1.0, not_negative(), traced=True)
    entropy_weight: float = option(0.01, not_negative(), traced=True)
    # Longest gradient, which a longer one is shortened to.
    max_grad_norm: float | None = option(None, positive("the agent would not move"))
    adam_eps: float = option(1e-8, positive("it keeps Adam from dividing by 0"))
    # Of the Gaussian policy; learned.
    init_action_std: float = option(0.5, positive("the agent would not move"))
    action_repeat: int = option(1, counts())

    def make(self, task: Any) -> Agent:
        """The agent for a task's observations and actions."""
        action_dim = task.action_dim if task.num_actions is None else None
        return make_ppo(self, task.obs_dim, task.num_actions, action_dim, task.max_action,
                        task.max_steps)  # fmt: skip

    def rollout_length(self, max_episode_steps: int) -> int:
        """Decisions between two learning phases: `rollout_steps`, if that is set.

        The authors learn as soon as (decisions x `action_repeat`) / `max_episode_steps` exceeds
        `update_episodes`, also in the middle of an episode; this is the first whole number that
        does.

        Source: `docs/reference.md` 4.5.
        """
        if self.rollout_steps is not None:
            return self.rollout_steps
        return self.update_episodes * max_episode_steps // self.action_repeat + 1

    def steps_before_learning(self, max_episode_steps: int) -> int:
        """As of any agent; PPO learns once a rollout is full."""
        return self.rollout_length(max_episode_steps) * self.action_repeat

    def optimizer(self) -> optax.GradientTransformation:
        """Adam's direction, of a gradient that may be shortened first."""
        adam = optax.scale_by_adam(eps=self.adam_eps)
        if self.max_grad_norm is None:
            return adam
        return optax.chain(optax.clip_by_global_norm(self.max_grad_norm), adam)


class PPOState(struct.PyTreeNode):
    """One agent. `params` are the actor's, the critic's and the std, as one flat vector."""

    params: Float[Array, " num_params"]
    opt_state: optax.OptState
    hparams: Any  # traced options, and hidden_size in use or None


class Distribution(NamedTuple):
    """A distribution of actions, given the actor's outputs and the Gaussian's std.

    Attributes:
      sample: `(key, outputs, std) -> action`, for one observation.
      mode: `outputs -> action`, for one observation.
      evaluate: `(outputs, std, action) -> (log_prob, entropy)`, for `[outputs, batch]` and a batch
        of actions; both `[batch]`, in nats.
      env_action: `action -> action` as the world takes it.
    """

    sample: Callable[[Array, Array, Array], Array]
    mode: Callable[[Array], Array]
    evaluate: Callable[[Array, Array, Array], tuple[Array, Array]]
    env_action: Callable[[Array], Array]


@functools.cache
def make_ppo(
    config: PPOConfig,
    obs_dim: int,
    num_actions: int | None,
    action_dim: int | None,
    max_action: float,
    max_steps: int,
) -> Agent:
    """Builds the agent for observations `[obs_dim]`.

    `update` learns once the rollout is full and costs next to nothing before, in lanes too.

    Without exploration the agent takes its most probable action. Differs: the authors also test
    with sampled actions (`docs/reference.md` 3.7), and they do not clip actions, so that
    MountainCarContinuous charges for what was drawn. The policy delay in the paper's table for PPO
    has no counterpart in their code, nor here.

    Args:
      config: hyperparameters.
      obs_dim: length of an observation.
      num_actions: for actions `0..num_actions-1`; None if they are vectors.
      action_dim: length of an action; None if it is an index.
      max_action: continuous actions reach the world clipped to [-max_action, max_action], and are
        remembered as drawn.
      max_steps: the task's step limit for an episode, in steps of the world.

    Raises:
      ValueError: unless exactly one of `num_actions` and `action_dim` is given.
      ConfigError: if a rollout has fewer than two steps for each minibatch.

    Example:
      >>> agent = make_ppo(PPOConfig(), 4, num_actions=2, action_dim=None, max_action=1.0,
      ...                  max_steps=200)
      >>> state = agent.init(jax.random.key(0), agent.hparams)
      >>> int(agent.act(jax.random.key(1), state, jnp.zeros(4), explore=True)) in (0, 1)
      True
    """
    if (num_actions is None) == (action_dim is None):
        raise ValueError(
            "make_ppo needs either num_actions (discrete) or action_dim (continuous); got "
            f"num_actions={num_actions} and action_dim={action_dim}. Set the other one to None."
        )
    policy = SOFTMAX if action_dim is None else gaussian(max_action)
    networks = make_networks(config, obs_dim, policy, num_actions, action_dim)
    length = config.rollout_length(max_steps)
    require(
        config.num_minibatches == 1 or 2 * config.num_minibatches <= length,
        "agent.num_minibatches", f"be at most half of the rollout's {length} steps",
        "advantages are compared within a minibatch", config.num_minibatches,
        f"agent.num_minibatches={max(1, length // 2)}",
    )  # fmt: skip
    optimizer = config.optimizer()
    learn = make_learning_phase(config, networks, optimizer, obs_dim, action_dim is None)

    def init(key: Array, hparams: Any) -> PPOState:
        params = networks.init(key, hparams.hidden_size)
        return PPOState(
            params=params,
            opt_state=optimizer.init(params),
            hparams=jax.tree.map(jnp.float32, hparams),
        )

    def act(key: Array, state: PPOState, obs: Float[Array, " obs_dim"], explore: bool) -> Array:
        outputs, std = networks.actor(networks.unflatten(state.params), obs)
        return policy.sample(key, outputs, std) if explore else policy.mode(outputs)

    def update(key: Array, state: PPOState, rollout: Rollout) -> PPOState:
        """Learns if the rollout is full.

        A loop of one trip or none: in lanes `lax.cond` would learn in every step and throw it away,
        whereas this loop runs only when some lane's rollout is full.
        """

        def phase(carry: tuple[Array, Array, Any]) -> tuple[Array, Array, Any]:
            _, params, opt_state = carry
            # XLA would move what does not depend on the carry out of the loop, into every step.
            inputs = jax.lax.optimization_barrier((key, params, rollout.rows))
            return jnp.bool_(False), *learn(*inputs, opt_state, state.hparams)

        _, params, opt_state = jax.lax.while_loop(
            lambda carry: carry[0], phase, (rollout.is_full, state.params, state.opt_state)
        )
        return state.replace(params=params, opt_state=opt_state)

    return Agent(
        init=init,
        act=act,
        update=update,
        memory=rollout_memory(length),
        hparams=traced(config, hidden_size=None),
        init_episodes=config.init_episodes,
        learns_from=0,
        env_action=policy.env_action,
        action_repeat=config.action_repeat,
    )


class Networks(NamedTuple):
    """The actor, the critic and the std as functions of one tree of parameters.

    Attributes:
      init: `(key, hidden_size) -> params`, flat; `hidden_size` is the number of units in use, or
        None for all.
      unflatten: of flat parameters to the tree.
      actor: `(tree, obs) -> (outputs, std)`.
      critic: `(tree, obs) -> value`, `[steps]`.
      evaluate: `(tree, obs, action) -> (log_prob, entropy, value)`, `[steps]` each.
      least_params: lower bounds of flat parameters: only the std has one.
    """

    init: Callable[[Array, Array | None], Array]
    unflatten: Callable[[Array], Any]
    actor: Callable[[Any, Array], tuple[Array, Array]]
    critic: Callable[[Any, Array], Array]
    evaluate: Callable[[Any, Array, Array], tuple[Array, Array, Array]]
    least_params: Float[Array, " num_params"]


def make_networks(
    config: PPOConfig,
    obs_dim: int,
    policy: Distribution,
    num_actions: int | None,
    action_dim: int | None,
) -> Networks:
    """An actor `s -> outputs` and a critic `s -> V` of the same hidden layers, and the std."""
    std_dim = action_dim or 0  # a softmax has no std
    shape = (config.hidden_size, config.num_layers, config.activation)
    mlps = {
        "actor": MLP(num_actions or std_dim, *shape, learn_prelu_slope=True),
        "critic": MLP(1, *shape, learn_prelu_slope=True),
    }

    def init_tree(key: Array) -> dict[str, Any]:
        keys = dict(zip(mlps, jax.random.split(key), strict=True))
        weights = {name: mlp.init(keys[name], jnp.zeros(obs_dim)) for name, mlp in mlps.items()}
        return {**weights, "std": jnp.full(std_dim, config.init_action_std, jnp.float32)}

    def init(key: Array, hidden_size: Array | None) -> Array:
        tree = init_tree(key)
        if hidden_size is not None:
            for name in mlps:
                tree[name] = {"params": narrow(tree[name]["params"], hidden_size)}
        return flat.flatten(tree)

    def actor(tree: Any, obs: Array) -> tuple[Array, Array]:
        outputs: Any = mlps["actor"].apply(tree["actor"], obs)
        return outputs, tree["std"]

    def critic(tree: Any, obs: Array) -> Array:
        value: Any = mlps["critic"].apply(tree["critic"], obs)
        return value[0]

    def evaluate(tree: Any, obs: Array, action: Array) -> tuple[Array, Array, Array]:
        log_prob, entropy = policy.evaluate(*actor(tree, obs), action)
        return log_prob, entropy, critic(tree, obs)

    template = jax.eval_shape(init_tree, jax.random.key(0))
    unbounded = jax.tree.map(lambda x: jnp.full(x.shape, -jnp.inf), template)
    return Networks(
        init=init,
        unflatten=flat.unflattener(init_tree),
        actor=actor,
        critic=critic,
        evaluate=evaluate,
        least_params=flat.flatten({**unbounded, "std": jnp.full(std_dim, MIN_STD)}),
    )


class Batch(NamedTuple):
    """What a learning phase learns from, steps last: a rollout or a minibatch of it.

    Attributes:
      old_log_prob: of the actions when the rollout was made, in nats.
      advantage: of the actions; None where it is to be `returns` less the critic's present value.
      returns: what the critic is to predict.
    """

    obs: Float[Array, "obs_dim steps"]
    action: Array
    old_log_prob: Float[Array, " steps"]
    advantage: Float[Array, " steps"] | None
    returns: Float[Array, " steps"]


def make_learning_phase(
    config: PPOConfig,
    networks: Networks,
    optimizer: optax.GradientTransformation,
    obs_dim: int,
    is_discrete: bool,
) -> Callable[[Array, Array, Array, Any, Any], tuple[Array, Any]]:
    """Builds `learn(key, params, rows, opt_state, hparams) -> (params, opt_state)`.

    A learning phase on a rollout's `rows`: `config.epochs` passes over it, each of
    `config.num_minibatches` Adam steps. A rollout that these do not divide leaves some steps out of
    each pass.
    """
    unflatten = networks.unflatten

    def prepared(tree: Any, rollout: Rollout, hp: Any) -> Batch:
        steps = rollout.transitions(obs_dim, is_discrete)
        # These parameters have made the whole rollout.
        old_log_prob, _, value = networks.evaluate(tree, steps.obs, steps.action)
        advantage = None
        if config.advantages == "gae":
            next_value = networks.critic(tree, steps.next_obs)
            advantage = generalized_advantages(
                steps, rollout.ended, value, next_value, hp.discount, hp.gae_lambda
            )
            returns = advantage + value
        else:
            returns = normalized(discounted_returns(steps.reward, rollout.ended, hp.discount))
        return Batch(steps.obs, steps.action, old_log_prob, advantage, returns)

    def loss_fn(tree: Any, batch: Batch, hp: Any) -> Array:
        log_prob, entropy, value = networks.evaluate(tree, batch.obs, batch.action)
        if batch.advantage is None:
            advantage = jax.lax.stop_gradient(batch.returns - value)
        else:
            advantage = normalized(batch.advantage)
        return ppo_loss(log_prob, entropy, value, batch.old_log_prob, advantage, batch.returns, hp)

    def learn(key: Array, params: Array, rows: Array, opt_state: Any, hp: Any) -> tuple[Array, Any]:
        batch = prepared(unflatten(params), Rollout(rows, jnp.bool_(True)), hp)
        order = shuffled(key, config.epochs, config.num_minibatches, rows.shape[0])

        def adam_step(number: Array, carry: tuple[Array, Any]) -> tuple[Array, Any]:
            params, opt_state = carry
            minibatch = batch
            if config.num_minibatches > 1:
                minibatch = jax.tree.map(lambda x: x[..., order[number]], batch)
            gradient = flat.flatten(jax.grad(loss_fn)(unflatten(params), minibatch, hp))
            direction: Any
            direction, opt_state = optimizer.update(gradient, opt_state)
            moved = params - hp.learning_rate * direction
            return jnp.maximum(moved, networks.least_params), opt_state

        num_updates = config.epochs * config.num_minibatches
        return jax.lax.fori_loop(0, num_updates, adam_step, (params, opt_state))

    return learn


def shuffled(
    key: Array, epochs: int, num_minibatches: int, num_steps: int
) -> Int[Array, "updates size"]:
    """Which steps each minibatch has: in each epoch all of them, in random order.

    Each epoch's steps are sorted by random bits, whose last ones are the step's number: a sort of
    single numbers takes a fifth of the time of `jax.random.permutation`. The bits are MurmurHash3's
    finaliser of counters that start at random, since XLA would move what threefry does with
    counters that start at 0 out of the learning phase, into every step.
    """
    size = num_steps // num_minibatches
    x = jax.random.bits(key) + jnp.arange(epochs * num_steps, dtype=jnp.uint32)
    x = (x ^ (x >> 16)) * jnp.uint32(0x85EBCA6B)
    x = (x ^ (x >> 13)) * jnp.uint32(0xC2B2AE35)
    bits = (x ^ (x >> 16)).reshape(epochs, num_steps)
    mask = jnp.uint32((1 << (num_steps - 1).bit_length()) - 1)
    order = jax.lax.sort(bits & ~mask | jnp.arange(num_steps, dtype=jnp.uint32)) & mask
    return order[:, : num_minibatches * size].reshape(-1, size).astype(jnp.int32)


def generalized_advantages(
    steps: Transition,
    ended: Float[Array, " steps"],
    value: Float[Array, " steps"],
    next_value: Float[Array, " steps"],
    discount: Array | float,
    gae_lambda: Array | float,
) -> Float[Array, " steps"]:
    r"""Advantages :math:`A_t = \delta_t + \gamma d_t \lambda A_{t+1}` within each episode.

    .. math:: \delta_t = r_t + \gamma d_t V(s'_t) - V(s_t)

    where :math:`d_t` is the transition's own discount: 0 where the episode terminated; at a time
    limit, and where the rollout is cut, the critic's value of the next state stands for what would
    have come.

    Args:
      steps: `reward` and `discount` of each step.
      ended: 1 at the last step of an episode, terminated or truncated, else 0.
      value: V(s), in units of the reward.
      next_value: V(s'), likewise.
      discount: gamma.
      gae_lambda: lambda; 0 has the least variance, 1 the least bias.

    Source: Schulman et al. (2016), eq. 11 to 16.
    """
    decay = discount * steps.discount
    delta = steps.reward + decay * next_value - value
    return discounted_sums(delta, gae_lambda * decay, ended)


def discounted_returns(
    reward: Float[Array, " steps"], ended: Float[Array, " steps"], discount: Array | float
) -> Float[Array, " steps"]:
    r"""Monte-Carlo returns :math:`R_t = r_t + \gamma R_{t+1}` within each episode.

    Nothing is bootstrapped: an episode counts as over where it was cut, and where the rollout is.

    Args:
      reward: in the task's units.
      ended: 1 at the last step of an episode, else 0.
      discount: gamma.

    Source: `docs/reference.md` 4.5. Differs: the authors restart where the stored `done` exceeds
    0.5, which in an SE is not so at a time limit; returns there run on into the next episode.
    """

    return discounted_sums(reward, jnp.broadcast_to(discount, reward.shape), ended)


def discounted_sums(
    x: Float[Array, " steps"], decay: Float[Array, " steps"], ended: Float[Array, " steps"]
) -> Float[Array, " steps"]:
    """Sums :math:`y_t = x_t + decay_t y_{t+1}` within each episode."""

    def step(later: Array, terms: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        x, decay, ended = terms
        now = x + decay * jnp.where(ended > 0.5, 0.0, later)
        return now, now

    return jax.lax.scan(step, jnp.float32(0), (x, decay, ended), reverse=True)[1]


def normalized(x: Float[Array, " steps"]) -> Float[Array, " steps"]:
    """Numbers with mean 0 and std 1, the std being the unbiased estimate plus 1e-5."""
    std = jnp.std(x, ddof=min(1, x.shape[0] - 1))
    return (x - jnp.mean(x)) / (std + 1e-5)


def ppo_loss(
    log_prob: Float[Array, " steps"],
    entropy: Float[Array, " steps"],
    value: Float[Array, " steps"],
    old_log_prob: Float[Array, " steps"],
    advantage: Float[Array, " steps"],
    returns: Float[Array, " steps"],
    hp: Any,
) -> Float[Array, ""]:
    r"""What a learning phase minimises.

    .. math:: -\overline{\min(\rho A, \mathrm{clip}(\rho, 1-\epsilon, 1+\epsilon) A)}
       + c_V \overline{(V - R)^2} - c_H \overline{H}

    with the ratio :math:`\rho` of the new to the old probability.

    Args:
      log_prob: of the actions, in nats.
      entropy: of the policy, in nats.
      value: V of the critic, in units of `returns`.
      old_log_prob: of the actions when the rollout was made.
      advantage: A of the actions, about 1 in size; passes no gradient.
      returns: R, what the critic is to predict.
      hp: clip_ratio (epsilon), value_weight (c_V) and entropy_weight (c_H).

    Source: Schulman et al. (2017), eq. 7 and 9; `docs/reference.md` 4.5.
    """
    ratio = jnp.exp(jnp.clip(log_prob - old_log_prob, -_MAX_LOG_RATIO, _MAX_LOG_RATIO))
    clipped = jnp.clip(ratio, 1 - hp.clip_ratio, 1 + hp.clip_ratio)
    surrogate = jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
    value_error = jnp.mean((value - returns) ** 2)
    return -surrogate + hp.value_weight * value_error - hp.entropy_weight * jnp.mean(entropy)


def _sample_softmax(key: Array, outputs: Float[Array, " actions"], std: Array) -> Int[Array, ""]:
    return jax.random.categorical(key, outputs).astype(jnp.int32)


def _softmax_mode(outputs: Float[Array, " actions"]) -> Int[Array, ""]:
    return jnp.argmax(outputs).astype(jnp.int32)


def _evaluate_softmax(
    outputs: Float[Array, "actions batch"], std: Array, action: Int[Array, " batch"]
) -> tuple[Float[Array, " batch"], Float[Array, " batch"]]:
    log_probs = jax.nn.log_softmax(outputs, axis=0)
    entropy = -jnp.sum(jnp.exp(log_probs) * log_probs, axis=0)
    return select_action(log_probs, action), entropy


SOFTMAX = Distribution(
    sample=_sample_softmax,
    mode=_softmax_mode,
    evaluate=_evaluate_softmax,
    env_action=lambda action: action,
)


def gaussian(max_action: float) -> Distribution:
    """Independent normal actions with mean `max_action * tanh(outputs)` and a given std.

    Differs: the authors' mean is `tanh(outputs)`, which cannot reach the whole range of a task
    whose largest action is not 1, such as Pendulum. The std is in units of the action, as theirs.

    Source: `docs/reference.md` 4.5.
    """

    def mode(outputs: Float[Array, "action_dim *batch"]) -> Float[Array, "action_dim *batch"]:
        return max_action * jnp.tanh(outputs)

    def sample(key: Array, outputs: Array, std: Array) -> Float[Array, " action_dim"]:
        return mode(outputs) + std * jax.random.normal(key, outputs.shape)

    def evaluate(
        outputs: Float[Array, "action_dim batch"], std: Array, action: Array
    ) -> tuple[Float[Array, " batch"], Float[Array, " batch"]]:
        standardized = (action - mode(outputs)) / std[:, None]
        log_scale = jnp.sum(jnp.log(std) + 0.5 * math.log(2 * math.pi))
        log_prob = -0.5 * jnp.sum(standardized**2, axis=0) - log_scale
        return log_prob, jnp.broadcast_to(log_scale + 0.5 * std.size, log_prob.shape)

    def env_action(action: Float[Array, " action_dim"]) -> Float[Array, " action_dim"]:
        return jnp.clip(action, -max_action, max_action)

    return Distribution(sample=sample, mode=mode, evaluate=evaluate, env_action=env_action)
