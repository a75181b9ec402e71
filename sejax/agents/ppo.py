"""PPO with a clipped ratio and Monte-Carlo returns, for discrete and for continuous actions.

Source: Schulman et al., "Proximal Policy Optimization Algorithms" (2017); the paper's appendix,
table of PPO; `reference_details.md` 4.5.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from sejax.agents import replay
from sejax.agents.agent import Agent, hparams_of
from sejax.agents.configs import PPOConfig
from sejax.agents.ddqn import select_action
from sejax.agents.memory import Rollout, rollout_memory
from sejax.networks import MLP, narrow

MIN_STD = 0.01  # of the Gaussian policy, in units of the action
_MAX_LOG_RATIO = 20.0  # exp(20) is beyond any clip, and finite


class PPOHparams(NamedTuple):
    """The traced hyperparameters, scalars that a population of agents may vary."""

    learning_rate: Array | float
    discount: Array | float
    clip_ratio: Array | float
    value_weight: Array | float
    entropy_weight: Array | float
    hidden_size: Array | None = None  # units in use, if fewer than the networks have


class PPOState(struct.PyTreeNode):
    """One agent. `params` are the actor's, the critic's and the std, as one flat vector."""

    params: Float[Array, " num_params"]
    opt_state: optax.OptState
    hparams: PPOHparams


class Policy(NamedTuple):
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
    with sampled actions (`reference_details.md` 3.7), and they do not clip actions, so that
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
    std_dim = action_dim or 0  # a softmax has no std
    actor, critic = (
        MLP(size, config.hidden_size, config.num_layers, config.activation, learn_prelu_slope=True)
        for size in (num_actions or std_dim, 1)
    )

    def init_params(key: Array) -> dict[str, Any]:
        key_actor, key_critic = jax.random.split(key)
        return {
            "actor": actor.init(key_actor, jnp.zeros(obs_dim)),
            "critic": critic.init(key_critic, jnp.zeros(obs_dim)),
            "std": jnp.full(std_dim, config.init_action_std, jnp.float32),
        }

    template = jax.eval_shape(init_params, jax.random.key(0))
    _, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape), template))
    adam = optax.scale_by_adam()

    def init(key: Array, hparams: PPOHparams) -> PPOState:
        tree = init_params(key)
        if hparams.hidden_size is not None:
            for name in ("actor", "critic"):
                tree[name] = {"params": narrow(tree[name]["params"], hparams.hidden_size)}
        params, _ = ravel_pytree(tree)
        return PPOState(
            params=params,
            opt_state=adam.init(params),
            hparams=jax.tree.map(jnp.float32, hparams),
        )

    def act(key: Array, state: PPOState, obs: Float[Array, " obs_dim"], explore: bool) -> Array:
        params = unravel(state.params)
        outputs: Any = actor.apply(params["actor"], obs)
        return policy.sample(key, outputs, params["std"]) if explore else policy.mode(outputs)

    def evaluate(params: dict[str, Any], obs: Array, action: Array) -> tuple[Array, Array]:
        outputs: Any = actor.apply(params["actor"], obs)
        return policy.evaluate(outputs, params["std"], action)

    def least_params() -> Float[Array, " num_params"]:
        """Lower bounds of the parameters: only the std has one."""
        unbounded = jax.tree.map(lambda x: jnp.full(x.shape, -jnp.inf), template)
        return ravel_pytree({**unbounded, "std": jnp.full(std_dim, MIN_STD)})[0]

    def learn(params: Array, opt_state: Any, rows: Array, hp: Any) -> tuple[Array, Any]:
        """A learning phase: `epochs` Adam steps on the whole rollout."""
        steps = replay.unpack(rows[:, :-1].T, action_dim)
        returns = normalized(discounted_returns(steps.reward, rows[:, -1], hp.discount))
        # These parameters have made the whole rollout.
        old_log_prob, _ = evaluate(unravel(params), steps.obs, steps.action)
        bounds = least_params()

        def loss_fn(params: dict[str, Any]) -> Array:
            log_prob, entropy = evaluate(params, steps.obs, steps.action)
            value = critic.apply(params["critic"], steps.obs)[0]
            return ppo_loss(log_prob, entropy, value, old_log_prob, returns, hp)

        def epoch(number: Array, carry: tuple[Array, Any]) -> tuple[Array, Any]:
            params, opt_state = carry
            gradient, _ = ravel_pytree(jax.grad(loss_fn)(unravel(params)))
            direction, opt_state = adam.update(gradient, opt_state)
            params = jnp.maximum(params - hp.learning_rate * direction, bounds)
            return params, opt_state

        return jax.lax.fori_loop(0, config.epochs, epoch, (params, opt_state))

    def update(key: Array, state: PPOState, rollout: Rollout) -> PPOState:
        """Learns if the rollout is full.

        A loop of one trip or none: in lanes `lax.cond` would learn in every step and throw it away,
        whereas this loop runs only when some lane's rollout is full.
        """

        def phase(carry: tuple[Array, Array, Any]) -> tuple[Array, Array, Any]:
            _, params, opt_state = carry
            # XLA would move what depends on the rows alone out of the loop, into every step.
            rows, params = jax.lax.optimization_barrier((rollout.rows, params))
            return jnp.bool_(False), *learn(params, opt_state, rows, state.hparams)

        _, params, opt_state = jax.lax.while_loop(
            lambda carry: carry[0], phase, (rollout.is_full, state.params, state.opt_state)
        )
        return state.replace(params=params, opt_state=opt_state)

    return Agent(
        init=init,
        begin_episode=lambda state, episode: state,
        act=act,
        update=update,
        memory=rollout_memory(config.rollout_length(max_steps)),
        hparams=hparams_of(PPOHparams, config),
        init_episodes=config.init_episodes,
        learns_from=0,
        env_action=policy.env_action,
        action_repeat=config.action_repeat,
    )


def discounted_returns(
    reward: Float[Array, " steps"], ended: Float[Array, " steps"], discount: Array | float
) -> Float[Array, " steps"]:
    r"""Monte-Carlo returns :math:`R_t = r_t + \gamma R_{t+1}` within each episode.

    Nothing is bootstrapped: an episode counts as over where it was cut, and where the rollout is.

    Args:
      reward: in the task's units.
      ended: 1 at the last step of an episode, else 0.
      discount: gamma.

    Source: `reference_details.md` 4.5. Differs: the authors restart where the stored `done` exceeds
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
    hp: PPOHparams,
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

    Source: Schulman et al. (2017), eq. 7 and 9; `reference_details.md` 4.5.
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


SOFTMAX = Policy(
    sample=_sample_softmax,
    mode=_softmax_mode,
    evaluate=_evaluate_softmax,
    env_action=lambda action: action,
)


def gaussian(max_action: float) -> Policy:
    """Independent normal actions with mean `max_action * tanh(outputs)` and a given std.

    Differs: the authors' mean is `tanh(outputs)`, which cannot reach the whole range of a task
    whose largest action is not 1, such as Pendulum. The std is in units of the action, as theirs.

    Source: `reference_details.md` 4.5.
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

    return Policy(sample=sample, mode=mode, evaluate=evaluate, env_action=env_action)
