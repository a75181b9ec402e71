"""What a search's words say, and its spaces; without Optuna."""

import math

import pytest
import yaml

from sejax.cli import compose
from sejax.errors import ConfigError
from sejax.search import __main__ as command
from sejax.search import settings, spaces


class Trial:
    """Suggests the lowest value of each range and the last of each choice; keeps what was asked."""

    def __init__(self):
        self.asked = {}

    def suggest_float(self, name, low, high, *, step=None, log=False):
        self.asked[name] = ("float", low, high, step, log)
        return low

    def suggest_int(self, name, low, high, *, step=1, log=False):
        self.asked[name] = ("int", low, high, step, log)
        return low

    def suggest_categorical(self, name, choices):
        self.asked[name] = choices
        return choices[-1]


@pytest.mark.parametrize(
    ("text", "asked", "word"),
    [
        ("tag(log, interval(0.01, 0.3))", ("float", 0.01, 0.3, None, True), "0.01"),
        ("interval(1, 10)", ("float", 1.0, 10.0, None, False), "1"),
        ("int(interval(1, 10))", ("int", 1, 10, 1, False), "1"),
        ("tag(log, int(interval(48, 192)))", ("int", 48, 192, 1, True), "48"),
        ("range(1, 9, 3)", ("int", 1, 7, 3, False), "1"),  # as Python's: 1, 4, 7
        ("range(1, 10, 3)", ("int", 1, 7, 3, False), "1"),
        ("true,false", ("true", "false"), "false"),
        ("choice(tanh, 3, x y)", ("tanh", "3", "'x y'"), "'x y'"),
        ("choice([1,2], [3])", ("[1,2]", "[3]"), "[3]"),
    ],
)
def test_hydras_sweeps_become_optunas_distributions(text, asked, word):
    trial = Trial()
    assert spaces.parse("es.x", text).suggest(trial) == word
    assert trial.asked == {"es.x": asked}


def test_inverse_logarithms_are_drawn_in_the_distance_from_1():
    trial = Trial()
    dimension = spaces.parse("agent.discount", "tag(log, inverse, interval(0.9, 0.999))")
    assert dimension.suggest(trial) == "0.999"  # the least distance
    kind, low, high, _, log = trial.asked["1 - agent.discount"]
    assert (kind, log) == ("float", True)
    assert math.isclose(low, 0.001) and math.isclose(high, 0.1)
    assert dimension.of({"1 - agent.discount": 0.05}) == "0.95"
    assert dimension.shown({"1 - agent.discount": 0.0013249}) == "0.99868"


def test_written_values_stay_within_their_bounds():
    dimension = spaces.parse("es.x", "interval(0.12345678, 0.23456789)")
    assert dimension.of({"es.x": 0.12345678}) == "0.123457"
    assert dimension.of({"es.x": 0.23456789}) == "0.23456789"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("3", r"es\.x must be a sweep of Hydra's.*got 3\. Set es\.x="),
        ("glob(*)", "must be a sweep"),
        ("interval(0, 1", "must be a sweep"),
        ("interval(0.1, inf)", r"have finite bounds.*got interval\(0.1, inf\)"),
        ("interval(2, 1)", r"be a range that grows.*got interval\(2, 1\)"),
        ("tag(log, interval(0, 1))", "begin above 0"),
        ("tag(inverse, interval(0, 1))", "have the tags log, or log and inverse"),
        ("tag(log, inverse, interval(0.5, 1))", "end below 1 with inverse"),
        ("tag(lgo, interval(0.5, 1))", "have the tags log"),
    ],
)
def test_what_cannot_be_searched_is_refused(text, message):
    with pytest.raises(ConfigError, match=message):
        spaces.parse("es.x", text)


def test_words_are_the_searchs_own_the_space_or_fixed():
    search = settings.read(
        ["env=acrobot", "trials=7", "es.noise_std=interval(0.1,1)", "storage=postgresql://a:b@c/d?e=f",
         "agent.batch_size=32,64", "timeout=null"]
    )  # fmt: skip
    assert search.config.trials == 7
    assert search.storage == "postgresql://a:b@c/d?e=f"
    assert search.fixed == ("env=acrobot",)
    assert list(search.space) == ["es.noise_std", "agent.batch_size"]
    assert search.study == "acrobot-se-ddqn"
    assert not search.is_of_agent


def test_a_proxy_that_exists_makes_it_a_search_of_an_agent():
    search = settings.read(["proxy=cartpole", "agent=ppo", "space=agent"])
    assert search.is_of_agent
    assert search.study == "ppo-on-cartpole"
    assert all(name.startswith("agent.") for name in search.space)
    assert not settings.read(["proxy=rn", "env=cliff_walking"]).is_of_agent


def test_what_is_fixed_or_has_a_space_of_its_own_is_left_out_of_the_preset():
    search = settings.read(
        ["space=paper_se", "agent.hidden_size=64", "es.noise_std=interval(0.1,0.2)"]
    )
    assert "agent.hidden_size" not in search.space
    assert search.space["es.noise_std"].high == 0.2
    assert search.space["proxy.hidden_size"].high == 192


def test_a_preset_has_the_ranges_of_the_agent_that_the_task_chooses():
    search = settings.read(["env=cliff_walking", "proxy=rn", "space=paper_rn"])
    assert search.study == "cliff_walking-rn-q_learning"
    assert "agent.epsilon_decay" in search.space and "agent.batch_size" not in search.space


def test_machines_are_where_trials_are_made_and_no_setting():
    search = settings.read(["env=acrobot", "machines=local", "es.noise_std=0.1,0.2"])
    assert search.fixed == ("env=acrobot",) and not search.machines.is_elsewhere
    assert "machines" not in search.stored()["fixed"]
    with pytest.raises(ConfigError, match="machines"):
        settings.read(["machines=slurm", "es.noise_std=0.1,0.2"])


@pytest.mark.parametrize(
    ("text", "value", "parameter"),
    [("choice(tanh, relu)", "relu", "relu"), ("choice(true, false)", True, "true"),
     ("choice(tanh, relu)", "prelu", None),
     ("choice(1, 0.5)", 1.0, "1"), ("choice(1.0, 2.0)", 2, "2.0"), ("choice(0, 1)", True, None),
     ("interval(0.1, 1)", 1, 1.0),
     ("interval(0.1, 1)", 2.0, None), ("int(interval(1, 10))", 3, 3),
     ("range(16, 65, 16)", 40, None), ("interval(0.1, 1)", "often", None),
     ("tag(log, inverse, interval(0.9, 0.999))", 0.99, 0.01)],
)  # fmt: skip
def test_a_value_has_its_place_in_a_range_or_none(text, value, parameter):
    dimension = spaces.parse("a.b", text)
    assert dimension.parameter_of(value) == parameter
    if parameter is not None:
        found = dimension.of({dimension.parameter: parameter})
        assert found == {True: "true"}.get(value, f"{value}") or float(found) == value


def test_what_one_has_is_tried_first(tmp_path):
    pytest.importorskip("optuna")
    from sejax.search import study

    words = ["env=cartpole", "space=paper_se", f"search_dir={tmp_path}"]
    search = settings.read(words)
    usual = settings.fields_of(search, compose.config(["env=cartpole"]))
    found, search = study.open_study(search, usual)
    study.open_study(search, usual)  # who joins adds none
    (first,) = found.trials
    asked = first.system_attrs["fixed_params"]
    assert asked["es.noise_std"] == usual["es.noise_std"]
    assert asked["1 - agent.discount"] == pytest.approx(0.01)


def test_each_of_several_agents_has_the_ranges_of_its_own():
    search = settings.read(["agents=[ddqn,ppo]", "space=agent", "agents.ppo.discount=0.9"])
    assert search.fixed == ("agent=ddqn+ppo", "agents.ppo.discount=0.9")
    assert {"agents.ddqn.learning_rate", "agents.ddqn.discount"} <= set(search.space)
    assert "agents.ppo.clip_ratio" in search.space and "agents.ppo.discount" not in search.space
    lows = [f"{name}={x.suggest(Trial())}" for name, x in search.space.items()]
    config = compose.config([*search.fixed, *lows])
    settings.require_fields(search, config)
    ddqn, ppo = config.agents.families
    assert (ddqn.agent.learning_rate, ppo.agent.clip_ratio) == (0.0001, 0.05)


@pytest.mark.parametrize("name", spaces.names())
def test_every_preset_names_fields_of_its_command_with_bounds_that_are_taken(name):
    agents = yaml.safe_load((spaces.FOLDER / f"{name}.yaml").read_text())["with_agent"]
    tasks = {"q_learning": "cliff_walking", "sarsa": "cliff_walking", "td3": "pendulum"}
    for agent in ["ddqn", "q_learning", "td3"] if name == "paper_rn" else ["ddqn", "ppo"]:
        if agent not in agents:
            continue
        dimensions = spaces.preset(name, agent, of_agent=False)
        lows = [f"{field}={x.suggest(Trial())}" for field, x in dimensions.items()]
        kind = "rn" if name == "paper_rn" else "se"
        compose.config([f"env={tasks.get(agent, 'cartpole')}", f"proxy={kind}", f"agent={agent}",
                        *lows])  # fmt: skip


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["space=nothing"], r"space must be one of .*agent.*, or a YAML file; got nothing"),
        (["space=agent", "agent=boltzmann"], "agent must be one of ddqn.*got boltzmann"),
        (["space=agent", "agents=[ddqn,boltzmann]"], "agent must be one of ddqn.*got boltzmann"),
        (["min_generations=9", "max_generations=3"], "max_generations must be at least"),
        (["pruner=asha"], "pruner must be one of"),
        (["es.noise_std=interval(1"], "must read name=value.*es.noise_std"),
        (["sampler_seed=-1"], "sampler_seed must be at least 0"),
        (["proxy=real"], r"proxy must be learned, .* got real\. Set proxy=cartpole"),
        (["trials=many"], "trials must be a whole number"),
        (["generations=9"], r"generations must be left out.*got 9\. Set max_generations=27"),
        (["run_dir=a,b"], r"run_dir must be left out.*Set search_dir=FOLDER"),
    ],
)
def test_bad_words_get_one_sentence(words, message):
    with pytest.raises(ConfigError, match=message):
        settings.read(words)


@pytest.mark.parametrize("text", ["[ddqn]", "{ddqn: 3}"])
def test_a_file_of_ranges_maps_agents_to_theirs(tmp_path, text):
    (tmp_path / "mine.yaml").write_text(f"with_agent: {text}")
    with pytest.raises(ConfigError, match="space must map agents to their sweeps"):
        settings.read([f"space={tmp_path / 'mine.yaml'}"])
    (tmp_path / "mine.yaml").write_text("es.noise_std: interval(0.1, 0.2)\nwith_agent:\n")
    assert list(settings.read([f"space={tmp_path / 'mine.yaml'}"]).space) == ["es.noise_std"]


def test_a_field_that_does_not_exist_is_not_searched():
    search = settings.read(["es.noise_stdd=interval(0.1,0.2)"])
    with pytest.raises(ConfigError, match=r"es\.noise_stdd must be a field.*mean es\.noise_std\?"):
        settings.require_fields(search, compose.config([]))


def test_stored_searches_read_back():
    search = settings.read(["env=acrobot", "space=paper_se", "seeds=3", "trials=5"])
    joined = settings.Search.from_stored(
        search.stored(), settings.SearchConfig(trials=9), search.machines
    )
    assert joined.stored() == search.stored()
    assert (joined.config.seeds, joined.config.trials) == (3, 9)


def test_without_optuna_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr(command, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"Install it with pip install 'sejax\[search\]'\.$"):
        command.main(["space=agent"])
