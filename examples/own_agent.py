"""An agent of one's own: SAC, written once more, in one file (sejax's is `agent=sac`).

    python own_agent.py
    python -m sejax.run env=pendulum agent=own_agent:SAC agent.learning_rate=1e-3   # in this folder

The script trains eight agents on Pendulum for 20,000 steps, 20 seconds on four cores:

    test return of each agent: -108 -148 -141 -183 -172 -131 -120 -148
    mean -144

An agent is a `sejax.Agent`, a bundle of pure functions of one agent's state; the inner loop stores
its steps and calls `update` on batches of them. The dataclass makes it configurable: its fields are
options of the command line. Those that are `traced` are numbers that a compiled program can take as
arguments, so that the agents of a population may differ in them.

Source: Haarnoja et al., "Soft Actor-Critic Algorithms and Applications" (2018), algorithm 1.
"""

import argparse
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct
from jax import Array

import sejax
from sejax.agents import AgentOptions, Hparams, Transition, replay_buffer, traced
from sejax.options import Count, Fraction, Positive, option

MIN_LOG_STD, MAX_LOG_STD = -20.0, 2.0
ADAM = optax.scale_by_adam()  # the learning rate, which is traced, is applied below


@dataclass(frozen=True, kw_only=True)
class SAC(AgentOptions):
    """Soft actor-critic with twin critics and an automatic temperature.

    Differs: networks and batches are smaller than the authors' and the learning rate is larger, for
    small tasks. Actions are random in the first `warmup_episodes`, before it learns.
    """

    actions: ClassVar[tuple[str, ...]] = ("continuous",)

    batch_size: Count = 128
    buffer_size: Count = 100_000
    hidden_size: Count = 64
    learning_rate: Positive = option(1e-3, traced=True, varied="triple")
    tau: Fraction = option(0.005, traced=True)
    discount: Fraction = option(0.99, traced=True)

    def make(self, task: sejax.Task) -> sejax.Agent:
        """The agent for a task's observations and actions."""
        networks = Networks(Actor(task.action_dim, self.hidden_size), Critic(self.hidden_size))

        def init(key: Array, hparams: Hparams) -> SACState:
            params = networks.init(key, jnp.zeros(task.obs_dim), jnp.zeros(task.action_dim))
            return SACState(params=params, target_critics=params["critics"],
                            opt_state=ADAM.init(params), is_warming_up=jnp.bool_(True),
                            hparams=jax.tree.map(jnp.float32, hparams))  # fmt: skip

        def begin_episode(state: SACState, episode: Array) -> SACState:
            return state.replace(is_warming_up=episode < self.warmup_episodes)

        def act(key: Array, state: SACState, obs: Array, explore: bool) -> Array:
            key_warm_up, key_noise = jax.random.split(key)
            random = jax.random.uniform(key_warm_up, [task.action_dim], minval=-1.0)
            noise = jax.random.normal(key_noise, [task.action_dim]) if explore else 0.0
            action, _ = networks.action(state.params["actor"], obs, noise)
            return jnp.where(explore & state.is_warming_up, random, action)

        def update(key: Array, state: SACState, batch: Transition) -> SACState:
            shape = (2, *batch.action.shape[::-1])  # [now or next, batch, action_dim]
            noise = jax.random.normal(key, shape)
            return learn(networks, state, batch.rows, noise)

        return sejax.Agent(
            init=init, begin_episode=begin_episode, act=act, update=update, 
            hparams=traced(self),
            buffer=replay_buffer(self.batch_size, self.buffer_size), spec=self.spec(),
            discount=lambda hparams: hparams.discount,
            env_action=lambda action: task.max_action * action,  # remembered in [-1, 1]
        )  # fmt: skip


class SACState(struct.PyTreeNode):
    """One agent. `params` has the keys actor, critics (leaves `[2, ...]`) and log_alpha."""

    params: Any
    target_critics: Any
    opt_state: optax.OptState
    is_warming_up: Array
    hparams: Hparams


def hidden_layers(x: Array, size: int) -> Array:
    for _ in range(2):
        x = nn.relu(nn.Dense(size)(x))
    return x


class Actor(nn.Module):
    """Mean and std of a Gaussian, `[action_dim]` each."""

    action_dim: int
    hidden_size: int

    @nn.compact
    def __call__(self, obs: Array) -> tuple[Array, Array]:
        x = hidden_layers(obs, self.hidden_size)
        mean, log_std = jnp.split(nn.Dense(2 * self.action_dim)(x), 2)
        return mean, jnp.exp(jnp.clip(log_std, MIN_LOG_STD, MAX_LOG_STD))


class Critic(nn.Module):
    """Q of an observation and an action, `[]`."""

    hidden_size: int

    @nn.compact
    def __call__(self, obs: Array, action: Array) -> Array:
        x = hidden_layers(jnp.concatenate([obs, action]), self.hidden_size)
        return nn.Dense(1)(x)[0]


class Networks(NamedTuple):
    """Pure functions of the parameters of an actor and two critics."""

    actor: Actor
    critic: Critic

    def init(self, key: Array, obs: Array, action: Array) -> dict[str, Any]:
        key_actor, key_critics = jax.random.split(key)
        critics = jax.vmap(self.critic.init, (0, None, None))
        return {"actor": self.actor.init(key_actor, obs),
                "critics": critics(jax.random.split(key_critics), obs, action),
                "log_alpha": jnp.zeros(())}  # fmt: skip

    def q_values(self, critics: Any, obs: Array, action: Array) -> Array:
        """Both critics', `[2]`."""
        return jax.vmap(self.critic.apply, (0, None, None))(critics, obs, action)

    def action(self, actor: Any, obs: Array, noise: Array | float) -> tuple[Array, Array]:
        """An action `[action_dim]` in [-1, 1], and the logarithm of its density; appendix C."""
        mean, std = self.actor.apply(actor, obs)
        u = mean + std * noise
        log_normal = -0.5 * noise**2 - jnp.log(std) - 0.5 * jnp.log(2 * jnp.pi)
        log_slope = 2 * (jnp.log(2.0) - u - nn.softplus(-2 * u))  # log(1 - tanh(u)^2), stably
        return jnp.tanh(u), jnp.sum(log_normal - log_slope)


def losses(
    networks: Networks, params: Any, state: SACState, step: Transition, noise: Array
) -> Array:
    """Losses of critics, actor and temperature for one transition, `[3]`; equations 5, 7 and 18.

    Args:
      networks: actor and critic.
      params: to differentiate by. Each loss has a gradient with respect to its own alone.
      state: has the target critics and the hyperparameters.
      step: leaves `[feature]` and `[]`.
      noise: `[2, action_dim]`, standard normal.
    """
    fixed = jax.lax.stop_gradient(params)
    alpha = jnp.exp(fixed["log_alpha"])
    next_action, next_log_p = networks.action(fixed["actor"], step.next_obs, noise[1])
    next_q = jnp.min(networks.q_values(state.target_critics, step.next_obs, next_action))
    target = step.reward + state.hparams.discount * step.discount * (next_q - alpha * next_log_p)
    q_values = networks.q_values(params["critics"], step.obs, step.action)
    action, log_p = networks.action(params["actor"], step.obs, noise[0])
    q = jnp.min(networks.q_values(fixed["critics"], step.obs, action))
    entropy_gap = jax.lax.stop_gradient(-log_p) + action.size  # above the target entropy
    temperature_loss = jnp.exp(params["log_alpha"]) * entropy_gap
    return jnp.array([0.5 * jnp.sum((q_values - target) ** 2), alpha * log_p - q, temperature_loss])


def learn(networks: Networks, state: SACState, batch: Transition, noise: Array) -> SACState:
    """One step of Adam on all losses at once, from the same parameters, as in the authors' code.

    `batch` has a transition in each row; those that only fill it up have weight 0.
    """

    def mean_loss(params: Any) -> Array:
        each = jax.vmap(lambda step, noise: losses(networks, params, state, step, noise), (0, 1))
        return jnp.average(each(batch, noise).sum(axis=1), weights=batch.weight)

    hp = state.hparams
    direction, opt_state = ADAM.update(jax.grad(mean_loss)(state.params), state.opt_state)
    params = jax.tree.map(lambda x, d: x - hp.learning_rate * d, state.params, direction)
    target_critics = optax.incremental_update(params["critics"], state.target_critics, hp.tau)
    return state.replace(params=params, target_critics=target_critics, opt_state=opt_state)


def main() -> None:
    parser = argparse.ArgumentParser(description="Trains SAC agents on Pendulum.")
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--steps", type=int, default=20_000)
    args = parser.parse_args()
    sejax.configure_xla()  # a device for each core
    task = sejax.envs.make("pendulum")
    training = sejax.TrainingConfig(stop_rule="never", max_steps=args.steps, test_episodes=20)
    agent = sejax.make_agent(SAC(), task)
    keys = jax.random.split(jax.random.key(0), args.seeds)
    outcome = sejax.evaluate_agents(agent, task.env, task.params, task, training, keys)
    print("test return of each agent:", *(f"{x:.0f}" for x in outcome.test_return))
    print(f"mean {outcome.test_return.mean():.0f}")


if __name__ == "__main__":
    main()
