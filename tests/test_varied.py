"""sejax.agents.hparams: what is drawn, and that a narrowed network is exactly a small one."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from sejax import envs
from sejax.agents.blocks import block_size, sum_over_batch
from sejax.agents.configs import DDQNConfig, DuelingDDQNConfig, ExplorationConfig, QLearningConfig
from sejax.agents.ddqn import make_ddqn, q_network
from sejax.agents.hparams import (
    Range,
    draw_value,
    drawing_key,
    hidden_sizes,
    make_varied_agents,
    ranges_of,
)
from sejax.agents.replay import Transition
from sejax.configs import SyntheticConfig, TrainingConfig
from sejax.evaluation import evaluate_agents
from sejax.networks import MLP, narrow
from sejax.proxies.synthetic import make_synthetic

OBS_DIM, NUM_ACTIONS = 3, 2
SMALL, LARGE = 5, 8
NUM_COLUMNS, BATCH = 70, 130  # of a batch of 130 columns, 70 count: more than one block


# --- ranges and draws ----------------------------------------------------------------------------


def test_ranges_around_the_default_agent_are_the_papers():
    ranges = ranges_of(DDQNConfig())
    assert ranges["learning_rate"] == pytest.approx((1e-3 / 3, 3e-3, True, False))
    assert ranges["batch_size"] == (42, 384, True, True)
    assert ranges["hidden_size"] == (42, 384, True, True)
    assert ranges["num_layers"] == (1, 3, False, True)
    assert ranges_of(DDQNConfig(num_layers=1))["num_layers"] == (1, 2, False, True)
    tabular = ranges_of(QLearningConfig())
    assert tabular == dict.fromkeys(("learning_rate", "discount"), (0.1, 1.0, False, False))


@pytest.mark.parametrize(
    "bounds",
    [Range(1e-4, 9e-4, True, False), Range(0.1, 1.0, False, False), Range(42, 384, True, True),
     Range(1, 3, False, True)],
)  # fmt: skip
def test_draws_fill_their_range_with_the_density_they_should_have(bounds):
    keys = jax.random.split(jax.random.key(0), 20_000)
    drawn = np.asarray(jax.jit(jax.vmap(lambda key: draw_value(key, bounds)))(keys), np.float64)
    assert drawn.min() >= bounds.low * (1 - 1e-6) and drawn.max() <= bounds.high * (1 + 1e-6)
    if bounds.integer:
        np.testing.assert_array_equal(drawn, np.round(drawn))
        assert {bounds.low, bounds.high} <= set(drawn.tolist())
    scale = np.log if bounds.log else lambda x: x
    half = 0.5 if bounds.integer else 0.0
    low, high = scale(bounds.low - half), scale(bounds.high + half)
    if bounds.integer:  # spread each integer over its cell, to compare with a uniform density
        drawn = drawn + np.random.default_rng(0).uniform(-0.5, 0.5, drawn.shape)
    share = (scale(drawn) - low) / (high - low)
    assert np.abs(np.sort(share) - np.linspace(0, 1, share.size)).max() < 0.02  # Kolmogorov-Smirnov


@pytest.mark.parametrize("num_layers", [1, 2, 3])
def test_every_hidden_size_has_a_network_and_little_arithmetic_is_wasted(num_layers):
    sizes = np.array(hidden_sizes(Range(42, 384, True, True), num_layers))
    assert sizes[-1] == 384 and (np.diff(sizes) > 0).all()
    drawn = np.arange(42, 385)
    rooms = np.array([sizes[sizes >= size].min() for size in drawn])
    # A layer between hidden ones costs the square of its size; sizes are drawn log-uniformly.
    power = 1 if num_layers == 1 else 2
    assert (rooms**power / drawn).sum() / (drawn.astype(float) ** (power - 1)).sum() < 1.2


@pytest.mark.parametrize("bounds", [Range(7, 72, True, True), Range(19, 171, True, True),
                                    Range(1, 9, True, True)])  # fmt: skip
def test_the_smallest_and_the_largest_hidden_size_have_room(bounds):
    for num_layers in (1, 2):
        sizes = hidden_sizes(bounds, num_layers)
        assert bounds.low <= sizes[0] < bounds.low + 32 and sizes[-2:-1] < (bounds.high,)
        assert bounds.high <= sizes[-1] < bounds.high + 32


# --- narrow networks -----------------------------------------------------------------------------


def configured(kind, hidden_size, batch_size):
    make = {"ddqn": DDQNConfig, "dueling": functools.partial(
        DuelingDDQNConfig, feature_dim=4, stream_hidden_size=4)}[kind]  # fmt: skip
    return make(
        hidden_size=hidden_size, batch_size=batch_size, num_layers=2, activation="prelu",
        learning_rate=0.01, target_update_rate=0.1,
    )  # fmt: skip


def embed(small, large):
    """The small network's parameters in a large one's, whose other entries are 0."""

    def place(x, y):
        return jnp.zeros_like(y).at[tuple(slice(n) for n in x.shape)].set(x)

    return jax.tree.map(place, small, large)


def random_batch(num_columns, seed=0):
    rng = np.random.default_rng(seed)
    return Transition(
        obs=jnp.float32(rng.normal(size=(OBS_DIM, num_columns))),
        action=jnp.int32(rng.integers(0, NUM_ACTIONS, num_columns)),
        reward=jnp.float32(rng.normal(size=num_columns)),
        discount=jnp.float32(rng.uniform(0, 1, num_columns)),
        next_obs=jnp.float32(rng.normal(size=(OBS_DIM, num_columns))),
    )


@pytest.mark.parametrize("kind", ["ddqn", "dueling"])
def test_a_narrowed_agent_learns_exactly_as_a_small_one_on_the_columns_in_use(kind):
    configs = [configured(kind, SMALL, NUM_COLUMNS), configured(kind, LARGE, BATCH)]
    small, large = (make_ddqn(config, OBS_DIM, NUM_ACTIONS) for config in configs)
    networks = [q_network(config, NUM_ACTIONS) for config in configs]
    trees = [net.init(jax.random.key(1), jnp.zeros(OBS_DIM)) for net in networks]
    unravels = [ravel_pytree(tree)[1] for tree in trees]
    state = small.init(jax.random.key(0), small.hparams)
    hparams = large.hparams._replace(hidden_size=jnp.float32(SMALL),
                                     batch_size=jnp.float32(NUM_COLUMNS))  # fmt: skip
    wide = large.init(jax.random.key(0), hparams)
    params = ravel_pytree(embed(unravels[0](state.params), trees[1]))[0]
    wide = wide.replace(params=params, target_params=params)
    update, update_wide = jax.jit(small.update), jax.jit(large.update)
    for step in range(4):
        batch = random_batch(BATCH, seed=step)
        cut = jax.tree.map(lambda x: x[..., :NUM_COLUMNS] if jnp.ndim(x) else x, batch)
        weight = jnp.float32(jnp.arange(BATCH) < NUM_COLUMNS)
        state = update(jax.random.key(step), state, cut)
        wide = update_wide(jax.random.key(step), wide, batch._replace(weight=weight))
    expected = ravel_pytree(embed(unravels[0](state.params), trees[1]))[0]
    np.testing.assert_allclose(wide.params, expected, rtol=2e-5, atol=2e-6)
    in_use = ravel_pytree(embed(jax.tree.map(jnp.ones_like, trees[0]), trees[1]))[0]
    np.testing.assert_array_equal(wide.params[in_use == 0], 0.0)


def test_narrowed_weights_are_distributed_as_those_of_a_small_network():
    net, small = (MLP(2, size, 3, "tanh") for size in (96, 40))
    keys = jax.random.split(jax.random.key(3), 30)
    zeros = jnp.zeros(OBS_DIM)
    wide = jax.vmap(lambda k: narrow(net.init(k, zeros)["params"], jnp.float32(40)))(keys)
    plain = jax.vmap(lambda k: small.init(k, zeros)["params"])(keys)
    for layer in plain:
        for name, expected in plain[layer].items():
            cut = (slice(None), *(slice(n) for n in expected.shape[1:]))
            got = np.asarray(wide[layer][name][cut])
            assert (got != 0).all()
            assert np.abs(got).max() <= np.abs(expected).max() * 1.1
            assert got.std() == pytest.approx(np.asarray(expected).std(), rel=0.05)


def test_a_layer_norm_sees_only_the_units_in_use():
    small, large = (
        MLP(2, size, 3, "tanh", layer_norm=True, may_narrow=True) for size in (SMALL, LARGE)
    )
    x = jnp.float32(np.random.default_rng(0).normal(size=(OBS_DIM, 6)))
    params = small.init(jax.random.key(0), x)["params"]
    template = narrow(large.init(jax.random.key(1), x)["params"], jnp.float32(SMALL))
    embedded = embed(params, template)
    embedded["width"] = template["width"]
    np.testing.assert_allclose(
        large.apply({"params": embedded}, x), small.apply({"params": params}, x),
        rtol=1e-5, atol=1e-6,
    )  # fmt: skip
    gradient = jax.grad(lambda p: jnp.sum(large.apply({"params": p}, x) ** 2))(embedded)
    assert gradient["width"] == 0
    np.testing.assert_array_equal(gradient["Dense_3"]["kernel"][:, SMALL:], 0.0)


# --- blocks of a batch ---------------------------------------------------------------------------


@pytest.mark.parametrize("batch_size", [1, block_size(100), block_size(100) + 1, 100])
def test_a_sum_over_blocks_is_the_sum_over_the_columns_in_use(batch_size):
    values = jnp.arange(100.0)
    batch = {"x": jnp.stack([values, 2 * values]), "weight": values < batch_size, "scale": 3.0}

    def total(batch):
        return jnp.sum(batch["scale"] * batch["weight"] * batch["x"], axis=1)

    expected = 3 * np.arange(batch_size).sum() * np.array([1.0, 2.0])
    got = jax.jit(lambda n: sum_over_batch(total, batch, n))(jnp.float32(batch_size))
    np.testing.assert_allclose(got, expected)
    np.testing.assert_allclose(sum_over_batch(total, batch, None), expected)


# --- whole programs ------------------------------------------------------------------------------


def test_every_drawn_agent_finds_a_network_with_room():
    task = envs.make("cartpole")
    config = DDQNConfig(hidden_size=24, num_layers=2, batch_size=16)
    varied = make_varied_agents(config, task, ExplorationConfig())
    values = jax.vmap(varied.draw)(jax.random.split(jax.random.key(0), 200))
    branches = jax.vmap(varied.branch)(values)
    sizes = {depth: hidden_sizes(varied.ranges["hidden_size"], depth) for depth in (1, 2, 3)}
    assert len(varied.agents) == sum(map(len, sizes.values()))
    for index, hidden, depth in zip(branches, values["hidden_size"], values["num_layers"],
                                    strict=True):  # fmt: skip
        agent = varied.agents[int(index)]
        state = jax.eval_shape(agent.init, jax.random.key(0), agent.hparams)
        room = min(size for size in sizes[int(depth)] if size >= hidden)
        inner = (int(depth) - 1) * room * (room + 1)
        assert state.params.shape == (room * 5 + inner + 2 * (room + 1),)
    assert len(set(branches.tolist())) == len(varied.agents)


def test_trainings_with_drawn_hyperparameters_equal_those_with_the_same_given():
    task = envs.make("cartpole")
    env = make_synthetic(task, SyntheticConfig(hidden_size=4))
    training = TrainingConfig(stop_rule="never", max_steps=60, test_episodes=2)
    config = DDQNConfig(hidden_size=3, num_layers=1, batch_size=4, init_episodes=0)
    varied = make_varied_agents(config, task, ExplorationConfig())
    keys = jax.random.split(jax.random.key(5), 3)
    outcome = evaluate_agents(varied, env, env.default_params, task, training, keys)
    values = jax.vmap(lambda key: varied.draw(drawing_key(key)))(keys)
    for i, key in enumerate(keys):
        given = {name: x[i] for name, x in values.items()}
        agent = varied.agents[int(varied.branch(given))]
        agent = dataclasses.replace(agent, hparams=varied.hparams(given))
        alone = evaluate_agents(agent, env, env.default_params, task, training, key[None])
        assert outcome.test_return[i] == alone.test_return[0]
        assert outcome.train_steps[i] == alone.train_steps[0] == 60
