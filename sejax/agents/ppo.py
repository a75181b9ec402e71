"""PPO with a clipped ratio and Monte-Carlo returns, for discrete and for continuous actions.

Source: Schulman et al., "Proximal Policy Optimization Algorithms" (2017); the paper's appendix,
table of PPO; `docs/reference.md` 4.5.
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
from sejax.networks import ACTIVATIONS, MLP, narrow
from sejax.options import counts, fraction, not_negative, one_of, option, positive

MIN_STD = 0.01  # of the Gaussian policy, in units of the action
_MAX_LOG_RATIO = 20.0  # exp(20) is beyond any clip, and finite


@dataclass(frozen=True, kw_only=True)
class PPOConfig(AgentOptions):
    """PPO (clip) for discrete and continuous actions (paper, appendix, table of PPO).

    The defaults are the paper's for MountainCarContinuous, whose RNs add `action_repeat=5`.
    """

    actions: ClassVar[tuple[str, ...]] = ("discrete", "continuous")

    # PPO learns from the start; this only holds back the stop rule.
    init_episodes: int = option(1, counts("it counts episodes", least=0))
    hidden_size: int = option(64, counts(), varied="triple")
    num_layers: int = option(2, counts(), varied="one_more_or_less")
    activation: str = option("relu", one_of(ACTIVATIONS))
    learning_rate: float = option(
        3e-4, positive("the agent would not move"), traced=True, varied="triple"
    )
    discount: float = option(0.99, fraction(), traced=True)
    update_episodes: int = option(10, counts())  # of full length, between two learning phases
    epochs: int = option(80, counts())  # Adam steps on all of the rollout in a learning phase
    clip_ratio: float = option(0.2, positive("the agent would not move"), traced=True)
    value_weight: float = option(1.0, not_negative(), traced=True)
    entropy_weight: float = option(0.01, not_negative(), traced=True)
    # Of the Gaussian policy; learned.
    init_action_std: float = option(0.5, positive("the agent would not move"))
    action_repeat: int = option(1, counts())

    def make(self, task: Any) -> Agent:
        """The agent for a task's observations and actions."""
        action_dim = task.action_dim if task.num_actions is None else None
        return make_ppo(self, task.obs_dim, task.num_actions, action_dim, task.max_action,
                        task.max_steps)  # fmt: skip

    def rollout_length(self, max_episode_steps: int) -> int:
        """Decisions between two learning phases.

        The authors learn as soon as (decisions x `action_repeat`) / `max_episode_steps` exceeds
        `update_episodes`, also in the middle of an episode; this is the first whole number that
        does.

        Source: `docs/reference.md` 4.5.
        """
        return self.update_episodes * max_episode_steps // self.action_repeat + 1

    def steps_before_learning(self, max_episode_steps: int) -> int:
        """As of any agent; PPO learns once a rollout is full."""
        return self.rollout_length(max_episode_steps) * self.action_repeat


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
    learn = make_learning_phase(config, networks, obs_dim, is_discrete=action_dim is None)

    def init(key: Array, hparams: Any) -> PPOState:
        params = networks.init(key, hparams.hidden_size)
        return PPOState(
            params=params,
            opt_state=flat.ADAM.init(params),
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
            # XLA would move what depends on the rows alone out of the loop, into every step.
            rows, params = jax.lax.optimization_barrier((rollout.rows, params))
            full = rollout._replace(rows=rows)
            return jnp.bool_(False), *learn(params, opt_state, full, state.hparams)

        _, params, opt_state = jax.lax.while_loop(
            lambda carry: carry[0], phase, (rollout.is_full, state.params, state.opt_state)
        )
        return state.replace(params=params, opt_state=opt_state)

    return Agent(
        init=init,
        act=act,
        update=update,
        memory=rollout_memory(config.rollout_length(max_steps)),
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
      evaluate: `(tree, obs, action) -> (log_prob, entropy, value)`, `[steps]` each.
      least_params: lower bounds of flat parameters: only the std has one.
    """

    init: Callable[[Array, Array | None], Array]
    unflatten: Callable[[Array], Any]
    actor: Callable[[Any, Array], tuple[Array, Array]]
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

    def evaluate(tree: Any, obs: Array, action: Array) -> tuple[Array, Array, Array]:
        log_prob, entropy = policy.evaluate(*actor(tree, obs), action)
        value: Any = mlps["critic"].apply(tree["critic"], obs)
        return log_prob, entropy, value[0]

    template = jax.eval_shape(init_tree, jax.random.key(0))
    unbounded = jax.tree.map(lambda x: jnp.full(x.shape, -jnp.inf), template)
    return Networks(
        init=init,
        unflatten=flat.unflattener(init_tree),
        actor=actor,
        evaluate=evaluate,
        least_params=flat.flatten({**unbounded, "std": jnp.full(std_dim, MIN_STD)}),
    )


def make_learning_phase(
    config: PPOConfig, networks: Networks, obs_dim: int, is_discrete: bool
) -> Callable[[Array, Any, Rollout, Any], tuple[Array, Any]]:
    """Builds `learn(params, opt_state, rollout, hparams) -> (params, opt_state)`.

    A learning phase: `config.epochs` Adam steps on the whole rollout.
    """
    evaluate, unflatten = networks.evaluate, networks.unflatten

    def learn(params: Array, opt_state: Any, rollout: Rollout, hp: Any) -> tuple[Array, Any]:
        steps = rollout.transitions(obs_dim, is_discrete)
        returns = normalized(discounted_returns(steps.reward, rollout.ended, hp.discount))
        # These parameters have made the whole rollout.
        old_log_prob, _, _ = evaluate(unflatten(params), steps.obs, steps.action)

        def loss_fn(tree: Any) -> Array:
            log_prob, entropy, value = evaluate(tree, steps.obs, steps.action)
            return ppo_loss(log_prob, entropy, value, old_log_prob, returns, hp)

        def epoch(number: Array, carry: tuple[Array, Any]) -> tuple[Array, Any]:
            params, opt_state = carry
            gradient = flat.flatten(jax.grad(loss_fn)(unflatten(params)))
            moved, opt_state = flat.adam_step(params, opt_state, gradient, hp.learning_rate)
            return jnp.maximum(moved, networks.least_params), opt_state

        return jax.lax.fori_loop(0, config.epochs, epoch, (params, opt_state))

    return learn


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

    def step(later: Array, x: tuple[Array, Array]) -> tuple[Array, Array]:
        reward, ended = x
        now = reward + discount * jnp.where(ended > 0.5, 0.0, later)
        return now, now

    _, returns = jax.lax.scan(step, jnp.float32(0), (reward, ended), reverse=True)
    return returns


def normalized(returns: Float[Array, " steps"]) -> Float[Array, " steps"]:
    """Returns with mean 0 and std 1, the std being the unbiased estimate plus 1e-5."""
    std = jnp.std(returns, ddof=min(1, returns.shape[0] - 1))
    return (returns - jnp.mean(returns)) / (std + 1e-5)


def ppo_loss(
    log_prob: Float[Array, " steps"],
    entropy: Float[Array, " steps"],
    value: Float[Array, " steps"],
    old_log_prob: Float[Array, " steps"],
    returns: Float[Array, " steps"],
    hp: Any,
) -> Float[Array, ""]:
    r"""What a learning phase minimises.

    .. math:: -\overline{\min(\rho A, \mathrm{clip}(\rho, 1-\epsilon, 1+\epsilon) A)}
       + c_V \overline{(V - R)^2} - c_H \overline{H}

    with the ratio :math:`\rho` of the new to the old probability and the advantage
    :math:`A = R - V`, which passes no gradient.

    Args:
      log_prob: of the actions, in nats.
      entropy: of the policy, in nats.
      value: V of the critic, in units of `returns`.
      old_log_prob: of the actions when the rollout was made.
      returns: R, normalised.
      hp: clip_ratio (epsilon), value_weight (c_V) and entropy_weight (c_H).

    Source: Schulman et al. (2017), eq. 7 and 9; `docs/reference.md` 4.5.
    """
    advantage = jax.lax.stop_gradient(returns - value)
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
