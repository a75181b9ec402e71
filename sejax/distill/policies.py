"""Policies that `python -m sejax.distill` is given, and their copies in the form of an exact SE.

A policy is a model of Stable-Baselines3, a function, or an agent of sejax. Its copy, affine maps
with ReLUs between, is fitted to the policy's actions in states that both visit. In each round the
copy plays episodes, each with another emulated error. The policy says what it would have done
there, and the copy is fitted to all states so far. So they include states that a rough student
gets into.

Source: Ross et al., "A reduction of imitation learning and structured prediction to no-regret
online learning" (DAgger, 2011). The emulated error is ours.
"""

import functools
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pandas as pd
from jaxtyping import Array, PyTree

from sejax import options
from sejax.agents import make_agent
from sejax.distill.policy_search import Arrays, Lesson, random_map
from sejax.envs.base import Task
from sejax.options import Count, Options, WholeNumber, registry, require, shortened
from sejax.options.plain import configure
from sejax.proxies.exact import Layer, forward
from sejax.runs.store import Store
from sejax.training import TrainingConfig, make_trainer

# Observations [state, obs_dim] to actions [state] or [state, action_dim], of NumPy.
Actor = Callable[[np.ndarray], np.ndarray]
Scale = tuple[np.ndarray, np.ndarray]  # mean and deviation, which whiten observations
FIX = "Set policy=ppo:FILE.zip (Stable-Baselines3), module:function, or an agent such as ppo."
_POLICY_ERROR = 0.1  # of a copy in an episode, root mean square in units of the action's bound
_BATCH_SIZE, _LEARNING_RATE = 256, 3e-3  # of the fit, by Adam
_OVERSHOOT = 0.05  # weight of outputs beyond the bounds, where clipping has no slope


@dataclass(frozen=True, kw_only=True)
class CopyConfig(Options):
    """How a policy is copied.

    Attributes:
      hidden_size: ReLUs; 0: a linear copy
      episodes: episodes of a round
      steps: steps of Adam in each round
      agent_steps: training steps on the real task, if `policy` names an agent
    """

    group: ClassVar[str] = "copy"

    hidden_size: WholeNumber = 32
    rounds: Count = 4
    episodes: Count = 8
    steps: Count = 5000
    agent_steps: Count = 100_000


# --- what the user names --------------------------------------------------------------------------


def policy_of(text: str, task: Task, agent_steps: int, key: Array) -> Actor:
    """The policy that an override names.

    Args:
      text: `ALGORITHM:FILE.zip`, a model of Stable-Baselines3; `module:function`, of observations
        `[state, obs_dim]` to actions; or the name of an agent, which is trained.
      task: the real task.
      agent_steps: steps on the real task for which an agent trains.
      key: the key of this training.

    Raises:
      ConfigError: for anything else. When the policy is called: if it fails, or if the task does
        not have its actions.
    """
    if registry.is_registered("agent", text):
        return _of_agent(text, task, agent_steps, key)
    if text.endswith(".zip"):
        return _checked(_of_sb3(text, task), task)
    require(":" in text, "policy", "must be a model or a function", got=text, fix=FIX)
    return _checked(registry.imported("policy", text), task)


def _checked(act: Actor, task: Task) -> Actor:
    """The policy, with checks of its actions; continuous ones are clipped to their bounds."""
    count = task.num_actions
    expected = "finite numbers" if count is None else f"whole numbers from 0 to {count - 1}"

    def checked(obs: np.ndarray) -> np.ndarray:
        shape = (len(obs), task.action_dim) if count is None else (len(obs),)
        with options.foreign_code("policy", f"must act in {task.name}; it"):
            actions = np.asarray(act(obs), float)
        known = np.isfinite(actions) if count is None else np.isin(actions, np.arange(count))
        got = f"{list(actions.shape)}, such as {actions.ravel()[:3]}"
        is_fit = actions.shape == shape and known.all()
        require(is_fit, "policy", f"must give {expected} of the shape {list(shape)}", got=got)
        return actions if count is not None else actions.clip(-task.max_action, task.max_action)

    return checked


def _of_sb3(text: str, task: Task) -> Actor:
    name, _, path = text.partition(":")
    try:
        import stable_baselines3

        model = getattr(stable_baselines3, name.upper()).load(path, device="cpu")
    except Exception as error:  # of any kind: the file, the algorithm or the library
        got = f"{shortened(text)} ({options.told(error)}). It needs pip install '.[sb3]'"
        rule = f"must be a model that its algorithm saved; got {got}"
        raise options.ConfigError("policy", rule, fix=FIX) from error
    # sejax scales actions to [-1, 1] if their bounds differ between dimensions.
    space = model.action_space
    is_discrete = task.num_actions is not None
    is_fit = hasattr(space, "n") == is_discrete
    require(is_fit, "policy", f"must have the actions of {task.name}", got=space, fix=FIX)
    low, high = np.asarray((-1, 1) if is_discrete else (space.low, space.high), float)
    factor = 2 * task.max_action / (high - low)
    return lambda obs: (model.predict(obs, deterministic=True)[0] - (low + high) / 2) * factor


def _of_agent(name: str, task: Task, num_steps: int, key: Array) -> Actor:
    """A fresh agent with its default hyperparameters, trained on the real task."""
    with options.errors_of("agent", "policy"):  # it may not fit the task
        agent = make_agent(configure("agent", {"name": name}), task)
    training = TrainingConfig(max_steps=num_steps, max_episodes=num_steps)
    key_train, key_act = jax.random.split(key)
    print(f"training a {name} on {task.name} for {num_steps:,} steps ...", flush=True)
    state = jax.jit(make_trainer(agent, task.env, training))(key_train, task.params).agent_state
    act = functools.partial(agent.act, key_act, state, explore=False)
    return jax.jit(jax.vmap(lambda obs: agent.env_action(act(obs))))


# --- copies ---------------------------------------------------------------------------------------


def copy_policy(
    config: CopyConfig, task: Task, policy: str, keys: Mapping[str, Array], store: Store
) -> tuple[list[Lesson], pd.DataFrame]:
    """The copy of a policy as the only lesson, and a row of its costs: `real_steps` and `cpu_s`.

    Args:
      config: form and effort.
      task: the real task.
      policy: see `policy_of`.
      keys: `search`, for training an agent; `record`, for episodes, errors and fits.
      store: where the copy of an agent is kept; the code of a function or a model may change.
    """
    compute = functools.partial(_copy, config, task, policy, keys)
    copied = store.once("copy", compute) if registry.is_registered("agent", policy) else compute()
    num_layers = 1 + (config.hidden_size > 0)
    layers = [(copied[f"kernel{i}"], copied[f"bias{i}"]) for i in range(num_layers)]
    costs = pd.DataFrame({name: [copied[name].item()] for name in ("real_steps", "cpu_s")})
    return [Lesson(0, layers, copied["states"], copied["policy_return"].item())], costs


def _copy(config: CopyConfig, task: Task, policy: str, keys: Mapping[str, Array]) -> Arrays:
    """The copy's layers, the states that the policy visits, its return, and the costs, by name."""
    started = time.process_time()
    act = policy_of(policy, task, config.agent_steps, keys["search"])
    # One key is unused: without it the numbers of stored proxies would change.
    key, key_visit, _, key_fit = jax.random.split(keys["record"], 4)
    policy_states, policy_return = visit(task, act, key_visit, config.episodes)
    scale = policy_states.mean(0), np.maximum(policy_states.std(0), 1e-2)
    states, actions = policy_states, act(policy_states)
    layers = fit(config, task, states, actions, scale, key_fit)
    for _ in range(config.rounds - 1):
        key, key_visit, key_error, key_fit = jax.random.split(key, 4)
        rough = erring(task, layers, policy_states, key_error, config.episodes)
        visited, _ = visit(task, rough, key_visit, config.episodes)
        states = np.concatenate([states, visited])
        actions = np.concatenate([actions, act(visited)])
        layers = fit(config, task, states, actions, scale, key_fit)
    tested, copy_return = visit(task, acting(task, layers), key, config.episodes)
    print(f"policy {policy_return:.1f}, its copy {copy_return:.1f}", flush=True)
    agent_steps = config.agent_steps if registry.is_registered("agent", policy) else 0
    real_steps = len(states) + len(tested) + agent_steps
    costs = {"real_steps": real_steps, "cpu_s": time.process_time() - started}
    values = costs | {"states": policy_states, "policy_return": policy_return}
    for i, (kernel, bias) in enumerate(layers):
        values |= {f"kernel{i}": kernel, f"bias{i}": bias}
    return {name: np.asarray(value) for name, value in values.items()}


def acting(task: Task, layers: Sequence[Layer], error: Actor = lambda obs: np.zeros(1)) -> Actor:
    """The actor of a policy of affine maps and ReLUs: the best action, or the outputs clipped.

    The `error` is added to the outputs, `[state, action_dim]`.
    """

    def act(obs: np.ndarray) -> np.ndarray:
        outputs = forward(layers, obs) + error(obs)
        if task.num_actions is not None:
            return outputs.argmax(axis=1)
        return outputs.clip(-task.max_action, task.max_action)

    return act


def erring(
    task: Task, layers: Sequence[Layer], states: np.ndarray, key: Array, episodes: int
) -> Actor:
    """A policy with an error that is linear in the observation, another error in each episode.

    Args:
      task: the real task.
      layers: the policy.
      states: states that the policy visits. Their mean and deviation whiten the observations that
        an error is linear in. Its unit is the action's bound; for discrete actions, the deviation
        of the policy's outputs in these states.
      key: the key of the errors.
      episodes: number of episodes, which are played side by side.
    """
    mean, std = states.mean(0), np.maximum(states.std(0), 1e-2)
    unit = task.max_action
    if task.num_actions is not None:
        unit = float(forward(layers, states).std()) + 1e-9
    maps = np.asarray(random_map(key, (episodes, task.action_dim, task.obs_dim + 1)))

    def error(obs: np.ndarray) -> np.ndarray:
        whitened = np.concatenate([(obs - mean) / std, np.ones((len(obs), 1))], axis=1)
        return np.asarray(_POLICY_ERROR * unit * np.einsum("eij,ej->ei", maps, whitened))

    return acting(task, layers, error)


def visit(task: Task, act: Actor, key: Array, episodes: int) -> tuple[np.ndarray, float]:
    """All observations `[state, obs_dim]` of whole episodes side by side, and the mean return.

    The actor may be of any library.
    """
    reset, step = _stepper(task)
    dtype = np.int32 if task.num_actions is not None else np.float32
    key_reset, key_steps = jax.random.split(key)
    obs, state = reset(jax.random.split(key_reset, episodes))
    active = np.ones(episodes, bool)
    returns = np.zeros(episodes)
    seen = []
    for i in range(task.max_steps):
        seen.append(np.asarray(obs)[active])
        action = np.asarray(act(np.asarray(obs))).astype(dtype)
        keys = jax.random.split(jax.random.fold_in(key_steps, i), episodes)
        obs, state, reward, is_over = step(keys, state, action)
        returns += np.where(active, np.asarray(reward, float), 0.0)
        active &= ~np.asarray(is_over)
        if not active.any():
            break
    return np.concatenate(seen), float(returns.mean())


@functools.cache
def _stepper(task: Task) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Two compiled functions: the resets of many episodes, and a step of each."""
    env, params = task.env, task.params
    reset = jax.jit(jax.vmap(lambda key: env.reset_env(key, params)))

    def step(key: Array, state: PyTree, action: Array) -> tuple[Array, PyTree, Array, Array]:
        obs, state, reward, terminated, _ = env.step_env(key, state, action, params)
        return obs, state, reward, terminated | env.is_truncated(state, params)

    return reset, jax.jit(jax.vmap(step))


def fit(
    config: CopyConfig, task: Task, obs: np.ndarray, actions: np.ndarray, scale: Scale, key: Array
) -> list[Layer]:
    """A copy that is fitted to a policy's actions in some states.

    The loss is the squared error after clipping for continuous actions, the cross-entropy for
    discrete actions.
    """
    is_discrete = task.num_actions is not None
    mean, std = scale
    inputs = jnp.asarray((obs - mean) / std, jnp.float32)
    targets = jnp.asarray(actions / task.max_action, jnp.int32 if is_discrete else jnp.float32)
    key_init, key_fit = jax.random.split(key)
    sizes = [n for n in (task.obs_dim, config.hidden_size, task.action_dim) if n > 0]
    keys = jax.random.split(key_init, len(sizes) - 1)
    params = []
    for k, (n_in, n_out) in zip(keys, itertools.pairwise(sizes), strict=True):
        params.append((jax.random.normal(k, (n_out, n_in)) * n_in**-0.5, jnp.zeros(n_out)))
    optimiser = optax.adam(optax.cosine_decay_schedule(_LEARNING_RATE, config.steps))

    def loss(params: PyTree, key: Array) -> Array:
        rows = jax.random.randint(key, (_BATCH_SIZE,), 0, len(inputs))
        outputs, wanted = forward(params, inputs[rows]), targets[rows]
        if is_discrete:
            return optax.softmax_cross_entropy_with_integer_labels(outputs, wanted).mean()
        clipped = jnp.clip(outputs, -1.0, 1.0)
        # An output beyond the wrong bound gets no slope through clipping: tanh pulls it back.
        pull = 0.1 * (jnp.tanh(outputs) - wanted) ** 2
        return jnp.mean((clipped - wanted) ** 2 + _OVERSHOOT * (outputs - clipped) ** 2 + pull)

    def step(carry: PyTree, key: Array) -> tuple[Any, None]:
        params, state = carry
        updates, state = optimiser.update(jax.grad(loss)(params, key), state)
        return (optax.apply_updates(params, updates), state), None

    keys = jax.random.split(key_fit, config.steps)
    run = jax.jit(lambda *carry: jax.lax.scan(step, carry, keys)[0][0])
    fitted = run(params, optimiser.init(params))
    layers = [(np.asarray(k, float), np.asarray(b, float)) for k, b in fitted]
    kernel, bias = layers[0]
    layers[0] = (kernel / std, bias - (kernel / std) @ mean)
    kernel, bias = layers[-1]
    layers[-1] = (task.max_action * kernel, task.max_action * bias)
    return layers
