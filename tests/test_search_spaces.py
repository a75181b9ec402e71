"""The overrides of a search: what is searched, what is fixed, and what is refused."""

import pytest

pytest.importorskip("optuna", reason="needs Optuna: pip install '.[search]'")

from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from support import refusal, refused

from sejax.options.plain import to_plain
from sejax.search import __main__ as command
from sejax.search import config as search_config
from sejax.search import spaces


@pytest.mark.parametrize(("text", "distribution"), [
    ("choice(tanh, relu)", CategoricalDistribution(("tanh", "relu"))),
    ("tanh,relu", CategoricalDistribution(("tanh", "relu"))),
    ("choice([32,32], [64])", CategoricalDistribution(("[32,32]", "[64]"))),
    ("interval(0, 1)", FloatDistribution(0.0, 1.0)),
    ("int(interval(1, 10))", IntDistribution(1, 10)), ("range(1, 4)", IntDistribution(1, 3)),
    ("range(16, 65, 16)", IntDistribution(16, 64, step=16)),
    ("tag(log, interval(0.01, 0.3))", FloatDistribution(0.01, 0.3, log=True)),
    ("tag(log, int(interval(48, 192)))", IntDistribution(48, 192, log=True)),
    ("tag(log, inverse, interval(0.9, 0.999))", FloatDistribution(0.001, 0.1, log=True)),
])  # fmt: skip
def test_ranges_become_optunas_distributions(text, distribution):
    assert spaces.parse("es.noise_std", text).distribution == distribution


def test_inverse_ranges_are_drawn_in_the_distance_from_1():
    dimension = spaces.parse("agent.discount", "tag(log, inverse, interval(0.9, 0.999))")
    assert dimension.value({"1 - agent.discount": 0.0123456789}) == "0.987654"
    assert dimension.value({"1 - agent.discount": 0.1}) == "0.9"
    assert refused(spaces.parse("a.b", "choice(x,y)").value, {"a.b": "theirs:z"}) == "a.b"
    assert dimension.parameter_of(0.99) == pytest.approx(0.01)
    assert dimension.parameter_of(0.5) is None


@pytest.mark.parametrize(("text", "value", "parameter"), [
    ("choice(true, false)", True, "true"), ("choice(1, 2)", 3, None), ("interval(0, 1)", 1, 1.0),
    ("int(interval(1, 3))", 2, 2), ("range(16, 65, 16)", 17, None), ("interval(0, 1)", None, None),
])  # fmt: skip
def test_a_current_value_has_its_place_in_a_range_or_none(text, value, parameter):
    assert spaces.parse("x.y", text).parameter_of(value) == parameter


@pytest.mark.parametrize("text", [
    "interval(1)", "interval(0, inf)", "interval(2, 1)", "int(choice(1, 2))", "range(1, 9, 0)",
    "range(9, 1)", "tag(log, interval(0, 1))", "tag(log, inverse, interval(0.9, 1))",
    "tag(inverse, interval(0.1, 0.2))", "tag(log, choice(a, b))", "tag(fast, interval(0, 1))",
    "tag(log, inverse, int(interval(1, 2)))", "choice()",
])  # fmt: skip
def test_what_cannot_be_searched_is_refused(text):
    assert refused(spaces.parse, "es.noise_std", text) == "es.noise_std"


def test_overrides_are_the_searchs_own_the_space_or_fixed():
    words = ["env=acrobot", "es.noise_std=interval(0.1, 1)", "trials=7", "study=2024-01-01"]
    assert search_config.plan_of(["es.noise_std=0.1,1", "es.step_size=1,2", "es.noise_std=3"]).fixed
    search = search_config.plan_of(words)
    assert search.fixed == ("env=acrobot",) and list(search.space) == ["es.noise_std"]
    assert (search.config.trials, search.study_name) == (7, "2024-01-01")
    assert search.folder.name == "search-2024-01-01"
    assert search_config.plan_of(words[:2]).study_name == "acrobot-se-ddqn"


def test_what_is_fixed_or_has_a_range_of_its_own_is_left_out_of_the_preset(tmp_path):
    (tmp_path / "p.yaml").write_text("proxy.num_layers: 1\n")
    overrides = ["space=paper_se", "es.step_size=1", "es.noise_std=0.1,0.2"]
    search = search_config.plan_of([*overrides, f"preset={tmp_path}/p.yaml"])
    assert not {"es.step_size", "proxy.num_layers"} & set(search.space)
    assert search.space["es.noise_std"].text == "0.1,0.2"
    assert "agent.batch_size" in search.space  # of the agent that the task chooses


def test_each_agent_of_a_mixture_has_its_own_ranges():
    search = search_config.plan_of(["agents=[ddqn,ppo]", "space=agent", "es.name=nes"])
    assert {"agents.ddqn.tau", "agents.ppo.clip_ratio"} <= set(search.space)


COMMANDS = [
    ("paper_se", ["env=cartpole"]),
    ("paper_rn", ["env=cliff_walking", "proxy=rn"]),
    ("paper_rn", ["env=cartpole", "proxy=rn"]),
    ("paper_rn", ["env=mountain_car_continuous", "proxy=rn"]),
    ("agent", ["agent=ppo"]),
    ("agent", ["agent=ddqn"]),
]


@pytest.mark.parametrize(("name", "words"), COMMANDS)
def test_every_preset_names_fields_with_bounds_that_are_accepted(name, words):
    assert {name for name, _ in COMMANDS} == {x.stem for x in spaces.FOLDER.glob("*.yaml")}
    search = search_config.plan_of([*words, f"space={name}"])
    bounds = {
        field: getattr(x.distribution, "choices", None) or (x.distribution.low, x.distribution.high)
        for field, x in search.space.items()
    }
    for number in range(max(map(len, bounds.values()))):  # all at once, which is fast
        ends = {field: values[number % len(values)] for field, values in bounds.items()}
        search.trial_config(
            search.overrides({search.space[k].parameter: x for k, x in ends.items()})
        )


@pytest.mark.parametrize(("word", "field"), [
    ("trials=0", "trials"), ("max_generations=2", "max_generations"), ("space=papr_se", "space"),
    ("generations=5", "generations"), ("machines.workers=2", "machines.workers"),
    ("sampler=random", "sampler"), ("proxy=cartpole", "proxy"), ("es.a=1,2", "es.a"),
    ("trials=1,2", "trials"), ("seed=0,1", "seed"), ("generations=choice(1, 2)", "generations"),
    ("es.population_size=tag(log, interval(2, 6))", "es.population_size"),
])  # fmt: skip
def test_bad_overrides_are_refused(word, field):
    assert refused(search_config.plan_of, ["es.noise_std=0.1,0.2", word]) == field
    assert refused(search_config.plan_of, ["env=acrobot"]) == "space"  # nothing is searched


@pytest.mark.parametrize(
    "text",
    ["- a", "with_agent: [ddqn]", "es.noise_std: 3", "{", "3: 4", "env: 'choice(acrobot,my:Task)'"],
)
def test_a_file_of_ranges_must_map_fields_to_ranges(tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.yaml").write_text(text)
    assert "own.yaml" in str(refusal(search_config.plan_of, ["space=own.yaml"])) or "my:" in text


def test_help_says_what_each_field_is():
    said = command.help_text([])
    assert all(f"  {name}=" in said for name in to_plain(search_config.StudyConfig()))


def test_without_optuna_the_extra_is_named(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "pip install '.[search]'" in str(refusal(command.main, []))
