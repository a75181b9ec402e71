"""The experiments with SEs: the framework, sets of SEs, feasibility, performance, single SEs."""

import dataclasses
import fnmatch
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass

import jax
import numpy as np
import pandas as pd
import pytest
import yaml
from support import refuse

import sejax
from experiments import (
    experiment,
    figures,
    pieces,
    se_agents,
    se_feasibility,
    se_models,
    se_performance,
    settings,
    worlds,
)  # fmt: skip
from experiments.statistics import bootstrap_interval, interquartile_mean
from sejax import envs
from sejax.agents.base import drawing_key
from sejax.cli import session
from sejax.errors import ConfigError
from sejax.options import counts
from sejax.serialize import flatten

TINY_RUN = ["es.population_size=2", "es.num_incumbent_evals=2", "agent.hidden_size=4",
            "agent.batch_size=4", "agent.warmup_episodes=0", "proxy.hidden_size=4",
            "training.max_steps=30", "training.test_episodes=1"]  # fmt: skip
TINY_AGENT = {"hidden_size": 2, "batch_size": 4, "num_layers": 1, "warmup_episodes": 0}


# What experiments are told.


@dataclass(frozen=True, kw_only=True)
class Example(settings.Settings):
    name = "example"

    env: str = settings.setting("cartpole", about="task")
    agents: tuple[str, ...] = settings.setting(
        ("ddqn", "ppo"), settings.each_of(("ddqn", "ppo")), about="kinds"
    )
    num_agents: int = settings.setting(10, counts("it counts agents"), quick=4, about="of each")
    run: tuple[str, ...] = settings.setting((), about="overrides")


def given(*words):
    return Example.of(**experiment.parse(Example, words))


def test_settings_are_complete_and_say_which_command_makes_them():
    assert (given().num_agents, given("quick=true").num_agents) == (10, 4)
    made = given("quick=true", "agents=[ppo]", "num_agents=null", "run.es.noise_std=0.1", "seed=7",
                 "run.agent.hidden_size=4")  # fmt: skip
    assert made.run == ("es.noise_std=0.1", "agent.hidden_size=4")
    assert made == Example.of(quick=True, agents="ppo", seed=7, run=made.run)
    words = made.command().removeprefix("python -m experiments.example ").split()
    assert given(*(word.strip("'") for word in words)) == made and len(words) == 5
    assert given().command() == "python -m experiments.example"


def test_results_are_apart_from_what_may_be_thrown_away():
    assert str(given().folder) == "results/example/cartpole"
    assert str(given().work_folder) == "runs/experiments/example/cartpole"
    assert str(given("quick=true").folder) == "runs/experiments/example-quick/cartpole"
    assert str(given("out=results/example/mine").work_folder) == "runs/experiments/example/mine"
    assert str(given("out=/tmp/mine").work_folder) == "/tmp/mine/work"
    assert str(given("out=/tmp/mine", "work=/tmp/other").work_folder) == "/tmp/other"


@pytest.mark.parametrize(
    ("word", "message"),
    [("agents=[dqn]", "agents must be one of ddqn, ppo; got 'dqn'"),
     ("agents=ddqn,ppo", r"agents must be one value or a list.*Set agents=\[ddqn,ppo\]"),
     ("num_agents=0", "num_agents must be at least 1, because it counts agents; got 0"),
     ("num_agents=many", "num_agents must be a whole number"),
     ("numagents=3", "Did you mean num_agents="), ("--quick", "Did you mean quick="),
     ("seed=-1", "seed must lie in"), ("devices=0", "devices must be at least 1"),
     ("seed=[1", "no viable alternative|mismatched input")],
)  # fmt: skip
def test_words_that_cannot_work_are_refused(word, message):
    with pytest.raises(ConfigError, match=message):
        given(word)


def test_help_lists_all_fields_with_their_values():
    example = experiment.Experiment(settings=Example, compute=refuse, report=refuse, about="What.")
    text = example.help()
    assert "What." in text and "num_agents=10" in text and "of each (quick: 4)" in text
    assert "run.FIELD=VALUE" in text and "agents=[ddqn,ppo]" in text


def test_tables_are_remade_from_the_stored_rows(tmp_path):
    reported = []
    rows = {"a": pd.DataFrame({"x": [0.1, 1 / 3]}), "b": pd.DataFrame({"flag": [True], "n": [3]})}
    example = experiment.Experiment(
        settings=Example, compute=lambda _: pieces.stack(rows), about="",
        report=lambda _, rows: reported.append(rows) or rows,
    )  # fmt: skip
    example.run(Example.of(out=str(tmp_path)))
    with_rows = Example.of(out=str(tmp_path), from_rows=True)
    pd.testing.assert_frame_equal(example.run(with_rows), reported[0])
    pd.testing.assert_frame_equal(pieces.unstack(reported[1], "a"), rows["a"])
    assert pieces.unstack(reported[1], "b").to_dict("list") == {"flag": [True], "n": [3]}
    with pytest.raises(ConfigError, match=r"from_rows must be false.*no .*rows\.csv\.xz"):
        example.run(Example.of(out=str(tmp_path / "none"), from_rows=True))


def test_results_say_what_each_piece_was_made_with(tmp_path):
    settings = Example.of(out=str(tmp_path))
    agents = {
        "quick": {"name": "td3", "noise": {"std": 0.1}},
        "slow": {"name": "ppo", "epochs": 80},
    }
    made_with = {  # names have three parts or four; slow is a row and a world
        f"{prefix}{row}-{world}-{group}": {
            "agent": agents[row], "seed": 0, "weights": f"{world}{group}", "prefix": prefix,
            "odd": (row, group) == ("quick", "1") and world == "rn",
        }
        for prefix in ("", "auc-") for row in agents for world in ("rn", "slow") for group in "01"
    }  # fmt: skip
    rows = pd.DataFrame({"x": [0.0]})

    def compute(settings):
        for name, mine in made_with.items():
            settings.pieces.compute(name, mine, lambda: rows)
        return rows

    def report(settings, rows):
        return rows

    example = experiment.Experiment(settings=Example, compute=compute, report=report, about="")
    for _ in ("computed", "read"):
        example.run(Example.of(out=str(tmp_path)))
        stored = json.loads(settings.made_with_file.read_text())
        assert stored["*"] == {"seed": 0} and stored["*-rn-1"] == {"weights": "rn1"}
        for name, mine in made_with.items():
            found = [stored[pattern] for pattern in stored if fnmatch.fnmatchcase(name, pattern)]
            assert {key: x for each in found for key, x in each.items()} == flatten(mine)
            assert all(each.items() <= flatten(mine).items() for each in found)  # none disagree
        settings.made_with_file.unlink()
    example.run(Example.of(out=str(tmp_path), from_rows=True))
    assert not settings.made_with_file.exists()


def test_a_kill_while_a_piece_is_written_loses_nothing(tmp_path, monkeypatch):
    made, done = pieces.Pieces(tmp_path), []

    def compute(count):
        table = pd.DataFrame({"row": range(count)})
        return made.compute("p", {"count": count}, lambda: done.append(count) or table)

    written = pieces.write_text

    def killed(path, text):
        if path.suffix == ".json":
            raise KeyboardInterrupt
        written(path, text)

    monkeypatch.setattr(pieces, "write_text", killed)
    with pytest.raises(KeyboardInterrupt):
        compute(2)
    monkeypatch.setattr(pieces, "write_text", written)
    assert len(compute(2)) == len(compute(2)) == 2 and done == [2, 2]
    with pytest.raises(ConfigError, match="with another count"):
        compute(3)


# Sets of SEs.


@pytest.fixture(scope="module")
def ses(tmp_path_factory):
    """A file with three SEs of random weights: its path and the weights."""
    path = tmp_path_factory.mktemp("ses") / "ses.safetensors"
    config = sejax.config(
        ["proxy.hidden_size=4", "training.max_steps=40", "agent.warmup_episodes=0"]
    )
    env = config.parts()["proxy"]
    weights = [env.init_weights(jax.random.key(i)) for i in range(3)]
    records = [{"score": 1.0 + i, "generation": 4 + i, "seed": 7 + i} for i in range(3)]
    sejax.save_set(path, env, weights, records, plain(config))
    return path, weights


def plain(config):
    from sejax.cli import build

    return build.to_plain(config)


def assert_equal_trees(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_set_that_is_saved_and_loaded_is_the_same(ses):
    path, weights = ses
    loaded = sejax.load_set(path)
    assert loaded.size == 3 and loaded.task.name == "cartpole"
    for i in range(3):
        assert_equal_trees(loaded.one(i).weights, weights[i])
    np.testing.assert_array_equal(loaded.scores, [1, 2, 3])
    assert [record["generation"] for record in loaded.records] == [4, 5, 6]
    np.testing.assert_array_equal(loaded.seeds, [7, 8, 9])
    assert len({loaded.fingerprint(i) for i in range(3)}) == 3
    assert_equal_trees(loaded.first(2).weights, jax.tree.map(lambda x: x[:2], loaded.weights))
    assert loaded.first(None).size == 3


@pytest.mark.parametrize(("scores", "solved"), [((195.0, 194.9, 200.0), [7, 9]), ((0, 0, 0), [])])
def test_the_solved_ones_of_a_set_reached_the_threshold(ses, tmp_path, scores, solved):
    records = [{"score": x, "seed": 7 + i} for i, x in enumerate(scores)]
    env = sejax.load_set(ses[0]).env
    sejax.save_set(tmp_path / "s.safetensors", env, ses[1], records)
    assert list(sejax.load_set(tmp_path / "s.safetensors").solved().seeds) == solved


def test_all_ses_of_a_set_step_at_once(ses):
    loaded = sejax.load_set(ses[0])
    env, params = loaded.env, loaded.params
    axes = params.replace(weights=0, max_steps_in_episode=None)
    key = jax.random.key(0)
    obs, state = env.reset_env(key, loaded.one(0))

    def reward(params):
        return env.step_env(key, state, jax.numpy.int32(1), params)[2]

    rewards = jax.vmap(reward, in_axes=(axes,))(params)
    np.testing.assert_allclose(rewards, [reward(loaded.one(i)) for i in range(3)], rtol=1e-6)
    assert obs.shape == (4,) and len(set(np.asarray(rewards).tolist())) == 3


def test_a_single_proxy_is_a_set_of_one(ses, tmp_path):
    env, weights = sejax.load_set(ses[0]).env, ses[1][0]
    sejax.save(tmp_path / "p.safetensors", env, weights, score=12.5, generation=7, seed=2)
    loaded = sejax.load_set(tmp_path / "p.safetensors")
    assert (loaded.size, loaded.scores[0], loaded.seeds[0]) == (1, 12.5, 2)
    assert_equal_trees(loaded.one(0).weights, weights)
    assert loaded.fingerprint(0) == sejax.load_set(ses[0]).fingerprint(0)


def test_files_that_are_no_set_are_refused(ses, tmp_path):
    path, weights = ses
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ConfigError, match=r"source must be a single proxy.*load_set reads sets"):
        sejax.load(path)
    with pytest.raises(ConfigError, match=r"fixed must be a whole safetensors file.*is damaged"):
        sejax.load_set(damaged, option="fixed")
    other = sejax.config(["proxy.hidden_size=5"]).parts()["proxy"]
    with pytest.raises(ConfigError, match="weights must have the shapes"):
        sejax.save_set(tmp_path / "other.safetensors", other, weights, [{}] * 3)
    with pytest.raises(ConfigError, match="does not exist"):
        sejax.load_set(tmp_path / "none.safetensors")


# Feasibility.


def curves(*means):
    """Curves of several runs with these incumbent means."""
    return pd.concat(
        pd.DataFrame({"seed": seed, "generation": range(len(m)), "incumbent_mean": m,
                      "env_steps_total": 100 * np.arange(1, len(m) + 1), "wall_s": 60.0})
        for seed, m in enumerate(means)
    )  # fmt: skip


def test_runs_are_summarised_by_their_first_solved_generation():
    table = se_feasibility.summarise(curves([10, 196, 20, 200], [10, 20, 30, 40]), 195)
    assert table["generations_to_solve"].tolist() == [2, np.inf]
    assert table["env_steps_to_solve"][0] == 200 and np.isnan(table["env_steps_to_solve"][1])
    assert table["best_incumbent_mean"].tolist() == [200, 40]
    assert table["last_incumbent_mean"].tolist() == [200, 40]


@pytest.mark.parametrize(
    ("values", "text"),
    [([3, 9, 5], "5 (3 to 9)"), ([2, 4], "3 (2 to 4)"), ([2, np.inf], "> 50 (2 to > 50)"),
     ([np.inf, np.inf], "> 50"), ([2, np.inf, 7], "7 (2 to > 50)")],
)  # fmt: skip
def test_runs_that_do_not_solve_the_task_count_as_longer_than_all(values, text):
    assert se_feasibility.median_and_range(values, 50) == text


@pytest.mark.parametrize(("env", "agent", "has_paper"),
                         [("pendulum", "td3", False), ("acrobot", "ddqn", True)])  # fmt: skip
def test_runs_have_the_tasks_agent_and_the_papers_numbers_where_it_has_some(env, agent, has_paper):
    config = se_feasibility.learning_config(se_feasibility.SeFeasibility.of(env=env))
    assert config.name("agent") == agent
    table = se_feasibility.make_table(config, se_feasibility.summarise(curves([10], [20]), 195))
    assert any(table["paper"]) == has_paper


def learned(out, *run, **given):
    options = {"runs": 2, "generations": 3, "run": [*TINY_RUN, *run]} | given
    asked = se_feasibility.SeFeasibility.of(quick=True, seed=3, out=str(out), **options)
    return se_feasibility.EXPERIMENT.run(asked)


@pytest.fixture(scope="module")
def two_runs(tmp_path_factory):
    """Two NES runs of three generations: the folder and the table."""
    out = tmp_path_factory.mktemp("feasibility")
    return out, learned(out)


def test_feasibility_learns_as_sejax_run_does_and_is_not_done_twice(two_runs, monkeypatch):
    out, table = two_runs
    made = pieces.read_rows(out / "rows.csv.xz")
    assert made.groupby("seed").size().to_dict() == {3: 3, 4: 3}
    stored = sejax.load_set(out / "ses.safetensors")
    config = yaml.safe_load((out / "work/runs/seed4/config.yaml").read_text())
    assert config["seed"] == 4 and config["proxy"]["hidden_size"] == 4
    result = jax.jit(sejax.make_learner(session.build.learn_config(config)))(jax.random.key(4))
    mine = made[made["seed"] == 4]
    np.testing.assert_allclose(mine["incumbent_mean"], result.info.incumbent_mean, rtol=1e-6)
    assert stored.seeds.tolist() == [3, 4]
    assert_equal_trees(stored.one(1).weights, result.weights)
    assert stored.scores[1] == pytest.approx(float(result.score))

    monkeypatch.setattr(session.Chunks, "advance", refuse)
    pd.testing.assert_frame_equal(learned(out), table)
    pd.testing.assert_frame_equal(learned(out, from_rows=True), table)
    with pytest.raises(ConfigError, match=r"differs in agent_hparams.*Set work=DIR"):
        learned(out, agent_hparams="varied")


def test_a_run_that_was_stopped_goes_on_at_its_last_generation(two_runs, tmp_path):
    """Learns one generation, then three: the same as three at once."""
    for generations in (1, 3):
        learned(tmp_path, runs=1, generations=generations)
    at_once = pieces.read_rows(two_runs[0] / "rows.csv.xz").query("seed == 3")
    gone_on = pieces.read_rows(tmp_path / "rows.csv.xz")
    pd.testing.assert_frame_equal(gone_on.drop(columns="wall_s"), at_once.drop(columns="wall_s"))


def test_a_run_without_its_checkpoint_is_not_replaced(two_runs, tmp_path):
    shutil.copytree(two_runs[0] / "work", tmp_path / "work")
    for folder in (tmp_path / "work/runs").glob("*/checkpoint"):
        shutil.rmtree(folder)
    metrics = tmp_path / "work/runs/seed3/metrics.csv"
    before = metrics.read_text()
    with pytest.raises(ConfigError, match=r"checkpoints of a run.*with 3 generations"):
        learned(tmp_path, generations=4)
    assert metrics.read_text() == before


@pytest.mark.parametrize("preset", ["best", "paper", "paper_performance"])
@pytest.mark.parametrize("env", ["cartpole", "acrobot"])
def test_quick_runs_are_long_enough_to_learn(env, preset):
    config = sejax.config([f"env={env}", f"preset={preset}", *se_feasibility.QUICK])
    assert config.agent.warmup_episodes == 1


def made_up_agents(num_ses=4, num_agents=6):
    """Agents of a kind in a setting; SE g has mean return about 10 g."""
    rng = np.random.default_rng(0)
    rows = [
        {"kind": "td3_discrete", "setting": "varied", "group": f"se{g}", "se": g, "agent": a,
         "train_steps": rng.integers(10, 99), "train_episodes": rng.integers(1, 9),
         "nonfinite": False, "test_return": 10.0 * g + rng.normal()}
        for g in range(num_ses) for a in range(num_agents)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_intervals_draw_ses_and_not_agents_but_on_the_real_task():
    agents = made_up_agents(num_ses=5)
    row = se_performance.summarise(agents).iloc[0]
    values = agents["test_return"].to_numpy().reshape(5, 6)
    low, high = bootstrap_interval(values.mean(axis=1))
    assert (row["test_return_low"], row["test_return_high"]) == pytest.approx((low, high))
    assert row["test_return_mean"] == pytest.approx(values.mean())
    assert row["test_return_std"] == pytest.approx(np.std(values))
    assert (row["num_ses"], row["num_agents"]) == (5, 30)
    real = se_performance.summarise(agents.assign(setting="real")).iloc[0]
    ends = bootstrap_interval(values.ravel())
    assert (real["test_return_low"], real["test_return_high"]) == pytest.approx(ends)


def test_fewer_than_five_ses_have_no_interval():
    summary = se_performance.summarise(made_up_agents(num_ses=4))
    assert np.isnan(summary["test_return_low"][0]) and np.isnan(summary["train_steps_high"][0])
    assert "[" not in se_performance.make_table("cartpole", summary)["return"][0]
    summary = se_performance.summarise(made_up_agents(num_ses=5))
    assert "[" in se_performance.make_table("cartpole", summary)["return"][0]


def test_intervals_of_interquartile_means_draw_agents_within_ses():
    agents = made_up_agents(num_ses=5)
    row = se_performance.summarise(agents).iloc[0]
    values = agents["test_return"].to_numpy().reshape(5, 6)
    assert row["test_return_iqm"] == interquartile_mean(values.ravel())
    ends = bootstrap_interval(*values, statistic=interquartile_mean)
    assert (row["test_return_iqm_low"], row["test_return_iqm_high"]) == ends
    assert ends[1] - ends[0] < 2 < row["test_return_high"] - row["test_return_low"]
    real = se_performance.summarise(agents.assign(setting="real")).iloc[0]
    ends = bootstrap_interval(values.ravel(), statistic=interquartile_mean)
    assert (real["test_return_iqm_low"], real["test_return_iqm_high"]) == ends


def test_a_tuned_agent_is_a_baseline_of_its_own():
    settings = se_performance.SePerformance.of(max_steps=700, real_groups=2)
    task = envs.make("cartpole")
    real = se_performance.real_world(settings, task, {}, "ddqn")
    tuned = se_performance.tuned_world(settings, real, "ddqn")
    assert (real.hparams, tuned.hparams) == ("varied", "default")
    assert (real.agent.hidden_size, tuned.agent.hidden_size) == (128, 64)
    assert real.training.time_limit_is_terminal and not tuned.training.time_limit_is_terminal
    assert tuned.training.max_steps == 700
    assert [group.name for group in tuned.groups] == ["real-00", "real-01"]

    steps = {"real": 1000.0, "tuned": 400.0, "fixed": 100.0}
    agents = pd.concat(
        made_up_agents().assign(kind="ddqn", setting=name, train_steps=value)
        for name, value in steps.items()
    )
    table = se_performance.make_table("cartpole", se_performance.summarise(agents))
    assert table["fewer"].tolist() == ["", "60%", "90%"]
    assert table["than tuned"].tolist() == ["", "", "75%"]


def test_the_best_ses_are_shown_by_agents_that_did_not_select_them():
    agents = made_up_agents()
    agents.loc[(agents["group"] == "se0") & (agents["agent"] % 2 == 1), "test_return"] = 999
    best = se_performance.select_best(agents, count=2)
    assert set(best["group"]) == {"se2", "se3"} and set(best["agent"]) == {1, 3, 5}
    assert set(se_performance.select_best(agents)["group"]) == {"se1", "se2", "se3"}
    settings = se_performance.with_best(agents)["setting"].value_counts()
    assert settings.to_dict() == {"varied": 24, "best": 9}
    alone = agents[agents["group"] == "se0"]
    assert "best" not in set(se_performance.with_best(alone)["setting"])


def test_the_density_is_that_of_reflected_kernels():
    values, low, high = np.array([8.0, 50, 50, 200]), 8.0, 200.0
    grid = np.linspace(low, high, 4001)
    made = figures.density(values, grid, low, high)
    assert np.trapezoid(made, grid) == pytest.approx(1, abs=1e-3)
    width = values.std() * 4 ** (-1 / 5)
    expected = sum(
        np.exp(-0.5 * ((30 - centre) / width) ** 2) / (4 * width * np.sqrt(2 * np.pi))
        for v in values
        for centre in (v, 2 * low - v, 2 * high - v)
    )
    assert figures.density(values, [30.0], low, high)[0] == pytest.approx(expected)
    equal = figures.density(np.full(5, 200.0), grid, low, high)
    assert np.trapezoid(equal, grid) == pytest.approx(1, abs=1e-3) and np.argmax(equal) == 4000


def test_single_ses_are_sorted_and_their_ranks_correlated():
    agents = made_up_agents()
    other = agents.assign(kind="ddqn", test_return=-agents["test_return"])
    summary = se_models.summarise(pd.concat([agents, other]), solved_reward=15)
    assert summary["kind"].tolist() == ["td3_discrete"] * 4 + ["ddqn"] * 4
    assert summary["se"].tolist() == [3, 2, 1, 0, 0, 1, 2, 3]
    assert summary["solved"].tolist()[:4] == [1, 1, 0, 0]
    assert se_models.rank_correlations(summary).loc["ddqn", "td3_discrete"] == pytest.approx(-1)
    assert "td3_discrete and ddqn -1.00" in se_models.correlations_text(summary)


def trained(module, out, **given):
    """A table of `se_performance` or `se_models` for two SEs and little agents."""
    options = {"agents": "ddqn", "num_agents": 3, "num_ses": 2, "test_episodes": 2} | given
    cls = module.EXPERIMENT.settings
    return module.EXPERIMENT.run(cls.of(quick=True, seed=3, out=str(out), **options))


@pytest.fixture
def tiny_agents(monkeypatch):
    monkeypatch.setattr(se_agents, "QUICK_AGENT", TINY_AGENT)


def performance(ses, out, **given):
    return trained(se_performance, out, fixed=str(ses[0]), real_episodes=3, **given)


@pytest.mark.slow
def test_performance_trains_as_evaluation_does_and_goes_on(ses, tmp_path, monkeypatch, tiny_agents):
    table = performance(ses, tmp_path)
    agents = pieces.read_rows(tmp_path / "rows.csv.xz")
    assert agents.groupby("setting").size().to_dict() == {"real": 6, "fixed": 6}
    check_as_evaluation(ses, agents)
    assert table["trained on"].tolist() == ["real", "synth., HPs fixed"]
    assert (tmp_path / "performance.png").stat().st_size > 10_000
    assert "16887.7" in (tmp_path / "table.md").read_text()
    # Agents of equal number draw equal hyperparameters in all settings.
    real, fixed = (agents[agents["setting"] == name] for name in ("real", "fixed"))
    for name in ("learning_rate", "batch_size", "hidden_size", "num_layers"):
        np.testing.assert_array_equal(real[name], fixed[name])
        assert real[name].nunique() > 1

    monkeypatch.setattr(worlds, "train", refuse)
    monkeypatch.setattr(se_performance, "draw", lambda *_: None)
    pd.testing.assert_frame_equal(performance(ses, tmp_path), table)
    pd.testing.assert_frame_equal(performance(ses, tmp_path, from_rows=True), table)
    with pytest.raises(ConfigError, match=r"with another training\.test_episodes"):
        performance(ses, tmp_path, test_episodes=4)

    fewer = performance(ses, tmp_path, real_groups=1)
    assert fewer["SEs, agents"].tolist() == ["1, 3", "2, 6"]

    single = trained(se_models, tmp_path, ses=str(ses[0]))  # finds what was trained
    assert set(single["SE"]) == {0, 1} and set(single["run's seed"]) == {7, 8}
    assert (tmp_path / "models.png").stat().st_size > 10_000


def check_as_evaluation(ses, agents):
    """Agents of the second groups are those of `make_evaluator` with the same keys and draws."""
    loaded, task = sejax.load_set(ses[0]), envs.make("cartpole")
    key = jax.random.fold_in(jax.random.key(3), 1)
    keys = jax.numpy.stack([jax.random.fold_in(key, i) for i in range(3)])
    mine = agents[agents["group"] == f"se-{loaded.seeds[1]:02d}-{loaded.fingerprint(1)}"]
    training = sejax.TrainingConfig(max_steps=40, stop_rule="never", test_episodes=2)
    chosen, expected = evaluated(loaded.env, loaded.one(1), task, training, keys)
    np.testing.assert_allclose(mine["test_return"].iloc[chosen], expected.test_return, rtol=1e-6)
    np.testing.assert_allclose(mine["return_0"] + mine["return_1"], 2 * mine["test_return"])
    assert (mine["train_steps"] == 40).all() and mine["hidden_size"].between(1, 6).all()
    mine = agents[agents["group"] == "real-01"]
    training = sejax.TrainingConfig(max_episodes=3, max_steps=4000, stop_rule="solved",
                                    solved_by="train", test_episodes=2)  # fmt: skip
    chosen, expected = evaluated(task.env, task.params, task, training, keys)
    np.testing.assert_allclose(mine["test_return"].iloc[chosen], expected.test_return, rtol=1e-6)
    np.testing.assert_array_equal(mine["train_steps"].iloc[chosen], expected.train_steps)


def evaluated(env, params, task, training, keys):
    """Outcomes of the agents that draw networks as deep as the first one does, and which they are.

    All depths would be compiled otherwise.
    """
    varied = sejax.make_agent(sejax.DDQNConfig(**TINY_AGENT), task, varied=True)
    draws = jax.vmap(lambda key: varied.draw(drawing_key(key)))(keys)
    chosen = np.flatnonzero(draws.variant == draws.variant[0])
    agent = varied.varied.agents[int(draws.variant[0])]

    @jax.jit
    def evaluate(key, hparams):
        fixed = dataclasses.replace(agent, hparams=hparams)
        return sejax.make_evaluator(fixed, env, task, training)(key, params)

    each = [evaluate(keys[i], jax.tree.map(lambda x, i=i: x[i], draws.hparams)) for i in chosen]
    return chosen, jax.tree.map(lambda *x: np.stack(x), *each)


def test_ses_learned_otherwise_than_the_option_says_are_refused(ses, tmp_path):
    with pytest.raises(ConfigError, match=r"varied must be SEs learned with varied.*fixed="):
        trained(se_performance, tmp_path, varied=str(ses[0]))


def test_ses_of_another_task_are_refused(ses, tmp_path):
    with pytest.raises(ConfigError, match="must be of one task"):
        performance(ses, tmp_path, env="acrobot")


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [("se_feasibility", ["env=cartpol"], "Did you mean env=cartpole"),
     ("se_performance", ["fixed=none.safetensors"], "does not exist"),
     ("se_performance", ["agents=[dqn]"], "agents must be one of ddqn"),
     ("se_models", [], "ses must be given")],
)  # fmt: skip
def test_commands_end_bad_input_with_one_message_and_status_2(
    name, words, message, tmp_path, capsys, monkeypatch
):
    module = __import__(f"experiments.{name}", fromlist=["EXPERIMENT"])
    monkeypatch.setattr(experiment.runtime, "configure_jax", lambda: None)
    with pytest.raises(SystemExit) as ended:
        module.EXPERIMENT.main([f"out={tmp_path}", *words])
    error = capsys.readouterr().err
    assert ended.value.code == 2 and message in error
    assert error.startswith("error: ") and error.count("\n") == 1


def test_a_command_refuses_before_it_imports_gymnax(tmp_path):
    code = ("import runpy, sys; sys.argv[1:] = ['seed=-1']\n"
            "try: runpy.run_module('experiments.se_models', run_name='__main__')\n"
            "finally: print('gymnax.environments.environment' in sys.modules)")  # fmt: skip
    environment = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                          timeout=120, env=environment)  # fmt: skip
    assert done.returncode == 2 and "seed must lie in" in done.stderr and done.stdout == "False\n"


def test_all_experiments_are_listed():
    done = subprocess.run([sys.executable, "-m", "experiments"], capture_output=True,
                          text=True, timeout=120, check=True)  # fmt: skip
    for module in (se_feasibility, se_models, se_performance):
        assert f"  {module.EXPERIMENT.settings.name} " in done.stdout
