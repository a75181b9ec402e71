"""A task: a real environment that agents are tested on, and its spec."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from sejax.envs.environment import Environment, EnvParams, spaces_of
from sejax.envs.spec import Space, TaskSpec, sizes_of
from sejax.envs.wrappers import as_vectors
from sejax.options import Count, as_python, checked, foreign_code, require, shortened


@dataclass(frozen=True, kw_only=True, eq=False)
class Task(TaskSpec):
    """A real task: its spec, and the environment that agents are tested on.

    Agents and networks see vectors. If observations are no `[obs_dim]` float32 vectors, or
    continuous actions do not lie in the same [-x, x] in each dimension, then
    `sejax.envs.wrappers.AsVectors` flattens observations and scales actions to [-1, 1]. Build a
    task once: programs that are compiled for it are cached by its identity.

    Args:
      name: the task's name, in files too.
      env: gymnax 1.x `Environment`. sejax uses `reset_env`, `step_env`, `is_truncated`,
        `action_space`, `observation_space` and `default_params`. Its params have
        `max_steps_in_episode`; its state has `time` for RNs with `zero_at_terminal`. `step_env`
        returns observation, state, reward, terminated and info. `info["discount"]` may give the
        factor of a target's bootstrap value; without it the factor is 1 minus terminated.
      params: its `EnvParams`; the environment's `default_params` if not given.
      solved_reward, info_keys, augmented_keys: see `TaskSpec`.
      max_steps: step limit of an episode; put into `params`, or taken from there if not given.

    Attributes:
      origin: plain values from which `sejax.envs.make` makes the task again. None for a task made
        by hand, which must be passed where agents on a proxy of it are tested.

    Raises:
      ConfigError: for spaces that are neither discrete nor boxes, actions without bounds, and an
        environment that cannot be reset and stepped.

    Example:
      >>> import gymnax
      >>> env, _ = gymnax.make("MountainCar-v0")
      >>> task = Task(name="my_car", env=env, solved_reward=-110.0, max_steps=300)
      >>> task.obs_dim, task.num_actions, task.max_steps
      (2, 3, 300)
    """

    name: str
    env: Environment
    params: EnvParams = None  # type: ignore[assignment]
    max_steps: int = None  # type: ignore[assignment]
    origin: Mapping[str, object] | None = field(init=False, default=None)
    observation: Space = field(init=False)  # from `env`, which `dataclasses.replace` may change
    action: Space = field(init=False)

    def __post_init__(self) -> None:
        solved_reward = as_python(self.solved_reward)
        is_nan = type(solved_reward) in (int, float) and math.isnan(solved_reward)
        is_known = not is_nan and not isinstance(solved_reward, str | None)  # it may be traced
        require(is_known, "env.solved_reward", "must be a number", got=solved_reward, use="inf")
        rule = "must be a gymnax 1.x environment, in JAX"
        fix = "Write env, params = gymnax.make(...)." if isinstance(self.env, tuple) else ""
        with foreign_code("env", f"{rule}; {self.name}"):
            is_env = hasattr(self.env, "step_env") or hasattr(self.env, "default_params")
            require(is_env, "env", rule, got=self.env, fix=fix)
            params = self.env.default_params if self.params is None else self.params
            limit = params.max_steps_in_episode if self.max_steps is None else self.max_steps
            max_steps = checked(limit, Count, "env.max_steps", 200)
            if params.max_steps_in_episode != max_steps:
                params = replace(params, max_steps_in_episode=max_steps)
            require_own_steps(self.env)
            env = as_vectors(self.env, params)
            observation, action = spaces_of(env, params)
            # `make_trainer` asks for the spaces without params: they are those of `default_params`.
            is_same = sizes_of(observation, action) == sizes_of(*spaces_of(env))
            require(is_same, "env", "needs its own default_params", got=self.name)
            if not type(self.env).__module__.startswith(("sejax.", "gymnax.")):
                _check_step(env, params, self.name)  # takes seconds; the others have tests
        vars(self).update(env=env, params=params, max_steps=max_steps)
        vars(self).update(observation=observation, action=action, solved_reward=solved_reward)

    @classmethod
    def of(cls, spec: TaskSpec, *, name: str, env: Environment) -> "Task":
        """The task of an environment that has the spec's spaces."""
        names = ("max_steps", "solved_reward", "info_keys", "augmented_keys")
        return cls(name=name, env=env, **{field: getattr(spec, field) for field in names})


def require_own_steps(env: Environment) -> None:
    """Checks that it is an environment, and no wrapper of gymnax's kind.

    Such a wrapper changes `step`, but its `step_env` is that of the environment in it. sejax calls
    `step_env`, so it would silently leave the wrapper out.

    Raises:
      ConfigError: for a class with `step` and no `step_env`, or `reset` and no `reset_env`, and for
        what has no `step_env`, such as a task.
    """
    rule = "must have reset_env and step_env, as gymnax's have"
    fix = "Derive a wrapper from sejax.envs.wrappers.Wrapper; of a task pass task.env."
    methods = dir(type(env))
    is_whole = all(f"{name}_env" in methods for name in ("reset", "step") if name in methods)
    is_whole &= hasattr(env, "step_env")
    require(is_whole, "env", rule, got=type(env).__name__, fix=fix)


def _check_step(env: Environment, params: EnvParams, name: str) -> None:
    """Traces a step, so that an environment's faults show before an agent trains on it.

    Raises:
      ConfigError: if it returns other shapes or dtypes than the spaces and `reset_env` have.
    """

    def step(key: Array) -> PyTree:
        obs, state = env.reset_env(key, params)
        action = env.action_space(params).sample(key)
        next_obs, next_state, reward, terminated, _ = env.step_env(key, state, action, params)
        env.is_truncated(next_state, params)
        in_space = jnp.zeros(env.observation_space(params).shape, obs.dtype)
        expected = {"obs": in_space, "next_obs": obs, "state": state}
        expected |= {"reward": jnp.float32(0), "terminated": jnp.bool_(False)}
        actual = {"obs": obs, "next_obs": next_obs, "state": next_state}
        return expected, actual | {"reward": jnp.float32(reward), "terminated": terminated}

    def types(tree: PyTree) -> dict[str, str]:
        leaves = jax.tree_util.tree_leaves_with_path(tree)
        flat = {jax.tree_util.keystr(path, simple=True, separator="."): x for path, x in leaves}
        return {name: f"{x.dtype}{list(x.shape)}" for name, x in flat.items()}

    expected, actual = map(types, jax.eval_shape(step, jax.random.key(0)))
    keys = [x for x in expected | actual if expected.get(x) != actual.get(x)]
    faults = [f"{x} is {actual.get(x)}, not {expected.get(x)}" for x in keys]
    rule = f"must keep its shapes; got {name}, where {shortened('; '.join(faults), 120)}"
    require(not faults, "env", rule, fix="Cast in reset_env and step_env what differs.")
    at_limit = getattr(type(env), "is_truncated", Environment.is_truncated)
    if at_limit.__module__.startswith(("sejax.", "gymnax.")):  # else the limit is the user's own
        times = jax.jit(lambda key: [x["state"].time for x in step(key)])(jax.random.key(0))
        is_counted = isinstance(times[0], jax.core.Tracer) or times[0] != times[1]
        require(is_counted, "env", "must add 1 to state.time in step_env", got=name)
