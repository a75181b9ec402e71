"""The inner loop: how long an agent trains, and one agent's whole training in one world.

Source: paper, Algorithm 1 (TrainAgent) and appendix "Heuristics for Agent Training and Evaluation";
`docs/reference.md` 3.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, PyTree

from sejax.agents.base import Agent, AgentState, Hparams, require_agent
from sejax.agents.buffers import Buffer, Transition
from sejax.envs.base import require_own_steps
from sejax.envs.environment import Environment, spaces_of
from sejax.envs.spec import Discrete
from sejax.envs.wrappers import repeat_actions
from sejax.ops import cpu
from sejax.ops.keys import step_keys
from sejax.ops.loops import STEPS_PER_CHECK, while_any_active
from sejax.ops.modes import require_modes
from sejax.ops.parallel import in_batches_on_cpu
from sejax.ops.scores import reaches
from sejax.options import LARGEST, Count, NonNegative, Options, WholeNumber, require
from sejax.options.registry import require_part
from sejax.proxies.base import proxy_in, steps_are_real


@dataclass(frozen=True, kw_only=True)
class TrainingConfig(Options):
    """How long an agent trains, and how it is tested.

    The defaults are for one-step SEs. On a real task set `stop_rule="solved", max_steps=None`; for
    `make_trainer`, which plays no tests of its own, `solved_by="train"` too.

    Attributes:
      max_episodes: n_e: most episodes of a training
      min_steps: Training steps before the stop rule may end a training.
      max_steps: Steps of a whole training, not of an episode; it ends then, whatever the stop rule
        says.
      stop_rule: plateau (SEs), solved (real tasks), or never
      window: d: episodes in each of the two means that the plateau rule compares
      plateau_tolerance: C_diff: relative change between them that counts as flat
      solved_by: test or train: whose mean return of the last d episodes must reach the solved
        score, for stop_rule=solved
      test_episodes: n_te: greedy episodes on the real task after training
      tests_between: Greedy episodes on the real task after each training episode; at least one
        with stop_rule=solved and solved_by=test.
      time_limit_is_terminal: Targets do not bootstrap at a real time limit, as in the paper.
    """

    group: ClassVar[str] = "training"

    max_episodes: Count = 2000
    min_steps: WholeNumber = 0
    max_steps: Count | None = 2000
    stop_rule: Literal["plateau", "solved", "never"] = "never"
    window: Count = 10
    plateau_tolerance: NonNegative = 0.01
    solved_by: Literal["test", "train"] = "test"
    test_episodes: Count = 10
    tests_between: WholeNumber = 0
    time_limit_is_terminal: bool = False

    @property
    def is_fixed_length(self) -> bool:
        """Whether all agents train for equally many steps, unless they run out of episodes."""
        return self.stop_rule == "never" and self.max_steps is not None

    @property
    def stops_by_tests(self) -> bool:
        """Whether tests between training episodes say that the task is solved."""
        return self.stop_rule == "solved" and self.solved_by == "test"

    @property
    def tests_after_each(self) -> int:
        """Test episodes after each training episode."""
        return max(self.tests_between, int(self.stops_by_tests))


def require_reachable(name: str, training: TrainingConfig, max_episode_steps: int) -> None:
    """Checks that a training of fixed length does not run out of episodes.

    Args:
      name: name of the group of fields.
      training: the limits.
      max_episode_steps: most steps of an episode.

    Raises:
      ConfigError: if even the longest episodes are too few.
    """
    if training.max_steps is None or not training.is_fixed_length:
        return
    episodes = training.max_episodes
    least = math.ceil(training.max_steps / max_episode_steps)
    rule = f"must suffice for {name}.max_steps={training.max_steps}"
    require(episodes >= least, f"{name}.max_episodes", rule, got=episodes, use=least)


class TrainResult(struct.PyTreeNode):
    """The result of one training.

    Attributes:
      agent_state: the trained agent.
      train_steps: steps in the training world, `[]` int32.
      episodes: finished training episodes, `[]` int32.
      returns: return of each training episode in the training world, `[max_episodes]`; nan after
        the last.
      test_returns: mean return of the tests on the real task after each training episode, in the
        same form; None if there are no such tests.
      episode_ends: training steps at the end of each training episode, `[max_episodes]` int32; 0
        after the last.
      nonfinite: whether a number that is not finite was met: an output of a proxy, or
        a float of the agent's state.
      test_steps: real steps spent on tests between training episodes, `[]` int32.
      stored: arrays of the agent's buffer at the end, if the trainer keeps them; else None.
    """

    agent_state: AgentState
    train_steps: Array
    episodes: Array
    returns: Float[Array, " max_episodes"]
    test_returns: Float[Array, " max_episodes"] | None
    episode_ends: Int[Array, " max_episodes"]
    nonfinite: Array
    test_steps: Array
    stored: PyTree = None


class _StepKeys(NamedTuple):
    """The keys of one step, named by what each is for."""

    act: Array
    env: Array
    sample: Array
    update: Array
    reset: Array
    test: Array

    @classmethod
    def of(cls, key: Array, step: Array) -> "_StepKeys":
        """Those of the `step`-th step of a loop with this key: as many as there are fields."""
        return cls(*step_keys(key, step, len(cls._fields)))


LastReturns = Float[Array, " two_windows"]  # newest last


class _LoopState(struct.PyTreeNode):
    """Carry of the step loop. Buffers and a row for each episode are carried beside it.

    `step` counts decisions, and the keys and the buffer go by it. `train_steps` counts steps of the
    world, more where actions are repeated, and the limits of steps go by it. `tested` stays what it
    was until the next test; `step` writes it into the row of the episode that has just ended.
    """

    active: Array
    step: Array  # decisions
    train_steps: Array  # steps of the world
    episode: Array
    episode_return: Array
    obs: Array
    env_state: PyTree
    agent_state: AgentState
    recent: LastReturns  # which the stop rule judges
    nonfinite: Array
    test_steps: Array
    tested: Array  # mean return of the last tests


class _Consts(NamedTuple):
    """What the steps of a training only read: the key of all steps, and the prepared params."""

    key: Array
    env_params: PyTree


# `(key, agent_state, active) -> (mean return, steps)`, on the real task.
TestFn = Callable[[Array, AgentState, Array], tuple[Array, Array]]


def make_trainer(
    agent: Agent,
    env: Environment,
    training: TrainingConfig = TrainingConfig(),
    solved_reward: float = math.inf,
    test_fn: TestFn | None = None,
    keeps_stored: bool = False,
    in_batches: bool = True,
) -> Callable[..., TrainResult]:
    """Builds `train(key, env_params, hparams=None, active=True) -> TrainResult` for one agent.

    `train` is pure; `vmap` it over keys, parameters and hyperparameters. On a GPU all agents then
    step together until the longest training ends. On a CPU `vmap` gives a `lax.map` over batches of
    the width that suits the agent, often one. No replay buffer is copied. With `active=False` no
    step is taken.

    Args:
      agent: from `sejax.make_agent`, or one of your own.
      env: gymnax environment to train in: real, synthetic or reward-shaped. A potential-based
        reward takes the agent's discount, whatever its params say. The plateau rule reads the
        returns of this environment; for tests on the real task see `sejax.make_evaluator`. If a
        proxy's params allow longer episodes than its task, the buffer may hold fewer steps than the
        agent asks for.
      training: stopping rule and limits. `time_limit_is_terminal` concerns real time limits and is
        ignored in an SE. There the last step of an episode bootstraps as the SE's
        `info["discount"]` says: with 1 minus the done network's output if `proxy.done=soft`, as in
        the authors' code.
      solved_reward: for `stop_rule="solved"`.
      test_fn: plays tests on the real task, `(key, agent_state, active) -> (mean return, steps)`,
        each `[]`; called after each training episode if `training.tests_after_each` is not 0.
        `active` is False for an agent whose result is not read.
      keeps_stored: whether the result has what the agent's buffer holds at the end.
      in_batches: whether `vmap` on a CPU gives this `lax.map`; False for a plain `vmap`.

    Raises:
      ConfigError: for arguments of the wrong kind; if `training` has a fixed number of steps and
        too few episodes of a proxy for them, or stops at a solved reward that is not finite; or if
        tests are asked for and no `test_fn` is given.

    Source: paper, Algorithm 1, TrainAgent.

    Example:
      >>> import sejax
      >>> task = sejax.envs.make("cliff_walking")
      >>> agent = sejax.make_agent(sejax.QLearningConfig(), task)
      >>> train = make_trainer(agent, task.env, TrainingConfig(max_episodes=20))
      >>> result = jax.jit(jax.vmap(train, (0, None)))(
      ...     jax.random.split(jax.random.key(0), 8), task.params)
      >>> result.returns.shape
      (8, 20)
    """
    require_part("agent", Agent, agent, "Write make_trainer(agent, env).")
    require_own_steps(env)
    require_agent(agent, *spaces_of(env))
    fix = "sejax.make_evaluator draws others."
    require(agent.varied is None, "agent", "must have fixed hyperparameters", fix=fix)
    require_part("training", TrainingConfig, training)
    can_stop = training.stop_rule != "solved" or math.isfinite(solved_reward)
    fix = "Set solved_reward=task.solved_reward."
    rule = "must be finite with stop_rule=solved"
    require(can_stop, "solved_reward", rule, got=solved_reward, fix=fix)
    require_modes()
    fix = "sejax.make_evaluator plays them; or set solved_by=train."
    require(test_fn or not training.tests_after_each, "test_fn", "must be given", fix=fix)
    test_fn = test_fn if training.tests_after_each else None
    # A curve of tests may end at either limit.
    if test_fn is None and (proxy := proxy_in(env)) is not None:
        require_reachable("training", training, proxy.max_steps)
    env = repeat_actions(env, agent.spec.action_repeat)
    train = _Loop(agent, env, training, solved_reward, test_fn, keeps_stored).train
    if in_batches:
        train = in_batches_on_cpu(train, cpu_num_parallel_of(agent, training))
    return lambda key, env_params, hparams=None, active=True: train(
        key, env_params, agent.hparams if hparams is None else hparams, jnp.asarray(active)
    )


def cpu_num_parallel_of(
    agent: Agent, training: TrainingConfig, num_agents: int = LARGEST
) -> int | None:
    """Agents in a vmapped batch of a CPU core; None for all, as with tabular agents.

    Other agents train one by one if each may stop at its own time.
    """
    width = agent.spec.cpu_num_parallel
    if width is None:
        return None
    if not training.is_fixed_length:
        return 1
    return min(width, cpu.balanced_num_parallel(num_agents))


@dataclass(frozen=True)
class _Loop:
    """The step loop of one agent in one world; pure functions of its carry.

    `train` runs `step` while `state.active`. An agent that learns from whole rollouts runs
    `rollout` in its place: `learns_every` steps that do not learn, then one update.

    ============ ===========================================================================
    carried      how it changes
    ============ ===========================================================================
    `large`      replay buffer and learning curve: rows are written in place, never selected
    `state`      all else, a `_LoopState`: small enough to be selected
    ============ ===========================================================================

    `step` ends a training at `max_steps`; `end_episode` ends it at `max_episodes`, by the stop
    rule, or after a number that is not finite. Under `vmap` (`masked`) a training that is over
    computes steps until the last one of its batch is over. Then `active` is False: its writes to
    `large` go beyond the last row, where they are dropped, and `while_any_active` (in a rollout
    `rollout` itself) keeps its `state` by a select.
    """

    agent: Agent
    env: Environment  # whose steps are the agent's
    training: TrainingConfig
    solved_reward: float
    test_fn: TestFn | None
    keeps_stored: bool

    @property
    def limit_is_terminal(self) -> bool:
        """Whether targets do not bootstrap at a time limit."""
        return self.training.time_limit_is_terminal and steps_are_real(self.env)

    def train(self, key: Array, env_params: PyTree, hparams: Hparams, active: Array) -> TrainResult:
        """One training."""
        if (proxy := proxy_in(self.env)) is not None:
            gamma = self.agent.discount(hparams)
            env_params = proxy.prepare(env_params, gamma, self.limit_is_terminal)
        key_begin, key_steps = jax.random.split(key)
        state = self.begin(key_begin, env_params, hparams, active)
        buffer = self.buffer(state)
        max_episodes = self.training.max_episodes
        no_returns = jnp.full(max_episodes, jnp.nan)
        curve = {"returns": no_returns, "episode_ends": jnp.zeros(max_episodes, jnp.int32)}
        if self.test_fn is not None:
            curve["test_returns"] = no_returns
        learns_each_step = buffer.learns_every == 1
        body = partial(self.step if learns_each_step else self.rollout, buffer)
        per_check = STEPS_PER_CHECK if learns_each_step else 1
        (stored, curve), state = while_any_active(
            body, (buffer.init(), curve), state, _Consts(key_steps, env_params), per_check
        )
        return TrainResult(
            agent_state=state.agent_state,
            train_steps=state.train_steps,
            episodes=state.episode,
            returns=curve["returns"],
            test_returns=curve.get("test_returns"),
            episode_ends=curve["episode_ends"],
            nonfinite=state.nonfinite | ~_all_finite(state.agent_state),
            test_steps=state.test_steps,
            stored=stored if self.keeps_stored else None,
        )

    def begin(self, key: Array, env_params: PyTree, hparams: Hparams, active: Array) -> _LoopState:
        """A fresh agent at the start of its first episode, before its first step."""
        key_agent, key_reset = jax.random.split(key)
        obs, env_state = self.env.reset_env(key_reset, env_params)
        agent_state = self.agent.init(key_agent, hparams)
        return _LoopState(
            active=active,
            step=jnp.int32(0),
            train_steps=jnp.int32(0),
            episode=jnp.int32(0),
            episode_return=jnp.float32(0),
            obs=obs,
            env_state=env_state,
            agent_state=self.agent.begin_episode(agent_state, jnp.int32(0)),
            recent=jnp.zeros(2 * self.training.window),
            nonfinite=jnp.bool_(False),
            test_steps=jnp.int32(0),
            tested=jnp.float32(0),
        )

    def buffer(self, state: _LoopState) -> Buffer:
        """The agent's buffer, for transitions of the shapes that `state` implies.

        A replay buffer gets no more rows than a training can have steps. Only the shapes of `state`
        are read: nothing is computed.
        """

        def example() -> Transition:
            action = self.agent.act(jax.random.key(0), state.agent_state, state.obs, explore=True)
            return Transition(state.obs, action, jnp.float32(0), jnp.float32(0), state.obs)

        most = self.training.max_steps or LARGEST
        if (proxy := proxy_in(self.env)) is not None:
            most = min(most, self.training.max_episodes * proxy.max_steps)
        return self.agent.buffer(jax.eval_shape(example), most)

    def rollout(
        self, buffer: Buffer, large: PyTree, state: _LoopState, consts: _Consts, masked: bool
    ) -> tuple[PyTree, _LoopState]:
        """An iteration of the loop that replaces `learns_every` of `step`, with its arguments.

        Fills the buffer and learns from it. If the training ends before, it learns nothing. With
        `learns_every=3` an iteration is step, step, step, learn. Each `step` is masked, since the
        training may end at the first or second one.
        """

        def step(_: Array, carry: tuple[PyTree, _LoopState]) -> tuple[PyTree, _LoopState]:
            large, state = carry
            large, stepped = self.step(buffer, large, state, consts, masked=True, learns=False)
            return large, jax.tree.map(partial(jnp.where, state.active), stepped, state)

        first_step = state.step
        large, state = jax.lax.fori_loop(0, buffer.learns_every, step, (large, state))
        stored, _ = large
        # Keys of the last step, which did not learn.
        keys = _StepKeys.of(consts.key, state.step - 1)
        is_full = state.step == first_step + buffer.learns_every
        return large, self.learn(state, buffer, stored, keys, is_due=is_full)

    def learn(
        self,
        state: _LoopState,
        buffer: Buffer,
        stored: PyTree,
        keys: _StepKeys,
        transition: Transition | None = None,
        is_due: Array | bool = True,
    ) -> _LoopState:
        """One update of the agent, if it is due.

        Args:
          state: of the loop, with the last step counted.
          buffer: what the agent learns from.
          stored: the buffer's arrays.
          keys: of the last step.
          transition: the last step's; None after a rollout, which has stored it.
          is_due: whether the agent learns now, if its episodes of warm-up are over.
        """

        def update(agent_state: AgentState) -> AgentState:
            in_use = self.agent.batch_size(agent_state)
            batch = buffer.batch(keys.sample, stored, state.step, transition, in_use)
            return self.agent.update(keys.update, agent_state, batch)

        is_due &= state.episode >= self.agent.spec.learns_from
        agent_state = jax.lax.cond(is_due, update, lambda same: same, state.agent_state)
        return state.replace(agent_state=agent_state)

    def step(
        self,
        buffer: Buffer,
        large: PyTree,
        state: _LoopState,
        consts: _Consts,
        masked: bool,
        learns: bool = True,
    ) -> tuple[PyTree, _LoopState]:
        """One agent step: act, step the world, store, learn, and close the episode if it ended.

        Args:
          buffer: how steps are kept.
          large: `(stored, curve)`: the buffer's arrays, and the learning curve's by name.
          state: all else that changes.
          consts: what all steps only read.
          masked: a Python bool, from `while_any_active`: whether the training may be over already,
            so that writes to `large` need a mask.
          learns: a Python bool; False within a rollout, which learns at its end.

        Returns:
          `large` and `state` after the step.
        """
        stored, curve = large
        keys = _StepKeys.of(consts.key, state.step)
        action = self.agent.act(keys.act, state.agent_state, state.obs, explore=True)
        env_action = self.agent.env_action(action)
        is_index = not jnp.issubdtype(jnp.result_type(env_action), jnp.floating)
        is_fit = is_index or not isinstance(spaces_of(self.env)[1], Discrete)
        require(is_fit, "agent.act", "must give an index, jnp.int32, on this task")
        next_obs, env_state, reward, terminated, info = self.env.step_env(
            keys.env, state.env_state, env_action, consts.env_params
        )
        truncated = self.env.is_truncated(env_state, consts.env_params)
        nonfinite = state.nonfinite | info.get("nonfinite", False)
        ended = terminated | truncated | nonfinite
        # What a target bootstraps with, before gamma.
        discount = jnp.float32(info.get("discount", jnp.where(terminated, 0.0, 1.0)))
        if self.limit_is_terminal:
            discount = jnp.where(truncated, 0.0, discount)
        transition = Transition(state.obs, action, reward, discount, next_obs)
        active = state.active if masked else True
        finished = ended & active  # not in a training that is over
        stored = buffer.store(stored, state.step, transition, ended, active)
        state = state.replace(step=state.step + 1)
        if learns:
            state = self.learn(state, buffer, stored, keys, transition)
        train_steps = state.train_steps + info.get("sejax_num_steps", 1)
        # The episode's row of the curve; one that is out of range is dropped.
        row = jnp.where(finished, state.episode, self.training.max_episodes)
        episode_return = state.episode_return + reward
        state = state.replace(
            train_steps=train_steps,
            episode_return=episode_return,
            obs=next_obs,
            env_state=env_state,
            nonfinite=nonfinite,
            active=state.active & (train_steps < (self.training.max_steps or LARGEST)),
        )
        end_episode = partial(self.end_episode, keys, consts.env_params, finished)
        state = jax.lax.cond(ended, end_episode, lambda state: state, state)
        entries = {"returns": episode_return, "episode_ends": train_steps}
        entries["test_returns"] = state.tested
        curve = {name: x.at[row].set(entries[name], mode="drop") for name, x in curve.items()}
        return (stored, curve), state

    def end_episode(
        self, keys: _StepKeys, env_params: PyTree, finished: Array, state: _LoopState
    ) -> _LoopState:
        """Tests and judges the episode, and starts the next one; `step` records it.

        Under `vmap` this runs for all agents if it runs for one. Only agents that have `finished`
        are tested.
        """
        judged = state.episode_return
        if self.test_fn is not None:
            tested, num_steps = self.test_fn(keys.test, state.agent_state, finished)
            state = state.replace(tested=tested, test_steps=state.test_steps + num_steps)
            judged = tested if self.training.stops_by_tests else judged
        recent = jnp.concatenate([state.recent[1:], judged[None]])
        stop = self.stops(state, recent)
        obs, env_state = self.env.reset_env(keys.reset, env_params)
        num_episodes = state.episode + 1
        return state.replace(
            active=state.active & ~stop,
            episode=num_episodes,
            episode_return=jnp.float32(0),
            obs=obs,
            env_state=env_state,
            agent_state=self.agent.begin_episode(state.agent_state, num_episodes),
            recent=recent,
        )

    def stops(self, state: _LoopState, recent: LastReturns) -> Array:
        """Whether training ends with the episode that has just ended.

        Args:
          state: from before `end_episode` counts the episode, so that `state.episode` is its index.
          recent: as in `is_plateau`, with this episode.
        """
        training = self.training
        first = self.agent.spec.stops_from
        num_episodes = state.episode + 1
        stop = (num_episodes >= training.max_episodes) | state.nonfinite
        may_stop = (state.episode >= first) & (state.train_steps >= training.min_steps)
        if training.stop_rule == "plateau":
            flat = is_plateau(recent, num_episodes, training.plateau_tolerance)
            return stop | (may_stop & flat & (state.episode >= first + training.window))
        if training.stop_rule == "solved":
            return stop | (may_stop & is_solved(recent, num_episodes, self.solved_reward))
        return stop


def is_plateau(recent: LastReturns, num_episodes: Array, tolerance: float) -> Array:
    r"""Whether the mean returns of the last d episodes and of the d episodes before are close.

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


def is_solved(recent: LastReturns, num_episodes: Array, solved_reward: float) -> Array:
    """Whether the mean of the last d returns (of all, if fewer) reaches the solved reward."""
    window = recent.shape[0] // 2
    return reaches(recent[window:].sum() / jnp.clip(num_episodes, 1, window), solved_reward)


def _all_finite(tree: PyTree) -> Array:
    """Whether all floats of a pytree are finite; integers and keys always are."""
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.array([jnp.all(jnp.isfinite(x)) for x in leaves], bool).all()
