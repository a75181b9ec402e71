"""sejax.training: the inner loop against a plain Python one, alone and in lanes."""

import dataclasses
import functools
import re

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scripted import MAX_EPISODES, MAX_STEPS, WHO, ScriptedEnv, script, scripted_agent
from support import assert_close, assert_equal, paper_se, paper_training, refused

from sejax import envs, evaluation
from sejax.agents import AgentSpec
from sejax.agents.buffers import Buffer, Rollout, rollout_buffer
from sejax.agents.dqn import DDQN, DDQNConfig
from sejax.agents.tabular import QLearningConfig
from sejax.envs.wrappers import PartlyScored, PartParams
from sejax.evaluation import make_recorder, make_tester
from sejax.options import registry
from sejax.training import is_plateau, is_solved, make_trainer

WINDOW, TOLERANCE, SOLVED, INIT_EPISODES = 2, 0.25, 1.5, 2
KEY = jax.random.key(0)
ENV = ScriptedEnv()


def training(**fields):
    scripted = {"max_episodes": MAX_EPISODES, "window": WINDOW, "plateau_tolerance": TOLERANCE}
    return paper_training(**scripted | {"time_limit_is_terminal": False} | fields)


def scripted_test(key, agent_state, active):
    """A test between episodes whose return is -1, 0, 1, 2, ... after episode 0, 1, 2, ..."""
    return agent_state.episode - 1.0, jnp.int32(3)


VARIANTS = {
    "never": training(stop_rule="never"),
    "plateau": training(stop_rule="plateau"),
    "solved": training(stop_rule="solved", solved_by="train"),
    "tested": training(stop_rule="solved", solved_by="test"),
    "cut": training(stop_rule="never", time_limit_is_terminal=True, max_steps=17),
    "watched": training(stop_rule="plateau", tests_between=1),
    "patient": training(stop_rule="plateau", min_steps=14),
}


@functools.cache
def trainer(variant):
    """The jitted scripted training of a variant: `(key, env_params, weight=0, active=True)`."""
    train = make_trainer(
        scripted_agent(INIT_EPISODES), ENV, VARIANTS[variant], SOLVED, test_fn=scripted_test
    )
    return jax.jit(train)


def stacked(scripts):
    """The scripts of several lanes as one."""
    return jax.tree.map(lambda *x: np.stack(x), *scripts)


def plain_training(returns, lengths, rule, min_steps=0):
    """The paper's loop and stopping rules in plain Python: episodes, steps, updates."""
    steps, updates = 0, 0
    for episode in range(MAX_EPISODES):
        length = min(lengths[episode], MAX_STEPS)
        steps += length
        if episode < INIT_EPISODES:
            continue
        updates += length
        history = returns[: episode + 1]
        newer, older = np.mean(history[-WINDOW:]), np.mean(history[-2 * WINDOW : -WINDOW])
        may_be_flat = rule == "plateau" and episode >= INIT_EPISODES + WINDOW
        is_flat = may_be_flat and abs(newer - older) <= TOLERANCE * (abs(older) + 1e-9)
        if steps >= min_steps and (is_flat or (rule == "solved" and newer >= SOLVED)):
            break
    return episode + 1, steps, updates


scripts = st.tuples(
    st.lists(st.integers(-3, 3), min_size=MAX_EPISODES, max_size=MAX_EPISODES),
    st.lists(st.integers(1, 6), min_size=MAX_EPISODES, max_size=MAX_EPISODES),
)


# --- the loop ------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", ["never", "plateau", "solved", "patient"])
@given(scripted=scripts)
@example(scripted=([3] * 12, [1] * 12))  # flat, or solved, as soon as the rule may say so
@example(scripted=([2**n for n in range(12)], [1] * 12))  # never flat
def test_training_equals_a_plain_python_loop(variant, scripted):
    returns, lengths = scripted
    rule, min_steps = VARIANTS[variant].stop_rule, VARIANTS[variant].min_steps
    num_episodes, steps, updates = plain_training(returns, lengths, rule, min_steps)
    result = trainer(variant)(KEY, script(returns, lengths))
    assert (result.train_steps, result.episodes) == (steps, num_episodes)
    unfinished = MAX_EPISODES - num_episodes
    ends = np.cumsum(np.minimum(lengths, MAX_STEPS))[:num_episodes]
    np.testing.assert_array_equal(result.returns, returns[:num_episodes] + [np.nan] * unfinished)
    np.testing.assert_array_equal(result.episode_ends, [*ends, *[0] * unfinished])
    assert result.agent_state.num_updates == updates
    assert not result.nonfinite and result.test_steps == 0 and result.test_returns is None


@pytest.mark.parametrize(("variant", "num_episodes"), [
    ("tested", 4),  # test returns -1, 0, 1, 2: the mean of the last two is 1.5
    ("watched", 5),  # the training's own returns are judged, flat from the first on
])  # fmt: skip
def test_tests_between_episodes_are_recorded_and_decide_if_the_rule_asks_for_them(
    variant, num_episodes
):
    result = trainer(variant)(KEY, script([3] * 12, [1] * 12))
    unfinished = [np.nan] * (12 - num_episodes)
    assert result.episodes == num_episodes and result.test_steps == num_episodes * 3
    np.testing.assert_array_equal(result.returns, [3] * num_episodes + unfinished)
    np.testing.assert_array_equal(result.test_returns, [*range(-1, num_episodes - 1), *unfinished])


def test_a_solved_training_that_is_tested_throughout_goes_on():
    numbers = {name: VARIANTS[name].tests_after_each for name in ("tested", "plateau", "solved")}
    assert numbers == {"tested": 1, "plateau": 0, "solved": 0}
    for rule, goes_on in (("tested", "never"), ("plateau", "plateau")):
        throughout = evaluation.tested_throughout(VARIANTS[rule])
        assert throughout == training(stop_rule=goes_on, tests_between=1)


def test_a_mean_that_equals_the_solved_reward_but_for_rounding_solves():
    returns = np.float32([0] * 10 + [np.float32(-0.01) + 1] * 10)
    assert is_solved(returns, 100, 0.99) and not is_solved(returns, 100, np.inf)


def test_a_step_budget_ends_training_within_an_episode():
    result = trainer("cut")(KEY, script([7] * 12, [4] * 12))
    assert (result.train_steps, result.episodes) == (17, 4)  # the fifth has no return
    np.testing.assert_array_equal(result.returns, [7] * 4 + [np.nan] * 8)
    assert result.agent_state.num_updates == 17 - 8


def test_all_episodes_are_trained_to_the_step_limit_of_the_params():
    result = trainer("never")(KEY, script([1] * 12, [99] * 12, max_steps_in_episode=7))
    assert result.episodes == 12 and result.train_steps == 12 * 7


# --- what is stored ------------------------------------------------------------------------------


def stored(result):
    """Rows of the last batch as tuples (episode, time, reward, discount, next time)."""
    batch = result.agent_state.batch
    np.testing.assert_array_equal(batch.action % WHO, batch.obs[0])  # acted on what it saw
    np.testing.assert_array_equal(batch.obs[1], batch.next_obs[1])  # the same episode's tag
    columns = (batch.action // WHO, batch.obs[0], batch.reward, batch.discount, batch.next_obs[0])
    return {tuple(float(c[i]) for c in columns) for i in range(batch.reward.size)}


def test_the_replay_holds_what_happened_with_the_true_last_observations():
    # Lengths 2 and 3 terminate, 6 is cut by the limit of 4 and bootstraps.
    lengths = [2, 3, 6] * 4
    result = trainer("never")(KEY, script(range(12), lengths))
    expected = set()
    for episode, length in enumerate(lengths):
        for t in range(min(length, MAX_STEPS)):
            last = t + 1 == min(length, MAX_STEPS)
            discount = 0.0 if t + 1 >= length else 1.0
            expected.add((float(episode), float(t), episode * last, discount, t + 1.0))
    rows = stored(result)
    assert rows <= expected
    # 64 draws of 36 rows: half of them are met, ends of both kinds among them.
    assert len(rows) > 18
    assert {discount for _, t, _, discount, next_t in rows if next_t == 4} == {1.0}
    assert 0.0 in {discount for *_, discount, _ in rows}


def test_each_episode_starts_from_a_fresh_reset():
    batch = trainer("never")(KEY, script([0] * 12, [1] * 12)).agent_state.batch
    episodes = np.unique(batch.action // WHO)
    assert 8 < len(episodes) == len(np.unique(batch.obs[1]))  # tags


def test_a_time_limit_bootstraps_unless_it_is_asked_to_be_terminal():
    params = script([0] * 12, [99] * 12)  # no episode terminates
    assert trainer("never")(KEY, params).agent_state.min_discount == 1.0
    result = trainer("cut")(KEY, params)
    assert result.agent_state.min_discount == 0.0
    assert {d for _, t, _, d, _ in stored(result) if t < MAX_STEPS - 1} == {1.0}


# --- trainings that go wrong ---------------------------------------------------------------------


def test_a_number_that_is_not_finite_stops_training_and_is_flagged():
    result = trainer("never")(KEY, script([5] * 12, [3] * 12, nonfinite_episode=2))
    assert result.nonfinite
    assert result.train_steps == 3 + 3 + 2 and result.episodes == 3


@pytest.mark.parametrize("weight", [1.0, jnp.nan, jnp.inf])
def test_weights_that_are_not_finite_are_flagged(weight):
    result = trainer("never")(KEY, script([5] * 12, [3] * 12), weight)
    assert result.nonfinite == (weight != 1.0)


# --- the stopping rules by hand ------------------------------------------------------------------


@pytest.mark.parametrize(("recent", "num_episodes", "flat"), [
    # Windows of 2, tolerance 1 %. Older mean 100: newer may be 99 to 101.
    ([100, 100, 100.5, 101.3], 4, True),  # newer 100.9
    ([100, 100, 101, 101.4], 4, False),  # newer 101.2
    ([-100, -100, -100.4, -101.2], 9, True),  # relative to the magnitude: 0.8 of 1
    ([50, -50, 0, 0], 4, True),  # older 0, newer 0
    ([50, -50, 0, 0.1], 4, False),  # older 0: nothing but 0 is close
    # Three episodes 5, 5, 5: the older window holds one of them, whose mean is 5.
    ([0, 5, 5, 5], 3, True),
    ([0, 4, 5, 5], 3, False),
    # One episode: newer is its return, older 0.
    ([0, 0, 0, 5], 1, False),
    # Windows of 3, five episodes: older (2.01 + 2) / 2 = 2.005, newer 2.
    ([0, 2.01, 2, 3, 2, 1], 5, True),
    ([1, 1, 1, np.nan], 4, False),
])  # fmt: skip
def test_a_plateau_compares_the_last_window_with_the_one_before(recent, num_episodes, flat):
    recent = jnp.array(recent, jnp.float32)
    assert bool(is_plateau(recent, jnp.int32(num_episodes), 0.01)) == flat


# --- what it asks of an agent --------------------------------------------------------------------


OFFSET = 5000  # the world's action 0 as the agent means it


def test_the_world_sees_what_the_agent_means_and_the_memory_what_it_did():
    plain = scripted_agent(batch_size=32)
    empty = plain.init(KEY, 0.0)
    empty = empty.replace(batch=empty.batch._replace(weight=jnp.zeros(32)))
    agent = dataclasses.replace(
        plain,
        init=lambda key, hparams: empty,
        act=lambda key, state, obs, explore: OFFSET + plain.act(key, state, obs, explore),
        env_action=lambda action: action - OFFSET,
        batch_size=lambda state: jnp.float32(3),
    )
    train = jax.jit(make_trainer(agent, ENV, training(stop_rule="never")))
    result = train(KEY, script(range(12), [3] * 12))
    assert result.train_steps == 36
    np.testing.assert_array_equal(result.returns, np.arange(12))
    drawn = result.agent_state.batch
    assert (np.asarray(drawn.action) >= OFFSET).all()
    assert drawn.weight.sum() == 3  # as many as the agent wants
    task = envs.Task(name="script", env=ENV, params=script(range(12), [3] * 12))
    tests = make_tester(agent, task, 2)(KEY, agent.begin_episode(empty, 7))
    np.testing.assert_array_equal(tests.returns, [7, 7])
    np.testing.assert_array_equal(tests.num_steps, [3, 3])


# --- lanes ---------------------------------------------------------------------------------------


@functools.cache
def scripted_lanes():
    """Keys, params, weights and whether they run, of six trainings: `[lane, ...]`."""
    rng = np.random.default_rng(0)
    scripts = [script(rng.integers(-2, 3, 12), rng.integers(1, 7, 12)) for _ in range(5)]
    scripts.append(script([1] * 12, [3] * 12, nonfinite_episode=1))
    active = np.array([True, True, False, True, True, True])
    return jax.random.split(KEY, 6), stacked(scripts), np.arange(6, dtype=np.float32), active


@pytest.mark.parametrize(("variant", "shape"), [("plateau", (6,)), ("tested", (2, 3))])
def test_lanes_equal_single_trainings(variant, shape):
    train = in_lanes = trainer(variant)
    for _ in shape:
        in_lanes = jax.vmap(in_lanes)
    lanes = scripted_lanes()
    many = jax.jit(in_lanes)(*jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), lanes))
    many = jax.tree.map(lambda x: x.reshape(6, *x.shape[len(shape) :]), jax.device_get(many))
    assert len(set(many.train_steps.tolist())) > 2  # stopped at different times
    for i in range(6):
        lane, alone = (jax.tree.map(lambda x, i=i: x[i], tree) for tree in (many, lanes))
        assert_close(lane, train(*alone), rtol=1e-4, atol=1e-4)


def test_a_rollout_is_learned_from_once_it_is_full_and_a_lane_that_has_stopped_does_nothing():
    num_tests = []

    def tested(key, agent_state, active):
        jax.debug.callback(lambda happens: num_tests.append(int(happens)), active)
        return jnp.float32(0), jnp.int32(1)

    plain = scripted_agent(warmup_episodes=0)
    empty = plain.init(KEY, 0.0).replace(batch=Rollout(jnp.zeros((13, 8))))
    agent = dataclasses.replace(
        plain,
        init=lambda key, hparams: empty,
        update=lambda key, state, rollout: state.replace(
            num_updates=state.num_updates + 1, batch=rollout
        ),
        buffer=rollout_buffer(13),
    )
    config = training(stop_rule="never", max_steps=30, tests_between=1)
    train = make_trainer(agent, ENV, config, test_fn=tested)
    params = stacked([script([1] * 12, [length] * 12) for length in (1, 2, 3)])
    result = jax.jit(jax.vmap(train))(jax.random.split(KEY, 3), params)
    jax.effects_barrier()
    np.testing.assert_array_equal(result.train_steps, [12, 24, 30])
    assert sum(num_tests) == 12 + 12 + 10
    np.testing.assert_array_equal(result.agent_state.num_updates, [0, 1, 2])
    *_, actions, _, _, _ = np.moveaxis(np.asarray(result.agent_state.batch.rows), -1, 0)
    second, third = np.arange(13), np.arange(13, 26)  # steps of the last full rollout
    expected = np.zeros(13), WHO * (second // 2) + second % 2, WHO * (third // 3) + third % 3
    np.testing.assert_array_equal(actions, expected)


def test_a_time_limit_is_never_terminal_in_an_se():
    """As programs; what they do on a real task is above."""
    env = paper_se(hidden_size=4).make(envs.make("cartpole"))
    agent = DDQN(DDQNConfig(hidden_size=4, num_layers=1, batch_size=4), 4, 2).agent()
    programs = set()
    for is_terminal in (False, True):
        train = make_trainer(agent, env, training(time_limit_is_terminal=is_terminal))
        program = str(jax.make_jaxpr(train)(KEY, env.default_params))
        programs.add(re.sub("0x[0-9a-f]+", "", program))
    assert len(programs) == 1


# --- the test on the real task -------------------------------------------------------------------


def test_the_tester_equals_greedy_episodes_in_gymnasium():
    task, key = envs.make("cartpole"), jax.random.key(3)
    agent = DDQN(DDQNConfig(hidden_size=8, num_layers=1), 4, 2).agent()
    state = agent.init(jax.random.key(2), agent.hparams)
    returns, steps, _ = jax.jit(make_tester(agent, task, num_episodes=6))(key, state)
    assert returns.shape == steps.shape == (6,)
    reference = gymnasium.make("CartPole-v1", max_episode_steps=200)
    greedy = jax.jit(lambda obs: agent.act(key, state, obs, explore=False))
    for i, key_episode in enumerate(jax.random.split(key, 6)):
        obs, _ = task.env.reset_env(jax.random.split(key_episode)[0], task.params)
        reference.reset(seed=0)
        reference.unwrapped.state = np.array(obs, np.float64)
        total, num_steps, ended = 0.0, 0, False
        while not ended:
            obs, reward, terminated, truncated, _ = reference.step(int(greedy(jnp.float32(obs))))
            total, num_steps = total + reward, num_steps + 1
            ended = terminated or truncated
        assert (returns[i], steps[i]) == (total, num_steps)
    assert len(set(np.asarray(steps).tolist())) > 1  # different initial states


# --- steps that a buffer keeps --------------------------------------------------------------------

LENGTHS = [2, 3, 6, 1] * 3


def row_buffer(example, max_steps):
    """Keeps episode, time and whether it ended of each step, by the buffers' contract."""
    assert example.obs.shape == (2,) and max_steps == 100

    def store(rows, step, transition, ended, active):
        row = jnp.stack([transition.action // WHO, transition.obs[0].astype(int), ended])
        return rows.at[step].set(jnp.where(active, row, rows[step]))

    batch = scripted_agent().init(KEY, 0.0).batch
    return Buffer(init=lambda: jnp.full((max_steps, 3), -1), store=store, batch=lambda *_: batch)


def test_a_buffer_is_handed_every_step_and_none_after_the_last():
    config = training(stop_rule="plateau", max_steps=100)
    agent = dataclasses.replace(scripted_agent(INIT_EPISODES), buffer=row_buffer)
    train = make_trainer(agent, ENV, config, keeps_stored=True)
    params = stacked([script(returns, LENGTHS) for returns in (range(12), [3] * 12)])
    result = jax.jit(jax.vmap(train))(jax.random.split(KEY, 2), params, jnp.zeros(2))
    for lane, num_episodes in ((0, 12), (1, 5)):
        expected = [
            (episode, time, time + 1 == min(LENGTHS[episode], MAX_STEPS))
            for episode in range(num_episodes)
            for time in range(min(LENGTHS[episode], MAX_STEPS))
        ]
        assert result.episodes[lane] == num_episodes
        assert result.train_steps[lane] == len(expected)
        np.testing.assert_array_equal(result.stored[lane, : len(expected)], expected)
        np.testing.assert_array_equal(result.stored[lane, len(expected) :], -1)


def scripted_task(length):
    """A task that pays 2.5 at the end of each episode, which terminates after so many steps."""
    return envs.Task(name="script", env=ENV, params=script([2.5] * 12, [length] * 12))


def scripted_state():
    return scripted_agent().init(KEY, 0.0).replace(episode=jnp.int32(0))


@pytest.mark.parametrize(("repeat", "scored_steps", "scored", "num_steps"), [
    # Episodes that go on for ever, cut after 4 steps, pay 2.5 in step 4 and in the last one.
    (1, 3, 0.0, 4), (1, 4, 2.5, 4), (1, 6, 5.0, 6),
    (3, 9, 5.0, 9),  # decisions of 3 and 1 steps, then of 3 and 2
])  # fmt: skip
def test_a_part_of_a_test_or_more_than_all_of_it_may_be_scored(
    repeat, scored_steps, scored, num_steps
):
    agent = dataclasses.replace(scripted_agent(), spec=AgentSpec(action_repeat=repeat))
    task = scripted_task(99)
    test = jax.jit(make_tester(agent, task, 2, lambda env: PartlyScored(env, task.params)))
    params = PartParams(scored_steps=jnp.int32(scored_steps))
    tests = test(KEY, scripted_state(), True, params)
    # Returns are of the task's own 4 steps.
    assert_equal(tests, [np.full(2, number) for number in (2.5, num_steps, scored)])
    not_begun = test(KEY, scripted_state(), False, params)
    assert not not_begun.returns.any() and not not_begun.num_steps.any()


def test_recorded_tests_are_the_tests():
    task, agent = scripted_task(3), scripted_agent()
    both = make_tester(agent, task, 3), make_recorder(agent, task, 3)
    (returns, num_steps, scored), steps = jax.jit(lambda *args: [f(*args) for f in both])(
        KEY, scripted_state()
    )
    valid = np.array(steps.valid).reshape(3, MAX_STEPS)
    np.testing.assert_array_equal(valid, [[True] * 3 + [False]] * 3)
    np.testing.assert_array_equal(valid.sum(axis=1), num_steps)
    rewards = np.array(steps.reward).reshape(3, MAX_STEPS)
    np.testing.assert_array_equal((rewards * valid).sum(axis=1), returns)
    np.testing.assert_array_equal(scored, returns)  # all that was played
    np.testing.assert_array_equal(steps.terminated[valid.ravel()], [False, False, True] * 3)
    keys = [jax.random.split(key)[0] for key in jax.random.split(KEY, 3)]
    starts = [float(ENV.reset_env(key, task.params)[0][1]) for key in keys]  # each episode's tag
    np.testing.assert_array_equal(steps.obs[:, 1].reshape(3, -1)[:, 0], np.float32(starts))


# --- what cannot be ------------------------------------------------------------------------------


def test_a_length_that_the_episodes_cannot_reach_is_refused():
    """One-step SEs: the default's 1,000 episodes are 1,000 steps."""
    task = envs.make("cartpole")
    agent = registry.make("agent", DDQNConfig(warmup_episodes=1), task)
    env = paper_se(initial_state="learned", horizon=1).make(task)
    config = paper_training(max_steps=4000, stop_rule="never")
    assert refused(make_trainer, agent, env, config) == "training.max_episodes"
    assert make_trainer(agent, env, dataclasses.replace(config, max_episodes=4000))
    assert make_trainer(agent, env, dataclasses.replace(config, stop_rule="plateau"))  # a bound
    assert make_trainer(agent, task.env, config)  # whose params may allow any length


def traced(agent, task, **parts):
    """The shapes of a training by an agent some parts of which are replaced."""
    train = make_trainer(dataclasses.replace(agent, **parts), task.env)
    return jax.eval_shape(train, KEY, task.params)


@pytest.mark.parametrize("make, field", [
    (lambda agent, task: make_trainer(task.env, agent), "agent"),
    (lambda agent, task: make_trainer(agent, task), "env"),
    (lambda agent, task: make_trainer(agent, task.env, {"max_steps": 3}), "training"),
    (lambda x, task: make_trainer(x, task.env, training(stop_rule="solved")), "solved_reward"),
    (lambda agent, task: evaluation.make_evaluator(agent, task.env, task.env, training()), "task"),
    (lambda agent, task: jax.enable_x64(True)(make_trainer)(agent, task.env), "jax_enable_x64"),
    (lambda agent, task: traced(agent, task, buffer=rollout_buffer(4)), "agent.buffer"),
    (lambda x, task: traced(x, task, act=lambda *_, explore: jnp.float32(0)), "agent.act"),
])  # fmt: skip
def test_arguments_of_other_kinds_are_refused(make, field):
    task = envs.make("gridworld_2x2")
    assert refused(make, registry.make("agent", QLearningConfig(), task), task) == field
