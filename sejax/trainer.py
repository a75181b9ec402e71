"""The inner loop: one agent's whole training in one world, then its test on the real task.

Source: paper, Algorithm 1 (TrainAgent, EvaluateAgent) and appendix "Heuristics for Agent Training
and Evaluation"; `reference_details.md` 3.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from sejax.agents.agent import Agent
from sejax.agents.memory import Memory
from sejax.agents.replay import Transition
from sejax.configs import TrainingConfig
from sejax.envs.action_repeat import repeat_actions
from sejax.masked_loop import while_any_active
from sejax.proxies.reward import RewardEnv
from sejax.proxies.synthetic import SyntheticEnv

_NO_LIMIT = 2**31 - 1


@struct.dataclass
class TrainResult:
    """What came of one training.

    Attributes:
      agent_state: the trained agent.
      train_steps: steps in the training world, `[]` int32.
      episodes: finished training episodes, `[]` int32.
      returns: return of each training episode in the training world, `[max_episodes]`; nan after
        the last. With tests between episodes (`solved_by="test"`) the test returns.
      episode_ends: training steps at the end of each training episode, `[max_episodes]` int32; 0
        after the last.
      nonfinite: whether a number that is not finite was met: an output of the world or a weight.
      test_steps: real steps spent on tests between training episodes, `[]` int32.
    """

    agent_state: Any
    train_steps: Array
    episodes: Array
    returns: Float[Array, " max_episodes"]
    episode_ends: Int[Array, " max_episodes"]
    nonfinite: Array
    test_steps: Array


@struct.dataclass
class _TestState:
    """Carry of a test episode."""

    active: Array
    num_steps: Array
    total: Array
    obs: Array
    env_state: Any


@struct.dataclass
class _LoopState:
    """Carry of the step loop. What the agent remembers is carried beside it."""

    active: Array
    step: Array  # decisions
    train_steps: Array  # steps of the world
    episode: Array
    episode_return: Array
    obs: Array
    env_state: Any
    agent_state: Any
    recent: Array  # [2 * window]: the last returns, newest last
    returns: Array  # [max_episodes]
    episode_ends: Array  # [max_episodes]
    nonfinite: Array
    test_steps: Array


def make_trainer(
    agent: Agent,
    env: Any,
    training: TrainingConfig = TrainingConfig(),  # noqa: B008 (frozen)
    solved_reward: float = jnp.inf,
    test_fn: Callable[[Array, Any, Array], tuple[Array, Array]] | None = None,
) -> Callable[..., TrainResult]:
    """Builds `train(key, env_params, hparams, active=True) -> TrainResult` for one agent.

    The result is pure; `vmap` it over keys, parameters and hyperparameters. Under `vmap` the lanes
    step together until the last one stops, and a lane that has stopped writes nothing; alone, it
    is a plain `while_loop` that stops early.

    Args:
      agent: from `sejax.agents`.
      env: gymnax environment to train in: real, synthetic or reward-shaped. A potential-based
        reward has the agent's discount, whatever its params say. The plateau rule, the default,
        reads the returns of this world; for tests on the real task see
        `evaluation.make_evaluator`. In a proxy whose params allow longer episodes than its task the
        buffer may hold fewer steps than the agent asks for.
      training: stopping rule and limits. `time_limit_is_terminal` speaks of real time limits and is
        ignored in an SE: there the last step of an episode bootstraps with what the done network
        says, as in the authors' code.
      solved_reward: for `stop_rule="solved"`.
      test_fn: `(key, agent_state, active) -> (mean return, steps)` on the real task, called after
        each training episode if `stop_rule="solved"` and `solved_by="test"`.

    Raises:
      ValueError: if tests are asked for and no `test_fn` is given.

    Source: paper, Algorithm 1, TrainAgent.
    """
    tests_each_episode = training.stop_rule == "solved" and training.solved_by == "test"
    if tests_each_episode and test_fn is None:
        raise ValueError("stop_rule='solved' with solved_by='test' needs a test_fn; got None.")
    time_limit_is_terminal = training.time_limit_is_terminal and not isinstance(env, SyntheticEnv)
    shaped = env if isinstance(env, RewardEnv) else None
    max_steps = memory_steps = training.max_steps or _NO_LIMIT
    if isinstance(env, RewardEnv | SyntheticEnv):  # whose episodes are no longer than the task's
        memory_steps = min(max_steps, training.max_episodes * env.task.max_steps)
    env = repeat_actions(env, agent.action_repeat)
    window = training.window

    def begin(key: Array, env_params: Any, hparams: Any, active: Array | bool) -> _LoopState:
        key_agent, key_reset = jax.random.split(key)
        obs, env_state = env.reset_env(key_reset, env_params)
        agent_state = agent.init(key_agent, hparams)
        return _LoopState(
            active=jnp.asarray(active),
            step=jnp.int32(0),
            train_steps=jnp.int32(0),
            episode=jnp.int32(0),
            episode_return=jnp.float32(0),
            obs=obs,
            env_state=env_state,
            agent_state=agent.begin_episode(agent_state, jnp.int32(0)),
            recent=jnp.zeros(2 * window),
            returns=jnp.full(training.max_episodes, jnp.nan),
            episode_ends=jnp.zeros(training.max_episodes, jnp.int32),
            nonfinite=jnp.bool_(False),
            test_steps=jnp.int32(0),
        )

    def make_memory(state: _LoopState) -> Memory:
        def example() -> Transition:
            action = agent.act(jax.random.key(0), state.agent_state, state.obs, explore=True)
            return Transition(state.obs, action, jnp.float32(0), jnp.float32(0), state.obs)

        return agent.memory(jax.eval_shape(example), memory_steps)

    def step(kept: Any, state: _LoopState, consts: Any, masked: bool) -> tuple[Any, _LoopState]:
        """One agent step: act, step the world, store, learn, and close the episode if it ended."""
        key, env_params = consts
        memory = make_memory(state)
        key_act, key_env, key_sample, key_update, key_end = jax.random.split(
            jax.random.fold_in(key, state.step), 5
        )
        action = agent.act(key_act, state.agent_state, state.obs, explore=True)
        next_obs, env_state, reward, terminated, info = env.step_env(
            key_env, state.env_state, agent.env_action(action), env_params
        )
        truncated = env.is_truncated(env_state, env_params)
        nonfinite = state.nonfinite | info.get("nonfinite", False)
        ended = terminated | truncated | nonfinite
        discount = jnp.float32(info["discount"])
        if time_limit_is_terminal:
            discount = jnp.where(truncated, 0.0, discount)
        transition = Transition(state.obs, action, reward, discount, next_obs)
        kept = memory.store(kept, state.step, transition, ended, state.active if masked else True)

        def learn(agent_state):
            size = agent.batch_size(agent_state)
            batch = memory.batch(key_sample, kept, state.step + 1, transition, size)
            return agent.update(key_update, agent_state, batch)

        agent_state = jax.lax.cond(
            state.episode >= agent.learns_from, learn, lambda s: s, state.agent_state
        )
        train_steps = state.train_steps + info.get("num_steps", 1)
        state = state.replace(
            step=state.step + 1,
            train_steps=train_steps,
            episode_return=state.episode_return + reward,
            obs=next_obs,
            env_state=env_state,
            agent_state=agent_state,
            nonfinite=nonfinite,
            active=train_steps < max_steps,
        )
        state = jax.lax.cond(
            ended, lambda s: end_episode(key_end, s, env_params, ended), lambda s: s, state
        )
        return kept, state

    def end_episode(key: Array, state: _LoopState, env_params: Any, ended: Array) -> _LoopState:
        """Records the episode, decides whether training goes on, and starts the next one.

        In lanes this runs for all of them if it runs for one; `ended` spares the others the test.
        """
        key_reset, key_test = jax.random.split(key)
        episode_return, test_steps = state.episode_return, state.test_steps
        if tests_each_episode and test_fn is not None:
            episode_return, num_steps = test_fn(key_test, state.agent_state, ended)
            test_steps = test_steps + num_steps
        recent = jnp.concatenate([state.recent[1:], episode_return[None]])
        num_episodes = state.episode + 1
        stop = (num_episodes >= training.max_episodes) | state.nonfinite
        may_stop = (state.episode >= agent.init_episodes) & (
            state.train_steps >= training.min_steps
        )
        if training.stop_rule == "plateau":
            flat = is_plateau(recent, num_episodes, training.plateau_tolerance)
            stop = stop | (may_stop & flat & (state.episode >= agent.init_episodes + window))
        elif training.stop_rule == "solved":
            stop = stop | (may_stop & is_solved(recent, num_episodes, solved_reward))
        obs, env_state = env.reset_env(key_reset, env_params)
        return state.replace(
            active=state.active & ~stop,
            episode=num_episodes,
            episode_return=jnp.float32(0),
            obs=obs,
            env_state=env_state,
            agent_state=agent.begin_episode(state.agent_state, num_episodes),
            recent=recent,
            returns=state.returns.at[state.episode].set(episode_return),
            episode_ends=state.episode_ends.at[state.episode].set(state.train_steps),
            test_steps=test_steps,
        )

    def train(
        key: Array, env_params: Any, hparams: Any = agent.hparams, active: Array | bool = True
    ) -> TrainResult:
        if shaped is not None:
            discount = agent.discount(hparams)
            env_params = shaped.prepared(env_params, discount, time_limit_is_terminal)
        key_begin, key_steps = jax.random.split(key)
        state = begin(key_begin, env_params, hparams, active)
        kept = make_memory(state).init()
        _, state = while_any_active(step, kept, state, (key_steps, env_params))
        return TrainResult(
            agent_state=state.agent_state,
            train_steps=state.train_steps,
            episodes=state.episode,
            returns=state.returns,
            episode_ends=state.episode_ends,
            nonfinite=state.nonfinite | ~_all_finite(state.agent_state),
            test_steps=state.test_steps,
        )

    return train


def is_plateau(
    recent: Float[Array, " two_windows"], num_episodes: Array, tolerance: float
) -> Array:
    r"""Whether the mean return of the last d episodes is close to that of the d before.

    .. math:: |\bar C_d - \bar C_{2d}| / |\bar C_{2d}| \le C_{diff}

    Args:
      recent: `[2 d]` returns, newest last; entries before the first episode are 0.
      num_episodes: episodes so far. With fewer than 2d the older window is shorter, and an empty
        one has mean 0.
      tolerance: C_diff.

    Source: paper, appendix "Heuristics for Agent Training and Evaluation".
    """
    window = recent.shape[0] // 2
    older = recent[:window].sum() / jnp.clip(num_episodes - window, 1, window)
    newer = recent[window:].sum() / jnp.clip(num_episodes, 1, window)
    return jnp.abs(newer - older) <= tolerance * (jnp.abs(older) + 1e-9)


def is_solved(
    recent: Float[Array, " two_windows"], num_episodes: Array, solved_reward: float
) -> Array:
    """Whether the mean of the last d returns (of all, if fewer) reaches the solved reward."""
    window = recent.shape[0] // 2
    return recent[window:].sum() / jnp.clip(num_episodes, 1, window) >= solved_reward


def make_tester(agent: Agent, task: Any, num_episodes: int) -> Callable[..., Any]:
    """Builds `test(key, agent_state, active=True) -> (returns, steps)`, both `[num_episodes]`.

    Episodes on the real task without exploration, each from a fresh initial state.

    Source: paper, Algorithm 1, EvaluateAgent.
    """
    env, params = repeat_actions(task.env, agent.action_repeat), task.params

    def step(nothing: Array, state: _TestState, consts: Any, masked: bool):
        key, agent_state = consts
        key_act, key_env = jax.random.split(jax.random.fold_in(key, state.num_steps))
        action = agent.act(key_act, agent_state, state.obs, explore=False)
        obs, env_state, reward, terminated, info = env.step_env(
            key_env, state.env_state, agent.env_action(action), params
        )
        ended = terminated | env.is_truncated(env_state, params)
        return nothing, _TestState(
            active=~ended,
            num_steps=state.num_steps + info.get("num_steps", 1),
            total=state.total + reward,
            obs=obs,
            env_state=env_state,
        )

    def episode(key: Array, agent_state: Any, active: Array | bool) -> tuple[Array, Array]:
        key_reset, key_steps = jax.random.split(key)
        obs, env_state = env.reset_env(key_reset, params)
        state = _TestState(
            active=jnp.asarray(active),
            num_steps=jnp.int32(0),
            total=jnp.float32(0),
            obs=obs,
            env_state=env_state,
        )
        _, state = while_any_active(step, jnp.zeros(0), state, (key_steps, agent_state))
        return state.total, state.num_steps

    def test(key: Array, agent_state: Any, active: Array | bool = True) -> tuple[Array, Array]:
        keys = jax.random.split(key, num_episodes)
        return jax.vmap(episode, in_axes=(0, None, None))(keys, agent_state, active)

    return test


def _all_finite(tree: Any) -> Array:
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.stack([jnp.all(jnp.isfinite(x)) for x in leaves]).all()
