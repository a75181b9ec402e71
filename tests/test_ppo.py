"""sejax.agents.ppo: advantages and loss by hand, phases against torch, lanes, and probes."""

import dataclasses
import functools
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree
from support import assert_shares, drawing, numpy_forward, raveled, shapes_of, unraveled

from sejax.agents import buffers
from sejax.agents.base import traced
from sejax.agents.buffers import Rollout, Transition
from sejax.agents.policies import gaussian, softmax
from sejax.agents.ppo import (
    MIN_STD,
    PPOConfig,
    discounted_returns,
    generalized_advantages,
    make_ppo,
    normalized,
    ppo_loss,
    shuffled,
)
from sejax.ops.networks import MLP
from sejax.options import ConfigError

OBS_DIM, NUM_ACTIONS, ACTION_DIM, MAX_ACTION, MAX_STEPS = 3, 4, 2, 2.0, 6
STEPS = 13  # two episodes of full length, and one step
ENDS = (3, 4, 9)  # last steps of episodes; the rollout is cut within the fourth
GOLDEN = Path(__file__).parent / "golden" / "ppo_updates.npz"
CONFIG = PPOConfig.paper(
    hidden_size=5, num_layers=2, activation="tanh", learning_rate=0.01, discount=0.9,
    update_episodes=2, epochs=3, clip_ratio=0.05, value_weight=0.7, entropy_weight=0.05,
)  # fmt: skip
HPARAMS = traced(CONFIG)
# Three minibatches of four steps, so that each epoch leaves one out.
GAE = dataclasses.replace(
    CONFIG, advantages="gae", gae_lambda=0.8, rollout_steps=STEPS, num_minibatches=3,
    normalize_rewards=True, max_grad_norm=0.5, adam_eps=1e-5,
)  # fmt: skip
CONFIGS = {"discrete": CONFIG, "continuous": CONFIG, "gae": GAE}
KINDS = tuple(CONFIGS)  # the last one's actions are discrete
KEY = jax.random.key(0)


@functools.cache
def ppo(kind, config=None):
    is_continuous = kind == "continuous"
    policy = gaussian(ACTION_DIM, MAX_ACTION) if is_continuous else softmax(NUM_ACTIONS)
    return make_ppo(config or CONFIGS[kind], OBS_DIM, policy, MAX_STEPS)


def networks(kind, config=CONFIG):
    """The actor, the critic, and the function from flat parameters to the nested ones."""
    num_outputs, std_dim = (ACTION_DIM,) * 2 if kind == "continuous" else (NUM_ACTIONS, 0)
    actor, critic = (
        MLP(size, config.hidden_size, config.num_layers, config.activation, learn_prelu_slope=True)
        for size in (num_outputs, 1)
    )
    example = {
        "actor": shapes_of(actor.init, KEY, np.zeros(OBS_DIM)),
        "critic": shapes_of(critic.init, KEY, np.zeros(OBS_DIM)),
        "std": np.zeros(std_dim),
    }
    return actor, critic, lambda flat: unraveled(flat, example)


def random_steps(kind, seed):
    """`STEPS` random transitions, one in a row, and where episodes end."""
    rng = np.random.default_rng(seed)
    if kind != "continuous":
        action = np.int32(rng.integers(0, NUM_ACTIONS, STEPS))
    else:
        action = np.float32(rng.normal(scale=0.5, size=(STEPS, ACTION_DIM)))
    ended = np.zeros(STEPS, np.float32)
    ended[list(ENDS)] = 1.0
    steps = Transition(
        obs=np.float32(rng.normal(size=(STEPS, OBS_DIM))),
        action=action,
        reward=np.float32(rng.normal(size=STEPS)),
        discount=np.float32(rng.uniform(-0.2, 1.2, STEPS)),  # soft; must not matter to returns
        next_obs=np.float32(rng.normal(size=(STEPS, OBS_DIM))),
    )
    return steps, ended


def pack(steps, ended):
    """Rows as a rollout keeps them."""
    steps = steps._replace(weight=jnp.ones_like(ended))
    return jnp.concatenate([jax.vmap(buffers.pack)(steps), ended[:, None]], axis=1)


jit_pack = jax.jit(pack)


@functools.cache
def rollout(kind, seed=0, is_full=True):
    rows = np.asarray(jit_pack(*random_steps(kind, seed)))
    return Rollout(rows=rows, is_full=np.bool_(is_full))


@functools.cache
def state_of(agent):
    return jax.jit(agent.init)(jax.random.key(1), agent.hparams)


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def agent(kind):
    return ppo(kind)


@pytest.fixture(scope="module")
def state(agent):
    return state_of(agent)


@pytest.fixture(scope="module")
def update(agent):
    return jax.jit(agent.update)


def adam_steps(state):
    return optax.tree.get(state.opt_state, "count")


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


# --- returns -------------------------------------------------------------------------------------


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
    got = jax.jit(normalized)
    np.testing.assert_allclose(got(np.float32([1, 2, 3])), [-1, 0, 1], rtol=2e-5)
    np.testing.assert_array_equal(got(np.float32([3, 3, 3])), 0.0)
    np.testing.assert_array_equal(got(np.float32([3])), 0.0)


# --- advantages ----------------------------------------------------------------------------------


def advantages_by_definition(steps, ended, value, next_value, gamma, gae_lambda):
    """Each step's sum of discounted one-step errors, in plain loops over what follows it."""
    expected = np.zeros(len(ended))
    for start in range(len(ended)):
        weight = 1.0
        for t in range(start, len(ended)):
            decay = gamma * steps.discount[t]
            expected[start] += weight * (steps.reward[t] + decay * next_value[t] - value[t])
            weight *= decay * gae_lambda
            if ended[t]:
                break
    return expected


# What the steps at which episodes end bootstrap with: nothing, if they terminated; fully, if they
# were truncated. The rollout's last step does so whether its episode has ended or not.
@pytest.mark.parametrize(
    "ends, at_ends", [((), None), (ENDS, 0.0), (ENDS, 1.0), (range(STEPS), 0.0), (ENDS, None)]
)
def test_generalized_advantages_equal_plain_loops(ends, at_ends):
    steps, ended = random_steps("gae", 0)
    rng = np.random.default_rng(1)
    value, next_value = np.float32(rng.normal(size=(2, STEPS)))
    ended = np.isin(np.arange(STEPS), list(ends)).astype(np.float32)
    if at_ends is not None:  # elsewhere 1, as in any task
        steps = steps._replace(discount=np.where(ended, at_ends, 1.0).astype(np.float32))
    decay = np.float32(0.9) * steps.discount
    got = jit_advantages(steps.reward, decay, ended, value, next_value, 0.8)
    expected = advantages_by_definition(steps, ended, value, next_value, 0.9, 0.8)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)
    if len(ends) == STEPS:  # a world of single steps
        np.testing.assert_allclose(got, steps.reward - value, rtol=1e-6)


jit_advantages = jax.jit(generalized_advantages)


def test_each_epoch_learns_from_each_step_once_and_in_an_order_of_its_own():
    order = np.asarray(jax.jit(shuffled, static_argnums=(1, 2, 3))(KEY, 400, 4, STEPS))
    assert order.shape == (1600, 3)
    epochs = np.sort(order.reshape(400, 12))
    assert (np.diff(epochs) > 0).all() and epochs.min() == 0 and epochs.max() == STEPS - 1
    # Every step is as often in any place: 400 / 13 times, within five standard deviations.
    for place in order.reshape(400, 12).T:
        assert np.abs(np.bincount(place, minlength=STEPS) - 400 / STEPS).max() < 5 * 5.4


# --- the loss ------------------------------------------------------------------------------------


def loss_inputs():
    """Columns on both sides of the clip with advantages of both signs."""
    rng = np.random.default_rng(3)
    names = ("log_prob", "entropy", "value", "old_log_prob", "returns")
    inputs = {name: np.float32(rng.normal(size=STEPS)) for name in names}
    return inputs | {"old_log_prob": inputs["log_prob"] + np.float32(0.2) * inputs["old_log_prob"]}


def test_loss_by_hand():
    hp = HPARAMS._replace(clip_ratio=0.2, value_weight=0.5, entropy_weight=0.1)
    # Ratios 2, 2, 0.5, 0.5 and advantages 1, -1, 1, -1. The smaller of the ratio's and of the
    # clipped ratio's product: min(2, 1.2), min(-2, -1.2), min(0.5, 0.8), min(-0.5, -0.8); mean
    # (1.2 - 2 + 0.5 - 0.8) / 4 = -0.275. Value error 1, entropy 3: 0.275 + 0.5 - 0.3 = 0.475.
    log_prob = np.log(np.float32([2.0, 2.0, 0.5, 0.5]))
    returns, zeros = np.float32([1.0, -1.0, 1.0, -1.0]), np.zeros(4, np.float32)
    loss = jax.jit(ppo_loss)(log_prob, zeros + 3, zeros, zeros, returns, returns, hp)
    np.testing.assert_allclose(loss, 0.475, rtol=1e-6)


def test_loss_and_gradients_equal_torchs():
    golden = np.load(GOLDEN)  # made by torch_ppo.py
    inputs = loss_inputs()
    others = {name: inputs.pop(name) for name in ("old_log_prob", "returns")}
    others["advantage"] = others["returns"] - inputs["value"]
    loss_fn = jax.jit(jax.value_and_grad(lambda x: ppo_loss(**x, **others, hp=HPARAMS)))
    loss, gradients = loss_fn(inputs)
    np.testing.assert_allclose(loss, golden["loss"], rtol=1e-6)
    for name, gradient in gradients.items():
        np.testing.assert_allclose(gradient, golden[f"loss/{name}"], rtol=1e-5, atol=1e-7)


def test_loss_and_gradients_are_finite_however_far_the_policy_has_moved():
    @jax.jit
    @jax.value_and_grad
    def loss(log_prob):
        values = jnp.array([3.0, -3.0])
        zeros = jnp.zeros(2)
        return ppo_loss(log_prob, values, values, zeros, -values, zeros, HPARAMS)

    for log_ratio in (1e5, -1e5):
        value, gradient = loss(np.full(2, log_ratio, np.float32))
        assert np.isfinite(value) and np.isfinite(gradient).all()


# --- phases --------------------------------------------------------------------------------------


def test_learning_phases_equal_torchs(kind, state, update):
    golden = np.load(GOLDEN)
    state = state.replace(params=golden[f"{kind}/params/0"])
    for number in (1, 2):
        state = update(KEY, state, rollout(kind, number))
        expected = golden[f"{kind}/params/{number}"]
        np.testing.assert_allclose(state.params, expected, rtol=2e-5, atol=5e-6)


def test_with_normalized_rewards_it_does_not_matter_in_what_they_are_paid():
    agent = ppo("gae")
    state, update = state_of(agent), jax.jit(agent.update)
    steps, ended = random_steps("gae", 0)
    paid_more = np.asarray(jit_pack(steps._replace(reward=1000 * steps.reward), ended))
    more = update(KEY, state, Rollout(paid_more, np.bool_(True)))
    np.testing.assert_allclose(
        more.params, update(KEY, state, rollout("gae")).params, rtol=1e-4, atol=1e-5
    )
    # Nor do rewards that never differ blow up, in a world of single steps say.
    always = np.asarray(jit_pack(steps._replace(reward=0 * ended + 3), 0 * ended + 1))
    assert np.isfinite(update(KEY, state, Rollout(always, np.bool_(True))).params).all()


def test_lanes_learn_as_they_would_alone(kind, agent, state, update):
    # With their own parameters and learning rates; the second one's rollout is not full.
    rates = (0.05, 0.05, 0.01)
    num_parallel = [
        state.replace(params=np.asarray(state.params) * np.float32(scale),
                      hparams=state.hparams._replace(learning_rate=np.float32(rate)))
        for scale, rate in zip((1.0, 0.8, -1.2), rates, strict=True)
    ]  # fmt: skip
    rollouts = [rollout(kind, seed, seed != 1) for seed in range(3)]
    states, stacked = (
        jax.tree.map(lambda *x: np.stack(x), *each) for each in (num_parallel, rollouts)
    )
    together = jax.jit(jax.vmap(agent.update, (None, 0, 0)))(KEY, states, stacked)
    together = jax.tree.map(np.asarray, together)
    for lane, (before, own) in enumerate(zip(num_parallel, rollouts, strict=True)):
        got, alone = jax.tree.map(lambda x: x[lane], together), update(KEY, before, own)  # noqa: B023
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), got, alone
        )
        assert (lane == 1) == bool((got.params == before.params).all())


@pytest.mark.parametrize("kind, epochs", [("discrete", 10**9), ("gae", 7)])
def test_a_step_without_a_phase_does_none_of_its_work(kind, epochs):
    # Were any of a thousand million epochs made, this test would not end.
    agent = ppo(kind, dataclasses.replace(CONFIGS[kind], epochs=epochs))
    states = jax.tree.map(lambda x: np.stack([x, x]), state_of(ppo(kind)))
    rollouts = jax.tree.map(lambda x: np.stack([x, x]), rollout(kind, is_full=False))
    compiled = jax.jit(jax.vmap(agent.update, (None, 0, 0))).lower(KEY, states, rollouts).compile()
    assert_equal(compiled(KEY, states, rollouts), states)
    # Nor has the compiler moved anything that is as long as the rollout out of the phase.
    entry = compiled.as_text().split("\nENTRY ")[1]
    long = [line for line in entry.splitlines() if re.search(rf"= \w+\[[\d,]*\b{STEPS}\b", line)]
    assert long and all(" parameter(" in line for line in long), "\n".join(long)


def test_the_std_stops_at_its_floor_and_can_grow_again():
    agent = ppo("continuous")
    update = jax.jit(agent.update)
    _, _, unravel = networks("continuous")

    def learn(state, entropy_weight):
        hparams = state.hparams._replace(entropy_weight=np.float32(entropy_weight),
                                         learning_rate=np.float32(0.05))  # fmt: skip
        return update(KEY, state.replace(hparams=hparams), rollout("continuous"))

    state = state_of(agent)
    params = {**unravel(state.params), "std": np.full(ACTION_DIM, 0.1, np.float32)}
    state = learn(state.replace(params=raveled(params)), entropy_weight=-1000.0)
    np.testing.assert_array_equal(unravel(state.params)["std"], np.float32(MIN_STD))
    for _ in range(3):
        state = learn(state, entropy_weight=1e5)
    assert (unravel(state.params)["std"] > 2 * MIN_STD).all()


def test_a_phase_starts_with_the_step_that_fills_the_rollout(agent):
    state, obs, zero = state_of(agent), np.zeros(OBS_DIM, np.float32), np.float32(0)
    action = jax.eval_shape(functools.partial(agent.act, explore=True), KEY, state, obs)
    example = Transition(obs, np.zeros(action.shape, action.dtype), zero, zero, obs)
    buffer = agent.buffer(example, 10_000)
    assert jax.eval_shape(buffer.init).shape[0] == STEPS

    def step(carry, number):
        rows, state = carry
        key, key_reward = jax.random.split(jax.random.fold_in(KEY, number))
        action = agent.act(key, state, obs, True)
        transition = example._replace(action=action, reward=jax.random.normal(key_reward))
        rows = buffer.store(rows, number, transition, number % 5 == 4, True)
        batch = buffer.batch(key, rows, number + 1, transition, None)
        state = agent.update(key, state, batch)
        return (rows, state), adam_steps(state)

    run = jax.jit(lambda state: jax.lax.scan(step, (buffer.init(), state),
                                             np.arange(2 * STEPS + 3))[1])  # fmt: skip
    counts = run(state)
    phase = CONFIG.epochs * (3 if agent is ppo("gae") else 1)
    expected = [0] * (STEPS - 1) + [phase] * STEPS + [2 * phase] * 4
    np.testing.assert_array_equal(counts, expected)


@pytest.mark.parametrize("update_episodes, action_repeat", [(10, 5), (2, 3), (1, 1), (3, 7)])
def test_a_rollout_is_as_long_as_the_authors(update_episodes, action_repeat):
    max_steps, decisions, time_step = 50, 0, 0
    while not time_step / max_steps > update_episodes:
        decisions, time_step = decisions + 1, time_step + action_repeat
    config = PPOConfig.paper(update_episodes=update_episodes, action_repeat=action_repeat)
    assert config.rollout_length(max_steps) == decisions
    given = dataclasses.replace(config, rollout_steps=17)
    assert given.rollout_length(max_steps) == 17
    assert given.steps_before_learning(1, max_steps) == 17 * action_repeat
    assert config.steps_before_learning(1, max_steps) == decisions * action_repeat


def test_a_minibatch_has_at_least_two_steps():
    with pytest.raises(ConfigError) as error:
        ppo("gae", dataclasses.replace(GAE, num_minibatches=7))
    assert error.value.field == "agent.num_minibatches"


# --- policies ------------------------------------------------------------------------------------

OBS = np.float32([0.3, -0.2, 0.5])


def actor_outputs(kind, state, scale=1.0):
    """The actor's outputs for `OBS`, and the state with its last layer scaled."""
    _, _, unravel = networks(kind)
    params = unravel(state.params)
    last = params["actor"]["params"][f"Dense_{CONFIG.num_layers}"]
    last.update({name: np.float32(scale) * value for name, value in last.items()})
    outputs = numpy_forward(params["actor"]["params"], OBS, CONFIG.activation, CONFIG.num_layers)
    return outputs, state.replace(params=raveled(params))


def test_discrete_actions_follow_the_softmax_and_tests_its_mode():
    agent = ppo("discrete")
    outputs, state = actor_outputs("discrete", state_of(agent), scale=4.0)
    drawn, tested = drawing(agent)(state, OBS)
    expected = np.exp(outputs) / np.exp(outputs).sum()
    assert expected.max() > 1.5 * expected.min()
    assert_shares(drawn, expected)
    np.testing.assert_array_equal(tested, np.argmax(outputs))


def test_continuous_actions_are_normal_around_the_scaled_tanh_and_tests_take_the_mean():
    agent = ppo("continuous")
    outputs, state = actor_outputs("continuous", state_of(agent), scale=4.0)
    mean = MAX_ACTION * np.tanh(outputs)
    actions, tested = map(np.asarray, drawing(agent)(state, OBS))
    deviation = CONFIG.init_action_std / np.sqrt(len(actions))
    assert (np.abs(actions.mean(axis=0) - mean) <= 5 * deviation).all()
    assert (np.abs(actions.std(axis=0) - CONFIG.init_action_std) <= 5 * deviation).all()
    assert abs(np.corrcoef(actions.T)[0, 1]) <= 5 / np.sqrt(len(actions))
    np.testing.assert_allclose(tested, np.tile(mean, (4000, 1)), rtol=1e-5)


def test_continuous_actions_are_clipped_for_the_world_only():
    agent = ppo("continuous")
    state = state_of(agent)
    _, _, unravel = networks("continuous")
    params = {**unravel(state.params), "std": np.full(ACTION_DIM, 5.0, np.float32)}
    wide = state.replace(params=raveled(params))
    actions, _ = drawing(agent)(wide, OBS)
    assert np.abs(actions).max() > 2 * MAX_ACTION  # remembered as drawn
    np.testing.assert_array_equal(
        agent.env_action(actions), np.clip(actions, -MAX_ACTION, MAX_ACTION)
    )


def test_log_probabilities_and_entropies_by_hand():
    # Odds 1 : 3, hence probabilities 1/4 and 3/4; entropy -(ln(1/4) + 3 ln(3/4)) / 4.
    outputs = np.log(np.float32([[1.0, 1.0], [3.0, 3.0]]))
    log_prob, entropy = jax.jit(softmax(2).evaluate)(outputs, np.zeros(0), np.array([0, 1]))
    np.testing.assert_allclose(np.exp(log_prob), [0.25, 0.75], rtol=1e-6)
    np.testing.assert_allclose(entropy, -(np.log(0.25) + 3 * np.log(0.75)) / 4, rtol=1e-6)
    # Means 0 and std 0.5, 2. The action (1, 2) is 2 and 1 deviations off:
    # density exp(-(4 + 1) / 2) / (2 pi * 0.5 * 2). Entropy ln(2 pi e * 0.5 * 2).
    std, action = np.float32([0.5, 2.0]), np.float32([[1.0], [2.0]])
    evaluate = jax.jit(gaussian(2, MAX_ACTION).evaluate)
    log_prob, entropy = evaluate(np.zeros((2, 1), np.float32), std, action)
    np.testing.assert_allclose(np.exp(log_prob), np.exp(-2.5) / (2 * np.pi), rtol=1e-6)
    np.testing.assert_allclose(entropy, [np.log(2 * np.pi) + 1], rtol=1e-6)


# --- probes --------------------------------------------------------------------------------------


BANDIT = PPOConfig(
    hidden_size=4, num_layers=1, learning_rate=0.03, epochs=5, rollout_steps=64, num_minibatches=2,
    discount=0.8, normalize_rewards=False, gae_lambda=0.95, clip_ratio=0.2, value_weight=1.0,
    max_grad_norm=None, adam_eps=1e-8,
)  # fmt: skip


def test_the_critic_bootstraps_with_each_transitions_own_discount():
    # A reward of 1 in each step of episodes of four, with gamma = 0.8: V = 1 / (1 - 0.8 d), which
    # is 1 where episodes terminate with each step, 5 where they are truncated after four.
    agent = make_ppo(BANDIT, obs_dim=1, policy=softmax(2), max_steps=4)
    obs, ones = np.ones((64, 1), np.float32), jnp.ones(64)

    @jax.jit
    def value(discount, ended):
        steps = Transition(obs, jnp.zeros(64), ones, discount * ones, obs)
        full = Rollout(pack(steps, ended), jnp.bool_(True))

        def phase(state, key):
            return agent.update(key, state, full), None

        state = agent.init(KEY, agent.hparams)
        state = jax.lax.scan(phase, state, jax.random.split(KEY, 100))[0]
        critic = MLP(1, BANDIT.hidden_size, 1, "tanh")
        template = {"actor": MLP(2, BANDIT.hidden_size, 1, "tanh").init(KEY, obs[0]),
                    "critic": critic.init(KEY, obs[0]), "std": jnp.zeros(0)}  # fmt: skip
        params = ravel_pytree(template)[1](state.params)
        return critic.apply(params["critic"], obs[0])[0]

    fourth = np.float32(np.arange(64) % 4 == 3)
    np.testing.assert_allclose(value(0.0, np.ones(64, np.float32)), 1.0, rtol=0.02)
    np.testing.assert_allclose(value(1.0, fourth), 5.0, rtol=0.02)
    np.testing.assert_allclose(value(0.5, fourth), 1 / (1 - 0.4), rtol=0.02)
