"""sejax.agents.varied: what is drawn, and that a narrowed network is exactly a small one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import assert_close, batch_of, raveled, refused, shapes_of

import sejax
from experiments.common.agents import paper_agent
from sejax import envs
from sejax.agents import AgentOptions, make_agent
from sejax.agents.buffers import Transition, block_size, num_columns, sum_over_batch
from sejax.agents.dqn import DDQN, DDQNConfig
from sejax.agents.exploration import CountBasedConfig
from sejax.agents.tabular import QLearningConfig
from sejax.agents.varied import Range, draw_value, for_keys, hidden_sizes, ranges_of
from sejax.ops.networks import MLP, narrow
from sejax.options import option

OBS_DIM, NUM_ACTIONS = 3, 2
SMALL, LARGE = 5, 8
KEY = jax.random.key(0)
NUM_COLUMNS, BATCH = 70, 130  # of a batch of 130 columns, 70 count: more than one block


# --- ranges and draws ----------------------------------------------------------------------------


def test_the_studys_ranges_are_the_papers():
    ranges = ranges_of(paper_agent("ddqn"))
    assert ranges["learning_rate"] == pytest.approx((1e-3 / 3, 3e-3, True, False))
    assert ranges["batch_size"] == (42, 384, True, True)
    assert ranges["hidden_size"] == (42, 384, True, True)
    assert ranges["num_layers"] == (1, 3, False, True)
    assert ranges_of(DDQNConfig())["num_layers"] == (1, 2, False, True)
    tabular = ranges_of(QLearningConfig())
    assert tabular == dict.fromkeys(("learning_rate", "discount"), (0.1, 1.0, False, False))
    wide = {"hidden_size": option(8, varied="triple"), "__annotations__": {"hidden_size": int}}
    cls = dataclasses.dataclass(frozen=True, kw_only=True)(type("Wide", (AgentOptions,), wide))
    assert refused(ranges_of, cls()) == "agent_hparams"


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


# --- narrow networks -----------------------------------------------------------------------------


def configured(hidden_size, batch_size):
    return DDQNConfig(
        hidden_size=hidden_size, batch_size=batch_size, num_layers=2, activation="prelu",
        learning_rate=0.01, tau=0.1,
    )  # fmt: skip


def embed(small, large):
    """The small network's parameters in a large one's, whose other entries are 0."""

    def place(x, y):
        return jnp.zeros_like(y).at[tuple(slice(n) for n in x.shape)].set(x)

    return jax.tree.map(place, small, large)


def random_batch(num_columns, seed):
    rng = np.random.default_rng(seed)
    columns = batch_of(rng, OBS_DIM, num_columns)
    return Transition(action=np.int32(rng.integers(0, NUM_ACTIONS, num_columns)), **columns)


def test_a_narrowed_agent_learns_exactly_as_a_small_one_on_the_columns_in_use():
    configs = [configured(SMALL, NUM_COLUMNS), configured(LARGE, BATCH)]
    small, large = (DDQN(config, OBS_DIM, NUM_ACTIONS).agent() for config in configs)
    like = shapes_of(large.init, KEY, large.hparams).params
    widened = jax.jit(lambda params: embed(params, like))
    state = jax.jit(small.init)(jax.random.key(0), small.hparams)
    hparams = large.hparams.replace(hidden_size=jnp.float32(SMALL),
                                     batch_size=jnp.float32(NUM_COLUMNS))  # fmt: skip
    wide = jax.jit(large.init)(jax.random.key(0), hparams)
    params = widened(state.params)
    wide = wide.replace(params=params, target_params=params)
    update, update_wide = jax.jit(small.update), jax.jit(large.update)
    weight = np.float32(np.arange(BATCH) < NUM_COLUMNS)
    for step in range(4):
        batch = random_batch(BATCH, seed=step)
        cut = jax.tree.map(lambda x: x[..., :NUM_COLUMNS] if np.ndim(x) else x, batch)
        state = update(jax.random.key(step), state, cut)
        wide = update_wide(jax.random.key(step), wide, batch._replace(weight=weight))
    assert_close(wide.params, widened(state.params), rtol=2e-5, atol=2e-6)
    in_use = raveled(widened(jax.tree.map(np.ones_like, state.params)))
    np.testing.assert_array_equal(raveled(wide.params)[in_use == 0], 0.0)


def test_narrowed_weights_are_distributed_as_those_of_a_small_network():
    net, small = (MLP(2, size, 3, "tanh") for size in (96, 40))
    zeros = jnp.zeros(OBS_DIM)

    @jax.jit
    @jax.vmap
    def draw(key):
        wide = narrow(net.init(key, zeros)["params"], jnp.float32(40))
        return wide, small.init(key, zeros)["params"]

    wide, plain = draw(jax.random.split(jax.random.key(3), 30))
    for layer in plain:
        for name, expected in plain[layer].items():
            cut = (slice(None), *(slice(n) for n in expected.shape[1:]))
            got, expected = np.asarray(wide[layer][name])[cut], np.asarray(expected)
            assert (got != 0).all()
            assert np.abs(got).max() <= np.abs(expected).max() * 1.1
            assert got.std() == pytest.approx(expected.std(), rel=0.05)


def test_a_layer_norm_sees_only_the_units_in_use():
    small, large = (MLP(2, size, 3, "tanh", layer_norm=True) for size in (SMALL, LARGE))
    x = np.float32(np.random.default_rng(0).normal(size=(OBS_DIM, 6)))

    @jax.jit
    def run(key):
        params = small.init(key, x)["params"]
        template = narrow(large.init(key, x)["params"], jnp.float32(SMALL))
        embedded = embed(params, template) | {"width": template["width"]}

        def loss(params):
            out = large.apply({"params": params}, x)
            return jnp.sum(out**2), out

        gradient, got = jax.grad(loss, has_aux=True)(embedded)
        return got, small.apply({"params": params}, x), gradient

    got, expected, gradient = run(jax.random.key(0))
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)
    assert gradient["width"] == 0
    np.testing.assert_array_equal(np.asarray(gradient["Dense_3"]["kernel"])[:, SMALL:], 0.0)


# --- blocks of a batch ---------------------------------------------------------------------------


@jax.jit
def sums_of_columns(batch, batch_size):
    def total(batch):
        return jnp.sum(batch["scale"] * batch["weight"] * batch["x"], axis=1)

    return sum_over_batch(total, batch, batch_size), sum_over_batch(total, batch, None)


@pytest.mark.parametrize("batch_size", [1, block_size(128), block_size(128) + 1, 128])
def test_a_sum_over_blocks_is_the_sum_over_the_columns_in_use(batch_size):
    values = np.arange(128.0, dtype=np.float32)
    batch = {"x": np.stack([values, 2 * values]), "weight": values < batch_size, "scale": 3.0}
    expected = 3 * np.arange(batch_size).sum() * np.array([1.0, 2.0])
    blockwise, at_once = sums_of_columns(batch, np.float32(batch_size))
    np.testing.assert_allclose(blockwise, expected)
    np.testing.assert_allclose(at_once, expected)


# --- varied agents -------------------------------------------------------------------------------


def test_every_drawn_agent_finds_the_smallest_network_with_room():
    config = DDQNConfig(hidden_size=8, num_layers=2, batch_size=16)
    varied = make_agent(config, envs.make("cartpole"), varied=True).varied
    variants, _, values = jax.jit(jax.vmap(varied.draw))(jax.random.split(jax.random.key(0), 200))
    bounds = ranges_of(config)
    assert set(values) == set(bounds)
    sizes = {depth: hidden_sizes(bounds["hidden_size"], depth) for depth in (1, 2, 3)}
    lengths = [raveled(shapes_of(x.init, KEY, x.hparams).params).size for x in varied.agents]
    hidden, depths = values["hidden_size"].tolist(), values["num_layers"].tolist()
    for variant, width, depth in zip(variants.tolist(), hidden, depths, strict=True):
        size = min(size for size in sizes[int(depth)] if size >= width)
        inner = (int(depth) - 1) * size * (size + 1)
        assert lengths[variant] == size * 5 + inner + 2 * (size + 1)
    assert len(set(variants.tolist())) == len(varied.agents) == sum(map(len, sizes.values()))


def test_a_network_that_is_not_varied_leaves_room_for_a_batch_that_is():
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class FixedNetwork(DDQNConfig):
        hidden_size: int = option(8)
        num_layers: int = option(1)

    (agent,) = make_agent(FixedNetwork(), envs.make("cartpole"), varied=True).varied.agents
    obs, zero = jnp.zeros(4), jnp.float32(0)
    buffer = agent.buffer(Transition(obs, jnp.int32(0), zero, zero, obs), 100)
    largest = 3 * FixedNetwork().batch_size
    assert num_columns(buffer.batch(KEY, buffer.init(), 1, None, largest)) == largest


def test_the_agent_inside_an_exploring_one_is_varied():
    varied = make_agent(QLearningConfig(), envs.make("gridworld_2x2"), CountBasedConfig(), True)
    (variant,) = varied.varied.agents
    number, hparams, values = jax.jit(varied.varied.draw)(jax.random.key(0))
    assert number == 0
    expected = variant.hparams.agent.replace(**values)
    assert hparams == variant.hparams.replace(agent=expected)
    assert values["discount"] != variant.hparams.agent.discount


@pytest.mark.slow
def test_a_training_is_that_of_the_variant_with_the_numbers_drawn_from_its_key():
    task = envs.make("cartpole")
    config = DDQNConfig(hidden_size=2, num_layers=1, batch_size=16, discount=0.9, warmup_episodes=1)
    varied = make_agent(config, task, varied=True)
    training = sejax.TrainingConfig(max_steps=60, stop_rule="never")
    train = jax.jit(sejax.make_evaluator(varied, task.env, task, training))
    draw = jax.jit(lambda key: (varied.varied.draw(key), varied.drawn_values(key)))
    key = jax.random.key(0)
    (number, hparams, drawn), values = draw(key)
    assert number > 0 and drawn == values
    for name in ("learning_rate", "batch_size", "hidden_size"):
        assert getattr(hparams, name) == values[name]
    assert hparams.discount == 0.9  # what is not varied stays as it was configured
    variant = varied.varied.agents[int(number)]
    variant = dataclasses.replace(variant, hparams=hparams)
    alone = jax.jit(sejax.make_evaluator(variant, task.env, task, training))
    assert_close(train(key, task.params), alone(key, task.params), rtol=1e-4, atol=1e-5)
    few = for_keys(varied, key[None]).varied  # which compiles this variant alone
    assert few.agents == (varied.varied.agents[int(number)],)
    assert few.draw(key) == (0, hparams, values)
