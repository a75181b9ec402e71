"""Greedy episodes of an agent on the real task: their returns, or every step of them.

Source: paper, Algorithm 1, EvaluateAgent.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from sejax.agents.base import Agent
from sejax.ops.keys import step_keys
from sejax.ops.loops import while_any_active


class Steps(NamedTuple):
    """Steps of greedy episodes, leaves `[step, ...]`; rows after an episode's end are not valid."""

    obs: Array
    action: Array
    next_obs: Array
    reward: Float[Array, " step"]
    terminated: Bool[Array, " step"]
    valid: Bool[Array, " step"]


class Tests(NamedTuple):
    """What came of greedy episodes.

    Attributes:
      returns: of each, within the task's step limit.
      num_steps: played.
      scored: return of the first `score_steps` steps, which may be fewer than the limit allows, or
        more; `returns`, if nothing is said of them.
    """

    returns: Float[Array, " episode"]
    num_steps: Int[Array, " episode"]
    scored: Float[Array, " episode"]


@struct.dataclass
class _Episode:
    """Carry of an episode."""

    active: Array
    num_steps: Array  # of the task
    total: Array
    scored: Array  # return of the steps that count for the objective
    obs: Array
    env_state: Any


class _Greedy:
    """One greedy episode of an agent on a task: how it begins, and its every step."""

    def __init__(self, agent: Agent, task: Any):
        from sejax.envs.wrappers import repeat_actions

        self.agent, self.params = agent, task.params
        self.env = repeat_actions(task.env, agent.spec.action_repeat)

    def begin(self, key: Array, active: Array | bool) -> _Episode:
        obs, env_state = self.env.reset_env(key, self.params)
        return _Episode(
            active=jnp.asarray(active),
            num_steps=jnp.int32(0),
            total=jnp.float32(0),
            scored=jnp.float32(0),
            obs=obs,
            env_state=env_state,
        )

    def step(
        self, key: Array, agent_state: Any, before: _Episode, score_steps: Array | None = None
    ) -> tuple[_Episode, Steps]:
        """The episode after a decision, and the decision; `key` is of the whole episode.

        With `score_steps` the episode may last for so many steps, beyond the task's limit too.
        """
        key_act, key_env = step_keys(key, before.num_steps, 2)
        action = self.agent.act(key_act, agent_state, before.obs, explore=False)
        action = self.agent.env_action(action)
        params = longest = self.params
        is_within: Any = True  # the task's limit, where a repeated action ends too
        if score_steps is not None:
            limit = self.params.max_steps_in_episode
            is_within, most = before.num_steps < limit, jnp.maximum(limit, score_steps)
            longest = self.params.replace(max_steps_in_episode=most)
            params = self.params.replace(max_steps_in_episode=jnp.where(is_within, limit, most))
        obs, env_state, reward, terminated, info = self.env.step_env(
            key_env, before.env_state, action, params
        )
        truncated = self.env.is_truncated(env_state, longest)
        total = scored = before.scored + reward
        if score_steps is not None:
            total = jnp.where(is_within, before.total + reward, before.total)
            scored = jnp.where(before.num_steps < score_steps, scored, before.scored)
        after = _Episode(
            active=~(terminated | truncated),
            num_steps=before.num_steps + info.get("num_steps", 1),
            total=total,
            scored=scored,
            obs=obs,
            env_state=env_state,
        )
        made = Steps(before.obs, action, obs, jnp.float32(reward), terminated, before.active)
        return after, made


def make_tester(agent: Agent, task: Any, num_episodes: int) -> Callable[..., Any]:
    """Builds `test(key, agent_state, active=True, score_steps=None) -> Tests`.

    Episodes on the real task without exploration, each from a fresh initial state. With
    `active=False` nothing is played and all are 0.
    """
    greedy = _Greedy(agent, task)

    def step(nothing: Array, state: _Episode, consts: Any, masked: bool) -> tuple[Array, _Episode]:
        key, agent_state, score_steps = consts
        after, _ = greedy.step(key, agent_state, state, score_steps)
        return nothing, after

    def episode(key: Array, agent_state: Any, active: Array | bool, score_steps: Any) -> Tests:
        key_reset, key_steps = jax.random.split(key)
        state = greedy.begin(key_reset, active)
        consts = (key_steps, agent_state, score_steps)
        _, state = while_any_active(step, jnp.zeros(0), state, consts)
        return Tests(state.total, state.num_steps, state.scored)

    def test(
        key: Array,
        agent_state: Any,
        active: Array | bool = True,
        score_steps: Array | None = None,
    ) -> Tests:
        keys = jax.random.split(key, num_episodes)
        in_axes = (0, None, None, None)
        return jax.vmap(episode, in_axes)(keys, agent_state, active, score_steps)

    return test


def make_recorder(agent: Agent, task: Any, num_episodes: int) -> Callable[[Array, Any], Steps]:
    """Builds `record(key, agent_state) -> Steps`, leaves `[num_episodes * max_steps, ...]`.

    The episodes are those of `make_tester` with the same key. A decision that an agent repeats is
    one step here.
    """
    greedy = _Greedy(agent, task)

    def episode(key: Array, agent_state: Any) -> Steps:
        key_reset, key_steps = jax.random.split(key)

        def step(state: _Episode, _: None) -> tuple[_Episode, Steps]:
            after, made = greedy.step(key_steps, agent_state, state)
            return after.replace(active=state.active & after.active), made

        start = greedy.begin(key_reset, True)
        return jax.lax.scan(step, start, length=-(-task.max_steps // agent.spec.action_repeat))[1]

    def record(key: Array, agent_state: Any) -> Steps:
        keys = jax.random.split(key, num_episodes)
        steps = jax.vmap(episode, in_axes=(0, None))(keys, agent_state)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), steps)

    return record
