"""PPO with a clipped ratio, for discrete and for continuous actions.

There are two ways to prepare a rollout (`ADVANTAGES`): `gae`, the usual generalised advantages, and
`monte_carlo`, the returns of the paper's code, which learns from the whole rollout in each Adam
step (`PPOConfig.paper`). All else is the same.

Without exploration the agent takes its most probable action. Differs: the authors also test with
sampled actions (`docs/reference.md` 3.7), and they do not clip actions, so that
MountainCarContinuous charges for what was drawn. The policy delay in the paper's table for PPO has
no counterpart in their code, nor here.

Source: Schulman et al., "Proximal Policy Optimization Algorithms" (2017); Schulman et al.,
"High-Dimensional Continuous Control Using Generalized Advantage Estimation" (2016); the paper's
appendix, table of PPO; `docs/reference.md` 4.5.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PyTree

from sejax.agents.base import Agent, AgentSpec, Number, TorsoOptions, traced
from sejax.agents.buffers import Rollout, Transition, rollout_buffer
from sejax.agents.policies import Distribution, gaussian, softmax
from sejax.envs.base import Task
from sejax.ops import flat
from sejax.ops.keys import murmur
from sejax.ops.networks import MLP, init_narrowed
from sejax.options import (
    ACTIVATIONS,
    MOST_LAYERS,
    MOVES,
    counts,
    fraction,
    not_negative,
    one_of,
    option,
    positive,
    require,
    shortened,
)

Steps = Float[Array, " steps"]  # of a rollout, or of a minibatch of it

MIN_STD = 0.01  # of the Gaussian policy, in units of the action
ADVANTAGES = ("monte_carlo", "gae")
_MAX_LOG_RATIO = 20.0  # exp(20) is beyond any clip, and finite


@dataclass(frozen=True, kw_only=True)
class PPOConfig(TorsoOptions):
    """PPO (clip) for discrete and continuous actions.

    The defaults learn from few steps (`docs/agents.md`). `paper` has the paper's PPO.

    Attributes:
      rollout_steps: Decisions between two learning phases; null: as `update_episodes` says.
      update_episodes: of full length, between two learning phases
      epochs: passes over the rollout in a learning phase
      num_minibatches: Adam steps in an epoch, each on its part of it
      gae_lambda: of advantages=gae
      normalize_rewards: Divides rewards by the running std of returns, with advantages=gae.
      max_grad_norm: Norm that a longer gradient is scaled down to.
      init_action_std: Of the Gaussian policy; learned.
    """

    actions: ClassVar[tuple[str, ...]] = ("discrete", "continuous")

    hidden_size: int = option(64, counts(), varied="triple")
    num_layers: int = option(2, counts(most=MOST_LAYERS), varied="one_more_or_less")
    activation: str = option("tanh", one_of(ACTIVATIONS))
    learning_rate: float = option(2e-3, positive(MOVES), traced=True, varied="triple")
    discount: float = option(0.99, fraction(), traced=True)
    rollout_steps: int | None = option(128, counts())
    update_episodes: int = option(10, counts())
    epochs: int = option(10, counts())
    num_minibatches: int = option(4, counts())
    advantages: str = option("gae", one_of(ADVANTAGES))
    gae_lambda: float = option(0.9, fraction(), traced=True)
    clip_ratio: float = option(0.1, positive(MOVES), traced=True)
    value_weight: float = option(0.5, not_negative(), traced=True)
    entropy_weight: float = option(0.01, not_negative(), traced=True)
    normalize_rewards: bool = True
    max_grad_norm: float | None = option(0.5, positive(MOVES))
    adam_eps: float = option(1e-5, positive("it keeps Adam from dividing by 0"))
    init_action_std: float = option(0.5, positive(MOVES))
    action_repeat: int = option(1, counts())

    @classmethod
    def paper(cls, **changes: Any) -> Self:
        """The paper's PPO, but for these changes: its table and, where that is silent, its code.

        Those are its values for MountainCarContinuous, whose RNs add `action_repeat=5`.

        Source: the paper's appendix, tables of PPO; `docs/reference.md` 4.5.

        Example:
          >>> PPOConfig.paper(epochs=20).advantages
          'monte_carlo'
        """
        paper: dict[str, Any] = {
            "advantages": "monte_carlo",
            "normalize_rewards": False,
            "rollout_steps": None,
            "num_minibatches": 1,
            "epochs": 80,
            "activation": "relu",
            "learning_rate": 3e-4,
            "clip_ratio": 0.2,
            "value_weight": 1.0,
            "max_grad_norm": None,
            "adam_eps": 1e-8,
            "gae_lambda": 0.95,
        }
        return cls(**(paper | changes))

    def make(self, task: Task) -> Agent:
        """The agent for a task's observations and actions."""
        if task.num_actions is None:
            policy = gaussian(task.action_dim, task.max_action)
        else:
            policy = softmax(task.num_actions)
        return make_ppo(self, task.obs_dim, policy, task.max_steps, task.image)

    def rollout_length(self, task_max_steps: int) -> int:
        """Decisions between two learning phases: `rollout_steps`, if that is set.

        The authors learn as soon as (decisions x `action_repeat`) / `task_max_steps` exceeds
        `update_episodes`, also in the middle of an episode; this is the first whole number that
        does.

        Source: `docs/reference.md` 4.5.
        """
        if self.rollout_steps is not None:
            return self.rollout_steps
        return self.update_episodes * task_max_steps // self.action_repeat + 1

    def checked_rollout_length(self, task_max_steps: int) -> int:
        """As `rollout_length`.

        Raises:
          ConfigError: if a rollout has fewer than two steps for each minibatch.
        """
        length = self.rollout_length(task_max_steps)
        require(
            self.num_minibatches == 1 or 2 * self.num_minibatches <= length,
            "agent.num_minibatches",
            f"must be at most half of the rollout's {length} steps; got "
            f"{shortened(self.num_minibatches)}. Set agent.num_minibatches={max(1, length // 2)}.",
        )
        return length

    def steps_before_learning(self, max_episode_steps: int, task_max_steps: int) -> int:
        """As of any agent; PPO learns once a rollout is full, whose length is by the task."""
        return self.rollout_length(task_max_steps) * self.action_repeat

    def spec(self) -> AgentSpec:
        # It learns from the start; `warmup_episodes` only holds back the stop rule.
        return dataclasses.replace(super().spec(), learns_from=0, action_repeat=self.action_repeat)

    def optimizer(self) -> optax.GradientTransformation:
        """Adam's direction, of a gradient that may be shortened first."""
        adam = optax.scale_by_adam(eps=self.adam_eps)
        if self.max_grad_norm is None:
            return adam
        return optax.chain(optax.clip_by_global_norm(self.max_grad_norm), adam)


class PPOHparams(NamedTuple):
    """Traced hyperparameters; of `hidden_size` what is in use, None for all."""

    learning_rate: Number
    discount: Number
    gae_lambda: Number
    clip_ratio: Number
    value_weight: Number
    entropy_weight: Number
    hidden_size: Array | None = None


class PPOState(struct.PyTreeNode):
    """One agent. `params` are the actor's, the critic's and the std, as one flat vector."""

    params: Float[Array, " num_params"]
    opt_state: optax.OptState
    return_sums: Float[Array, "3"]  # of 1, returns and their squares; 0 if unused
    hparams: PPOHparams


def make_ppo(
    config: PPOConfig,
    obs_dim: int,
    policy: Distribution,
    max_steps: int,
    image: tuple[int, ...] = (),
) -> Agent:
    """Builds the agent for observations `[obs_dim]` and a policy's actions.

    `update` learns once the rollout is full and costs next to nothing before, under `vmap` too.

    Args:
      config: hyperparameters.
      obs_dim: length of an observation.
      policy: the distribution of actions. The rollout keeps continuous ones as drawn; they reach
        the environment clipped to its range.
      max_steps: the task's step limit for an episode, in environment steps.
      image: rows, columns and channels of observations that are images, for a torso.

    Raises:
      ConfigError: if a rollout has fewer than two steps for each minibatch.

    Example:
      >>> agent = make_ppo(PPOConfig(), obs_dim=4, policy=softmax(2), max_steps=200)
      >>> state = agent.init(jax.random.key(0), agent.hparams)
      >>> int(agent.act(jax.random.key(1), state, jnp.zeros(4), explore=True)) in (0, 1)
      True
    """
    networks = make_networks(config, obs_dim, policy, image)
    length = config.checked_rollout_length(max_steps)
    optimizer = config.optimizer()
    learn = make_learning_phase(config, networks, optimizer, obs_dim, policy.std_dim == 0)

    def init(key: Array, hparams: PPOHparams) -> PPOState:
        params = networks.init(key, hparams.hidden_size)
        return PPOState(
            params=params,
            opt_state=optimizer.init(params),
            return_sums=jnp.zeros(3),
            hparams=jax.tree.map(jnp.float32, hparams),
        )

    def act(key: Array, state: PPOState, obs: Float[Array, " obs_dim"], explore: bool) -> Array:
        outputs, std = networks.actor(networks.unflatten(state.params), obs)
        return policy.sample(key, outputs, std) if explore else policy.mode(outputs)

    return Agent(
        init=init,
        act=act,
        update=_when_full(learn),
        buffer=rollout_buffer(length),
        hparams=traced(config, PPOHparams),
        spec=config.spec(),
        env_action=policy.env_action,
        discount=lambda hparams: hparams.discount,
    )


def _when_full(
    learn: Callable[[Array, PPOState, Rollout], PPOState],
) -> Callable[[Array, PPOState, Rollout], PPOState]:
    """Builds an update that is a learning phase where the rollout is full, and else nothing."""

    def update(key: Array, state: PPOState, rollout: Rollout) -> PPOState:
        def phase(state: PPOState) -> PPOState:
            # XLA would move what does not depend on the carry out of the loop, into every step.
            inputs = (key, state.params, rollout.rows)
            phase_key, params, rows = jax.lax.optimization_barrier(inputs)
            return learn(phase_key, state.replace(params=params), rollout._replace(rows=rows))

        return rollout.learn_if_full(phase, state)

    return update


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
    unflatten: Callable[[Array], PyTree]
    actor: Callable[[PyTree, Array], tuple[Array, Array]]
    critic: Callable[[PyTree, Array], Array]
    evaluate: Callable[[PyTree, Array, Array], tuple[Array, Array, Array]]
    least_params: Float[Array, " num_params"]


def make_networks(
    config: PPOConfig, obs_dim: int, policy: Distribution, image: tuple[int, ...] = ()
) -> Networks:
    """An actor `s -> outputs` and a critic `s -> V` of the same hidden layers, and the std.

    `image` is that of `make_ppo`.
    """
    shape = (config.hidden_size, config.num_layers, config.activation)
    mlps = {
        name: config.with_torso(MLP(size, *shape, learn_prelu_slope=True), image)
        for name, size in (("actor", policy.num_outputs), ("critic", 1))
    }

    def init_tree(key: Array, hidden_size: Array | None = None) -> dict[str, PyTree]:
        keys = dict(zip(mlps, jax.random.split(key), strict=True))
        weights = {
            name: init_narrowed(mlp, keys[name], obs_dim, hidden_size) for name, mlp in mlps.items()
        }
        return {**weights, "std": jnp.full(policy.std_dim, config.init_action_std, jnp.float32)}

    def init(key: Array, hidden_size: Array | None) -> Array:
        return flat.flatten(init_tree(key, hidden_size))

    def actor(tree: PyTree, obs: Array) -> tuple[Array, Array]:
        outputs: Any = mlps["actor"].apply(tree["actor"], obs)
        return outputs, tree["std"]

    def critic(tree: PyTree, obs: Array) -> Array:
        value: Any = mlps["critic"].apply(tree["critic"], obs)
        return value[0]

    def evaluate(tree: PyTree, obs: Array, action: Array) -> tuple[Array, Array, Array]:
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
        least_params=flat.flatten({**unbounded, "std": jnp.full(policy.std_dim, MIN_STD)}),
    )


class Batch(NamedTuple):
    """What a learning phase learns from, steps last: a rollout or a minibatch of it.

    Attributes:
      old_log_prob: of the actions when the rollout was made, in nats.
      advantage: of the actions; None for `returns` less the critic's present value.
      returns: what the critic is to predict.
    """

    obs: Float[Array, "obs_dim steps"]
    action: Array
    old_log_prob: Steps
    advantage: Steps | None
    returns: Steps


def prepared(
    config: PPOConfig, networks: Networks, state: PPOState, steps: Transition, ended: Steps
) -> tuple[Batch, Float[Array, "3"]]:
    """A rollout by the parameters that made it, and the agent's sums over all returns so far.

    With `advantages="monte_carlo"` returns are normalised, and the advantage is that over the value
    which the critic has in each Adam step (`docs/reference.md` 4.5). With `"gae"` the advantages
    are generalised ones, of rewards that `normalize_rewards` divides by the std of returns.
    """
    hp, tree, sums = state.hparams, networks.unflatten(state.params), state.return_sums
    old_log_prob, _, value = networks.evaluate(tree, steps.obs, steps.action)
    if config.advantages == "monte_carlo":
        returns = normalized(discounted_returns(steps.reward, ended, hp.discount))
        return Batch(steps.obs, steps.action, old_log_prob, None, returns), sums
    decay, reward = hp.discount * steps.discount, steps.reward
    if config.normalize_rewards:
        sums = sums + power_sums(discounted_sums(reward, decay, ended))
        reward = reward / std_of(sums)
    next_value = networks.critic(tree, steps.next_obs)
    advantage = generalized_advantages(reward, decay, ended, value, next_value, hp.gae_lambda)
    return Batch(steps.obs, steps.action, old_log_prob, advantage, advantage + value), sums


def make_learning_phase(
    config: PPOConfig,
    networks: Networks,
    optimizer: optax.GradientTransformation,
    obs_dim: int,
    is_discrete: bool,
) -> Callable[[Array, PPOState, Rollout], PPOState]:
    """Builds `learn(key, state, rollout) -> state`, a learning phase.

    It passes `config.epochs` times over the rollout, each time in `config.num_minibatches` Adam
    steps. A rollout that these do not divide leaves some steps out of each pass.
    """

    def loss_fn(tree: PyTree, batch: Batch, hp: PPOHparams) -> Array:
        log_prob, entropy, value = networks.evaluate(tree, batch.obs, batch.action)
        if batch.advantage is None:
            advantage = jax.lax.stop_gradient(batch.returns - value)
        else:
            advantage = normalized(batch.advantage)
        return ppo_loss(log_prob, entropy, value, batch.old_log_prob, advantage, batch.returns, hp)

    def learn(key: Array, state: PPOState, rollout: Rollout) -> PPOState:
        hp = state.hparams
        steps = rollout.transitions(obs_dim, is_discrete)
        batch, return_sums = prepared(config, networks, state, steps, rollout.ended)
        order = shuffled(key, config.epochs, config.num_minibatches, batch.returns.size)

        def adam_step(
            number: Array, carry: tuple[Array, optax.OptState]
        ) -> tuple[Array, optax.OptState]:
            params, opt_state = carry
            minibatch = batch
            if config.num_minibatches > 1:
                minibatch = jax.tree.map(lambda x: x[..., order[number]], batch)
            gradient = jax.grad(loss_fn)(networks.unflatten(params), minibatch, hp)
            direction: Any
            direction, opt_state = optimizer.update(flat.flatten(gradient), opt_state)
            moved = params - hp.learning_rate * direction
            return jnp.maximum(moved, networks.least_params), opt_state

        num_updates = config.epochs * config.num_minibatches
        params, opt_state = jax.lax.fori_loop(
            0, num_updates, adam_step, (state.params, state.opt_state)
        )
        return state.replace(params=params, opt_state=opt_state, return_sums=return_sums)

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
    counter = jax.random.bits(key) + jnp.arange(epochs * num_steps, dtype=jnp.uint32)
    bits = murmur(counter).reshape(epochs, num_steps)
    mask = jnp.uint32((1 << (num_steps - 1).bit_length()) - 1)
    order = jax.lax.sort(bits & ~mask | jnp.arange(num_steps, dtype=jnp.uint32)) & mask
    return order[:, : num_minibatches * size].reshape(-1, size).astype(jnp.int32)


def generalized_advantages(
    reward: Steps,
    decay: Steps,
    ended: Steps,
    value: Steps,
    next_value: Steps,
    gae_lambda: Array | float,
) -> Steps:
    r"""Advantages :math:`A_t = \delta_t + \gamma_t \lambda A_{t+1}` within each episode.

    .. math:: \delta_t = r_t + \gamma_t V(s'_t) - V(s_t)

    At a time limit, and where the rollout is cut, the critic's value of the next state stands for
    what would have come.

    Args:
      reward: in units of the critic's values.
      decay: gamma times the transition's own discount, which is 0 where the episode terminated.
      ended: 1 at the last step of an episode, terminated or truncated, else 0.
      value: V(s).
      next_value: V(s').
      gae_lambda: lambda; 0 has the least variance, 1 the least bias.

    Source: Schulman et al. (2016), eq. 11 to 16.
    """
    delta = reward + decay * next_value - value
    return discounted_sums(delta, gae_lambda * decay, ended)


def power_sums(x: Steps) -> Float[Array, "3"]:
    """How many numbers there are, their sum, and that of their squares."""
    return jnp.stack([jnp.float32(x.size), jnp.sum(x), jnp.sum(x**2)])


def std_of(power_sums: Float[Array, "3"]) -> Float[Array, ""]:
    """Standard deviation, and at least 1e-4, which leaves rewards finite that are always 0."""
    count, total, squares = power_sums
    return jnp.sqrt(jnp.maximum(squares / count - (total / count) ** 2, 1e-8))


def discounted_returns(reward: Steps, ended: Steps, discount: Array | float) -> Steps:
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


def discounted_sums(x: Steps, decay: Steps, ended: Steps) -> Steps:
    """Sums :math:`y_t = x_t + decay_t y_{t+1}` within each episode."""

    def step(later: Array, terms: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        x, decay, ended = terms
        now = x + decay * jnp.where(ended > 0.5, 0.0, later)
        return now, now

    return jax.lax.scan(step, jnp.float32(0), (x, decay, ended), reverse=True)[1]


def normalized(x: Steps) -> Steps:
    """Numbers with mean 0 and std 1, the std being the unbiased estimate plus 1e-5."""
    std = jnp.std(x, ddof=min(1, x.shape[0] - 1))
    return (x - jnp.mean(x)) / (std + 1e-5)


def ppo_loss(
    log_prob: Steps,
    entropy: Steps,
    value: Steps,
    old_log_prob: Steps,
    advantage: Steps,
    returns: Steps,
    hp: PPOHparams,
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
