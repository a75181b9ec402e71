"""sejax.agents.ppo: returns and loss by hand, phases against torch, lanes, and bandits."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from sejax import envs
from sejax.agents import replay
from sejax.agents.agent import traced
from sejax.agents.memory import Rollout
from sejax.agents.ppo import (
    MIN_STD,
    SOFTMAX,
    PPOConfig,
    discounted_returns,
    gaussian,
    make_ppo,
    normalized,
    ppo_loss,
)
from sejax.agents.replay import Transition
from sejax.networks import MLP
from sejax.rollout import make_tester
from sejax.trainer import TrainingConfig, make_trainer

OBS_DIM, NUM_ACTIONS, ACTION_DIM, MAX_ACTION, MAX_STEPS = 3, 4, 2, 2.0, 6
STEPS = 13  # two episodes of full length, and one step
ENDS = (3, 4, 9)  # last steps of episodes; the rollout is cut within the fourth
GOLDEN = Path(__file__).parent / "golden" / "ppo_updates.npz"
CONFIG = PPOConfig(
    hidden_size=5, num_layers=2, activation="tanh", learning_rate=0.01, discount=0.9,
    update_episodes=2, epochs=3, clip_ratio=0.05, value_weight=0.7, entropy_weight=0.05,
)  # fmt: skip
HPARAMS = traced(CONFIG)
KINDS = ("discrete", "continuous")
KEY = jax.random.key(0)


def ppo(kind, config=CONFIG):
    discrete = kind == "discrete"
    return make_ppo(config, OBS_DIM, NUM_ACTIONS if discrete else None,
                    None if discrete else ACTION_DIM, MAX_ACTION, MAX_STEPS)  # fmt: skip


def networks(kind, config=CONFIG):
    """The actor, the critic, and the function from flat parameters to the nested ones."""
    num_outputs, std_dim = (NUM_ACTIONS, 0) if kind == "discrete" else (ACTION_DIM, ACTION_DIM)
    actor, critic = (
        MLP(size, config.hidden_size, config.num_layers, config.activation, learn_prelu_slope=True)
        for size in (num_outputs, 1)
    )
    example = {
        "actor": actor.init(KEY, jnp.zeros(OBS_DIM)),
        "critic": critic.init(KEY, jnp.zeros(OBS_DIM)),
        "std": jnp.zeros(std_dim),
    }
    return actor, critic, ravel_pytree(example)[1]


def random_steps(kind, seed):
    """`STEPS` random transitions, one in a row, and where episodes end."""
    rng = np.random.default_rng(seed)
    if kind == "discrete":
        action = jnp.int32(rng.integers(0, NUM_ACTIONS, STEPS))
    else:
        action = jnp.float32(rng.normal(scale=0.5, size=(STEPS, ACTION_DIM)))
    ended = np.zeros(STEPS, np.float32)
    ended[list(ENDS)] = 1.0
    steps = Transition(
        obs=jnp.float32(rng.normal(size=(STEPS, OBS_DIM))),
        action=action,
        reward=jnp.float32(rng.normal(size=STEPS)),
        discount=jnp.float32(rng.uniform(-0.2, 1.2, STEPS)),  # must not matter
        next_obs=jnp.float32(rng.normal(size=(STEPS, OBS_DIM))),
    )
    return steps, jnp.array(ended)


def pack(steps, ended):
    """Rows as a rollout keeps them."""
    steps = steps._replace(weight=jnp.ones_like(ended))
    return jnp.concatenate([jax.vmap(replay.pack)(steps), ended[:, None]], axis=1)


def rollout(kind, seed=0, is_full=True):
    return Rollout(rows=pack(*random_steps(kind, seed)), is_full=jnp.bool_(is_full))


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def agent(kind):
    return ppo(kind)


@pytest.fixture(scope="module")
def state(agent):
    return agent.init(jax.random.key(1), agent.hparams)


@pytest.fixture(scope="module")
def update(agent):
    return jax.jit(agent.update)


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


# --- returns -------------------------------------------------------------------------------------


def test_returns_by_hand():
    # gamma = 0.5. The first episode ends at its third step, the second is cut after two:
    # 4; 2 + 0.5 * 4 = 4; 1 + 0.5 * 4 = 3. Then 6, and 8 + 0.5 * 6 = 11.
    reward, ended = jnp.array([1.0, 2.0, 4.0, 8.0, 6.0]), jnp.array([0.0, 0.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(discounted_returns(reward, ended, 0.5), [3.0, 4.0, 4.0, 11.0, 6.0])


@pytest.mark.parametrize("ends", [(), ENDS, (STEPS - 1,), range(STEPS)])
def test_returns_equal_a_plain_loop(ends):
    reward = np.random.default_rng(0).normal(size=STEPS).astype(np.float32)
    ended = np.zeros(STEPS, np.float32)
    ended[list(ends)] = 1.0
    expected = np.zeros(STEPS)
    for start in range(STEPS):
        for step in range(start, STEPS):
            expected[start] += 0.9 ** (step - start) * reward[step]
            if ended[step]:
                break
    got = jax.jit(discounted_returns)(reward, ended, 0.9)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)


def test_normalized_returns_have_mean_zero_and_std_one():
    # Mean 2; unbiased variance (1 + 0 + 1) / 2 = 1.
    np.testing.assert_allclose(normalized(jnp.array([1.0, 2.0, 3.0])), [-1, 0, 1], rtol=2e-5)
    np.testing.assert_array_equal(normalized(jnp.full(4, 3.0)), 0.0)
    np.testing.assert_array_equal(normalized(jnp.array([3.0])), 0.0)


# --- the loss ------------------------------------------------------------------------------------


def loss_inputs():
    """Columns on both sides of the clip with advantages of both signs."""
    rng = np.random.default_rng(3)
    names = ("log_prob", "entropy", "value", "old_log_prob", "returns")
    inputs = {name: jnp.float32(rng.normal(size=STEPS)) for name in names}
    return inputs | {"old_log_prob": inputs["log_prob"] + 0.2 * inputs["old_log_prob"]}


def test_loss_by_hand():
    hp = HPARAMS._replace(clip_ratio=0.2, value_weight=0.5, entropy_weight=0.1)
    # Ratios 2, 2, 0.5, 0.5 and advantages 1, -1, 1, -1. The smaller of the ratio's and of the
    # clipped ratio's product: min(2, 1.2), min(-2, -1.2), min(0.5, 0.8), min(-0.5, -0.8); mean
    # (1.2 - 2 + 0.5 - 0.8) / 4 = -0.275. Value error 1, entropy 3: 0.275 + 0.5 - 0.3 = 0.475.
    log_prob = jnp.log(jnp.array([2.0, 2.0, 0.5, 0.5]))
    returns = jnp.array([1.0, -1.0, 1.0, -1.0])
    loss = ppo_loss(log_prob, jnp.full(4, 3.0), jnp.zeros(4), jnp.zeros(4), returns, hp)
    np.testing.assert_allclose(loss, 0.475, rtol=1e-6)


def test_loss_and_gradients_equal_torchs():
    golden = np.load(GOLDEN)  # made by torch_ppo.py
    inputs = loss_inputs()
    others = {name: inputs.pop(name) for name in ("old_log_prob", "returns")}
    loss, gradients = jax.value_and_grad(lambda x: ppo_loss(**x, **others, hp=HPARAMS))(inputs)
    np.testing.assert_allclose(loss, golden["loss"], rtol=1e-6)
    for name, gradient in gradients.items():
        np.testing.assert_allclose(gradient, golden[f"loss/{name}"], rtol=1e-5, atol=1e-7)


def test_loss_and_gradients_are_finite_however_far_the_policy_has_moved():
    def loss(log_prob):
        values = jnp.array([3.0, -3.0])
        return ppo_loss(log_prob, values, values, jnp.zeros(2), jnp.zeros(2), HPARAMS)

    for log_ratio in (1e5, -1e5):
        value, gradient = jax.value_and_grad(loss)(jnp.full(2, log_ratio))
        assert np.isfinite(value) and np.isfinite(gradient).all()


# --- phases --------------------------------------------------------------------------------------


def test_learning_phases_equal_torchs(kind, state, update):
    golden = np.load(GOLDEN)
    state = state.replace(params=jnp.asarray(golden[f"{kind}/params/0"]))
    for number in (1, 2):
        state = update(KEY, state, rollout(kind, number))
        expected = golden[f"{kind}/params/{number}"]
        np.testing.assert_allclose(state.params, expected, rtol=2e-5, atol=5e-6)


def test_nothing_changes_until_the_rollout_is_full(kind, state, update):
    assert_equal(update(KEY, state, rollout(kind, is_full=False)), state)
    after = update(KEY, state, rollout(kind))
    assert after.opt_state.count == CONFIG.epochs
    assert np.abs(after.params - state.params).max() > 0.01


def test_lanes_learn_as_they_would_alone(kind, agent, update):
    keys = jax.random.split(KEY, 3)
    states = jax.vmap(agent.init, (0, None))(keys, agent.hparams)
    rates = jnp.array([0.05, 0.05, 0.01])
    states = states.replace(hparams=states.hparams._replace(learning_rate=rates))
    rollouts = [rollout(kind, seed, seed != 1) for seed in range(3)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *rollouts)
    lanes = jax.jit(jax.vmap(agent.update, (None, 0, 0)))(KEY, states, stacked)
    for lane in range(3):
        before, got = (jax.tree.map(lambda x: x[lane], s) for s in (states, lanes))  # noqa: B023
        alone = update(KEY, before, rollouts[lane])
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), got, alone
        )
        assert (lane == 1) == bool((got.params == before.params).all())


def test_a_step_without_a_phase_does_none_of_its_work():
    # Were any of these epochs made, this test would not end.
    config = PPOConfig(**{**vars(CONFIG), "epochs": 10**9})
    agent = ppo("discrete", config)
    states = jax.vmap(agent.init, (0, None))(jax.random.split(KEY, 2), agent.hparams)
    rollouts = jax.tree.map(lambda x: jnp.stack([x, x]), rollout("discrete", is_full=False))
    compiled = jax.jit(jax.vmap(agent.update, (None, 0, 0))).lower(KEY, states, rollouts).compile()
    assert_equal(compiled(KEY, states, rollouts), states)
    # Nor has the compiler moved anything that is as long as the rollout out of the phase.
    entry = compiled.as_text().split("\nENTRY ")[1]
    long = [line for line in entry.splitlines() if re.search(rf"= \w+\[[\d,]*\b{STEPS}\b", line)]
    assert long and all(" parameter(" in line for line in long), "\n".join(long)


def test_a_state_keeps_its_types_so_that_loops_may_carry_it(kind, agent, state):
    for full in (True, False):
        after = jax.eval_shape(agent.update, KEY, state, rollout(kind, is_full=full))
        before = jax.eval_shape(lambda: state)
        assert jax.tree.leaves(after) == jax.tree.leaves(before)  # shape, dtype and weak type
    assert agent.begin_episode(state, jnp.int32(3)) is state


def test_the_std_stops_at_its_floor_and_can_grow_again():
    config = {**vars(CONFIG), "init_action_std": 0.1, "learning_rate": 0.05}
    agent = ppo("continuous", PPOConfig(**config))
    update = jax.jit(agent.update)
    _, _, unravel = networks("continuous")

    def learn(state, entropy_weight):
        hparams = state.hparams._replace(entropy_weight=jnp.float32(entropy_weight))
        return update(KEY, state.replace(hparams=hparams), rollout("continuous"))

    state = learn(agent.init(KEY, agent.hparams), entropy_weight=-1000.0)
    np.testing.assert_array_equal(unravel(state.params)["std"], np.float32(MIN_STD))
    for _ in range(3):
        state = learn(state, entropy_weight=1e5)
    assert (unravel(state.params)["std"] > 2 * MIN_STD).all()


def test_a_phase_starts_with_the_step_that_fills_the_rollout(agent):
    state, obs, zero = agent.init(KEY, agent.hparams), jnp.zeros(OBS_DIM), jnp.float32(0)
    example = Transition(obs, agent.act(KEY, state, obs, True), zero, zero, obs)
    memory = agent.memory(example, 10_000)
    assert memory.init().shape[0] == STEPS

    def step(carry, number):
        rows, state = carry
        key, key_reward = jax.random.split(jax.random.fold_in(KEY, number))
        action = agent.act(key, state, obs, True)
        transition = example._replace(action=action, reward=jax.random.normal(key_reward))
        rows = memory.store(rows, number, transition, number % 5 == 4, True)
        batch = memory.batch(key, rows, number + 1, transition, None)
        state = agent.update(key, state, batch)
        return (rows, state), state.opt_state.count

    _, counts = jax.lax.scan(step, (memory.init(), state), jnp.arange(2 * STEPS + 3))
    epochs = CONFIG.epochs
    expected = [0] * (STEPS - 1) + [epochs] * STEPS + [2 * epochs] * 4
    np.testing.assert_array_equal(counts, expected)


@pytest.mark.parametrize("update_episodes, action_repeat", [(10, 5), (2, 3), (1, 1), (3, 7)])
def test_a_rollout_is_as_long_as_the_authors(update_episodes, action_repeat):
    max_steps, decisions, time_step = 50, 0, 0
    while not time_step / max_steps > update_episodes:
        decisions, time_step = decisions + 1, time_step + action_repeat
    config = PPOConfig(update_episodes=update_episodes, action_repeat=action_repeat)
    assert config.rollout_length(max_steps) == decisions


# --- policies ------------------------------------------------------------------------------------

OBS = jnp.array([0.3, -0.2, 0.5])


def draw(agent, state, explore):
    keys = jax.random.split(jax.random.key(2), 4000)
    return jax.jit(jax.vmap(lambda key: agent.act(key, state, OBS, explore)))(keys)


def actor_outputs(kind, state, scale=1.0):
    """The actor's outputs for `OBS`, and the state with its last layer scaled."""
    actor, _, unravel = networks(kind)
    params = unravel(state.params)
    last = params["actor"]["params"][f"Dense_{CONFIG.num_layers}"]
    last.update({name: scale * value for name, value in last.items()})
    state = state.replace(params=ravel_pytree(params)[0])
    return np.asarray(actor.apply(params["actor"], OBS)), state


def test_discrete_actions_follow_the_softmax_and_tests_its_mode():
    agent = ppo("discrete")
    outputs, state = actor_outputs("discrete", agent.init(KEY, agent.hparams), scale=4.0)
    actions = draw(agent, state, explore=True)
    assert actions.dtype == jnp.int32
    expected = np.exp(outputs) / np.exp(outputs).sum()
    assert expected.max() > 1.5 * expected.min()
    share = np.bincount(actions, minlength=NUM_ACTIONS) / actions.size
    deviation = np.sqrt(expected * (1 - expected) / actions.size)
    assert (np.abs(share - expected) <= 5 * deviation).all()
    np.testing.assert_array_equal(draw(agent, state, explore=False), np.argmax(outputs))
    assert agent.env_action(actions[0]) == actions[0]


def test_continuous_actions_are_normal_around_the_scaled_tanh_and_tests_take_the_mean():
    agent = ppo("continuous")
    outputs, state = actor_outputs("continuous", agent.init(KEY, agent.hparams), scale=4.0)
    mean = MAX_ACTION * np.tanh(outputs)
    actions = np.asarray(draw(agent, state, explore=True))
    assert actions.dtype == np.float32
    deviation = CONFIG.init_action_std / np.sqrt(len(actions))
    assert (np.abs(actions.mean(axis=0) - mean) <= 5 * deviation).all()
    assert (np.abs(actions.std(axis=0) - CONFIG.init_action_std) <= 5 * deviation).all()
    assert abs(np.corrcoef(actions.T)[0, 1]) <= 5 / np.sqrt(len(actions))
    for action in draw(agent, state, explore=False)[:3]:
        np.testing.assert_allclose(action, mean, rtol=1e-5)


def test_continuous_actions_are_clipped_for_the_world_only():
    agent = ppo("continuous")
    state = agent.init(KEY, agent.hparams)
    _, _, unravel = networks("continuous")
    params = unravel(state.params)
    wide = state.replace(params=ravel_pytree({**params, "std": jnp.full(ACTION_DIM, 5.0)})[0])
    actions = draw(agent, wide, explore=True)
    assert np.abs(actions).max() > 2 * MAX_ACTION  # remembered as drawn
    np.testing.assert_array_equal(
        agent.env_action(actions), np.clip(actions, -MAX_ACTION, MAX_ACTION)
    )


def test_log_probabilities_and_entropies_by_hand():
    # Odds 1 : 3, hence probabilities 1/4 and 3/4; entropy -(ln(1/4) + 3 ln(3/4)) / 4.
    outputs = jnp.log(jnp.array([[1.0, 1.0], [3.0, 3.0]]))
    log_prob, entropy = SOFTMAX.evaluate(outputs, jnp.zeros(0), jnp.array([0, 1]))
    np.testing.assert_allclose(np.exp(log_prob), [0.25, 0.75], rtol=1e-6)
    np.testing.assert_allclose(entropy, -(np.log(0.25) + 3 * np.log(0.75)) / 4, rtol=1e-6)
    # Means 0 and std 0.5, 2. The action (1, 2) is 2 and 1 deviations off:
    # density exp(-(4 + 1) / 2) / (2 pi * 0.5 * 2). Entropy ln(2 pi e * 0.5 * 2).
    std, action = jnp.array([0.5, 2.0]), jnp.array([[1.0], [2.0]])
    log_prob, entropy = gaussian(MAX_ACTION).evaluate(jnp.zeros((2, 1)), std, action)
    np.testing.assert_allclose(np.exp(log_prob), np.exp(-2.5) / (2 * np.pi), rtol=1e-6)
    np.testing.assert_allclose(entropy, [np.log(2 * np.pi) + 1], rtol=1e-6)


def test_an_agent_has_either_discrete_or_continuous_actions():
    for num_actions, action_dim in ((None, None), (2, 1)):
        with pytest.raises(ValueError, match=r"either num_actions .* or action_dim .*; got num_a"):
            make_ppo(CONFIG, OBS_DIM, num_actions, action_dim, MAX_ACTION, MAX_STEPS)


def test_the_agent_says_what_was_configured(agent):
    assert agent.hparams._asdict() == {
        "learning_rate": 0.01, "discount": 0.9, "clip_ratio": 0.05, "value_weight": 0.7,
        "entropy_weight": 0.05, "hidden_size": None,  # all of it
    }  # fmt: skip
    assert (agent.init_episodes, agent.learns_from, agent.action_repeat) == (1, 0, 1)


# --- probes --------------------------------------------------------------------------------------


def solve_bandit(agent, length, reward_fn, num_phases):
    """The agent after learning phases on episodes of one step each."""
    obs = jnp.zeros((length, 1))

    def phase(state, key):
        act = jax.vmap(lambda key: agent.act(key, state, obs[0], True))
        action = act(jax.random.split(key, length))
        reward = reward_fn(agent.env_action(action))
        steps = Transition(obs, action, reward, jnp.zeros(length), obs)
        rows = pack(steps, jnp.ones(length))
        return agent.update(key, state, Rollout(rows, jnp.bool_(True))), None

    state = agent.init(KEY, agent.hparams)
    return jax.lax.scan(phase, state, jax.random.split(KEY, num_phases))[0]


BANDIT = PPOConfig(
    hidden_size=4, num_layers=1, activation="tanh", learning_rate=0.03, update_episodes=64,
    epochs=5,
)  # fmt: skip


def test_a_bandits_better_arm_is_found():
    agent = make_ppo(BANDIT, 1, 3, None, 1.0, max_steps=1)
    state = solve_bandit(agent, 65, lambda action: jnp.where(action == 1, 1.0, 0.0), 30)
    keys = jax.random.split(jax.random.key(3), 500)
    actions = jax.vmap(lambda key: agent.act(key, state, jnp.zeros(1), True))(keys)
    assert (actions == 1).mean() > 0.95
    assert agent.act(KEY, state, jnp.zeros(1), False) == 1


def test_a_continuous_bandits_best_action_is_found_beyond_the_reach_of_a_tanh():
    agent = make_ppo(BANDIT, 1, None, 1, 2.0, max_steps=1)
    state = solve_bandit(agent, 65, lambda action: -jnp.sum((action - 1.5) ** 2, axis=-1), 40)
    np.testing.assert_allclose(agent.act(KEY, state, jnp.zeros(1), False), [1.5], atol=0.15)


# --- learning curves -----------------------------------------------------------------------------

# An agent that has not learned has returns of about 20 and -1200.
LEARNING = {
    "cartpole": (
        PPOConfig(
            activation="tanh", learning_rate=1e-3, update_episodes=4, epochs=20, discount=0.98
        ),
        TrainingConfig(max_episodes=1000, stop_rule="never", max_steps=80_000),
        195.0,
    ),
    "pendulum": (
        PPOConfig(
            activation="tanh", learning_rate=2e-3, update_episodes=10, epochs=30,
            discount=0.9, init_action_std=1.0, entropy_weight=0.0,
        ),
        TrainingConfig(max_episodes=700, stop_rule="never"),
        -600.0,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNING)
def test_the_agent_learns(name):
    config, training, wanted = LEARNING[name]
    task = envs.make(name)
    action_dim = task.action_dim if task.num_actions is None else None
    agent = make_ppo(
        config, task.obs_dim, task.num_actions, action_dim, task.max_action, task.max_steps
    )
    train, test = make_trainer(agent, task.env, training), make_tester(agent, task, 20)

    @jax.jit
    def run(key):
        key_train, key_test = jax.random.split(key)
        result = train(key_train, task.params)
        return result, test(key_test, result.agent_state)[0]

    result, returns = run(KEY)
    assert not result.nonfinite
    print(name, "steps", result.train_steps, "test", returns.mean(), "+-", returns.std())
    assert returns.mean() >= wanted
