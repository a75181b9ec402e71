"""Soft actor-critic, for continuous actions and for discrete ones.

The two share everything but a `Policy`: a Gaussian squashed by tanh, of which one action is drawn
for each expectation, or a softmax, under which expectations are sums.

Source: Haarnoja et al., "Soft Actor-Critic Algorithms and Applications" (2018); Christodoulou,
"Soft Actor-Critic for Discrete Action Settings" (2019).
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, PyTree

from sejax.agents.base import Agent, Number, traced
from sejax.agents.buffers import Transition
from sejax.agents.off_policy import ActorCriticOptions, adam_step, off_policy_agent, soft_update
from sejax.agents.policies import select_action
from sejax.envs.base import Task
from sejax.ops import flat
from sejax.ops.networks import init_narrowed
from sejax.options import finite, fraction, not_negative, option, positive, require, shortened

_MIN_LOG_STD, _MAX_LOG_STD = -20.0, 2.0  # of the Gaussian, as in the authors' code


@dataclass(frozen=True, kw_only=True)
class SACConfig(ActorCriticOptions):
    """SAC's hyperparameters.

    Attributes:
      alpha: Temperature: what a nat of entropy is worth, in reward units. None: learned, as the
        authors do to meet a target entropy.
      target_entropy: Of actions in [-1, 1], in nats for each dimension; a uniform one's is the
        largest, log 2.
      target_entropy_fraction: Of discrete actions, as a fraction of the largest, log |A|: see
        docs/agents.md.

    Differs: Haarnoja et al. (2018) have two layers of 256 units, batches of 256 out of a million
    steps, a learning rate of 0.0003 and a tau of 0.005 (table 1). Christodoulou (2019)
    has a target entropy of 0.98 of the largest, with which SAC does not learn CartPole.
    """

    actions: ClassVar[tuple[str, ...]] = ("discrete", "continuous")

    alpha: float | None = option(None, not_negative("it weighs the entropy"), traced=True)
    init_alpha: float = option(1.0, positive("it is learned as a logarithm"), traced=True)
    target_entropy: float = option(-1.0, finite("the temperature must settle"), traced=True)
    target_entropy_fraction: float = option(0.2, fraction(), traced=True)

    def make(self, task: Task) -> Agent:
        """The agent for a task's observations and actions.

        Raises:
          ConfigError: if the target entropy of the other kind of actions is set.
        """
        kinds = ("target_entropy", "target_entropy_fraction")
        used, unused = kinds if task.num_actions is None else kinds[::-1]
        got, default = (getattr(config, unused) for config in (self, type(self)))
        require(
            got == default,
            f"agent.{unused}",
            f"must stay {default} with {task.name}'s actions; got {shortened(got)}. Set "
            f"agent.{used} in its place.",
        )
        if task.num_actions is None:
            policy = gaussian_policy(task.action_dim, task.max_action)
        else:
            policy = softmax_policy(task.num_actions)
        return make_sac(self, task.obs_dim, policy)


class SACHparams(NamedTuple):
    """Traced hyperparameters; of sizes what is in use, None for all."""

    learning_rate: Number
    tau: Number
    discount: Number
    alpha: Number | None
    init_alpha: Number
    target_entropy: Number
    target_entropy_fraction: Number
    hidden_size: Array | None = None
    batch_size: Array | None = None


class SACState(struct.PyTreeNode):
    """One agent. Parameters are flat: the actor's, both critics' and log alpha in one vector."""

    params: Float[Array, " num_params"]
    target_critics: Float[Array, " num_critic_params"]
    opt_state: optax.OptState
    is_warming_up: Bool[Array, ""]
    hparams: SACHparams


class LearningNoise(NamedTuple):
    """Standard normal numbers of one learning step, `[action_dim, batch]`; None if discrete.

    Attributes:
      next_action: of the actions drawn for the next states.
      action: of those drawn for the states.
    """

    next_action: Array | None
    action: Array | None


# `inputs [in, batch] -> [2, out, batch]`, both critics with some parameters.
Critics = Callable[[Array], Array]


@dataclass(frozen=True, kw_only=True)
class Policy:
    """What the two variants differ in. Actions and outputs are `[feature, *batch]`.

    Attributes:
      num_outputs: of the actor.
      critic_inputs: how many numbers besides the observation's.
      critic_outputs: of each critic.
      target_entropy: `hparams -> []`, in nats.
      draw: `(key, batch) -> LearningNoise` for so many columns.
      sample: `(key, outputs, is_uniform) -> action` of the policy, or a uniform one, for one
        observation.
      best: `outputs -> action` without any randomness.
      q_values: `(critics, obs, action) -> [2, batch]`, of actions that were taken.
      expected: `(critics, obs, outputs, noise) -> (q_value, entropy)`, `[batch]` each: the lesser
        critic's value and the entropy, in expectation over the policy or for a draw of it.
      env_action: `action -> action` as the environment takes it.
    """

    num_outputs: int
    critic_inputs: int
    critic_outputs: int
    target_entropy: Callable[[SACHparams], Number]
    draw: Callable[[Array, int], LearningNoise]
    sample: Callable[[Array, Array, Array], Array]
    best: Callable[[Array], Array]
    q_values: Callable[[Critics, Array, Array], Array]
    expected: Callable[[Critics, Array, Array, Array | None], tuple[Array, Array]]
    env_action: Callable[[Array], Array]


def make_sac(config: SACConfig, obs_dim: int, policy: Policy) -> Agent:
    """Builds the agent for observations `[obs_dim]` and a policy's actions.

    Example:
      >>> agent = make_sac(SACConfig(), obs_dim=4, policy=softmax_policy(2))
      >>> state = jax.jit(agent.init)(jax.random.key(0), agent.hparams)
      >>> int(agent.act(jax.random.key(1), state, jnp.zeros(4), explore=True)) in (0, 1)
      True
    """
    networks = make_networks(config, obs_dim, policy)
    learn = make_learning_step(networks, policy)

    def init(key: Array, hparams: SACHparams) -> SACState:
        params = networks.init(key, hparams)
        return SACState(
            params=params,
            target_critics=networks.critics_of(params),
            opt_state=flat.ADAM.init(params),
            is_warming_up=jnp.bool_(config.warmup_episodes > 0),
            hparams=jax.tree.map(jnp.float32, hparams),
        )

    def act(key: Array, state: SACState, obs: Float[Array, " obs_dim"], explore: bool) -> Array:
        outputs = networks.actor(networks.unflatten(state.params), obs)
        if not explore:
            return policy.best(outputs)
        return policy.sample(key, outputs, state.is_warming_up)

    def update(key: Array, state: SACState, batch: Transition) -> SACState:
        return learn(state, batch, policy.draw(key, batch.reward.size))

    return off_policy_agent(
        config,
        hparams=traced(config, SACHparams),
        init=init,
        begin_episode=config.begin_episode,
        act=act,
        update=update,
        env_action=policy.env_action,
    )


# --- networks ------------------------------------------------------------------------------------


class Params(NamedTuple):
    """Parameters of an agent; the leaves of `critics` are `[2, ...]`."""

    actor: PyTree
    critics: PyTree
    log_alpha: Array


class Networks(NamedTuple):
    """The actor and the critics as functions of parameters.

    Attributes:
      init: `(key, hparams) -> params`, `[num_params]`.
      unflatten: `params [num_params] -> Params`.
      critics_of: `params [num_params] -> critics [num_critic_params]`.
      unflatten_critics: `critics [num_critic_params] -> Params.critics`.
      actor: `(Params, obs) -> outputs`, `[num_outputs, *batch]`.
      critics: `(Params.critics, inputs) -> outputs`, `[2, critic_outputs, batch]`.
    """

    init: Callable[[Array, SACHparams], Array]
    unflatten: Callable[[Array], Params]
    critics_of: Callable[[Array], Array]
    unflatten_critics: Callable[[Array], PyTree]
    actor: Callable[[Params, Array], Array]
    critics: Callable[[PyTree, Array], Array]


def make_networks(config: SACConfig, obs_dim: int, policy: Policy) -> Networks:
    """An actor and two critics of the same hidden layers."""

    actor, critic = config.mlp(policy.num_outputs), config.mlp(policy.critic_outputs)

    def init_params(key: Array, hidden_size: Array | None = None) -> Params:
        key_actor, key_critics = jax.random.split(key)
        num_inputs = obs_dim + policy.critic_inputs
        init_critics = jax.vmap(lambda key: init_narrowed(critic, key, num_inputs, hidden_size))
        return Params(
            actor=init_narrowed(actor, key_actor, obs_dim, hidden_size),
            critics=init_critics(jax.random.split(key_critics)),
            log_alpha=jnp.zeros(()),
        )

    def init(key: Array, hparams: SACHparams) -> Array:
        params = init_params(key, hparams.hidden_size)
        return flat.flatten(params._replace(log_alpha=jnp.log(jnp.float32(hparams.init_alpha))))

    template = jax.eval_shape(init_params, jax.random.key(0))
    start, size = (sum(x.size for x in jax.tree.leaves(part)) for part in template[:2])
    return Networks(
        init=init,
        unflatten=flat.inverse_of_flatten(template),
        critics_of=lambda params: params[start : start + size],
        unflatten_critics=flat.inverse_of_flatten(template.critics),
        actor=lambda params, obs: actor.apply(params.actor, obs),
        critics=jax.vmap(critic.apply, (0, None)),
    )


# --- learning ------------------------------------------------------------------------------------


def make_learning_step(
    networks: Networks, policy: Policy
) -> Callable[[SACState, Transition, LearningNoise], SACState]:
    r"""Builds `learn(state, batch, noise) -> state`.

    One step of Adam on all three losses from the same parameters, as in the authors' code, each
    with a gradient for its own parameters alone:

    .. math::
      y &= r + \gamma d\, E[\min_i Q'_i(s', a') - \alpha \log \pi(a'|s')] \\
      J_Q &= \tfrac12 \sum_i (Q_i(s, a) - y)^2 \\
      J_\pi &= E[\alpha \log \pi(a|s) - \min_i Q_i(s, a)] \\
      J_\alpha &= \log \alpha\, (E[-\log \pi(a|s)] - \bar H)

    Differs: the paper's temperature loss has alpha where its logarithm stands here and in the
    authors' code; alpha then falls and rises at a rate of its own, whatever it is.

    Source: Haarnoja et al. (2018), equations 5, 7 and 18; Christodoulou (2019), equations 10 to 12.
    """

    losses = functools.partial(losses_of, networks, policy)

    def learn(state: SACState, batch: Transition, noise: LearningNoise) -> SACState:
        hp = state.hparams
        tree = networks.unflatten(state.params)
        target_critics = networks.unflatten_critics(state.target_critics)

        def sum_of_losses(params: Params, batch: Transition, noise: LearningNoise) -> Array:
            return jnp.sum(batch.weight * losses(params, target_critics, hp, batch, noise))

        params, opt_state = adam_step(
            sum_of_losses, state.params, state.opt_state, (batch, noise), hp, tree
        )
        critics = networks.critics_of(params)
        return state.replace(
            params=params,
            opt_state=opt_state,
            target_critics=soft_update(state.target_critics, critics, hp.tau),
        )

    return learn


def losses_of(
    networks: Networks,
    policy: Policy,
    params: Params,
    target_critics: PyTree,
    hp: SACHparams,
    batch: Transition,
    noise: LearningNoise,
) -> Float[Array, " batch"]:
    """All three losses of a batch's columns; see `make_learning_step`."""
    fixed = jax.lax.stop_gradient(params)
    online, online_fixed, target = (
        functools.partial(networks.critics, critics)
        for critics in (params.critics, fixed.critics, target_critics)
    )
    alpha = jnp.exp(fixed.log_alpha) if hp.alpha is None else hp.alpha
    next_q, next_entropy = policy.expected(
        target, batch.next_obs, networks.actor(fixed, batch.next_obs), noise.next_action
    )
    targets = batch.reward + hp.discount * batch.discount * (next_q + alpha * next_entropy)
    errors = policy.q_values(online, batch.obs, batch.action) - targets
    q_value, entropy = policy.expected(
        online_fixed, batch.obs, networks.actor(params, batch.obs), noise.action
    )
    losses = 0.5 * jnp.sum(errors**2, axis=0) - (q_value + alpha * entropy)
    if hp.alpha is None:
        excess = jax.lax.stop_gradient(entropy) - policy.target_entropy(hp)
        losses = losses + params.log_alpha * excess
    return losses


def lesser(q_values: Float[Array, "2 *values"]) -> Float[Array, "*values"]:
    """The lesser of the two critics' values.

    `jnp.min` would not do: its gradient divides by how many values equal the minimum, which are
    none where the compiler computes one of them twice and rounds it differently.
    """
    return jnp.minimum(q_values[0], q_values[1])


# --- policies ------------------------------------------------------------------------------------


def gaussian_policy(action_dim: int, max_action: float) -> Policy:
    """Continuous actions: the tanh of a Gaussian whose mean and log std are the outputs."""

    def draw(key: Array, batch: int) -> LearningNoise:
        return LearningNoise(*jax.random.normal(key, (2, action_dim, batch)))

    def sample(key: Array, outputs: Array, is_uniform: Array) -> Array:
        noise = jax.random.normal(key, (action_dim,))
        uniform = jax.lax.erf(noise / math.sqrt(2))  # its distribution function, times 2, less 1
        return jnp.where(is_uniform, uniform, squashed_gaussian(outputs, noise)[0])

    def q_values(critics: Critics, obs: Array, action: Array) -> Array:
        return critics(jnp.concatenate([obs, action]))[:, 0]

    def expected(
        critics: Critics, obs: Array, outputs: Array, noise: Array | None
    ) -> tuple[Array, Array]:
        assert noise is not None
        action, log_p = squashed_gaussian(outputs, noise)
        return lesser(q_values(critics, obs, action)), -log_p

    return Policy(
        num_outputs=2 * action_dim,
        critic_inputs=action_dim,
        critic_outputs=1,
        target_entropy=lambda hparams: hparams.target_entropy * action_dim,
        draw=draw,
        sample=sample,
        best=lambda outputs: jnp.tanh(outputs[:action_dim]),
        q_values=q_values,
        expected=expected,
        env_action=lambda action: max_action * action,
    )


def squashed_gaussian(
    outputs: Float[Array, "two_actions *batch"], noise: Float[Array, "actions *batch"]
) -> tuple[Float[Array, "actions *batch"], Float[Array, "*batch"]]:
    r"""Actions :math:`\tanh(\mu + \sigma \epsilon)` and the logarithms of their densities.

    Args:
      outputs: mean and, clipped, log std.
      noise: standard normal, `[actions, *batch]`.

    Source: Haarnoja et al. (2018), appendix C, eq. 26.
    """
    mean, log_std = jnp.split(outputs, 2)
    log_std = jnp.clip(log_std, _MIN_LOG_STD, _MAX_LOG_STD)
    u = mean + jnp.exp(log_std) * noise
    log_normal = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
    log_slope = 2 * (math.log(2) - u - jax.nn.softplus(-2 * u))  # log(1 - tanh(u)^2), stably
    return jnp.tanh(u), jnp.sum(log_normal - log_slope, axis=0)


def softmax_policy(num_actions: int) -> Policy:
    """Discrete actions with logits as outputs; critics have an output for each action."""

    def sample(key: Array, outputs: Array, is_uniform: Array) -> Array:
        logits = jnp.where(is_uniform, 0.0, outputs)
        return jax.random.categorical(key, logits).astype(jnp.int32)

    def q_values(critics: Critics, obs: Array, action: Array) -> Array:
        return jax.vmap(select_action, (0, None))(critics(obs), action)

    def expected(
        critics: Critics, obs: Array, outputs: Array, noise: Array | None
    ) -> tuple[Array, Array]:
        log_p = jax.nn.log_softmax(outputs, axis=0)
        p = jnp.exp(log_p)
        q_value = jnp.sum(p * lesser(critics(obs)), axis=0)
        return q_value, -jnp.sum(p * log_p, axis=0)

    return Policy(
        num_outputs=num_actions,
        critic_inputs=0,
        critic_outputs=num_actions,
        target_entropy=lambda hparams: hparams.target_entropy_fraction * math.log(num_actions),
        draw=lambda key, batch: LearningNoise(None, None),
        sample=sample,
        best=lambda outputs: jnp.argmax(outputs).astype(jnp.int32),
        q_values=q_values,
        expected=expected,
        env_action=lambda action: action,
    )
