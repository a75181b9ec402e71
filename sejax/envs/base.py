"""The contract of a task: a real environment that agents are tested on, and what is known of it."""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from sejax import errors


class Facts(NamedTuple):
    """What must be known of a task to tell whether settings can work.

    A task's configuration may state them as its class attribute `facts`: then bad settings are
    refused before gymnax is imported, which takes seconds. A test holds them against the tasks.

    Attributes:
      states: "vector" or "discrete".
      actions: "discrete" or "continuous".
      max_steps: step limit of an episode.
      has_info: whether its steps tell more than the observation; see `Task.info_keys`.
      has_vector: whether some of that describes the state alone (`Task.augmented_keys`); None where
        nothing is told, or only the task knows.
    """

    states: str
    actions: str
    max_steps: int
    has_info: bool = False
    has_vector: bool | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """A real task: what an agent is tested on, and what counts as solved.

    Agents and networks see vectors: an observation that is no `[obs_dim]` float32 vector is
    flattened, and continuous actions that do not lie in [-x, x] in each dimension are scaled to
    [-1, 1] (`sejax.envs.wrappers`).

    Attributes:
      name: what it is called, in files too.
      env: gymnax 1.x `Environment`, of which `reset_env`, `step_env`, `is_truncated`,
        `action_space`, `observation_space` and `default_params` are used; its params have
        `max_steps_in_episode`, its state has `time` for RNs with
        `zero_at_terminal`. `step_env` returns observation, state, reward, terminated and info. A
        step's `info` may say under "discount" what a target
        bootstraps with; 1 minus terminated if not. Build a task once: what is compiled for it is
        kept by identity.
      params: its `EnvParams`; the environment's `default_params` if not given.
      solved_reward: mean return per episode at which the task counts as solved; inf if nobody says.
      max_steps: step limit of an episode; put into `params`, or taken from there if not given.
      info_keys: entries of a step's `info` that say more of the state than the observation, each
        `[]`; what reward networks can weigh.
      augmented_keys: those that describe the state alone, as input for reward networks.
      origin: plain values that `sejax.envs.make` makes it from again; None for one made by hand,
        which whoever loads a proxy of it must give.

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
    params: Any = None
    solved_reward: float = math.inf
    max_steps: Any = None  # an int once it is made
    info_keys: tuple[str, ...] = ()
    augmented_keys: tuple[str, ...] = ()
    origin: dict[str, Any] | None = None
    _obs_space: Any = field(init=False, repr=False, default=None)
    _action_space: Any = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        from sejax.envs.wrappers import as_vectors

        with _says_what_it_must_be(self.name):
            is_env = hasattr(self.env, "default_params")
            params = self.env.default_params if is_env and self.params is None else self.params
        errors.require(
            is_env,
            "env",
            "be a gymnax environment",
            "its params are asked for",
            type(self.env).__name__,
            "env to the first of the pair that gymnax.make returns",
        )
        require_own_steps(self.env)
        is_nan = isinstance(self.solved_reward, float) and math.isnan(self.solved_reward)
        is_odd = is_nan or isinstance(self.solved_reward, str | None)  # a traced one is fine
        errors.require(
            not is_odd,
            "env.solved_reward",
            "be a number",
            "returns are compared with it",
            self.solved_reward,
            "env.solved_reward=inf if nobody says",
        )
        errors.require(
            hasattr(params, "max_steps_in_episode"),
            "params",
            "have max_steps_in_episode",
            "episodes are cut there",
            type(params).__name__,
            "params to a gymnax EnvParams",
        )
        limit = params.max_steps_in_episode if self.max_steps is None else self.max_steps
        limit = errors.as_python(limit)
        errors.whole(1, "env.max_steps", limit, "an episode has steps", 200)
        if self.max_steps is not None and params.max_steps_in_episode != limit:
            errors.require(
                hasattr(params, "replace"),
                "params",
                f"have a method replace, or max_steps_in_episode={limit}",
                "that is the task's max_steps",
                params,
                "params to a gymnax EnvParams, or max_steps=None",
            )
            params = params.replace(max_steps_in_episode=limit)
        object.__setattr__(self, "max_steps", int(limit))
        object.__setattr__(self, "params", params)
        with _says_what_it_must_be(self.name):
            env = as_vectors(self.env, params, self.name)
        if not type(self.env).__module__.startswith(("sejax.", "gymnax.")):
            _try(env, params, self.name)  # seconds for some, which have tests of their own
        object.__setattr__(self, "env", env)
        # Once and here: gymnax computes some spaces, and within a program they would have no sizes.
        object.__setattr__(self, "_obs_space", env.observation_space(params))
        object.__setattr__(self, "_action_space", env.action_space(params))

    @property
    def facts(self) -> Facts:
        """The same facts, from the spaces."""
        return Facts(
            states="vector" if self.num_states is None else "discrete",
            actions="continuous" if self.num_actions is None else "discrete",
            max_steps=self.max_steps,
            has_info=bool(self.info_keys),
            has_vector=bool(self.augmented_keys) if self.info_keys else None,
        )

    @property
    def interface(self) -> dict[str, Any]:
        """What agents see of it, plain values that a proxy's file keeps.

        `observation` and `action` are `{"n": categories}` or the bounds of a vector, `{"low": [x],
        "high": [x]}` with None where there is none; `max_steps` is the step limit.
        """
        return {
            "observation": _plain_space(self._obs_space),
            "action": _plain_space(self._action_space),
            "max_steps": self.max_steps,
        }

    @property
    def is_solvable(self) -> bool:
        """Whether it is known what counts as solved."""
        return math.isfinite(self.solved_reward)

    @property
    def num_states(self) -> int | None:
        """Number of states of a task whose observation is an index; None for vectors."""
        return _num_categories(self._obs_space)

    @property
    def obs_dim(self) -> int:
        """Length of the observation that networks see; an index is one-hot to them."""
        return self.num_states or int(self._obs_space.shape[0])

    @property
    def num_actions(self) -> int | None:
        """Number of discrete actions; None for continuous ones."""
        return _num_categories(self._action_space)

    @property
    def action_dim(self) -> int:
        """Length of the action that networks see; a discrete one is one-hot to them."""
        return self.num_actions or int(self._action_space.shape[0])

    @property
    def max_action(self) -> float:
        """Continuous actions lie in [-max_action, max_action]; 1 for discrete ones."""
        if self.num_actions is not None:
            return 1.0
        import numpy as np

        return float(np.max(self._action_space.high))


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
    errors.require(
        not left_out,
        "env",
        " and ".join(f"change {name}_env in place of {name}" for name in left_out),
        "episodes are cut and begun anew around reset_env and "
        "step_env, and these two are never called",
        type(env).__name__,
        "env to a subclass of sejax.envs.wrappers.Wrapper",
    )


@contextlib.contextmanager
def _says_what_it_must_be(name: str) -> Iterator[None]:
    """Whatever an environment raises within is a `ConfigError`."""
    try:
        yield
    except errors.ConfigError:
        raise
    except Exception as error:
        raise errors.ConfigError(
            f"env must be a gymnax 1.x environment with default_params, spaces, reset_env, "
            f"step_env (five values) and is_truncated, because agents train and are tested there; "
            f"{name} raised {errors.told(error)}. Derive it from gymnax's Environment."
        ) from error


def _try(env: Any, params: Any, name: str) -> None:
    """Traces a step, so that what an environment lacks is told before an agent trains there.

    Raises:
      ConfigError: if it cannot be made, or returns something else than five values.
    """
    import jax

    def step(key: Any) -> Any:
        obs, state = env.reset_env(key, params)
        action = env.action_space(params).sample(key)
        next_obs, next_state, reward, terminated, _ = env.step_env(key, state, action, params)
        env.is_truncated(next_state, params)
        return obs, state, next_obs, next_state, reward, terminated

    with _says_what_it_must_be(name):
        obs, state, next_obs, next_state, reward, terminated = jax.eval_shape(
            step, jax.random.key(0)
        )
    shape = tuple(env.observation_space(params).shape)
    for what, got, wanted in (
        ("reset_env's observation", obs, shape),
        ("step_env's observation", next_obs, shape),
        ("step_env's reward", reward, ()),
        ("step_env's terminated", terminated, ()),
    ):
        errors.require(
            got.shape == wanted,
            "env",
            f"have {wanted} as the shape of {what}",
            "its space, or an episode at a time, says so",
            f"{got.shape} in {name}",
            "env to one that returns that",
        )
    errors.require(
        terminated.dtype == bool,
        "env",
        "return a bool as step_env's terminated",
        "a loop is compiled that ends by it",
        f"{terminated.dtype} in {name}",
        "env to one that returns such as terminated > 0",
    )
    began, went_on = (
        {
            jax.tree_util.keystr(path, simple=True, separator="."): (x.shape, str(x.dtype))
            for path, x in jax.tree_util.tree_leaves_with_path(each)
        }
        for each in ({"state": state, "obs": obs}, {"state": next_state, "obs": next_obs})
    )
    changed = [
        f"{key} {began.get(key)} and then {went_on.get(key)}"
        for key in {**began, **went_on}
        if began.get(key) != went_on.get(key)
    ]
    errors.require(
        not changed,
        "env",
        "keep the shapes and dtypes that reset_env returns",
        "an episode is one compiled loop",
        f"{', '.join(changed)} in {name}",
        "env to one whose step_env returns the same",
    )


def _num_categories(space: Any) -> int | None:
    """Size of a gymnax `Discrete` space; None for a `Box`."""
    from gymnax.environments import spaces

    return int(space.n) if isinstance(space, spaces.Discrete) else None


def _plain_space(space: Any) -> dict[str, Any]:
    """A space of `Task.interface`."""
    import numpy as np

    if (n := _num_categories(space)) is not None:
        return {"n": n}
    bounds = {"low": space.low, "high": space.high}
    return {
        name: [
            float(x) if math.isfinite(x) else None
            for x in np.broadcast_to(np.asarray(bound), space.shape)
        ]
        for name, bound in bounds.items()
    }
