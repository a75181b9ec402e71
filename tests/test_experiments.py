"""What all experiments have in common: settings, shards, rows, and that each runs and resumes."""

import dataclasses
import importlib
import lzma
import pkgutil
import re
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest
import scipy.stats
from flax.traverse_util import unflatten_dict
from support import numpy_forward, random_like, refuse, refused, shapes_of

import experiments
import sejax
from experiments import peers
from experiments.common import agents, curves, experiment, runs, shards
from experiments.common.experiment import parse
from experiments.common.reward_networks import RnSettings
from experiments.common.statistics import difference_interval, mean_interval, worst_tenth
from sejax.options import ConfigError, Count
from sejax.options.plain import configure
from sejax.runs.chunks import Chunks

NAMES = [module.name for module in pkgutil.iter_modules(experiments.__path__)
         if module.name not in ("__main__", "common")]  # fmt: skip
TINY_AGENT = {"hidden_size": 2, "batch_size": 4, "num_layers": 1, "warmup_episodes": 0}
LEARN = (
    "run.es.population_size=2 run.es.num_incumbent_evals=2 run.proxy.hidden_size=4 "
    "run.training.max_steps=30 run.training.test_episodes=1 run.agent.hidden_size=4 "
    "run.agent.batch_size=4 run.agent.warmup_episodes=0"
)
RNS = (
    "variants=[additive_potential,exclusive_non_potential] learned=2 generations=1 "
    "run.training.max_episodes=5 run.es.population_size=2"
)
CURVES = f"{RNS} num_agents=2 max_steps=150 rows=default"
# Settings with which an experiment takes seconds; `SE` stands for the file of a random SE.
TINY = {
    "agents": "steps=40",
    "break_even": "proxies=cliff_walking-rn num_agents=5 num_pilots=2 max_steps=300 "
    "test_episodes=1",
    "null_baselines": "sources=[by_hand,episodes,evolved] students=ddqn hparams=default policies=1 "
    "num_agents=2 num_evolved=2 steps=40 teacher_steps=60 num_states=16",
    "peers": "theirs=PUBLISHED tasks=cartpole_v1 students=sejax_default steps=[30,60]",
    "rn_objectives": f"{CURVES} objectives=[reward_threshold,auc]",
    "rn_performance": CURVES,
    "se_distilled": "env=cartpole students=ddqn run.training.max_steps=60 "
    "run.training.max_episodes=60",
    "se_dynamics": "kinds=[bandit,threshold] students=ddqn runs=1 generations=2 num_agents=2 "
    f"test_episodes=1 {LEARN}",
    "se_feasibility": f"runs=2 generations=2 {LEARN}",
    "se_histograms": "proxy=SE agents=ddqn num_agents=2 test_episodes=2 max_steps=60 max_rows=50",
    "se_myopia": "ses=SE num_agents=2 test_episodes=1",
    "se_performance": "fixed=SE agents=ddqn num_agents=2 test_episodes=2 real_episodes=3",
}


def fields(words, **given):
    """Those of words, small, with the seed 3, and others."""
    return {"quick": True, "seed": 3} | parse(words.split()) | given


def module_of(name):
    return importlib.import_module(f"experiments.{name}")


def save_ses(path, num, *overrides):
    """Writes SEs of random weights that were learned with these settings."""
    config = sejax.config(["proxy.hidden_size=4", "agent.warmup_episodes=0", *overrides])
    env = config.parts()["proxy"]
    shapes = shapes_of(env.init_weights, jax.random.key(0))
    weights = [random_like(shapes, seed=5 + i) for i in range(num)]
    records = [{"score": 1.0 + i, "generation": 4, "seed": 7 + i} for i in range(num)]
    sejax.save_set(path, env, weights, records, config.plain())
    return str(path)


@pytest.fixture(scope="module")
def se_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("se") / "se.safetensors"
    return save_ses(path, 1, "preset=soft", "training.max_steps=60")


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """Random weights in the layout of synthetic-gymnax's SE of CartPole; their file's folder."""
    rng, folder = np.random.default_rng(0), tmp_path_factory.mktemp("published")
    layers = {"initial_state/Dense_0": (4, 3), "initial_state/Dense_1": (3, 4),
              "reward/Dense_0": (6, 3), "reward/Dense_1": (3, 1)}  # fmt: skip
    weights = {f"params/{layer}/kernel": rng.normal(size=size) for layer, size in layers.items()}
    weights |= {f"params/{layer}/bias": rng.normal(size=n) for layer, (_, n) in layers.items()}
    np.savez(folder / "cartpole.npz", **weights)
    return folder


@pytest.fixture
def tiny(monkeypatch):
    """Agents and steps that cost nothing."""

    def tiny_agent(kind):
        known = vars(configure("agent", {"name": kind}))
        small = {name: value for name, value in TINY_AGENT.items() if name in known}
        return configure("agent", {"name": kind, **small})

    for name in ("agent_config", "paper_agent"):
        monkeypatch.setattr(agents, name, tiny_agent)


def refuse_to_compute(monkeypatch):
    places = {agents: "train", Chunks: "advance"}
    for place, name in places.items():
        monkeypatch.setattr(place, name, refuse)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_an_experiment_runs_and_resumes_and_remakes_its_report(
    name, se_file, published, tmp_path, monkeypatch, tiny
):
    """Each has a row in `TINY`; what is finished is not computed again."""
    page = module_of(name).EXPERIMENT
    words = TINY[name].replace("SE", se_file).replace("PUBLISHED", str(published))
    options = fields(words, out=str(tmp_path))
    settings = page.settings.of(**options)
    table = page.run(settings)
    assert settings.summary_file.exists() and settings.settings_file.exists()
    assert list(tmp_path.glob("*.png")) or name == "null_baselines"
    text = (tmp_path / "table.md").read_text()
    assert f"`python -m experiments.{name} quick=true" in text and str(table.iloc[0, 0]) in text

    rows = shards.read_rows(settings.rows_file)
    refuse_to_compute(monkeypatch)
    pd.testing.assert_frame_equal(page.run(page.settings.of(**options)), table)
    pd.testing.assert_frame_equal(shards.read_rows(settings.rows_file), rows)
    again = page.settings.of(**options, from_rows=True)
    pd.testing.assert_frame_equal(page.run(again), table)


@pytest.mark.parametrize("name", NAMES)
def test_an_experiment_says_what_it_is_and_refuses_other_words(name, tmp_path, capsys, monkeypatch):
    page = module_of(name).EXPERIMENT
    assert name == page.settings.name

    def main(*words):
        monkeypatch.setattr(sys, "argv", [name, *words])
        page.main()

    main("--help")
    said = capsys.readouterr().out
    assert all(f"  {field.name}=" in said for field in dataclasses.fields(page.settings))
    for word in ("nothing", "sed=1", "--quick", "seed=-1", "seed=[1"):
        with pytest.raises(SystemExit) as ended:
            main(f"out={tmp_path}", word)
        error = capsys.readouterr().err
        assert ended.value.code == 2 and error.startswith("error: ") and error.count("\n") == 1


def test_an_se_of_synthetic_gymnax_as_one_of_sejax_is_the_same(published):
    file, task, key = published / "cartpole.npz", sejax.envs.make("cartpole_v1"), jax.random.key(0)
    theirs = unflatten_dict({name: x.T for name, x in np.load(file).items()}, sep="/")["params"]
    env, weights = peers.converted(file, task)
    obs, state = env.reset_env(key, env.params(weights))
    _, _, reward, terminated, _ = env.step_env(key, state, 1, env.params(weights))
    start = numpy_forward(theirs["initial_state"], jax.random.normal(key, (4,)), "relu", 1)
    np.testing.assert_allclose(obs, start, atol=1e-5)
    paid = numpy_forward(theirs["reward"], np.array([*obs, 0, 1]), "relu", 1)
    np.testing.assert_allclose(reward, paid[0], rtol=1e-5)
    assert terminated and refused(peers.converted, published / "acrobot.npz", task) == "theirs"


def test_all_experiments_are_listed_and_nothing_else_is_a_command(capsys):
    module_of("__main__").main()
    assert re.findall(r"^  (\w+)", capsys.readouterr().out, re.MULTILINE) == NAMES
    assert set(TINY) == set(NAMES)


def test_commands_of_the_docs_and_of_stored_results_are_accepted():
    root = Path(__file__).parents[1]
    pages = [root / "README.md", *(root / "docs").rglob("*.md"), *(root / "results").rglob("*.md")]
    text = "\n".join(page.read_text() for page in pages)
    commands = set(re.findall(r"python -m experiments\.([a-z]\w+)([^`\n#|]*)", text))
    assert len(commands) > 20
    for name, words in (each for each in commands if "--help" not in each[1]):
        settings = module_of(name).EXPERIMENT.settings
        made = settings.of(**parse(shlex.split(words)))
        again = settings.of(**parse(shlex.split(made.command())[3:]))
        assert dataclasses.replace(made, out=again.out, work=None) == again
        if made.folder.parts[0] == "results":  # and it replaces no other results
            assert again.folder == made.folder
        if isinstance(made, runs.RunSettings):  # and so are the overrides of its runs
            made.learn_config(["proxy=rn"] if isinstance(made, RnSettings) else [])


# --- settings ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Example(experiment.Settings):
    """What it computes.

    Attributes:
      num_agents: of each
    """

    name = "example"

    env: str = experiment.setting("cartpole")
    agents: tuple[str, ...] = experiment.setting(("ddqn", "ppo"), ("ddqn", "ppo"))
    num_agents: Count = experiment.setting(10, quick=4)
    run: tuple[str, ...] = experiment.setting(())


def given(*words):
    return Example.of(**parse(words))


def example(compute=refuse, report=refuse):
    return experiment.Experiment(settings=Example, compute=compute, report=report, about="What.")


def test_settings_are_complete_and_say_which_command_makes_them():
    assert (given().num_agents, given("quick=true").num_agents) == (10, 4)
    words = ["quick=true", "seed=7", "agents=[ppo]", "run.es.noise_std=0.1", "run.agent.tau=0.1"]
    made = given(*words, "num_agents=null")
    assert made.run == ("es.noise_std=0.1", "agent.tau=0.1")
    assert made == Example.of(quick=True, agents="ppo", seed=7, run=made.run)
    command = ["python", "-m", "experiments.example"]
    assert sorted(shlex.split(made.command())) == sorted(command + words)
    assert given().command() == " ".join(command)


@pytest.mark.parametrize(("word", "field"), [
    ("agents=[dqn]", "agents"), ("agents=ddqn,ppo", "agents"), ("num_agents=0", "num_agents"),
    ("numagents=3", "numagents"), ("quick", "an override"), ("run.env=acrobot", "run.env"),
])  # fmt: skip
def test_words_that_cannot_work_are_refused(word, field):
    assert refused(given, word) == field


@pytest.mark.parametrize(("name", "options", "field"), [
    ("rn_performance", {"env": "acrobot"}, "env"),
    ("rn_performance", {"env": "cartpole", "variants": "additive_potential+augm"}, "variants"),
    ("rn_performance", {"rows": "tuned"}, "rows"),  # there is none on Cliff Walking
    ("rn_performance", {"bonuses": "icm"}, "bonuses"),
    ("rn_performance", {"rns": 3, "learned": 2}, "rns"),
    ("agents", {"tasks": "halfcheetah"}, "tasks"),
])  # fmt: skip
def test_settings_that_cannot_work_are_refused_at_once(name, options, field):
    assert refused(module_of(name).EXPERIMENT.settings.of, quick=True, **options) == field


# --- shards and rows -----------------------------------------------------------------------------


def damaged(whole):
    """Contents of a damaged file: cut, with another bit, empty, and other files."""
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]
    return whole[:-9], flipped, b"", b"steps,name\n", lzma.compress(b"{\nx\n1\n")


def test_a_shard_is_computed_once_and_again_if_it_is_damaged(tmp_path, capsys):
    computed = []

    def compute(**settings):
        def make():
            computed.append(settings)
            return pd.DataFrame({"x": [0.1, 1 / 3], "name": ["a", "b"]})

        return shards.Shards(tmp_path).compute("one", settings, make)

    first = compute(count=2, odd=float("nan"))
    pd.testing.assert_frame_equal(compute(count=2, odd=float("nan")), first)
    assert len(computed) == 1
    with pytest.raises(ConfigError, match=r"differs in count \(2 there, 3 here\).*Set work=DIR"):
        compute(count=3, odd=float("nan"))
    path = shards.Shards(tmp_path).path("one")
    whole = path.read_bytes()
    for content in damaged(whole):
        path.write_bytes(content)
        pd.testing.assert_frame_equal(compute(count=2, odd=float("nan")), first)
        assert path.read_bytes() == whole and f"{path} is damaged" in capsys.readouterr().out
    assert len(computed) == 1 + 5


def test_damaged_or_missing_rows_are_refused(tmp_path):
    settings = Example.of(out=str(tmp_path))
    again = dataclasses.replace(settings, from_rows=True)
    rows = pd.DataFrame({"steps": [3, 9, 2], "name": ["a", "b", "c"]})
    page = example(lambda _: rows, lambda _, rows: rows)
    assert refused(page.run, again) == "from_rows"
    for each in (settings, again):
        pd.testing.assert_frame_equal(page.run(each), rows)
    for content in damaged(settings.rows_file.read_bytes())[:-1]:
        settings.rows_file.write_bytes(content)
        with pytest.raises(ConfigError, match=r"rows\.csv\.xz is damaged"):
            page.run(again)


# --- agents and curves ---------------------------------------------------------------------------


def test_agents_that_diverged_count_as_the_worst(capsys):
    nan = float("nan")
    columns = ["agent", "test_return", "return_0", "return_1"]
    rows = [(0, 1.0, 2.0, 0.0), (1, nan, nan, 4.0), (2, -3.0, -5.0, -1.0)]
    whole = agents.worst_for_diverged(pd.DataFrame(rows, columns=columns).assign(group=0), "a-real")
    assert whole["test_return"].tolist() == [1.0, -5.0, -3.0]
    assert whole["return_0"].tolist() == [2.0, -5.0, -5.0]
    assert "a-real: 1 agents diverged" in capsys.readouterr().out


def curve(steps, returns, agent=0):
    return pd.DataFrame({"agent": agent, "steps": steps, "test_return": np.float64(returns)})


def test_a_task_is_solved_when_ten_tests_in_a_row_are_good_on_average():
    good_late = curve(range(10, 310, 10), [0] * 10 + [10] * 20)
    # Ten in a row have mean 9 once nine of them are 10: the window ends at the 19th episode.
    assert curves.steps_to_solve(good_late, 9.0) == 190
    assert curves.steps_to_solve(good_late, 10.1) == np.inf
    assert curves.steps_to_solve(good_late.head(9), 0.0) == np.inf  # too few tests


def test_curves_hold_the_value_of_the_last_finished_episode():
    two = pd.concat([curve([10, 20], [1, 3]), curve([15], [5], agent=1)])
    values = curves.on_grid(two, np.array([5, 10, 19, 20]))
    np.testing.assert_array_equal(values, [[np.nan, 1, 1, 3], [np.nan, np.nan, 5, 5]])


def test_thinned_curves_hold_the_same_values_on_the_grid():
    rising = curve(range(3, 303, 3), [*range(80), *[80] * 20])
    two = pd.concat([rising, curve([400], [5], agent=1)])
    grid = np.linspace(10, 300, 30)  # of its steps, 250 is the first at which 80 is held
    kept = curves.thinned(two, grid, solved_reward=50.0)
    assert kept.groupby("agent").size().tolist() == [25, 1]
    np.testing.assert_array_equal(curves.on_grid(two, grid), curves.on_grid(kept, grid))
    # The mean of the tests 46 to 55 is the first of 50 and more; agent 1 has too few tests.
    each = kept.groupby("agent").first()
    assert each["steps_to_solve"].tolist() == [3 * 56, np.inf]
    assert each["last_return"].tolist() == [80, 5]


# --- statistics: against scipy, and what is worked out by hand ------------------------------------


@pytest.mark.parametrize("size", [5, 6, 10, 33])
def test_intervals_are_those_of_scipys_t_tests(size):
    values = np.random.default_rng(size).exponential(size=size)
    expected = scipy.stats.ttest_1samp(values, 0).confidence_interval()
    assert mean_interval(values) == pytest.approx(tuple(expected))
    others = np.random.default_rng(0).normal(size=7)
    welch = scipy.stats.ttest_ind(values, others, equal_var=False).confidence_interval()
    assert difference_interval(values, others) == pytest.approx(tuple(welch))


def test_fewer_than_five_values_have_no_interval():
    assert np.isnan([mean_interval(range(4)), difference_interval(range(4), [1.0] * 9)]).all()


def test_the_worst_tenth_is_the_mean_of_the_lowest_values():
    assert worst_tenth(np.random.default_rng(0).permutation(20)) == 0.5
    assert worst_tenth([3.0, 1.0, 2.0]) == 1.0 and worst_tenth(range(11)) == 0.5
    assert np.isnan(worst_tenth([np.nan, 1.0]))
