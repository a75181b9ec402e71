"""A task: a real environment that agents are tested on, and its spec."""

import contextlib
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from sejax import options
from sejax.envs.spec import Space, TaskSpec


@dataclass(frozen=True, kw_only=True, eq=False, init=False)
class Task(TaskSpec):
    """A real task: its spec, and the environment that agents are tested on.

    Agents and networks see vectors: an observation that is no `[obs_dim]` float32 vector is
    flattened, and continuous actions that do not lie in [-x, x] in each dimension are scaled to
    [-1, 1] (`sejax.envs.wrappers.AsVectors`). Build a task once: what is compiled for it is kept by
    identity.

    Args:
      name: what it is called, in files too.
      env: gymnax 1.x `Environment`, of which `reset_env`, `step_env`, `is_truncated`,
        `action_space`, `observation_space` and `default_params` are used; its params have
        `max_steps_in_episode`, its state has `time` for RNs with `zero_at_terminal`. `step_env`
        returns observation, state, reward, terminated and info. A step's `info` may say under
        "discount" what a target bootstraps with; 1 minus terminated if not.
      params: its `EnvParams`; the environment's `default_params` if not given.
      solved_reward, info_keys, augmented_keys: as of `TaskSpec`.
      max_steps: step limit of an episode; put into `params`, or taken from there if not given.
      origin: plain values that `sejax.envs.make` makes it from again; None for one made by hand,
        which must be given to load a proxy of it.

    Raises:
      ConfigError: for an observation or action space that is neither discrete nor a bounded box, or
        an environment that cannot be reset and stepped.

    Example:
      >>> import gymnax
      >>> env, _ = gymnax.make("MountainCar-v0")
      >>> task = Task(name="my_car", env=env, solved_reward=-110.0, max_steps=300)
      >>> task.obs_dim, task.num_actions, task.max_steps
      (2, 3, 300)
    """

    name: str
    env: Any
    params: Any
    origin: dict[str, Any] | None
    observation: Space = field(init=False)  # of `env`, so that `dataclasses.replace` may change it
    action: Space = field(init=False)

    def __init__(
        self,
        *,
        name: str,
        env: Any,
        params: Any = None,
        solved_reward: float = math.inf,
        max_steps: int | None = None,
        info_keys: tuple[str, ...] = (),
        augmented_keys: tuple[str, ...] = (),
        origin: dict[str, Any] | None = None,
    ):
        from sejax.envs.wrappers import as_vectors  # imports JAX

        _require_threshold(solved_reward)
        params = _params_of(env, params, name)
        params, max_steps = _with_limit(params, max_steps)
        with _says_what_it_must_be(name):
            vectors, observation, action = as_vectors(env, params, name)
        if not type(env).__module__.startswith(("sejax.", "gymnax.")):
            _try(vectors, params, name)  # seconds for some, which have tests of their own
        super().__init__(
            observation=observation,
            action=action,
            max_steps=max_steps,
            solved_reward=solved_reward,
            info_keys=info_keys,
            augmented_keys=augmented_keys,
        )
        # As the generated `__init__` of a frozen dataclass does, but all at once.
        vars(self).update(name=name, env=vectors, params=params, origin=origin)

    @classmethod
    def of(cls, spec: TaskSpec, *, name: str, env: Any) -> "Task":
        """The task of an environment that has the spec's spaces."""
        return cls(
            name=name,
            env=env,
            max_steps=spec.max_steps,
            solved_reward=spec.solved_reward,
            info_keys=spec.info_keys,
            augmented_keys=spec.augmented_keys,
        )


def require_own_steps(env: Any) -> None:
    """Checks that an environment is no wrapper of gymnax's kind.

    Such a one changes `step`, and its `step_env` is that of the environment in it: what it does
    would silently be left out.

    Raises:
      ConfigError: for a class with `step` and no `step_env`, or `reset` and no `reset_env`.
    """
    left_out = [
        name
        for name in ("reset", "step")
        if hasattr(type(env), name) and not hasattr(type(env), f"{name}_env")
    ]
    options.require(
        not left_out,
        "env",
        f"must change {' and '.join(f'{name}_env in place of {name}' for name in left_out)}; got "
        f"{type(env).__name__}. Set env to a subclass of sejax.envs.wrappers.Wrapper.",
    )


def _require_threshold(solved_reward: Any) -> None:
    is_nan = isinstance(solved_reward, float) and math.isnan(solved_reward)
    options.require(
        not is_nan and not isinstance(solved_reward, str | None),
        "env.solved_reward",
        f"must be a number, because returns are compared with it; got "
        f"{options.shortened(solved_reward)}. Set env.solved_reward=inf if it is undefined.",
    )


def _params_of(env: Any, params: Any, name: str) -> Any:
    """The params given, or the environment's; checks that both are what they are called."""
    with _says_what_it_must_be(name):
        default = env.default_params
    require_own_steps(env)
    params = default if params is None else params
    options.require(
        hasattr(params, "max_steps_in_episode"),
        "params",
        "must have max_steps_in_episode, because episodes are cut there; got "
        f"{type(params).__name__}. Set params to a gymnax EnvParams.",
    )
    return params


def _with_limit(params: Any, max_steps: int | None) -> tuple[Any, int]:
    """Params that have the step limit, and the limit."""
    limit = params.max_steps_in_episode if max_steps is None else max_steps
    limit = options.as_python(limit)
    options.counts("an episode has steps")("env.max_steps", limit, 200)
    if max_steps is not None and params.max_steps_in_episode != limit:
        options.require(
            hasattr(params, "replace"),
            "params",
            f"must have a method replace, or max_steps_in_episode={limit}, because that is the "
            f"task's max_steps; got {options.shortened(params)}. Set params to a gymnax EnvParams, "
            "or max_steps=None.",
        )
        params = params.replace(max_steps_in_episode=limit)
    return params, int(limit)


@contextlib.contextmanager
def _says_what_it_must_be(name: str) -> Iterator[None]:
    """Turns whatever an environment raises within into a `ConfigError`."""
    try:
        yield
    except options.ConfigError:
        raise
    except Exception as error:
        raise options.ConfigError(
            f"env must be a gymnax 1.x environment (step_env returns five values); {name} raised "
            f"{options.told(error)}. Derive it from gymnax's Environment, or set env to the first "
            f"result of gymnax.make."
        ) from error


def _try(env: Any, params: Any, name: str) -> None:
    """Traces a step, so that faults of an environment are met before an agent trains there.

    Raises:
      ConfigError: if it cannot be made, or returns something else than five values whose shapes and
        dtypes are those of the spaces and of `reset_env`.
    """
    import jax

    def step(key: Any) -> Any:
        obs, state = env.reset_env(key, params)
        action = env.action_space(params).sample(key)
        next_obs, next_state, reward, terminated, _ = env.step_env(key, state, action, params)
        env.is_truncated(next_state, params)
        begin, after = {"obs": obs, "state": state}, {"obs": next_obs, "state": next_state}
        return begin, after, reward, terminated

    def kinds(tree: Any) -> dict[str, tuple[tuple[int, ...], str]]:
        leaves = jax.tree_util.tree_leaves_with_path(tree)
        name_of = functools.partial(jax.tree_util.keystr, simple=True, separator=".")
        return {name_of(path): (x.shape, str(x.dtype)) for path, x in leaves}

    with _says_what_it_must_be(name):
        begin, after, reward, terminated = jax.eval_shape(step, jax.random.key(0))
        shape = tuple(env.observation_space(params).shape)
    began, went_on = kinds(begin), kinds(after)
    faults = [
        f"{key} is {began.get(key)} after reset_env and {went_on.get(key)} after step_env"
        for key in {**began, **went_on}
        if began.get(key) != went_on.get(key)
    ]
    for what, is_right, x in (
        ("obs", begin["obs"].shape == shape, begin["obs"]),
        ("reward", reward.shape == (), reward),
        ("terminated", terminated.shape == () and terminated.dtype == bool, terminated),
    ):
        if not is_right:
            faults.append(f"{what} is {x.shape} {x.dtype}")
    options.require(
        not faults,
        "env",
        f"must keep its shapes: obs {shape}, reward a scalar, terminated a bool, because an "
        f"episode is one loop; got {name}, where {'; '.join(faults)}. Set env to one that does.",
    )
