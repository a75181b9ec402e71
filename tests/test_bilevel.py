"""sejax.bilevel: the outer loop as one program, however it is cut, mapped and spread."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import assert_close, assert_equal, large_ops_in_loops, refused

import sejax
from sejax.bilevel import make_bilevel, make_learner
from sejax.options import registry

# 40 steps for each of 12 agents: short enough for rounding not to grow into other actions.
TINY = [
    "proxy.hidden_size=4", "agent.hidden_size=4", "agent.num_layers=1", "agent.batch_size=4",
    "preset=paper_performance", "stop_when_solved=false",
    "agent.warmup_episodes=0", "es.population_size=4", "es.noise_std=1.0",
    "training.max_episodes=3",
    "training.max_steps=40", "training.window=2", "training.test_episodes=2", "generations=3",
]  # fmt: skip
# Tables in a room of 2 x 2 cells: the same loops, which compile in a third of the time.
ROOM = [
    "env=gridworld_2x2", "agent.learning_rate=0.5", "proxy.hidden_size=4", "es.population_size=4",
    "es.noise_std=1.0", "training.max_episodes=5", "training.max_steps=30", "training.window=2",
    "training.test_episodes=2", "generations=3", "num_parallel=1",
]  # fmt: skip
KEYS = jax.random.split(jax.random.key(0), 2)


def tiny(*overrides, words=TINY):
    return sejax.config([*words, *overrides])


def program_of(*overrides, words=TINY):
    return make_bilevel(**tiny(*overrides, words=words).parts())


def compiled(program, key):
    """The generation as an executable, and the initial state for this key."""
    state = jax.jit(program.init)(key)
    return jax.jit(program.generation).lower(state).compile(), state


def run(generation, state, generations):
    """States and infos of a run that Python drives, generation by generation."""
    states, infos = [state], []
    for _ in range(generations):
        state, info = generation(states[-1])
        states.append(state)
        infos.append(jax.device_get(info))
    return states, infos


def on_one_device(words):
    """Program on one device, its compiled generation, and a run of three generations per key."""
    program = program_of("devices=1", words=words)
    generation, state = compiled(program, KEYS[0])
    runs = [run(generation, state, 3), run(generation, program.init(KEYS[1]), 3)]
    return program, generation, runs


@pytest.fixture(scope="module")
def one_device():
    """Of DDQN agents."""
    return on_one_device(TINY)


@pytest.fixture(scope="module")
def room():
    return on_one_device(ROOM)


# --- what a generation does ----------------------------------------------------------------------


def test_a_generation_measures_the_incumbent_and_then_moves_it(one_device):
    _, _, ((states, infos), _) = one_device
    moves = []
    for number, ((before, after), info) in enumerate(
        zip(itertools.pairwise(states), infos, strict=True)
    ):
        np.testing.assert_array_equal(after.last.weights, before.es_state.mean)
        np.testing.assert_array_equal(after.last.score, info.incumbent_mean)
        # All Better 2 moves the mean exactly if a member beats the incumbents' mean.
        moves.append(bool((after.es_state.mean != before.es_state.mean).any()))
        assert moves[-1] == bool(info.population_max > info.incumbent_mean)
        assert info.generation == number and info.active and info.num_nonfinite == 0
        assert 0 < info.train_steps_max <= 40
        np.testing.assert_allclose(info.train_steps.sum(), 12 * info.train_steps_mean, rtol=1e-6)
        assert (info.real_steps >= 2 * 5).all()  # 2 tests of at least 5 steps each
    assert any(moves)


def test_the_best_proxy_is_the_one_with_the_highest_incumbent_mean(one_device):
    _, _, runs = one_device
    for states, infos in runs:
        means = np.array([info.incumbent_mean for info in infos])
        best_so_far = [info.best_so_far for info in infos]
        np.testing.assert_allclose(best_so_far, np.maximum.accumulate(means))
        best = max(range(len(means)), key=lambda i: (means[i], i))
        assert states[-1].best.generation == best and states[-1].best.score == means[best]
        np.testing.assert_array_equal(states[-1].best.weights, states[best + 1].last.weights)


def test_no_two_trials_generations_or_seeds_have_a_key_in_common(one_device):
    program, _, ((states, infos), (others, _)) = one_device
    assert others[0].last.weights is not others[0].best.weights  # so that it can be donated
    assert len({float(info.population_mean) for info in infos}) == 3
    assert program.evaluate.num_trainings == 12  # 4 members with two signs, 4 incumbents
    groups = [
        keys for state in (states[0], states[1], others[0]) for keys in program.ask(state).keys
    ]
    data = np.concatenate([np.asarray(jax.random.key_data(keys)).reshape(-1, 2) for keys in groups])
    assert len(np.unique(data, axis=0)) == len(data) == 3 * 12


@pytest.mark.slow
def test_candidates_are_compared_by_tests_as_long_as_the_curriculum_says():
    """A generation is ask, the trainings one by one with tests of one step, and tell."""
    program = program_of("devices=1", "objective.first_eval_steps=1", words=ROOM)
    state = program.init(KEYS[0])
    candidates = program.ask(state)
    assert candidates.test_params.scored_steps == 1 < program.proxy.task.max_steps
    (trainings,), (run,) = program.evaluate.trainings(candidates), program.evaluate.evaluators
    of_vectors = dataclasses.replace(candidates, test_params=jnp.arange(2))  # a leaf may have axes
    (repeated,) = program.evaluate.trainings(of_vectors)
    np.testing.assert_array_equal(repeated.test_params, [[0, 1]] * len(trainings.weights))
    outcome = jax.jit(lambda: jax.lax.map(run, trainings))()
    assert (outcome.scored_returns != outcome.test_returns).any()
    after, info = jax.jit(program.generation)(state)
    expected, expected_info = program.tell(state, candidates, outcome)
    np.testing.assert_allclose(after.es_state.mean, expected.es_state.mean, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(info.incumbent_mean, expected_info.incumbent_mean, rtol=1e-6)


def test_the_programs_loops_neither_copy_nor_select_a_buffer(one_device):
    hlo = one_device[1].as_text()
    buffer = "f32[40,11]"  # replay: 40 rows of 2 * 4 + 3
    assert buffer in hlo
    for op, line in large_ops_in_loops(hlo, num_elements=440):
        assert buffer not in line.split("(")[0] or op not in ("copy", "select"), line


# --- the same numbers, however it is run ---------------------------------------------------------


def assert_result_equals_run(result, program, states, infos, **tolerance):
    history = jax.tree.map(lambda *x: np.stack(x), *infos)
    last = states[-1]
    expected = (program.unravel(last.best.weights), program.unravel(last.last.weights), history)
    assert_close((result.weights, result.last_weights, result.info), expected, **tolerance)
    assert result.generation == last.best.generation
    assert_close(result.score, last.best.score, **tolerance)


def test_a_jitted_learner_on_two_devices_equals_driving_one_by_hand_to_the_bit(room):
    program, _, ((states, infos), _) = room
    result = jax.jit(make_learner(tiny("devices=2", words=ROOM)))(KEYS[0])
    assert_result_equals_run(result, program, states, infos, rtol=0)


@pytest.mark.slow
def test_a_learner_vmapped_over_keys_equals_separate_runs(room):
    # On both devices at once: the program of the README.
    program, _, runs = room
    results = jax.jit(jax.vmap(make_learner(tiny(words=ROOM))))(KEYS)
    for i, (states, infos) in enumerate(runs):
        result = jax.tree.map(lambda x, i=i: x[i], results)
        assert_result_equals_run(result, program, states, infos, rtol=1e-4, atol=1e-5)


def test_a_curve_may_end_at_either_limit():
    words = ["env=cartpole", "proxy=rn", "objective=auc", "training.max_steps=100000"]
    assert make_bilevel(**sejax.config(words).parts())
    parts = sejax.config([*words, "proxy.hidden_size=1000000000"]).parts()
    assert refused(make_bilevel, **parts) == "proxy"


def test_four_lanes_give_the_same_numbers_as_one(room):
    _, _, ((states, infos), _) = room
    program = program_of("devices=1", "num_parallel=4", words=ROOM)
    lane_states, lane_infos = run(*compiled(program, KEYS[0]), 2)
    assert_close(lane_states[2], states[2], rtol=1e-4, atol=1e-5)
    assert_close(lane_infos, infos[:2], rtol=1e-4, atol=1e-5)


# --- stopping ------------------------------------------------------------------------------------


def test_a_run_that_has_solved_its_task_stays_as_it_is_at_no_cost(room):
    _, _, ((alone, alone_infos), _) = room
    parts = tiny("devices=1", "stop_when_solved=true", words=ROOM).parts()
    task = dataclasses.replace(parts["task"], solved_reward=float(alone_infos[0].incumbent_mean))
    proxy = registry.make("proxy", parts["proxy"].config, task)
    program = make_bilevel(**parts | {"task": task, "proxy": proxy})
    assert program.solved_score == task.solved_reward
    states, infos = run(*compiled(program, KEYS[0]), 3)
    assert states[1].solved and infos[0].active
    assert_equal(states[1].best, alone[1].best)
    for state, info in zip(states[2:], infos[1:], strict=True):
        assert_equal(state, states[1])
        assert not info.active and info.train_steps.sum() == info.real_steps.sum() == 0


# --- trouble -------------------------------------------------------------------------------------


def test_a_population_of_proxies_that_diverge_is_counted_and_leaves_no_trace(one_device):
    _, generation, ((states, _), _) = one_device
    wild = states[1].replace(es_state=states[1].es_state.replace(noise_std=jnp.float32(1e30)))
    after, info = generation(wild)
    # All 8 perturbed proxies give numbers that are none; the 4 incumbents are as good as ever.
    assert info.num_nonfinite == 8
    assert np.isnan(info.population_mean) and np.isnan(info.population_max)
    assert np.isfinite(info.incumbent_mean) and np.isfinite(info.incumbent_std)
    np.testing.assert_array_equal(after.es_state.mean, wild.es_state.mean)
    assert 0 < info.train_steps_max <= 40


def test_an_incumbent_that_diverges_is_never_the_best(one_device):
    _, generation, ((states, _), _) = one_device
    es_state = states[0].es_state
    broken = states[0].replace(es_state=es_state.replace(mean=jnp.nan * es_state.mean))
    after, info = generation(broken)
    assert info.num_nonfinite == 12
    assert after.last.score == -jnp.inf and after.best.generation == -1
    np.testing.assert_array_equal(after.best.weights, states[0].best.weights)


def test_generations_beside_a_configuration_win():
    learn = make_learner(tiny(words=ROOM), generations=2)
    assert jax.eval_shape(learn, jax.random.key(0)).info.generation.shape == (2,)


@pytest.mark.parametrize(("part", "value"), [
    ("task", "nes"), ("agent", "nes"), ("proxy", "nes"), ("es", "nes"), ("objective", "nes"),
    ("generations", 0), ("generations", 1.5), ("devices", jax.device_count() + 1),
])  # fmt: skip
def test_what_no_learner_can_be_made_of_is_refused(part, value):
    parts = tiny(words=ROOM).parts()
    assert refused(make_learner, **parts | {part: value}) == part
    for fault in ({"num_candidates": 6}, {"num_evals": 0}, {"num_incumbent_evals": 0}):
        strategy = dataclasses.replace(sejax.NESConfig(population_size=4).make(138), **fault)
        assert refused(make_learner, **parts | {"es": strategy}) == "es"


@pytest.mark.parametrize(("words", "overrides"), [
    (ROOM, ("es=open_es",)), (ROOM, ("proxy=rn", "objective=auc")),
    (ROOM, ("es.mirrored=false", "es.num_evals=2")),
    (TINY, ("agent.activation=prelu", "proxy.activation=prelu", "proxy.done=threshold")),
], ids=lambda words: " ".join(words) if isinstance(words, tuple) else words[0])  # fmt: skip
def test_every_kind_of_configuration_makes_a_scan_body(words, overrides):
    # Tracing only: the state that comes out has the types of the one that goes in.
    program = program_of(*overrides, words=words)
    state = jax.eval_shape(program.init, KEYS[0])
    after, info = jax.eval_shape(program.generation, state)
    types = [[(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(x)] for x in (state, after)]
    assert types[0] == types[1]
    strategy = program.layout.strategy
    assert info.population_scores.shape == (strategy.num_candidates * strategy.num_evals,)
    assert info.train_steps.shape == info.real_steps.shape == (program.evaluate.num_trainings,)
    assert info.incumbent_mean.shape == ()
