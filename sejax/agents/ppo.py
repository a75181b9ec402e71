"""PPO with a clipped ratio, for discrete and for continuous actions.

There are two ways to prepare a rollout (`PPOConfig.advantages`): `gae`, the usual generalised
advantages, and `monte_carlo`, the returns of the paper's code. The paper's code learns from the
whole rollout in each Adam step (`preset=paper`). All else is the same.

Without exploration the agent takes its most probable action. Differs: the authors also test with
sampled actions (`docs/reference.md` 3.7). They do not clip actions, so that MountainCarContinuous
charges for the action as drawn. The policy delay in the paper's table for PPO has no counterpart in
their code, nor here.

Source: Schulman et al., "Proximal Policy Optimization Algorithms" (2017); Schulman et al.,
"High-Dimensional Continuous Control Using Generalized Advantage Estimation" (2016); the paper's
appendix, table of PPO; `docs/reference.md` 4.5.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, PyTree

from sejax.agents.base import Agent, AgentOptions, AgentSpec, Algorithm, Hparams
from sejax.agents.buffers import BufferMaker, Rollout, Transition, rollout_buffer
from sejax.agents.policies import value_of_action
from sejax.envs.base import Task
from sejax.ops import cpu
from sejax.ops.keys import murmur
from sejax.ops.networks import MLP, init_narrowed
from sejax.ops.optimizers import clip_by_global_norm, scale_by_adam
from sejax.ops.scores import Moments, merged_moments
from sejax.options import Activation, Count, Depth, Fraction, NonNegative, Positive, option, require

PerStep = Float[Array, " steps"]  # of a rollout, or of a minibatch of it
Moved = tuple[PyTree, optax.OptState]  # parameters, and the optimizer's state

MIN_STD = 0.01  # of the Gaussian policy, in units of the action
_MAX_LOG_RATIO = 20.0  # exp(20) is beyond any clip, and finite however far the policy has moved


@dataclass(frozen=True, kw_only=True)
class PPOConfig(AgentOptions):
    """PPO (clip) for discrete and continuous actions.

    The defaults learn from few steps (`docs/agents.md`). The paper's PPO is that of
    `env=mountain_car_continuous proxy=rn preset=paper`; see `docs/reference.md` 4.5.

    Attributes:
      warmup_episodes: Episodes before a stop rule may judge; a full rollout is learned from.
      rollout_steps: Decisions between two learning phases; null: as `update_episodes` says.
      update_episodes: episodes of full length between two learning phases
      epochs: passes over the rollout in a learning phase
      num_minibatches: Adam steps in an epoch, each on one part of the rollout
      gae_lambda: lambda of advantages=gae
      normalize_rewards: Divides rewards by the running std of returns, with advantages=gae.
      max_grad_norm: A gradient with a larger norm is scaled down to this norm.
      init_action_std: Initial std of the Gaussian policy, which is learned.
    """

    actions: ClassVar[tuple[str, ...]] = ("discrete", "continuous")

    hidden_size: Count = option(64, varied="triple")
    num_layers: Depth = option(2, varied="one_more_or_less")
    activation: Activation = "tanh"
    learning_rate: Positive = option(2e-3, traced=True, varied="triple")
    discount: Fraction = option(0.99, traced=True)
    rollout_steps: Count | None = 128
    update_episodes: Count = 10
    epochs: Count = 10
    num_minibatches: Count = 4
    advantages: Literal["monte_carlo", "gae"] = "gae"
    gae_lambda: Fraction = option(0.9, traced=True)
    clip_ratio: Positive = option(0.1, traced=True)
    value_weight: NonNegative = option(0.5, traced=True)
    entropy_weight: NonNegative = option(0.01, traced=True)
    normalize_rewards: bool = True
    max_grad_norm: Positive | None = 0.5
    adam_eps: Positive = 1e-5
    init_action_std: Positive = 0.5
    action_repeat: Count = 1

    def make(self, task: Task) -> Agent:
        """The agent for a task's observations and actions."""
        sizes = task.obs_dim, task.action_dim, self.rollout_length(task.max_steps)
        if task.num_actions is not None:
            return PPO(self, *sizes).agent()
        return ContinuousPPO(self, *sizes, task.max_action).agent()

    def rollout_length(self, task_max_steps: int) -> int:
        """Decisions between two learning phases: `rollout_steps`, if that is set.

        The authors learn as soon as (decisions x `action_repeat`) / `task_max_steps` exceeds
        `update_episodes`, also in the middle of an episode. This is the smallest such number of
        decisions.

        Source: `docs/reference.md` 4.5.
        """
        if self.rollout_steps is not None:
            return self.rollout_steps
        return self.update_episodes * task_max_steps // self.action_repeat + 1

    def steps_before_learning(self, max_episode_steps: int, task_max_steps: int) -> int:
        """PPO learns once a rollout is full; the task's limit decides its length."""
        return self.rollout_length(task_max_steps) * min(self.action_repeat, max_episode_steps)

    def spec(self) -> AgentSpec:
        # It learns from the start; `warmup_episodes` only holds back the stop rule.
        # A rollout of `update_episodes` counts as long.
        is_small = self.rollout_steps is not None and (
            self.hidden_size * (self.rollout_steps // self.num_minibatches) <= cpu.SMALL_PRODUCT
        )
        return AgentSpec(
            stops_from=self.warmup_episodes,
            action_repeat=self.action_repeat,
            cpu_num_parallel=cpu.SMALL_NUM_PARALLEL if is_small else 1,
        )


class PPOState(struct.PyTreeNode):
    """One agent. `params` are `{"actor", "critic", "std"}`."""

    params: dict[str, PyTree]
    opt_state: optax.OptState
    return_moments: Moments  # of all returns, see `merged_moments`; 0 if unused
    hparams: Hparams


class Batch(NamedTuple):
    """A rollout or a minibatch of it, as a learning phase uses it. The last axis is steps.

    Attributes:
      old_log_prob: of the actions when the rollout was made, in nats.
      advantage: of the actions; None for `returns` minus the critic's current value.
      returns: targets of the critic.
    """

    obs: Float[Array, "obs_dim steps"]
    action: Array
    old_log_prob: PerStep
    advantage: PerStep | None
    returns: PerStep


@dataclass(eq=False)
class PPO(Algorithm):
    """The agent for observations `[obs_dim]` and actions `0..num_actions-1`.

    Parameters have the keys actor, critic and std. The actor's outputs are logits.

    Args:
      config: hyperparameters.
      obs_dim: length of an observation.
      action_dim: number of the actor's outputs: of actions, or the length of a continuous one.
      length: decisions between two learning phases.
      max_action: the largest continuous action; None for discrete ones.

    Raises:
      ConfigError: if a rollout has fewer than two steps for each minibatch.

    Example:
      >>> agent = PPO(PPOConfig(), obs_dim=4, action_dim=2, length=128).agent()
      >>> state = agent.init(jax.random.key(0), agent.hparams)
      >>> int(agent.act(jax.random.key(1), state, jnp.zeros(4), explore=True)) in (0, 1)
      True
    """

    config: PPOConfig
    obs_dim: int
    action_dim: int
    length: int
    max_action: float | None = None

    def __post_init__(self) -> None:
        config = self.config
        number = config.num_minibatches
        most = max(1, self.length // 2)
        rule = f"must be at most half of the rollout's {self.length} steps"
        require(number <= most, "agent.num_minibatches", rule, got=number, use=most)
        hidden = (config.hidden_size, config.num_layers, config.activation)
        self.actor = MLP(self.action_dim, *hidden, learn_prelu_slope=True)
        self.critic = MLP(1, *hidden, learn_prelu_slope=True)
        self.std_dim = 0 if self.max_action is None else self.action_dim
        self.optimizer = scale_by_adam(config.adam_eps)
        if config.max_grad_norm is not None:
            self.optimizer = optax.chain(clip_by_global_norm(config.max_grad_norm), self.optimizer)

    def buffer(self) -> BufferMaker:
        return rollout_buffer(self.length)

    def init(self, key: Array, hparams: Hparams) -> PPOState:
        key_actor, key_critic = jax.random.split(key)
        size = hparams.hidden_size
        params = {
            "actor": init_narrowed(self.actor, key_actor, self.obs_dim, size),
            "critic": init_narrowed(self.critic, key_critic, self.obs_dim, size),
            "std": jnp.full(self.std_dim, self.config.init_action_std, jnp.float32),
        }
        return PPOState(
            params=params,
            opt_state=self.optimizer.init(params),
            return_moments=(jnp.zeros(()),) * 3,
            hparams=hparams,
        )

    def act(self, key: Array, state: PPOState, obs: Array, explore: bool) -> Array:
        outputs = cast(Array, self.actor.apply(state.params["actor"], obs))
        return self.sample(key, outputs, state.params["std"]) if explore else self.best(outputs)

    def value(self, params: PyTree, obs: Array) -> PerStep:
        """The critic's values."""
        return cast(Array, self.critic.apply(params["critic"], obs))[0]

    def evaluate_actions(
        self, params: PyTree, obs: Array, action: Array
    ) -> tuple[PerStep, PerStep, PerStep]:
        """The actions' log probabilities, the entropies and the values."""
        outputs = cast(Array, self.actor.apply(params["actor"], obs))
        log_prob, entropy = self.probabilities(outputs, params["std"], action)
        return log_prob, entropy, self.value(params, obs)

    def update(self, key: Array, state: PPOState, batch: Rollout) -> PPOState:
        """A learning phase.

        It passes `config.epochs` times over the rollout, each time in `config.num_minibatches` Adam
        steps. If this number does not divide the rollout, each pass leaves some steps out.
        """
        config = self.config
        hp = state.hparams
        steps = batch.transitions(self.obs_dim, is_discrete=self.std_dim == 0)
        rollout, return_moments = self.prepared(state, steps, batch.ended)
        order = shuffled(key, config.epochs, config.num_minibatches, rollout.returns.size)

        def minibatch_step(number: Array, carry: Moved) -> Moved:
            params, opt_state = carry
            minibatch = rollout
            if config.num_minibatches > 1:
                minibatch = jax.tree.map(lambda x: x[..., order[number]], rollout)
            gradient = jax.grad(self.loss)(params, minibatch, hp)
            directions, opt_state = self.optimizer.update(gradient, opt_state)
            params = jax.tree.map(lambda x, dx: x - hp.learning_rate * dx, params, directions)
            return params | {"std": jnp.maximum(params["std"], MIN_STD)}, opt_state

        num_updates = config.epochs * config.num_minibatches
        params, opt_state = jax.lax.fori_loop(
            0, num_updates, minibatch_step, (state.params, state.opt_state)
        )
        return state.replace(params=params, opt_state=opt_state, return_moments=return_moments)

    def prepared(self, state: PPOState, steps: Transition, ended: PerStep) -> tuple[Batch, Moments]:
        r"""A rollout, evaluated by the parameters that made it, and moments of all returns.

        With `advantages="monte_carlo"` returns are normalised. The advantage is the return minus
        the critic's value in each Adam step (`docs/reference.md` 4.5). Nothing is bootstrapped: an
        episode counts as over at a time limit and at the end of the rollout. Differs: the authors
        restart the sums where the stored `done` exceeds 0.5. In an SE it does not at a time limit,
        and their returns run on into the next episode.

        With `"gae"` advantages are generalised. With `normalize_rewards` the rewards are first
        divided by the std of returns:

        .. math::
          A_t &= \delta_t + \gamma_t \lambda A_{t+1}, \quad
          \delta_t = r_t + \gamma_t V(s'_t) - V(s_t)

        within each episode. :math:`\gamma_t` is gamma times the transition's own discount, which is
        0 where the episode terminated. At a time limit, and at the end of the rollout, the critic's
        value of the next state stands for the missing rewards.

        Source: Schulman et al. (2016), eq. 11 to 16.
        """
        hp = state.hparams
        moments = state.return_moments
        old_log_prob, _, value = self.evaluate_actions(state.params, steps.obs, steps.action)
        if self.config.advantages == "monte_carlo":
            decay = jnp.broadcast_to(hp.discount, ended.shape)
            returns = normalized(discounted_sums(steps.reward, decay, ended))
            return Batch(steps.obs, steps.action, old_log_prob, None, returns), moments
        decay = hp.discount * steps.discount
        reward = steps.reward
        if self.config.normalize_rewards:
            returns = discounted_sums(reward, decay, ended)
            squares = jnp.sum((returns - returns.mean()) ** 2)
            moments = merged_moments(moments, (jnp.float32(returns.size), returns.mean(), squares))
            reward = reward * (1 / std_of(moments))
        delta = reward + decay * self.value(state.params, steps.next_obs) - value
        advantage = discounted_sums(delta, hp.gae_lambda * decay, ended)
        return Batch(steps.obs, steps.action, old_log_prob, advantage, advantage + value), moments

    def loss(self, params: PyTree, batch: Batch, hp: Hparams) -> Float[Array, ""]:
        r"""What a learning phase minimises.

        .. math:: -\overline{\min(\rho A, \mathrm{clip}(\rho, 1-\epsilon, 1+\epsilon) A)}
           + c_V \overline{(V - R)^2} - c_H \overline{H}

        with the ratio :math:`\rho` of the new to the old probability, the clip_ratio
        :math:`\epsilon`, and the weights :math:`c_V` and :math:`c_H` of the value and the entropy.

        Source: Schulman et al. (2017), eq. 7 and 9; `docs/reference.md` 4.5.
        """
        log_prob, entropy, value = self.evaluate_actions(params, batch.obs, batch.action)
        if batch.advantage is None:
            advantage = jax.lax.stop_gradient(batch.returns - value)
        else:
            advantage = normalized(batch.advantage)
        log_ratio = jnp.clip(log_prob - batch.old_log_prob, -_MAX_LOG_RATIO, _MAX_LOG_RATIO)
        ratio = jnp.exp(log_ratio)
        clipped = jnp.clip(ratio, 1 - hp.clip_ratio, 1 + hp.clip_ratio)
        surrogate = jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
        value_error = jnp.mean((value - batch.returns) ** 2)
        return -surrogate + hp.value_weight * value_error - hp.entropy_weight * jnp.mean(entropy)

    # Methods that continuous actions override.

    def sample(self, key: Array, outputs: Array, std: Array) -> Array:
        """An action, for one observation."""
        return jax.random.categorical(key, outputs).astype(jnp.int32)

    def best(self, outputs: Array) -> Array:
        """The likeliest action, for one observation."""
        return jnp.argmax(outputs).astype(jnp.int32)

    def probabilities(self, outputs: Array, std: Array, action: Array) -> tuple[PerStep, PerStep]:
        """The logarithms of the actions' probabilities, and the entropies, in nats."""
        log_probs = jax.nn.log_softmax(outputs, axis=0)
        entropy = -jnp.sum(jnp.exp(log_probs) * log_probs, axis=0)
        return value_of_action(log_probs, action), entropy


class ContinuousPPO(PPO):
    """The agent for independent normal actions with mean `max_action * tanh(outputs)`.

    Their std is learned. The rollout keeps actions as drawn; they reach the environment clipped to
    its range.

    Differs: the authors' mean is `tanh(outputs)`, which cannot reach the whole range of a task
    whose largest action is not 1, such as Pendulum. Both stds are in units of the action.

    Source: `docs/reference.md` 4.5.
    """

    max_action: float

    def sample(self, key: Array, outputs: Array, std: Array) -> Array:
        return self.best(outputs) + std * jax.random.normal(key, outputs.shape)

    def best(self, outputs: Array) -> Array:
        return self.max_action * jnp.tanh(outputs)

    def probabilities(self, outputs: Array, std: Array, action: Array) -> tuple[PerStep, PerStep]:
        standardized = (action - self.best(outputs)) * (1 / std)[:, None]
        log_scale = jnp.sum(jnp.log(std) + 0.5 * math.log(2 * math.pi))
        log_prob = -0.5 * jnp.sum(standardized**2, axis=0) - log_scale
        return log_prob, jnp.broadcast_to(log_scale + 0.5 * std.size, log_prob.shape)

    def env_action(self, action: Array) -> Array:
        return jnp.clip(action, -self.max_action, self.max_action)


def shuffled(
    key: Array, epochs: int, num_minibatches: int, num_steps: int
) -> Int[Array, "updates size"]:
    """The steps of each minibatch: each epoch deals out all steps, in random order.

    Each epoch sorts random numbers whose last bits are the number of a step. A sort of single
    numbers takes a fifth of the time of `jax.random.permutation`. The random numbers are
    MurmurHash3's finaliser of counters that start at random.
    """
    size = num_steps // num_minibatches
    counter = jax.random.bits(key) + jnp.arange(epochs * num_steps, dtype=jnp.uint32)
    bits = murmur(counter).reshape(epochs, num_steps)
    mask = jnp.uint32((1 << (num_steps - 1).bit_length()) - 1)
    order = jax.lax.sort(bits & ~mask | jnp.arange(num_steps, dtype=jnp.uint32)) & mask
    return order[:, : num_minibatches * size].reshape(-1, size).astype(jnp.int32)


def std_of(moments: Moments) -> Float[Array, ""]:
    """Standard deviation, at least 1e-4: rewards that are always 0 stay finite when divided."""
    count, _, square = moments
    return jnp.sqrt(jnp.maximum(square / count, 1e-8))


def discounted_sums(x: PerStep, decay: PerStep, ended: PerStep) -> PerStep:
    """Sums :math:`y_t = x_t + decay_t y_{t+1}` within each episode."""

    def step(later: Array, terms: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        x, decay, ended = terms
        now = x + decay * jnp.where(ended > 0.5, 0.0, later)
        return now, now

    return jax.lax.scan(step, jnp.float32(0), (x, decay, ended), reverse=True)[1]


def normalized(x: PerStep) -> PerStep:
    """`x` less its mean, divided by its unbiased std plus 1e-5."""
    std = jnp.std(x, ddof=min(1, x.shape[0] - 1))
    return (x - jnp.mean(x)) * (1 / (std + 1e-5))
