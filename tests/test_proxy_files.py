"""Stored proxies come back as they were, and what is not a proxy is one message."""

import copy
import dataclasses
import errno
import functools
import math
from unittest.mock import MagicMock

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save
from support import paper_se, refusal, refused

import sejax
from sejax import envs
from sejax.ops.checksummed import pack, unpack
from sejax.options import ConfigError, old, registry
from sejax.options.plain import to_plain
from sejax.proxies import header
from sejax.proxies.reward import RewardConfig

CONFIG = {"preset": "best", "agent": {"name": "q_learning", "discount": 0.7}, "run_dir": "/home/me"}


@pytest.fixture(scope="module")
def env():
    """A small RN."""
    config = RewardConfig(hidden_size=2, variant="exclusive_potential")
    return registry.make("proxy", config, envs.make("gridworld_2x2"))


@pytest.fixture(scope="module")
def weights(env):
    """Of three proxies."""
    return [env.init_weights(key) for key in jax.random.split(jax.random.key(0), 3)]


@pytest.fixture
def path(tmp_path, env, weights):
    """A stored proxy."""
    path = tmp_path / "proxy.safetensors"
    sejax.save(path, env, weights[0], CONFIG, 0.7, score=12.5, generation=7, seed=3)
    return path


# --- round trips ---------------------------------------------------------------------------------


def test_a_proxy_that_is_saved_and_loaded_is_the_same(path, env, weights):
    assert sejax.load_set(path).env is env, "sets share one environment, hence its programs"
    loaded, params = sejax.load(path)
    assert loaded.config == env.config and loaded.default_params is params
    chex.assert_trees_all_equal(params.weights, weights[0])
    assert params.discount == 0.7
    proxy = sejax.load_proxy(path.parent)  # a folder with it
    assert proxy.record == {"score": 12.5, "generation": 7, "seed": 3}
    assert proxy.task is envs.make("gridworld_2x2") and proxy.path == path
    other = CONFIG | {"env": {"name": "cartpole"}}  # the environment's own task counts
    sejax.save(path, env, weights[0], other, 0.7)
    assert sejax.load_proxy(path).config["env"] == {"name": "gridworld_2x2"}
    known = {"env": {"name": "gridworld_2x2"}, "proxy": to_plain(env.config, "proxy")}
    known |= {"agents": {"q_learning": CONFIG["agent"]}, "preset": "best"}  # today's form
    assert proxy.config == known | {"run_dir": None}  # no path of a machine
    assert header.read(path).header.config == proxy.config
    assert proxy.learned_agents() == {"q_learning": sejax.QLearningConfig(discount=0.7)}
    assert refused(proxy.learned_with, "training") == "group"
    own = {"agents": {"mine": {"name": "my:Agent", "weight": 3}}}  # an own agent's own field
    assert old.upgraded(own) == own


def test_a_proxy_needs_no_configuration_and_no_record(tmp_path, env, weights):
    path = tmp_path / "bare.safetensors"
    sejax.save(path, env, weights[1], discount=0.7)
    proxy, proxies = sejax.load_proxy(path), sejax.load_set(path)
    assert proxy.record == {} and proxy.params.discount == 0.7
    assert np.isnan(proxies.scores) and proxies.seeds == [-1]
    assert proxy.learned_agents() == {} and refused(proxy.learned_with, "es") == "es"
    assert refused(sejax.training_of, proxy) == "training"
    sejax.save(path, env, weights[1], {"training": {"max_steps": 7}}, 0.7)  # with today's defaults
    assert not sejax.training_of(sejax.load_proxy(path)).time_limit_is_terminal


def test_a_set_comes_back_and_parts_of_it_are_chosen_by_score_and_place(tmp_path, env, weights):
    path, scores = tmp_path / "set.safetensors", (0.5, 0.9, 0.8)
    records = [{"score": score, "generation": i, "seed": 5 + i} for i, score in enumerate(scores)]
    sejax.save_set(path, env, weights, records, CONFIG, 0.7)
    proxies = sejax.load_set(path, kind="rn")
    assert proxies.env is env and len(proxies) == 3 and proxies.task is env.task
    assert proxies.scores.tolist() == [0.5, 0.9, 0.8] and proxies.seeds.tolist() == [5, 6, 7]
    for proxy, expected, record in zip(proxies, weights, records, strict=True):
        chex.assert_trees_all_equal(proxy.params.weights, expected)
        assert proxy.record == record and proxy.params.discount == proxies.discount == 0.7
    assert refused(sejax.load, path) == "source"
    for kind, field in (("se", "--ses"), ("typo", "kind")):
        assert refused(sejax.load_set, path, option="--ses", kind=kind) == field
    assert proxies.ranked(2).seeds.tolist() == [6, 7]
    assert proxies.ranked(2, worst=True).seeds.tolist() == [5, 7]
    sejax.save_set(tmp_path / "x", env, weights, [{"seed": 5}, *records[1:]], CONFIG, 0.7)
    for worst, seeds in ((False, [6, 7, 5]), (True, [7, 6, 5])):  # without a score comes last
        assert sejax.load_set(tmp_path / "x").ranked(3, worst).seeds.tolist() == seeds
    assert proxies[proxies.scores >= 0.8].seeds.tolist() == [6, 7]
    assert proxies[:2].seeds.tolist() == [5, 6]
    chosen = proxies[[2, 0]]
    chex.assert_trees_all_equal(chosen[0].params.weights, weights[2])
    assert chosen[0].fingerprint == proxies[2].fingerprint != proxies[0].fingerprint


def test_a_set_of_one_plays_in_numpy_too(tmp_path):
    env, params = sejax.load("cartpole")
    sejax.save_set(tmp_path / "set.safetensors", env, [params.weights], [{}])
    assert sejax.gym.make(str(tmp_path / "set.safetensors")).reset(seed=0)
    assert refused(sejax.save, tmp_path / "p.safetensors", env, params) == "weights"


def test_registering_with_gymnax_is_idempotent():
    gymnax = pytest.importorskip("gymnax")
    ids = sejax.register_gymnax()
    assert sejax.register_gymnax() == ids == [f"sejax/{x}" for x in header.pretrained_files()]
    for env_id in (ids[0], ids[-1]):
        _, params = gymnax.make(env_id)
        chex.assert_trees_all_equal(params, sejax.load(env_id.removeprefix("sejax/"))[1])


@pytest.mark.slow
def test_every_stored_result_loads():
    files = sorted((header.PRETRAINED_DIR.parents[1] / "results").rglob("*.safetensors"))
    assert len(files) > 40
    for file in files:
        assert len(sejax.load_set(file)) >= 1


# --- damage --------------------------------------------------------------------------------------


def test_a_file_that_is_damaged_or_foreign_is_refused(path):
    whole = path.read_bytes()
    for damaged in (whole[:-20], whole[:40], b"", whole + b"x", save({"x": np.zeros(3)})):
        path.write_bytes(damaged)
        assert refused(sejax.load, path) == "source"
    with path.open("wb") as sparse:  # which would not fit into memory
        sparse.truncate(10**12)
    assert refused(sejax.load, path) == "source"


MISSING = object()
ODD_VALUES = {  # of entries of the metadata, by their place
    ("format_version",): [MISSING, None, 0, 1, 3, "x", 2.5, [], True, "9" * 10_000],
    ("config",): [MISSING, None, [], 3], ("config", "agents"): ["x", 3, [3]],
    ("config", "env"): [MISSING, None, [], "cartpole", {}, {"name": 3}, {"name": None},
                        {"name": ["x"]}, {"name": "gridworld_2x2", "new": 1}],
    ("config", "proxy"): [MISSING, None, {"name": "rn", "hidden_size": "x"},
                          {"name": "rn", "new": 1}],
    ("task",): [MISSING, None, [], "t" * 10_000],
    ("is_set",): [MISSING, None, "yes", 2],
    ("proxies",): [MISSING, None, [], [None], [3], {}, 3, [{"score": None}], [{"score": "x"}],
                   [{"seed": None}], [{"seed": []}], [{"scores": {"ddqn": []}}],
                   [{"scores": 3}], [{"score": 10**400}],
                   [{"x": functools.reduce(lambda x, _: [x], range(99), 0)}]],
    ("discount",): [MISSING, None, "x", [], math.nan, -0.1, 1.5],
    ("interface",): [MISSING, None, []],
    ("interface", "max_steps"): [MISSING, 0, "9"],
    ("interface", "action"): [
        MISSING, None, "n", {"n": 0}, {"n": 2.0}, {"n": 2**40}, {"low": [0], "high": []},
        {"low": [], "high": []}, {"low": [0]}, {"low": ["x"], "high": [1]},
        {"low": [1], "high": [0]}, {"low": [math.nan], "high": [1]},
        {"low": [10**400], "high": [1]}, {"low": [-1e300], "high": [1]},
    ],
}  # fmt: skip


def test_metadata_of_another_shape_is_one_message(path):
    """Whole files, written by somebody who has another idea of what stands in them."""
    tensors, whole = unpack(path.read_bytes(), "sejax")
    for place, odd_values in ODD_VALUES.items():
        for value in odd_values:
            values = copy.deepcopy(whole)
            *groups, name = place
            entry = functools.reduce(dict.__getitem__, groups, values)
            entry[name] = value
            if value is MISSING:
                del entry[name]
            path.write_bytes(pack(tensors, "sejax", values))
            refusal(sejax.load, path)


def test_metadata_that_is_something_else_is_one_message(path):
    for text in ("null", "[]", "3", '"x"', "{}", "", "{", "NaN", "[" * 100_000):
        path.write_bytes(save({"x": np.zeros(3)}, metadata={"sejax": text}))
        assert refused(sejax.load, path) == "source"


ODD_TENSORS = [
    lambda name, x: {name: x.astype(np.int32)},
    lambda name, x: {name: x.astype(np.float64)},
    lambda name, x: {name: np.full_like(x, np.nan)},
    lambda name, x: {name: np.full_like(x, np.inf)},
    lambda name, x: {name: x[..., :1]},
    lambda name, x: {"x" + name: x},
    lambda name, x: {name: x, name.rpartition("/")[0]: x},  # a prefix
    lambda name, x: {name: x, "y" * 10_000: x},
    lambda name, x: {},
]


def test_tensors_that_are_not_the_networks_are_one_message(path):
    tensors, values = unpack(path.read_bytes(), "sejax")
    for change in ODD_TENSORS:
        changed = {new: y for name, x in tensors.items() for new, y in change(name, x).items()}
        path.write_bytes(pack(changed, "sejax", values))
        assert refused(sejax.load, path) == "source"
    data = pack({name: x.astype(np.uint8) for name, x in tensors.items()}, "sejax", values)
    data = data.replace(b'"U8"', b'"F8_E5M2"', 1)  # which NumPy lacks; longer by 5, see the header
    size = int.from_bytes(data[:8], "little") + 5
    path.write_bytes(size.to_bytes(8, "little") + data[8:])
    assert refused(sejax.load, path) == "source"


@pytest.mark.parametrize("given, field", [
    ({"weights": {"potential": {}}}, "weights"), ({"discount": None}, "discount"),
    ({"discount": 5.0}, "discount"), ({"score": "high"}, "config"),
    ({"x": functools.reduce(lambda x, _: [x], range(5000), 0)}, "config"),
    ({"config": sejax.NESConfig()}, "config"), ({"config": {"es": sejax.NESConfig()}}, "config"),
])  # fmt: skip
def test_what_could_not_be_loaded_is_not_saved_over_what_can(path, env, weights, given, field):
    before = path.read_bytes()
    given = {"env": env, "weights": weights[1], "discount": 0.7} | given
    assert refused(sejax.save, path, **given) == field
    assert refused(sejax.save_set, path, env, weights[:2], [{}], discount=0.7) == "weights"
    records = [{}, {}]
    for others in ({"potential": {}}, jax.tree.map(lambda x: x[:1], weights[0])):
        unequal = [weights[0], others]
        assert refused(sejax.save_set, path, env, unequal, records, discount=0.7) == "weights"
    odd = jax.tree.map(lambda x: x.at[..., 0].set(jnp.nan), weights[1])
    assert refused(sejax.save, path, env, odd, discount=0.7) == "weights"
    assert path.read_bytes() == before


def test_doubles_and_arrays_of_one_number_are_saved_as_floats_and_numbers(path, env, weights):
    doubles = jax.tree.map(lambda x: np.asarray(x, np.float64), weights[1])
    record = {"score": jnp.float32(0.5), "seed": np.int64(3)}
    sejax.save(path, env, doubles, discount=np.float32(0.5), **record)
    assert sejax.load_proxy(path).record == {"score": 0.5, "seed": 3}
    chex.assert_trees_all_equal(sejax.load_proxy(path).params.weights, weights[1])


def test_a_full_disk_is_an_oserror_and_the_older_file_stays(path, env, weights, monkeypatch):
    before = path.read_bytes()
    monkeypatch.setattr("os.fsync", MagicMock(side_effect=OSError(errno.ENOSPC, "No space left")))
    with pytest.raises(OSError, match="No space left"):
        sejax.save(path, env, weights[1], discount=0.7)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path], "temporary files are removed"


def test_a_task_given_must_be_that_of_the_proxy(path, tmp_path):
    assert refused(sejax.load, path, task=envs.make("cliff_walking")) == "source"
    task = dataclasses.replace(envs.make("gridworld_2x2"), solved_reward=0.5)
    assert sejax.load_proxy(path, task=task).task is task
    longer = dataclasses.replace(task, max_steps=task.max_steps + 1)
    assert sejax.load(path, task=longer)[0].task is longer  # an RN: the same dynamics
    se = tmp_path / "se.safetensors"
    env, weights = an_se_of(dataclasses.replace(envs.make("pendulum"), name="theirs"))
    sejax.save(se, env, weights)
    for change in ({"max_steps": 7}, {"env": envs.make("acrobot").env}):
        other = dataclasses.replace(env.task, **{"params": None, "max_steps": 200} | change)
        assert refused(sejax.load, se, task=other) == "task"


def test_a_task_that_was_changed_by_hand_must_be_given(tmp_path):
    task = dataclasses.replace(envs.make("cartpole"), max_steps=50)
    env, path = RewardConfig(hidden_size=3).make(task), tmp_path / "rn.safetensors"
    sejax.save(path, env, env.init_weights(jax.random.key(0)), discount=0.9)
    assert refused(sejax.load, path) == "task"
    assert sejax.load(path, task=task)[0].task is task


# --- without the task ----------------------------------------------------------------------------


def an_se_of(task, **config):
    env = paper_se(**{"hidden_size": 3, "initial_state": "learned"} | config).make(task)
    return env, env.init_weights(jax.random.key(0))


def test_an_se_with_its_own_starts_needs_no_task(tmp_path):
    task = dataclasses.replace(envs.make("pendulum"), name="by hand")
    env, weights = an_se_of(task, state_units="bounds")
    path = tmp_path / "se.safetensors"
    sejax.save(path, env, weights)
    there, params = sejax.load(path)
    assert there.task.interface == task.interface
    chex.assert_trees_all_equal(*(rollout(x, params, jax.random.key(0)) for x in (env, there)))
    assert sejax.load(path)[0].task is there.task
    assert sejax.make_agent(sejax.TD3Config(), there.task)
    again = tmp_path / "again.safetensors"
    sejax.save(again, there, params.weights)
    assert header.read(again).header.config["env"] == header.read(path).header.config["env"]
    assert refused(rollout, there.task.env, there.task.params, jax.random.key(0)) == "task"
    assert sejax.load_proxy(path, task=task).task is task


def rollout(env, params, key, num_steps=4):
    """Observations and rewards of an episode with random actions."""

    def step(state, key):
        action = env.action_space(params).sample(key)
        obs, state, reward, *_ = env.step_env(key, state, action, params)
        return state, (obs, reward)

    def play(key):
        obs, state = env.reset_env(key, params)
        return obs, jax.lax.scan(step, state, jax.random.split(key, num_steps))[1]

    return jax.jit(play)(key)


@pytest.mark.parametrize("config", [RewardConfig(hidden_size=3), paper_se(hidden_size=3)],
                         ids=["an RN", "an SE that begins there"])  # fmt: skip
def test_what_runs_its_task_needs_it(tmp_path, config):
    env = config.make(dataclasses.replace(envs.make("pendulum"), name="by hand"))
    weights = env.init_weights(jax.random.key(0))
    sejax.save(tmp_path / "p.safetensors", env, weights, discount=0.7)
    assert refused(sejax.load, tmp_path / "p.safetensors") == "task"


def test_the_shipped_cheetah_needs_no_mujoco(monkeypatch):
    without = MagicMock(side_effect=ConfigError("env", "needs MuJoCo."))
    monkeypatch.setattr("sejax.envs.make_from", without)
    env, params = sejax.load("halfcheetah")
    _, (obs, reward) = rollout(env, params, jax.random.key(0), num_steps=1)
    assert obs.shape == (1, 17) and jnp.isfinite(reward)
    assert env.task.interface == header.read("halfcheetah").header.interface
    with pytest.raises(ConfigError, match="needs MuJoCo"):
        sejax.load("halfcheetah-rn")


# --- names ---------------------------------------------------------------------------------------


def test_an_unknown_name_lists_the_shipped_ones(tmp_path, monkeypatch):
    error = refusal(sejax.load, "carpole")
    assert error.field == "source" and "Set source=cartpole." in str(error)
    assert "=real." not in str(refusal(sejax.load, "real"))  # a word of a command's
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cartpole").mkdir()  # a folder without a proxy
    assert sejax.load("cartpole")


@pytest.mark.parametrize("name, given", [
    ("source", None), ("source", 3),
    ("source", "hf://" + "/" * 100), ("source", "n" * 10_000), ("source", "."),
    ("source", "n" * 10_000 + ".safetensors"), ("source", "/".join(["n"] * 5000)),
    ("source", "a\0b"), ("source", "x/../y"), ("source", "nope.safetensors"),
], ids=lambda value: repr(value)[:20])  # fmt: skip
def test_an_argument_that_cannot_be_is_one_short_message(tmp_path, monkeypatch, name, given):
    monkeypatch.chdir(tmp_path)
    assert refused(sejax.load, **{"source": "cartpole", name: given}) == name
