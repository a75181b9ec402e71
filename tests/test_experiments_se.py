"""The experiments with SEs: sets of SEs, feasibility, performance, single SEs."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys

import jax
import numpy as np
import pandas as pd
import pytest
from sejax.configs import TrainingConfig
from sejax.proxies.sets import load_set, save_set
from support import experiment_options, refuse

import sejax
from sejax import envs
from sejax.errors import ConfigError
from sejax.experiments import (
    common,
    figures,
    proxy_runs,
    se_agents,
    se_feasibility,
    se_models,
    se_performance,
)  # fmt: skip
from sejax.proxies.synthetic import make_synthetic

TINY_RUN = ["generations=3", "es.population_size=2", "es.num_incumbent_evals=2",
            "agent.hidden_size=4", "agent.batch_size=4", "agent.init_episodes=0",
            "proxy.hidden_size=4", "training.max_steps=30", "training.test_episodes=1"]  # fmt: skip
TINY_AGENT = {"hidden_size": 2, "batch_size": 4, "num_layers": 1, "init_episodes": 0}


def learned(out, *argv):
    args = experiment_options(se_feasibility, out, "--runs", "2", *argv, "--set", *TINY_RUN)
    return se_feasibility.run(args)


@pytest.fixture(scope="module")
def ses(tmp_path_factory):
    """A file with three SEs of random weights: its path and the weights."""
    path = tmp_path_factory.mktemp("ses") / "ses.safetensors"
    config = sejax.config(["proxy.hidden_size=4", "training.max_steps=40", "agent.init_episodes=0"])
    env = make_synthetic(envs.make("cartpole"), config.proxy)
    weights = [env.init_weights(jax.random.key(i)) for i in range(3)]
    save_set(path, config, weights, [1.0, 2.0, 3.0], [4, 5, 6], [7, 8, 9])
    return path, weights


def assert_equal_trees(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_set_that_is_saved_and_loaded_is_the_same(ses):
    path, weights = ses
    loaded = load_set(path)
    assert loaded.size == 3 and loaded.task.name == "cartpole"
    for i in range(3):
        assert_equal_trees(loaded.one(i).weights, weights[i])
    np.testing.assert_array_equal(loaded.scores, [1, 2, 3])
    np.testing.assert_array_equal(loaded.generations, [4, 5, 6])
    np.testing.assert_array_equal(loaded.seeds, [7, 8, 9])
    assert len({loaded.fingerprint(i) for i in range(3)}) == 3
    assert_equal_trees(loaded.first(2).weights, jax.tree.map(lambda x: x[:2], loaded.weights))
    assert loaded.first(None).size == 3
    some = dataclasses.replace(loaded, scores=np.array([195.0, 194.9, 200.0]))
    assert list(some.solved().seeds) == [loaded.seeds[0], loaded.seeds[2]]
    assert dataclasses.replace(loaded, scores=np.zeros(3)).solved().size == 0


def test_all_ses_of_a_set_step_at_once(ses):
    loaded = load_set(ses[0])
    env, params = loaded.env, loaded.params
    axes = params.replace(weights=0, max_steps_in_episode=None)
    key = jax.random.key(0)
    obs, state = env.reset_env(key, params)

    def reward(params):
        return env.step_env(key, state, jax.numpy.int32(1), params)[2]

    rewards = jax.vmap(reward, in_axes=(axes,))(params)
    np.testing.assert_allclose(rewards, [reward(loaded.one(i)) for i in range(3)], rtol=1e-6)
    assert obs.shape == (4,) and len(set(np.asarray(rewards).tolist())) == 3


def test_a_single_proxy_is_a_set_of_one(ses, tmp_path):
    config, weights = load_set(ses[0]).config, ses[1][0]
    sejax.save(tmp_path / "p.safetensors", config, weights, score=12.5, generation=7, seed=2)
    loaded = load_set(tmp_path / "p.safetensors")
    assert (loaded.size, loaded.scores[0], loaded.seeds[0]) == (1, 12.5, 2)
    assert_equal_trees(loaded.one(0).weights, weights)
    assert loaded.fingerprint(0) == load_set(ses[0]).fingerprint(0)


def test_files_that_are_no_set_are_refused(ses, tmp_path):
    path, weights = ses
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ConfigError, match=r"proxy must be a single proxy.*load_set reads sets"):
        sejax.load(path)
    with pytest.raises(ConfigError, match=r"--fixed must be a whole file.*which is damaged"):
        load_set(damaged, "--fixed")
    other = sejax.config(["proxy.hidden_size=5"])
    save_set(tmp_path / "other.safetensors", other, weights, [1] * 3, [1] * 3, [1] * 3)
    with pytest.raises(ConfigError, match="source must hold the tensors of the network"):
        load_set(tmp_path / "other.safetensors")
    with pytest.raises(ConfigError, match="does not exist"):
        load_set(tmp_path / "none.safetensors")


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


def test_feasibility_learns_as_sejax_run_does_and_goes_on_where_it_stopped(tmp_path, monkeypatch):
    table = learned(tmp_path)
    made = pd.read_csv(tmp_path / "learning_curves.csv")
    assert made.groupby("seed").size().to_dict() == {3: 3, 4: 3}
    args = experiment_options(se_feasibility, tmp_path, "--set", *TINY_RUN)
    config = sejax.config(se_feasibility.overrides(args))
    result = jax.jit(sejax.make_learner(config))(jax.random.key(4))
    mine = made[made["seed"] == 4]
    np.testing.assert_allclose(mine["incumbent_mean"], result.info.incumbent_mean, rtol=1e-6)
    stored = load_set(tmp_path / "ses.safetensors")
    assert stored.seeds.tolist() == [3, 4]
    assert_equal_trees(stored.one(1).weights, result.weights)
    assert stored.scores[1] == pytest.approx(float(result.score))

    monkeypatch.setattr(proxy_runs, "learn_one", refuse)
    pd.testing.assert_frame_equal(learned(tmp_path), table)
    with pytest.raises(ConfigError, match="with another agent_hparams"):
        learned(tmp_path, "--agent-hparams", "varied")


def test_a_run_that_was_stopped_goes_on_at_its_last_generation(tmp_path):
    """Learns two generations, then five: the same as five at once."""
    for out, counts in ((tmp_path / "a", (2, 5)), (tmp_path / "b", (5,))):
        for count in counts:
            args = experiment_options(se_feasibility, out, "--runs", "1", "--set", *TINY_RUN)
            args.overrides = [*args.overrides, f"generations={count}"]
            se_feasibility.run(args)
    a, b = (pd.read_csv(tmp_path / x / "learning_curves.csv") for x in "ab")
    pd.testing.assert_frame_equal(a.drop(columns="wall_s"), b.drop(columns="wall_s"))


def test_a_run_without_its_checkpoint_is_not_replaced(tmp_path):
    learned(tmp_path)
    for folder in (tmp_path / "runs").glob("*/checkpoint"):
        shutil.rmtree(folder)
    before = (tmp_path / "runs" / "seed3" / "metrics.csv").read_text()
    args = experiment_options(se_feasibility, tmp_path, "--set", *TINY_RUN)
    args.overrides = [*args.overrides, "generations=4"]
    with pytest.raises(ConfigError, match=r"keep the checkpoints of a run.*with 3 generations"):
        se_feasibility.run(args)
    assert (tmp_path / "runs" / "seed3" / "metrics.csv").read_text() == before


def test_a_kill_while_a_piece_is_made_longer_loses_nothing(tmp_path, monkeypatch):
    pieces, rows = common.Pieces(tmp_path), []

    def make(count):
        rows.append(count)
        return pd.DataFrame({"row": range(count)})

    def compute(count):
        return pieces.compute("p", {"count": count}, lambda: make(count), length="count")

    assert len(compute(2)) == len(compute(2)) == 2 and rows == [2]
    written = common.write_text

    def killed(path, text):
        if path.suffix == ".json":
            raise KeyboardInterrupt
        written(path, text)

    monkeypatch.setattr(common, "write_text", killed)
    with pytest.raises(KeyboardInterrupt):
        compute(5)
    monkeypatch.setattr(common, "write_text", written)
    assert len(compute(5)) == len(compute(5)) == 5 and rows == [2, 5, 5]
    with pytest.raises(ConfigError, match="with another count"):
        compute(3)


@pytest.mark.parametrize("preset", ["best", "paper", "paper_performance"])
@pytest.mark.parametrize("env", ["cartpole", "acrobot"])
def test_quick_runs_are_long_enough_to_learn(env, preset):
    config = sejax.config([f"env={env}", f"preset={preset}", *se_feasibility.QUICK])
    assert config.agent.init_episodes == 1


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


def test_intervals_draw_ses_and_not_agents():
    agents = made_up_agents()
    row = se_performance.summarise(agents).iloc[0]
    values = agents["test_return"].to_numpy().reshape(4, 6)
    low, high = common.bootstrap_interval(values.mean(axis=1))
    assert (row["test_return_low"], row["test_return_high"]) == pytest.approx((low, high))
    assert row["test_return_mean"] == pytest.approx(values.mean())
    assert row["test_return_std"] == pytest.approx(np.std(values))
    assert (row["num_ses"], row["num_agents"]) == (4, 24)


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


def performance(ses, out, *argv):
    args = experiment_options(se_performance, out, "--fixed", str(ses[0]), "--agents", "ddqn",
                   "--num-agents", "3", "--num-ses", "2", "--test-episodes", "2",
                   "--real-episodes", "3", *argv)  # fmt: skip
    return se_performance.run(args)


def test_performance_trains_as_evaluation_does_and_goes_on(ses, tmp_path, monkeypatch, capsys):
    from sejax.agents.configs import DDQNConfig, ExplorationConfig
    from sejax.agents.hparams import make_varied_agents

    from sejax.evaluation import evaluate_agents

    monkeypatch.setattr(se_agents, "QUICK_AGENT", TINY_AGENT)
    table = performance(ses, tmp_path)
    agents = pd.read_csv(tmp_path / "agents.csv")
    assert agents.groupby("setting").size().to_dict() == {"real": 6, "fixed": 6}
    stored = load_set(ses[0])
    mine = agents[agents["group"] == f"se-{stored.seeds[1]:02d}-{stored.fingerprint(1)}"]
    loaded, task = load_set(ses[0]), envs.make("cartpole")
    key = jax.random.fold_in(jax.random.key(3), 1)
    keys = jax.numpy.stack([jax.random.fold_in(key, i) for i in range(3)])
    varied = make_varied_agents(DDQNConfig(**TINY_AGENT), task, ExplorationConfig())
    training = dataclasses.replace(loaded.config.training, test_episodes=2)
    expected = evaluate_agents(varied, loaded.env, loaded.one(1), task, training, keys)
    np.testing.assert_allclose(mine["test_return"], expected.test_return, rtol=1e-6)
    np.testing.assert_allclose(mine["return_0"] + mine["return_1"], 2 * mine["test_return"])
    assert (mine["train_steps"] == 40).all() and mine["hidden_size"].between(1, 6).all()
    real = agents[agents["setting"] == "real"]
    real_training = TrainingConfig(max_episodes=3, stop_rule="solved",
                                   solved_by="train", test_episodes=2)  # fmt: skip
    expected = evaluate_agents(varied, task.env, task.params, task, real_training, keys)
    mine = real[real["group"] == "real-01"]
    np.testing.assert_allclose(mine["test_return"], expected.test_return, rtol=1e-6)
    np.testing.assert_array_equal(mine["train_steps"], expected.train_steps)
    assert table["trained on"].tolist() == ["real", "synth., HPs fixed"]
    assert (tmp_path / "performance.png").stat().st_size > 10_000
    assert "16887.7" in (tmp_path / "table.md").read_text()

    monkeypatch.setattr(se_agents, "train_groups", refuse)
    pd.testing.assert_frame_equal(performance(ses, tmp_path), table)
    with pytest.raises(ConfigError, match=r"with another training\.test_episodes"):
        performance(ses, tmp_path, "--test-episodes", "4")

    fewer = performance(ses, tmp_path, "--real-groups", "1")
    assert fewer["SEs, agents"].tolist() == ["1, 3", "2, 6"]

    args = experiment_options(
        se_models, tmp_path, "--ses", str(ses[0]), "--agents", "ddqn", "--num-agents", "3",
        "--num-ses", "2", "--test-episodes", "2",
    )  # fmt: skip
    single = se_models.run(args)  # finds what se_performance has trained
    assert set(single["SE"]) == {0, 1} and set(single["run's seed"]) == {7, 8}
    assert (tmp_path / "models.png").stat().st_size > 10_000


def test_agents_of_equal_number_draw_equal_hyperparameters_in_all_settings(
    ses, tmp_path, monkeypatch
):
    monkeypatch.setattr(se_agents, "QUICK_AGENT", TINY_AGENT)
    performance(ses, tmp_path)
    agents = pd.read_csv(tmp_path / "agents.csv")
    real, fixed = (agents[agents["setting"] == name] for name in ("real", "fixed"))
    for name in ("learning_rate", "batch_size", "hidden_size", "num_layers"):
        np.testing.assert_array_equal(real[name], fixed[name])
        assert real[name].nunique() > 1


def test_ses_learned_otherwise_than_the_option_says_are_refused(ses, tmp_path):
    args = experiment_options(se_performance, tmp_path, "--varied", str(ses[0]))
    with pytest.raises(ConfigError, match=r"--varied must be SEs learned with varied.*--fixed="):
        se_performance.run(args)


@pytest.mark.parametrize(
    ("argv", "message"),
    [(["--agents", "dqn"], "--agents must be one of ddqn"),
     (["--num-agents", "0"], "--num-agents must be at least 1"),
     (["--env", "acrobot"], "must be of one task")],
)  # fmt: skip
def test_bad_options_are_refused(argv, message, ses, tmp_path):
    args = experiment_options(se_performance, tmp_path, "--fixed", str(ses[0]), *argv)
    with pytest.raises(ConfigError, match=message):
        se_performance.run(args)


@pytest.mark.parametrize(
    ("name", "argv", "message"),
    [("se_feasibility", ["--env", "cartpol"], "Did you mean env=cartpole"),
     ("se_performance", ["--fixed", "none.safetensors"], "does not exist"),
     ("se_models", [], "--ses must be given"),
     ("se_models", ["--seed", "-1"], "--seed must lie in"),
     ("se_models", ["--devices", "0"], "--devices must be at least 1")],
)  # fmt: skip
def test_commands_end_bad_input_with_one_message_and_status_2(name, argv, message, tmp_path):
    environment = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
    done = subprocess.run(
        [sys.executable, "-m", f"sejax.experiments.{name}", "--out", str(tmp_path), *argv],
        capture_output=True, text=True, timeout=120, env=environment,
    )  # fmt: skip
    assert done.returncode == 2 and message in done.stderr
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1


def test_a_piece_says_what_it_was_made_with(ses, tmp_path):
    learned(tmp_path)
    settings = json.loads((tmp_path / "pieces" / "seed4.json").read_text())
    assert settings["seed"] == 4 and settings["proxy.hidden_size"] == 4
    assert "run_dir" not in settings
