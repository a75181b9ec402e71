"""Copies of policies in the form that an exact SE has: affine maps with ReLUs between.

The copy is fitted to what the policy does in states that both visit. In each round the copy plays,
with an emulated error of its own in each episode, the policy says what it would have done, and the
copy is fitted to all that was seen: states that a rough student gets into are among them.

Source: Ross et al., "A reduction of imitation learning and structured prediction to no-regret
online learning" (DAgger, 2011). The emulated error is ours.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from sejax.distillation.policy_search import random_map
from sejax.envs.base import Task
from sejax.options import Options, counts, not_negative, option, positive
from sejax.proxies.exact import Layer, evaluate

# Observations [episode, obs_dim] to actions [episode] or [episode, action_dim], of NumPy.
Actor = Callable[[np.ndarray], np.ndarray]
_OVERSHOOT = 0.05  # weight of what lies beyond the bounds, where clipping has no slope


@dataclass(frozen=True, kw_only=True)
class CopyConfig(Options):
    """How a policy is copied."""

    group: ClassVar[str] = "copy"

    hidden_size: int = option(
        32, counts("0 is a linear copy", least=0), help="ReLUs; 0: a linear copy"
    )
    rounds: int = option(4, counts("a copy is fitted at least once"))
    episodes: int = option(8, counts("something must be seen"), help="of a round")
    policy_error: float = option(
        0.1,
        not_negative("it is a size"),
        help="Of the copy in an episode, root mean square in units of the action's bound.",
    )
    steps: int = option(5000, counts("a copy is fitted"), help="of Adam in each round")
    batch_size: int = option(256, counts("there is nothing to learn from otherwise"))
    learning_rate: float = option(3e-3, positive("the copy would not move"))


class Copy(NamedTuple):
    """A policy's copy.

    Attributes:
      layers: as of `sejax.proxies.exact`.
      states: that the policy itself visited, `[state, obs_dim]`.
      policy_return: mean return of the policy itself in the episodes of the first round.
      copy_return: that of the copy, without the error, in as many further episodes.
      real_steps: on the real task.
    """

    layers: list[Layer]
    states: np.ndarray
    policy_return: float
    copy_return: float
    real_steps: int


class Visit(NamedTuple):
    """Episodes: all observations `[state, obs_dim]` and the return of each episode."""

    states: np.ndarray
    returns: np.ndarray


def visit(task: Task, act: Actor, key: Array, episodes: int) -> Visit:
    """Plays whole episodes side by side; the actor may be of any library."""
    reset, step = _stepper(task)
    key_reset, key_steps = jax.random.split(key)
    obs, state = reset(jax.random.split(key_reset, episodes))
    active, returns, seen = np.ones(episodes, bool), np.zeros(episodes), []
    for i in range(task.max_steps):
        now = np.asarray(obs)
        seen.append(now[active])
        action = np.asarray(act(now))
        dtype = np.int32 if task.num_actions is not None else np.float32
        keys = jax.random.split(jax.random.fold_in(key_steps, i), episodes)
        obs, state, reward, terminated = step(keys, state, action.astype(dtype))
        returns += np.where(active, np.asarray(reward, float), 0.0)
        active &= ~np.asarray(terminated)
        if not active.any():
            break
    return Visit(np.concatenate(seen), returns)


@functools.cache
def _stepper(task: Task) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compiled: resets of many episodes, and a step of each."""
    env, params = task.env, task.params

    def step(key: Array, state: Any, action: Array) -> tuple[Any, ...]:
        return env.step_env(key, state, action, params)[:4]

    return jax.jit(jax.vmap(lambda key: env.reset_env(key, params))), jax.jit(jax.vmap(step))


def copy_policy(config: CopyConfig, task: Task, policy: Actor, key: Array) -> Copy:
    """Copies a policy.

    Args:
      config: form and effort.
      task: the real task.
      policy: what it does.
      key: of episodes, errors and fits.
    """
    states, actions, found, steps = [], [], None, 0
    first: Visit | None = None
    for _ in range(config.rounds):
        key, key_visit, key_error, key_fit = jax.random.split(key, 4)
        if found is None or first is None:
            seen = first = visit(task, policy, key_visit, config.episodes)
            scale = seen.states.mean(0), np.maximum(seen.states.std(0), 1e-2)
        else:
            act = erring(task, found, first.states, config.policy_error, key_error, config.episodes)
            seen = visit(task, act, key_visit, config.episodes)
        steps += len(seen.states)
        states.append(seen.states)
        actions.append(np.asarray(policy(seen.states)))
        found = fit(config, task, np.concatenate(states), np.concatenate(actions), scale, key_fit)
    assert found is not None and first is not None
    last = visit(task, acting(task, found), key, config.episodes)
    return Copy(
        layers=found,
        states=first.states,
        policy_return=float(first.returns.mean()),
        copy_return=float(last.returns.mean()),
        real_steps=steps + len(last.states),
    )


def acting(task: Task, layers: Sequence[Layer]) -> Actor:
    """What a policy of affine maps and ReLUs does."""

    return lambda obs: actions_of(task, evaluate(layers, obs))


def actions_of(task: Task, outputs: np.ndarray) -> np.ndarray:
    """Actions of a policy's outputs `[state, action_dim]`: the best, or the outputs clipped."""
    if task.num_actions is not None:
        return np.argmax(outputs, axis=-1)
    return np.clip(outputs, -task.max_action, task.max_action)


def erring(
    task: Task,
    layers: Sequence[Layer],
    states: np.ndarray,
    size: float,
    key: Array,
    episodes: int,
) -> Actor:
    """A policy with a random linear error of the observation, another one in each episode.

    Args:
      task: the real task.
      layers: the policy.
      states: that it visits; an error is linear in observations of their mean 0 and variance 1.
      size: of the error, in units of the action's bound; of discrete actions in units of the
        deviation of the policy's outputs in these states.
      key: of the errors.
      episodes: that are played side by side.
    """
    mean, std = states.mean(0), np.maximum(states.std(0), 1e-2)
    unit = task.max_action
    if task.num_actions is not None:
        unit = float(evaluate(layers, states).std()) + 1e-9
    shape = episodes, task.action_dim, task.obs_dim + 1
    error = np.asarray(random_map(key, shape))

    def act(obs: np.ndarray) -> np.ndarray:
        outputs = evaluate(layers, obs)
        whitened = np.concatenate([(obs - mean) / std, np.ones((len(obs), 1))], axis=1)
        wrong = size * unit * np.einsum("eij,ej->ei", error, whitened)
        return actions_of(task, outputs + wrong)

    return act


def fit(
    config: CopyConfig,
    task: Task,
    states: np.ndarray,
    actions: np.ndarray,
    scale: tuple[np.ndarray, np.ndarray],
    key: Array,
) -> list[Layer]:
    """A copy of what a policy does in some states.

    Continuous actions by squared error after clipping, discrete ones by cross-entropy.
    """
    mean, std = scale
    inputs = jnp.asarray((states - mean) / std, jnp.float32)
    targets = jnp.asarray(actions if task.num_actions is not None else actions / task.max_action)
    key_init, key_fit = jax.random.split(key)
    sizes = [task.obs_dim, *[config.hidden_size] * (config.hidden_size > 0), task.action_dim]
    params = [
        (jax.random.normal(k, (n_out, n_in)) * n_in**-0.5, jnp.zeros(n_out))
        for k, n_in, n_out in zip(
            jax.random.split(key_init, len(sizes) - 1), sizes[:-1], sizes[1:], strict=True
        )
    ]
    optimiser = optax.adam(optax.cosine_decay_schedule(config.learning_rate, config.steps))

    def outputs(params: Any, x: Float[Array, "batch inputs"]) -> Array:
        *hidden, (kernel, bias) = params
        for inner, shift in hidden:
            x = jax.nn.relu(x @ inner.T + shift)
        return x @ kernel.T + bias

    def loss(params: Any, key: Array) -> Array:
        places = jax.random.randint(key, (config.batch_size,), 0, len(inputs))
        given, wanted = outputs(params, inputs[places]), targets[places]
        if task.num_actions is not None:
            return optax.softmax_cross_entropy_with_integer_labels(given, wanted).mean()
        clipped = jnp.clip(given, -1.0, 1.0)
        # Beyond a bound that is wrong, clipping has no slope: tanh pulls back.
        pull = 0.1 * (jnp.tanh(given) - wanted) ** 2
        return jnp.mean((clipped - wanted) ** 2 + _OVERSHOOT * (given - clipped) ** 2 + pull)

    @jax.jit
    def run(params: Any, key: Array) -> Any:
        def step(carry: Any, key: Array) -> tuple[Any, None]:
            params, state = carry
            updates, state = optimiser.update(jax.grad(loss)(params, key), state)
            return (optax.apply_updates(params, updates), state), None

        keys = jax.random.split(key, config.steps)
        return jax.lax.scan(step, (params, optimiser.init(params)), keys)[0][0]

    fitted = [(np.asarray(k, float), np.asarray(b, float)) for k, b in run(params, key_fit)]
    kernel, bias = fitted[0]
    fitted[0] = (kernel / std, bias - (kernel / std) @ mean)
    if task.num_actions is None:
        kernel, bias = fitted[-1]
        fitted[-1] = (task.max_action * kernel, task.max_action * bias)
    return fitted
