"""Tasks of other JAX suites, through stoa; and fresh agents with and without a reward network.

    pip install '.[stoa]' navix
    python -m sejax.run env=other_suites:task env.suite=navix env.env_id=Navix-Empty-5x5-v0 \
        env.solved_reward=0.9 proxy=rn agent=ppo               # in this folder
    python other_suites.py env.suite=navix env.env_id=Navix-Empty-5x5-v0 env.solved_reward=0.9

[stoa](https://github.com/EdanToledo/Stoa) gives the suites one interface, in which an episode says
whether it was terminated or truncated and no step resets. Observations of several arrays become
one vector, in the order of their fields (of a dictionary, its names). Two players, or several
actions at once, do not fit an agent of sejax.
"""

import math
import pkgutil
import sys
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces
from jax import Array

import sejax

ADAPTERS = {  # of `stoa.env_adapters`
    "brax": "brax:BraxToStoa",
    "craftax": "gymnax:GymnaxToStoa",
    "jumanji": "jumanji:JumanjiToStoa",
    "navix": "navix:NavixToStoa",
    "pgx": "pgx:PGXToStoa",
    "playground": "playground:MuJoCoPlaygroundToStoa",
    "xminigrid": "xminigrid:XMiniGridToStoa",
}
LIMITS = ("max_steps", "max_timesteps", "time_limit", "episode_length")  # as suites call it


@struct.dataclass
class SuiteState(environment.EnvState):
    inner: Any  # the suite's
    is_cut: Array  # whether the suite has truncated the episode


class SuiteEnv(environment.Environment[SuiteState, environment.EnvParams]):
    """A stoa environment with the interface of gymnax 1.x."""

    def __init__(self, env: Any):
        self.env = env
        space = env.action_space()
        self.actions: spaces.Space = (
            spaces.Discrete(int(space.num_values)) if hasattr(space, "num_values")
            else spaces.Box(space.minimum, space.maximum, space.shape)
        )  # fmt: skip
        _, first = jax.eval_shape(env.reset, jax.random.key(0))
        obs = jax.eval_shape(vector, first.observation)
        self.observations = spaces.Box(-jnp.inf, jnp.inf, obs.shape)

    def reset_env(self, key: Array, params: environment.EnvParams) -> tuple[Array, SuiteState]:
        inner, step = self.env.reset(key)
        return vector(step.observation), SuiteState(jnp.int32(0), inner, jnp.bool_(False))

    def step_env(
        self, key: Array, state: SuiteState, action: Array, params: environment.EnvParams
    ) -> tuple[Array, SuiteState, Array, Array, dict[str, Array]]:
        inner, step = self.env.step(state.inner, action)
        # jumanji's last steps all come as terminated; the discount tells which are not.
        terminated = step.last() & (step.discount == 0)
        after = SuiteState(state.time + 1, inner, step.last() & ~terminated)
        info = {"discount": jnp.float32(step.discount)}
        return vector(step.observation), after, jnp.float32(step.reward), terminated, info

    def is_truncated(self, state: SuiteState, params: environment.EnvParams) -> Array:
        return state.is_cut | (state.time >= params.max_steps_in_episode)

    def action_space(self, params: environment.EnvParams) -> spaces.Space:
        return self.actions

    def observation_space(self, params: environment.EnvParams) -> spaces.Box:
        return self.observations


def vector(observation: Any) -> Array:
    leaves = jax.tree.leaves(observation)
    return jnp.concatenate([jnp.ravel(x).astype(jnp.float32) for x in leaves])


def of_suite(suite: str, env_id: str) -> tuple[Any, ...]:
    """The suite's own environment; and its params, where it has them apart."""
    if suite == "craftax":  # whose spaces are a copy of gymnax's
        env = pkgutil.resolve_name("craftax.craftax_env:make_craftax_env_from_name")(
            env_id, auto_reset=False
        )
        space = spaces.Discrete(env.action_space(env.default_params).n)
        env.action_space = lambda params=None: space
        return (env,)
    if suite == "playground":  # on JAX: its default, Warp, wants a GPU of NVIDIA
        load = pkgutil.resolve_name("mujoco_playground:registry").load
        return (load(env_id, config_overrides={"impl": "jax"}),)
    make = "brax.envs:get_environment" if suite == "brax" else f"{suite}:make"
    made = pkgutil.resolve_name(make)(env_id)
    return made if isinstance(made, tuple) else (made,)


def limit_of(parts: tuple[Any, ...]) -> int:
    """The environment's own step limit, or 1,000."""
    stated = (
        getattr(x, name, None)
        for part in parts
        for x in (part, getattr(part, "default_params", None), getattr(part, "_config", None))
        for name in LIMITS
    )
    return next((int(x) for x in stated if isinstance(x, int)), 1000)


def task(
    suite: str = "navix",
    env_id: str = "Navix-Empty-5x5-v0",
    solved_reward: float = math.inf,
    max_steps: int | None = None,  # None: the environment's own
) -> sejax.Task:
    """The task of an id of a suite, one of `ADAPTERS`."""
    parts = of_suite(suite, env_id)
    env = SuiteEnv(pkgutil.resolve_name(f"stoa.env_adapters.{ADAPTERS[suite]}")(*parts))
    params = environment.EnvParams(max_steps_in_episode=max_steps or limit_of(parts))
    name = f"{suite}/{env_id}"
    return sejax.Task(name=name, env=env, params=params, solved_reward=solved_reward)


def main() -> None:
    sejax.configure_xla()  # a device for each core
    config = sejax.config([
        "env=other_suites:task", "proxy=rn", "agent=ppo", "generations=10", "es.population_size=8",
        "training.max_steps=20000", "training.max_episodes=20000", "training.stop_rule=solved",
        *sys.argv[1:],
    ])  # fmt: skip
    parts = config.parts()
    task, agent, training = parts["task"], parts["agent"], parts["training"]
    learn = sejax.make_learner(**parts, generations=config.generations)
    learned = jax.jit(learn)(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), 8)
    for name, env, params in (
        ("with the RN", parts["proxy"], parts["proxy"].params(learned.weights)),
        ("without it", task.env, task.params),
    ):
        outcome = sejax.evaluate_agents(agent, env, params, task, training, keys)
        solved = (outcome.test_return >= task.solved_reward).sum()
        print(f"{name}: {solved} of 8 agents solve {task.name}, after "
              f"{outcome.train_steps.mean():,.0f} steps; mean return "
              f"{outcome.test_return.mean():.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
