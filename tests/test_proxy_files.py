"""sejax.proxies.files: proxies come back as they were, and what is no proxy is one message."""

import dataclasses
import errno
import json
import math
import sys

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save_file

import sejax
from sejax import envs, registry
from sejax.envs import absent
from sejax.errors import ConfigError
from sejax.ops.checksummed import pack, unpack
from sejax.proxies import files, stored
from sejax.proxies.configs import RewardConfig, SyntheticConfig

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


def assert_same_weights(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def flat(weights):
    return {f"potential/{layer}/{name}": np.asarray(x)
            for layer, leaves in weights["potential"].items()
            for name, x in leaves.items()}  # fmt: skip


def header_of(path):
    return unpack(path.read_bytes(), "sejax")


def rewrite(path, change):
    """The same file, whole and checksummed, with other metadata or tensors."""
    tensors, header = header_of(path)
    path.write_bytes(pack(*change(tensors, header)))


# --- round trips ---------------------------------------------------------------------------------


def test_a_proxy_that_is_saved_and_loaded_is_the_same(path, env, weights):
    assert sejax.load_set(path).env is env, "sets share one environment, hence its programs"
    loaded, params = sejax.load(path)
    assert loaded.config == env.config and loaded.default_params is params
    assert_same_weights(params.weights, weights[0])
    assert params.discount == 0.7
    proxy = files.load_proxy(path.parent)  # a folder with it
    assert proxy.record == {"score": 12.5, "generation": 7, "seed": 3}
    assert proxy.task is envs.make("gridworld_2x2") and proxy.path == path
    known = {"env": {"name": "gridworld_2x2"}, "proxy": registry.describe("proxy", env.config)}
    assert proxy.config == CONFIG | known | {"run_dir": None}  # no path of a machine
    assert files.read_config(path) == proxy.config
    assert proxy.learned_with("agent") == sejax.QLearningConfig(discount=0.7)


def test_a_proxy_needs_no_configuration_and_no_record(tmp_path, env, weights):
    sejax.save(tmp_path / "bare.safetensors", env, weights[1], discount=0.7)
    proxy = files.load_proxy(tmp_path / "bare.safetensors")
    assert proxy.record == {} and proxy.params.discount == 0.7
    proxies = sejax.load_set(tmp_path / "bare.safetensors")
    assert np.isnan(proxies.scores) and proxies.seeds == [-1]


def test_a_loaded_proxy_steps_as_a_gymnax_environment():
    env, params = sejax.load("cartpole")
    obs, state = env.reset(jax.random.key(0), params)
    key, action = jax.random.key(1), jnp.int32(1)
    obs, _, reward, terminated, *_ = env.step(key, state, action, params)
    assert obs.shape == (4,) and reward.shape == () and terminated  # after its only step
    assert env.step(key, state, action)[2] == reward, "wrappers may leave the params out"


def test_a_set_that_is_saved_and_loaded_is_the_same(tmp_path, env, weights):
    path = tmp_path / "set.safetensors"
    records = [{"score": score, "generation": i, "seed": 5 + i}
               for i, score in enumerate((0.5, 0.9, -0.1))]  # fmt: skip
    sejax.save_set(path, env, weights, records, CONFIG, 0.7)
    proxies = sejax.load_set(path)
    assert proxies.env is env and proxies.size == 3 and proxies.task is env.task
    assert proxies.records == tuple(records) and proxies.discount == 0.7
    assert proxies.scores.tolist() == [0.5, 0.9, -0.1] and proxies.seeds.tolist() == [5, 6, 7]
    for i in range(3):
        assert_same_weights(proxies.one(i).weights, weights[i])
        assert proxies.proxy(i).record == records[i] and proxies.one(i).discount == 0.7
    assert proxies.params.weights["potential"]["Dense_0"]["kernel"].shape == (3, 2, 4)
    with pytest.raises(ConfigError, match=r"source must be a single proxy, .* a set of 3\."):
        sejax.load(path)


def test_parts_of_a_set_are_chosen_by_score_and_place(tmp_path, env, weights):
    path = tmp_path / "set.safetensors"
    sejax.save_set(
        path, env, weights, [{"score": s, "seed": i} for i, s in enumerate((0.5, 0.9, 0.8))],
        discount=0.7,
    )  # fmt: skip
    proxies = sejax.load_set(path)
    assert proxies.ranked(2).seeds.tolist() == [1, 2]
    assert proxies.ranked(2, worst=True).seeds.tolist() == [0, 2]
    assert proxies.solved().seeds.tolist() == [1, 2]  # at 0.8
    assert proxies.first(2).seeds.tolist() == [0, 1] and proxies.first(None).size == 3
    chosen = proxies.select([2, 0])
    assert_same_weights(chosen.one(0).weights, weights[2])
    assert chosen.fingerprint(0) == proxies.fingerprint(2) != proxies.fingerprint(0)


def test_a_kind_may_be_asked_for(path):
    assert files.load_set(path, kind="rn").size == 1
    with pytest.raises(ConfigError, match=r"^--ses must hold proxies learned with proxy=se, .*=rn"):
        files.load_set(path, option="--ses", kind="se")


def test_registering_with_gymnax_is_idempotent():
    import gymnax

    ids = sejax.register_gymnax()
    assert sejax.register_gymnax() == ids
    for env_id in ids:
        _env, params = gymnax.make(env_id)
        shipped = sejax.load(env_id.removeprefix("sejax/"))[1]
        assert jnp.array_equal(jax.tree.leaves(params)[0], jax.tree.leaves(shipped)[0])


# --- files of version 1 --------------------------------------------------------------------------


def version_1(**header):
    env = {"name": "gridworld_2x2", "backend": None, "goal_reward": None}
    proxy = {"name": "rn", "hidden_size": 2, "num_layers": 1, "activation": "prelu",
             "variant": "exclusive_potential", "augmented": False,
             "zero_at_terminal": False}  # fmt: skip
    objective = {"name": "max_reward", "unsolved_weight": 100.0}
    config = {"env": env, "proxy": proxy, "objective": objective,
              "agent": {"name": "q_learning", "discount": 0.7}}  # fmt: skip
    return {"format_version": 1, "config": config, **header}


@pytest.mark.parametrize("name", files.pretrained_names())
def test_shipped_proxies_load(name):
    proxy = files.load_proxy(name)
    assert proxy.path.parent == files.PRETRAINED_DIR
    for group in ("exploration", "es", "objective", "training"):
        assert proxy.learned_with(group) is not None
    agents = proxy.learned_agents()
    # Of the first family; the Boltzmann policy, which looks no further than a step, has none.
    assert proxy.discount == getattr(agents[next(iter(agents))], "discount", 1.0)
    assert {"score", "generation", "seed", "evaluations", "card"} <= proxy.record.keys()


def test_a_proxy_of_version_1_loads(tmp_path, env, weights):
    path = tmp_path / "old.safetensors"
    header = version_1(score=0.5, generation=3, seed=8, note="kept")
    save_file(flat(weights[0]), path, metadata={"sejax": json.dumps(header)})
    proxy = files.load_proxy(path)
    assert proxy.env.config == env.config and proxy.params.discount == 0.7
    assert_same_weights(proxy.params.weights, weights[0])
    assert proxy.record == {"score": 0.5, "generation": 3, "seed": 8, "note": "kept"}
    assert proxy.learned_with("objective") == sejax.MaxReward()
    assert registry.name_of("exploration", proxy.learned_with("exploration")) == "none"


def test_a_set_of_version_1_loads(tmp_path, env, weights):
    path = tmp_path / "old.safetensors"
    header = version_1(scores=[0.5, 0.9, 0.1], generations=[1, 2, 3], seeds=[0, 1, 2])
    tensors = {name: np.stack([flat(one)[name] for one in weights]) for name in flat(weights[0])}
    save_file(tensors, path, metadata={"sejax_set": json.dumps(header)})
    proxies = sejax.load_set(path)
    assert proxies.env is env and proxies.discount == 0.7
    assert proxies.records[1] == {"score": 0.9, "generation": 2, "seed": 1}
    assert_same_weights(proxies.one(2).weights, weights[2])


# --- damage --------------------------------------------------------------------------------------


def test_every_flipped_bit_is_noticed(path):
    """Of the weights and of the version; of the rest one bit in each byte, to save time."""
    whole = path.read_bytes()
    files.read_config(path)
    weights = 8 + int.from_bytes(whole[:8], "little")
    version = whole.index(b"format_version")
    every = {*range(8), *range(version, version + 24), *range(weights, len(whole))}
    for position in range(len(whole)):
        for bit in range(8) if position in every else [position % 8]:
            damaged = bytearray(whole)
            damaged[position] ^= 1 << bit
            path.write_bytes(damaged)
            with pytest.raises(ConfigError, match=r"^source must be "):
                files.read_config(path)


def test_a_file_that_is_cut_or_longer_is_refused_with_the_way_out(path):
    whole = path.read_bytes()
    for damaged in (whole[:-20], whole[:40], b"", whole + b"x"):
        path.write_bytes(damaged)
        with pytest.raises(ConfigError, match=r"whole safetensors file.*which is damaged.*anew fr"):
            sejax.load(path)


def test_a_foreign_safetensors_file_is_refused(tmp_path):
    save_file({"x": np.zeros(3)}, tmp_path / "x.safetensors")
    with pytest.raises(ConfigError, match="a file that sejax has written"):
        sejax.load(tmp_path / "x.safetensors")


def nested(depth):
    value = []
    for _ in range(depth):
        value = [value]
    return value


def without(*names):
    return lambda header: {k: v for k, v in header.items() if k not in names}


@pytest.mark.parametrize(
    "change",
    [
        *(without(name) for name in
          ("format_version", "config", "task", "is_set", "proxies", "discount")),
        lambda header: header | {"config": without("env")(header["config"])},
        lambda header: header | {"config": without("proxy")(header["config"])},
        *(lambda header, value=value: header | {"config": value} for value in (None, [], 3)),
        *(lambda header, value=value: header | {"config": header["config"] | {"env": value}}
          for value in (None, [], "cartpole", {}, {"name": 3}, {"name": None}, {"name": ["x"]},
                        {"name": "gridworld_2x2", "new": 1})),
        *(lambda header, value=value: header | {"config": header["config"] | {"proxy": value}}
          for value in (None, {"name": "rn", "hidden_size": "2"}, {"name": "rn", "new": 1})),
        *(lambda header, value=value: header | {"proxies": value}
          for value in (None, [], [None], [3], {}, 3, [{"score": None}], [{"score": "x"}],
                        [{"seed": None}], [{"seed": []}])),
        *(lambda header, value=value: header | {"discount": value}
          for value in (None, "x", [], math.nan, -0.1, 1.5)),
        *(lambda header, value=value: header | {"format_version": value}
          for value in (None, 0, 3, "2", 2.5, [], True)),
        *(lambda header, value=value: header | {"interface": header["interface"] | value}
          for value in ({"max_steps": 0}, {"max_steps": "9"}, {"action": None},
                        {"action": "n"}, {"action": {"n": 0}}, {"action": {"n": 2.0}},
                        {"action": {"n": 2**40}}, {"action": {"low": [0], "high": []}},
                        {"action": {"low": [], "high": []}}, {"action": {"low": [0]}},
                        {"action": {"low": ["x"], "high": [1]}},
                        {"action": {"low": [1], "high": [0]}},
                        {"action": {"low": [math.nan], "high": [1]}},
                        {"action": {"low": [10**400], "high": [1]}})),
        lambda header: header | {"interface": None},
        lambda header: header | {"format_version": "9" * 10_000},
        lambda header: header | {"task": None},
        lambda header: header | {"task": "t" * 10_000},
        lambda header: header | {"is_set": "yes"},
        lambda header: header | {"is_set": None},
    ],
)  # fmt: skip
def test_metadata_of_another_shape_is_one_message(path, change):
    """Whole files, written by somebody who has another idea of what stands in them."""
    rewrite(path, lambda tensors, header: (tensors, "sejax", change(header)))
    with pytest.raises(ConfigError) as error:
        sejax.load(path)
    said = str(error.value)
    assert "\n" not in said and len(said) < 2000


@pytest.mark.parametrize(
    "text",
    ["null", "[]", "3", '"x"', "{}", "", "{", "NaN", '{"format_version": 1}', "[" * 100_000,
     json.dumps({"format_version": 1, "config": None}),
     json.dumps(version_1(score=None)), json.dumps(version_1() | {"config": {"env": {}}})],
    ids=lambda text: text[:30],
)  # fmt: skip
def test_metadata_that_is_something_else_is_one_message(tmp_path, weights, text):
    path = tmp_path / "proxy.safetensors"
    save_file(flat(weights[0]), path, metadata={"sejax": text})
    with pytest.raises(ConfigError, match=r"a file that sejax has written.*Learn it again\.$"):
        sejax.load(path)


@pytest.mark.parametrize("column", ["scores", "generations", "seeds"])
@pytest.mark.parametrize("value", [None, 3, [1.0], [None] * 3, ["x"] * 3])
def test_columns_of_a_set_of_version_1_that_are_none_are_one_message(
    tmp_path, weights, column, value
):
    path = tmp_path / "set.safetensors"
    header = version_1(scores=[0.5] * 3, generations=[1] * 3, seeds=[0, 1, 2]) | {column: value}
    tensors = {name: np.stack([flat(one)[name] for one in weights]) for name in flat(weights[0])}
    save_file(tensors, path, metadata={"sejax_set": json.dumps(header)})
    with pytest.raises(ConfigError, match=r"a file that sejax has written"):
        sejax.load_set(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda tensors: {"potential/Dense_0": np.zeros(3, np.float32)} | tensors,  # a prefix
        lambda tensors: {name: x.astype(np.int32) for name, x in tensors.items()},
        lambda tensors: {name: x.astype(np.float64) for name, x in tensors.items()},
        lambda tensors: {name: np.full_like(x, np.nan) for name, x in tensors.items()},
        lambda tensors: {name: np.full_like(x, np.inf) for name, x in tensors.items()},
        lambda tensors: {name: x[..., :1] for name, x in tensors.items()},
        lambda tensors: {"x" + name: x for name, x in tensors.items()},
        lambda tensors: {"y" * 10_000: np.zeros(1, np.float32)} | tensors,
        lambda tensors: {},
    ],
)
def test_tensors_that_are_not_the_networks_are_one_message(path, change):
    rewrite(path, lambda tensors, header: (change(tensors), "sejax", header))
    with pytest.raises(ConfigError, match=r"must hold the tensors of the network") as error:
        sejax.load(path)
    assert len(str(error.value)) < 2000


def test_tensors_of_another_shape_are_refused(path):
    def with_a_larger_network(tensors, header):
        config = header["config"]
        proxy = config["proxy"] | {"hidden_size": 3}
        return tensors, "sejax", header | {"config": config | {"proxy": proxy}}

    rewrite(path, with_a_larger_network)
    with pytest.raises(ConfigError, match="must hold the tensors of the network"):
        sejax.load(path)


@pytest.mark.parametrize("given, said", [
    ({"weights": {"potential": {}}}, r"^weights must have the shapes \{.*Reward-gridworld"),
    ({"weights": RewardConfig}, r"^weights must be nested dict.*Set weights to params\.weights"),
    ({"discount": None}, r"^discount must be given for a potential-based.*=params\.discount"),
    ({"discount": 5.0}, r"^config, discount and record must be plain .*outside of \[0, 1"),
    ({"score": "high"}, r"^config, discount and record must be plain values"),
    ({"config": sejax.NESConfig()}, r"^config must be nested plain values.*\.plain\(\)"),
    ({"config": {"es": sejax.NESConfig()}}, r"^config, discount and record must be plain values"),
])  # fmt: skip
def test_what_could_not_be_loaded_is_not_saved_over_what_can(path, env, weights, given, said):
    before = path.read_bytes()
    given = {"weights": weights[1], "discount": 0.7} | given
    with pytest.raises(ConfigError, match=said):
        sejax.save(path, env, **given)
    with pytest.raises(ConfigError, match=r"^records must be one for each proxy, .*1 for 2"):
        sejax.save_set(path, env, weights[:2], [{}], discount=0.7)
    given = jax.tree.map(lambda x: x.at[..., 0].set(jnp.nan), weights[1])
    with pytest.raises(ConfigError, match=r"^weights must be finite, .*others in potential/Dense"):
        sejax.save(path, env, given, discount=0.7)
    assert path.read_bytes() == before


def test_doubles_and_arrays_of_one_number_are_saved_as_floats_and_numbers(path, env, weights):
    doubles = jax.tree.map(lambda x: np.asarray(x, np.float64), weights[1])
    record = {"score": jnp.float32(0.5), "seed": np.int64(3)}
    sejax.save(path, env, doubles, discount=np.float32(0.5), **record)
    assert files.load_proxy(path).record == {"score": 0.5, "seed": 3}
    assert_same_weights(files.load_proxy(path).params.weights, weights[1])


def test_tensors_of_types_that_numpy_lacks_are_refused(path):
    tensors, header = header_of(path)
    data = pack({name: x.astype(np.uint8) for name, x in tensors.items()}, "sejax", header)
    data = data.replace(b'"U8"', b'"F8_E5M2"', 1)  # longer by 5: taken from the padding's count
    size = int.from_bytes(data[:8], "little") + 5
    path.write_bytes(size.to_bytes(8, "little") + data[8:])
    with pytest.raises(ConfigError, match="which is damaged"):
        sejax.load(path)


def test_a_full_disk_is_an_oserror_and_the_older_file_stays(path, env, weights, monkeypatch):
    before = path.read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("sejax.ops.files.os.write", full)
        with pytest.raises(OSError, match="No space left"):
            sejax.save(path, env, weights[1], discount=0.7)
        with pytest.raises(OSError, match="No space left"):
            sejax.save_set(path, env, weights, [{}] * 3, discount=0.7)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path], "temporary files are removed"


# --- nothing in a file is resolved or imported ---------------------------------------------------


def test_interpolations_in_metadata_are_plain_text(path, tmp_path, env, weights, monkeypatch):
    monkeypatch.setenv("SECRET", "hush")
    text = "${oc.env:SECRET}"
    config = CONFIG | {"preset": text, "agent": {"name": "q_learning", "note": text}}
    sejax.save(path, env, weights[0], config, 0.7, note=text)
    proxy = files.load_proxy(path)
    assert proxy.config["preset"] == proxy.record["note"] == text
    again = tmp_path / "again.safetensors"
    sejax.save(again, env, proxy.params.weights, proxy.config, proxy.discount, **proxy.record)
    assert b"hush" not in again.read_bytes() and text.encode() in again.read_bytes()
    rewrite(path, lambda tensors, header: (tensors, "sejax", header | {"task": text}))
    with pytest.raises(ConfigError, match=r"one of \$\{oc\.env:SECRET\} in"):
        sejax.load(path)


MINE = """
import dataclasses
from sejax import envs
from sejax.proxies.configs import RewardConfig

@dataclasses.dataclass(frozen=True)
class Room:
    size: int = 2

    def make(self):
        return dataclasses.replace(envs.make("gridworld_2x2"), name="my_room", origin=None)

@dataclasses.dataclass(frozen=True, kw_only=True)
class Mine(RewardConfig):
    mine: int = 3
"""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A file of a foreign kind of proxy of a foreign task, whose module is not imported any more.

    Returns the file, the task and the proxy's configuration.
    """
    (tmp_path / "my_file_worlds.py").write_text(MINE)
    monkeypatch.syspath_prepend(str(tmp_path))
    task = envs.make("my_file_worlds:Room", size=3)
    config = registry.configure("proxy", {"name": "my_file_worlds:Mine", "hidden_size": 2})
    env = registry.make("proxy", config, task)
    path = tmp_path / "mine.safetensors"
    sejax.save(path, env, env.init_weights(jax.random.key(0)), discount=0.7)
    del sys.modules["my_file_worlds"]
    return path, task, config


def test_a_foreign_task_or_kind_is_never_imported_and_loads_if_it_is_given(mine):
    path, task, config = mine
    stored = files.read_config(path)
    assert stored["env"] == {"name": "my_file_worlds:Room", "size": 3}
    assert stored["proxy"]["name"] == "my_file_worlds:Mine"
    before = set(sys.modules)
    for given in ({}, {"task": task}):
        with pytest.raises(
            ConfigError, match=r"registered proxy if no proxy is given.*proxy_kind=my_fi"
        ):
            sejax.load(path, **given)
    with pytest.raises(
        ConfigError, match=r"registered env if no task is given.*env=my_file_worlds:R"
    ):
        sejax.load(path, proxy=config)
    assert set(sys.modules) == before
    env, _ = sejax.load(path, task=task, proxy=config)
    assert env.task is task and env.config == config
    assert "my_file_worlds" not in sys.modules


def test_a_task_given_must_be_that_of_the_proxy(path, tmp_path):
    with pytest.raises(ConfigError, match=r"be a proxy of cliff_walking, .* one of gridworld_2x2"):
        sejax.load(path, task=envs.make("cliff_walking"))
    task = dataclasses.replace(envs.make("gridworld_2x2"), solved_reward=0.5)
    assert files.load_proxy(path, task=task).task is task
    longer = dataclasses.replace(task, max_steps=task.max_steps + 1)
    assert sejax.load(path, task=longer)[0].task is longer  # an RN: the same dynamics
    se = tmp_path / "se.safetensors"
    env, weights = an_se_of(dataclasses.replace(envs.make("pendulum"), name="theirs", origin=None))
    sejax.save(se, env, weights)
    for change, said in (({"max_steps": 7}, "max_steps of"),
                         ({"env": envs.make("acrobot").env}, "observation of")):  # fmt: skip
        other = dataclasses.replace(env.task, **{"params": None, "max_steps": 200} | change)
        with pytest.raises(ConfigError, match=f"^task must have the {said}"):
            sejax.load(se, task=other)


def test_a_task_made_by_hand_must_be_given(tmp_path, env, weights):
    task = dataclasses.replace(env.task, name="by hand", origin=None)
    mine = env.config.make(task)
    sejax.save(tmp_path / "p.safetensors", mine, weights[0], discount=0.7)
    with pytest.raises(ConfigError, match=r"proxy of a registered env if no task is given"):
        sejax.load(tmp_path / "p.safetensors")
    assert sejax.load(tmp_path / "p.safetensors", task=task)[0].task is task


# --- without the task ----------------------------------------------------------------------------


def an_se_of(task, **config):
    env = SyntheticConfig(**{"hidden_size": 3, "initial_state": "learned"} | config).make(task)
    return env, env.init_weights(jax.random.key(0))


def test_an_se_with_its_own_starts_needs_no_task(tmp_path):
    task = dataclasses.replace(envs.make("pendulum"), name="by hand", origin=None)
    env, weights = an_se_of(task, state_units="bounds")
    path = tmp_path / "se.safetensors"
    sejax.save(path, env, weights)
    there, params = sejax.load(path)
    assert there.task.interface == task.interface
    for key in jax.random.split(jax.random.key(0), 3):
        episode = [rollout(world, params, key) for world in (env, there)]
        chex.assert_trees_all_equal(*episode)
    assert sejax.load(path)[0].task is there.task
    assert sejax.make_agent(sejax.TD3Config(), there.task)
    again = tmp_path / "again.safetensors"
    sejax.save(again, there, params.weights)
    assert files.read_config(again)["env"] == files.read_config(path)["env"]
    for use in (lambda: files.load_proxy(path).task, lambda: files.load_set(path).solved(),
                lambda: rollout(there.task.env, there.task.params, jax.random.key(0))):  # fmt: skip
        with pytest.raises(ConfigError, match=r"proxy of a registered env if no task is given"):
            use()
    assert files.load_proxy(path, task=task).task is task


def rollout(env, params, key, num_steps=4):
    """Observations and rewards of an episode with random actions."""
    obs, state = env.reset_env(key, params)
    seen = [obs]
    for step_key in jax.random.split(key, num_steps):
        action = env.action_space(params).sample(step_key)
        obs, state, reward, *_ = env.step_env(step_key, state, action, params)
        seen += [obs, reward]
    return seen


@pytest.mark.parametrize("made", [
    lambda task: an_se_of(task, initial_state="real"),
    lambda task: an_rn_of(task),
], ids=["an SE that begins there", "an RN"])  # fmt: skip
def test_what_runs_its_task_needs_it(tmp_path, made):
    env, weights = made(dataclasses.replace(envs.make("pendulum"), name="by hand", origin=None))
    sejax.save(tmp_path / "p.safetensors", env, weights, discount=0.7)
    with pytest.raises(ConfigError, match=r"proxy of a registered env if no task is given"):
        sejax.load(tmp_path / "p.safetensors")


def an_rn_of(task):
    env = RewardConfig(hidden_size=3).make(task)
    return env, env.init_weights(jax.random.key(0))


def test_the_shipped_cheetah_needs_no_mujoco(monkeypatch):
    def without(*_):
        raise ConfigError("env=halfcheetah needs MuJoCo.")

    monkeypatch.setattr("sejax.envs.make_from", without)
    env, params = sejax.load("halfcheetah")
    _, obs, reward = rollout(env, params, jax.random.key(0), num_steps=1)
    assert obs.shape == (17,) and jnp.isfinite(reward)
    assert env.task.interface == stored.read(files.find("halfcheetah"), "source")[1]["interface"]
    with pytest.raises(ConfigError, match="needs MuJoCo"):
        sejax.load("halfcheetah-rn")


@pytest.mark.parametrize("name", ["cartpole", "cliff_walking", "pendulum", "gymnax/Pong-misc"])
def test_spaces_of_a_task_come_back_from_plain_values(name):
    task = envs.make(name)
    again = absent.make(name, json.loads(json.dumps(task.interface)), task.origin, "")
    assert again.origin == task.origin
    assert again.interface == task.interface
    assert (again.obs_dim, again.action_dim) == (task.obs_dim, task.action_dim)
    assert (again.num_states, again.num_actions) == (task.num_states, task.num_actions)
    assert (again.max_action, again.max_steps) == (task.max_action, task.max_steps)


# --- names ---------------------------------------------------------------------------------------


def test_an_unknown_name_lists_the_shipped_ones():
    with pytest.raises(ConfigError) as error:
        sejax.load("carpole")
    said = str(error.value)
    assert said.startswith("source must be one of cartpole, ") and "got 'carpole'" in said
    assert "Did you mean source=cartpole?" in said


def test_real_is_no_proxy_that_python_could_load():
    with pytest.raises(ConfigError) as error:
        sejax.load("real")
    said = str(error.value)
    assert said.startswith("source must be one of ") and "=real?" not in said


def test_a_folder_without_a_proxy_says_what_it_is(tmp_path):
    for load in (sejax.load, sejax.load_set):
        with pytest.raises(
            ConfigError, match=r"this is a folder of another sort; got .*Set source"
        ):
            load(tmp_path)
    (tmp_path / "config.yaml").write_text("{}")
    for load in (sejax.load, sejax.load_set):
        with pytest.raises(
            ConfigError, match=r"run has not finished a generation yet; got .*finis"
        ):
            load(tmp_path)


@pytest.mark.parametrize(
    "source",
    ["n" * 10_000, "n" * 10_000 + ".safetensors", "/".join(["n"] * 5000), "a\0b", "\0", "x/../y",
     "nope.safetensors", "nope/nope"],
    ids=lambda source: repr(source[:20]),
)  # fmt: skip
def test_a_path_that_leads_nowhere_is_one_short_message(source):
    with pytest.raises(ConfigError, match=r"^source must be ") as error:
        sejax.load(source)
    assert len(str(error.value)) < 700
