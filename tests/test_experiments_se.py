"""The experiments with SEs: what their tables say, worked out by hand, and what they train."""

import dataclasses
import itertools
from types import SimpleNamespace

import jax
import numpy as np
import pandas as pd
import pytest
import yaml
from support import paper_training, refuse
from test_experiments import TINY, TINY_AGENT, save_ses

import sejax
from experiments import (
    se_families,
    se_feasibility,
    se_horizons,
    se_models,
    se_out_of_sample,
    se_performance,
)
from experiments.common import agents, figures, runs, shards
from experiments.common.statistics import (
    mean_interval,
)
from sejax import envs
from sejax.agents.base import drawing_key
from sejax.cli import config as configuration
from sejax.options import ConfigError


@pytest.fixture(scope="module")
def ses(tmp_path_factory):
    """A file with three SEs of random weights."""
    return save_ses(tmp_path_factory.mktemp("s") / "s.safetensors", 3, "training.max_steps=40")


@pytest.fixture
def tiny_agents(monkeypatch):
    monkeypatch.setattr(agents, "QUICK_AGENT", TINY_AGENT)


def run(name, module, out, **given):
    """The table of an experiment with tiny settings."""
    options = TINY[name] | {"quick": True, "seed": 3, "out": str(out)} | given
    return module.EXPERIMENT.run(module.EXPERIMENT.settings.of(**options))


# --- feasibility, and runs with a budget ----------------------------------------------------------


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


@pytest.mark.parametrize("solved, text", [
    ([100, 300, 200], "200"), ([100, 200, None], "200"), ([100, None, None], "> 900"),
])  # fmt: skip
def test_a_run_that_did_not_solve_the_task_took_more_steps_than_all(solved, text):
    each = pd.DataFrame({
        "generations_to_solve": [np.inf if x is None else 1 for x in solved],
        "env_steps_to_solve": [np.nan if x is None else x for x in solved],
        "env_steps": [900, 950, 1000],
    })  # fmt: skip
    assert se_feasibility.median_steps(each) == text


def test_feasibility_learns_as_sejax_run_does_and_goes_on(tmp_path):
    def learned(**given):
        run("se_feasibility", se_feasibility, tmp_path, **given)
        return shards.read_rows(tmp_path / "rows.csv.xz").drop(columns=["wall_s", "cpu_s"])

    first = learned(generations=1)
    made = learned(generations=3)
    assert made.groupby("seed").size().to_dict() == {3: 3, 4: 3}
    pd.testing.assert_frame_equal(made[made["generation"] == 0].reset_index(drop=True), first)
    stored = sejax.load_set(tmp_path / "ses.safetensors")
    config = yaml.safe_load((tmp_path / "work/runs/seed4/config.yaml").read_text())
    assert config["seed"] == 4 and config["proxy"]["hidden_size"] == 4
    result = jax.jit(sejax.make_learner(configuration.learn_config(config)))(jax.random.key(4))
    mine = made[made["seed"] == 4]
    np.testing.assert_allclose(mine["incumbent_mean"], result.info.incumbent_mean, rtol=1e-6)
    assert stored.seeds.tolist() == [3, 4]
    weights = stored[1].params.weights
    assert all(jax.tree.leaves(jax.tree.map(np.array_equal, weights, result.weights)))
    assert stored.scores[1] == pytest.approx(float(result.score))
    with pytest.raises(ConfigError, match=r"agent_hparams.*Set work=DIR"):
        learned(agent_hparams="varied")
    with pytest.raises(ConfigError) as refused:
        learned(run=["proxy=rn"])
    assert refused.value.field == "run.proxy"


def test_a_cost_whose_generation_was_lost_is_written_again(tmp_path):
    path = tmp_path / "cpu_s.txt"
    assert runs.read_costs(path, 3).tolist() == []
    path.write_text("0.500\n0.250\n7.000\n")
    assert runs.read_costs(path, 2).tolist() == [0.5, 0.25]
    path.write_text("0.500\nx")
    with pytest.raises(ConfigError, match=r"cpu_s\.txt is damaged"):
        runs.read_costs(path, 2)


# --- performance, and single SEs ------------------------------------------------------------------


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


def test_intervals_are_over_ses_and_not_agents_but_on_the_real_task():
    agents = made_up_agents(num_ses=5)
    values = agents["test_return"].to_numpy().reshape(5, 6)
    for setting, independent in (("varied", values.mean(axis=1)), ("real", values.ravel())):
        row = se_performance.summarise(agents.assign(setting=setting), 25.0).iloc[0]
        assert row["test_return_mean"] == pytest.approx(values.mean())
        assert row["test_return_std"] == pytest.approx(np.std(values))
        assert (row["num_ses"], row["num_agents"]) == (5, 30)
        ends = mean_interval(independent)
        assert (row["test_return_low"], row["test_return_high"]) == pytest.approx(ends)
        assert row["test_return_worst_tenth"] == np.sort(values.ravel())[:3].mean()
        assert row["solved"] == 0.4  # two SEs of five
    few = se_performance.summarise(made_up_agents(num_ses=4), 25.0)
    assert np.isnan(few["test_return_low"][0]) and np.isnan(few["train_steps_high"][0])
    assert "[" not in se_performance.make_table("cartpole", few)["return"][0]


def test_a_tuned_agent_is_a_baseline_of_its_own():
    settings = se_performance.SePerformance.of(max_steps=700, real_groups=2)
    task = envs.make("cartpole")
    real = se_performance.on_real(settings, task, {}, "ddqn")
    tuned = se_performance.on_real_tuned(settings, real, "ddqn")
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
    table = se_performance.make_table("cartpole", se_performance.summarise(agents, 195))
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


@pytest.mark.slow
def test_performance_trains_as_evaluation_does(ses, tmp_path, tiny_agents):
    given = {"num_agents": 3, "num_ses": 2}
    table = run("se_performance", se_performance, tmp_path, fixed=ses, **given)
    rows = shards.read_rows(tmp_path / "rows.csv.xz")
    assert rows.groupby("setting").size().to_dict() == {"real": 6, "fixed": 6}
    assert table["trained on"].tolist() == ["real", "synth., HPs fixed"]
    check_as_evaluation(ses, rows)
    # Agents of equal number draw equal hyperparameters in all settings.
    real, fixed = (rows[rows["setting"] == name] for name in ("real", "fixed"))
    for name in ("learning_rate", "batch_size", "hidden_size", "num_layers"):
        np.testing.assert_array_equal(real[name], fixed[name])
        assert real[name].nunique() > 1
    single = run("se_models", se_models, tmp_path, ses=ses, **given)  # finds what was trained
    assert set(single["SE"]) == {0, 1} and set(single["run's seed"]) == {7, 8}


def check_as_evaluation(ses, rows):
    """Agents of the second groups are those of `make_evaluator` with the same keys and draws."""
    loaded, task = sejax.load_set(ses), envs.make("cartpole")
    key = jax.random.fold_in(jax.random.key(3), 1)
    keys = jax.numpy.stack([jax.random.fold_in(key, i) for i in range(3)])
    mine = rows[rows["group"] == f"se-{loaded.seeds[1]:02d}-{loaded[1].fingerprint}"]
    training = paper_training(max_steps=40, stop_rule="never", test_episodes=2)
    chosen, expected = evaluated(loaded.env, loaded[1].params, task, training, keys)
    np.testing.assert_allclose(mine["test_return"].iloc[chosen], expected.test_return, rtol=1e-6)
    np.testing.assert_allclose(mine["return_0"] + mine["return_1"], 2 * mine["test_return"])
    assert (mine["train_steps"] == 40).all() and mine["hidden_size"].between(1, 6).all()
    mine = rows[rows["group"] == "real-01"]
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
    draws = jax.vmap(lambda key: varied.varied.draw(drawing_key(key)))(keys)
    chosen = np.flatnonzero(draws.variant == draws.variant[0])
    agent = varied.varied.agents[int(draws.variant[0])]

    @jax.jit
    def evaluate(key, hparams):
        fixed = dataclasses.replace(agent, hparams=hparams)
        return sejax.make_evaluator(fixed, env, task, training)(key, params)

    each = [evaluate(keys[i], jax.tree.map(lambda x, i=i: x[i], draws.hparams)) for i in chosen]
    return chosen, jax.tree.map(lambda *x: np.stack(x), *each)


def test_ses_learned_otherwise_or_of_another_task_are_refused(ses, tmp_path):
    for field, given in (("varied", {"varied": ses, "fixed": None}),
                         ("env", {"fixed": ses, "env": "acrobot"})):  # fmt: skip
        with pytest.raises(ConfigError) as refused:
            run("se_performance", se_performance, tmp_path, **given)
        assert refused.value.field == field


# --- out of sample --------------------------------------------------------------------------------


def test_an_se_is_solved_where_its_fresh_agents_are_and_intervals_draw_ses():
    returns = {"a": [200, 190], "b": [200, 180], "c": [195, 195], "d": [150, 0], "e": [200, 200]}
    agents = pd.DataFrame([
        {"kind": "ppo", "hparams": "default", "trained_on": name, "steps": 2000, "group": group,
         "agent": i, "test_return": float(x)}
        for name in ("fixed", "real") for group, pair in returns.items()
        for i, x in enumerate(pair)
    ])  # fmt: skip
    summary = se_out_of_sample.summarise(agents, 195).set_index("trained_on")
    ses, real = summary.loc["fixed"], summary.loc["real"]
    assert (ses["groups_solved"], ses["num_groups"], ses["num_agents"]) == (3, 5, 10)  # a, c, e
    assert ses["solved"] == 0.6 and ses["worst_tenth"] == ses["worst"] == 0
    ends = ses["test_return_low"], ses["test_return_high"]
    assert ends == pytest.approx(mean_interval([195, 190, 195, 75, 200]))
    ends = real["test_return_low"], real["test_return_high"]
    assert ends == pytest.approx(mean_interval(agents["test_return"][:10]))
    table = se_out_of_sample.make_table(summary.reset_index())
    assert table["interval over"].tolist() == ["5 SEs", "10 agents"]
    assert table["SEs or tables solved"].tolist() == ["3 of 5", ""]


def test_fresh_agents_train_on_all_ses_and_beside_them_as_long(ses):
    settings = se_out_of_sample.SeOutOfSample.of(fixed=ses, real_agents=4, more_steps=[90])
    assert settings.seed == 1000, "seeds that took no part in tuning"
    sets = se_out_of_sample.load_sets(settings)
    found = list(se_out_of_sample.conditions(settings, sets, "ddqn", "default"))
    names = [condition.groups[0].name.partition("-")[0] for condition, _ in found]
    assert names == ["fixed", "hand", "real", "real"]
    assert [condition.training.max_steps for condition, _ in found] == [41, 41, 41, 90]
    counts = [len(condition.groups) * num_agents for condition, num_agents in found]
    assert counts == [3 * 10, 4, 4, 4], "unsolved SEs are not left out"
    assert not found[-1][0].training.time_limit_is_terminal


def test_ses_of_another_task_are_refused(ses):
    settings = se_out_of_sample.SeOutOfSample.of(env="acrobot", fixed=ses)
    with pytest.raises(ConfigError, match="env=cartpole"):
        se_out_of_sample.load_sets(settings)


# --- mixtures and horizons ------------------------------------------------------------------------


def config_with(names, others=(), **given):
    settings = se_families.SeFamilies.of(quick=True, **given)
    return settings.config_with(names, others)


def test_words_on_a_family_reach_the_sets_that_have_it():
    run = ["agents.ppo.epochs=3", "es.noise_std=0.5"]
    both = config_with(["ddqn", "ppo"], ["ddqn", "ppo"], run=run)
    assert [(x.key, x.weight) for x in both.agents.members] == [("ddqn", 1), ("ppo", 1)]
    assert both.agents.members[1].agent.epochs == 3 and both.es.noise_std == 0.5
    alone = config_with(["ddqn"], ["ddqn", "ppo"], run=run)
    assert [x.key for x in alone.agents.members] == ["ddqn"] and alone.es.noise_std == 0.5
    with pytest.raises(ConfigError, match="agents"):
        config_with(["ddqn"], ["ddqn"], run=["agents.ppo.epochs=3"])
    assert config_with(["ddqn"], cpu_budget_s=5.0).generations == runs.UNLIMITED
    assert config_with(["ddqn"], cpu_budget_s=5.0, generations=7).generations == 7


def agents_tested(means):
    """Two agents on each of two SEs; `means` by (set, tested family), SEs 10 apart."""
    return pd.DataFrame([
        {"learned_with": name, "kind": kind, "hparams": "default", "seed": seed, "agent": agent,
         "test_return": mean + 10 * (seed - 0.5) + 2 * (agent - 0.5)}
        for (name, kind), mean in means.items() for seed in (0, 1) for agent in (0, 1)
    ])  # fmt: skip


MEANS = {("ddqn", "ddqn"): 100.0, ("ddqn", "ppo"): 20.0, ("ddqn+ppo", "ddqn"): 90.0,
         ("ddqn+ppo", "ppo"): 80.0}  # fmt: skip


def test_the_matrix_has_means_costs_and_marks_families_that_took_no_part():
    curves = pd.DataFrame([
        {"learned_with": name, "seed": seed, "generation": g, "cpu_s": cost,
         "incumbent_mean": 50.0 + 30 * g * seed, "env_steps_total": 100 * (g + 1)}
        for name, cost in (("ddqn", 1.0), ("ddqn+ppo", 2.5)) for seed in (0, 1) for g in range(3)
    ])  # fmt: skip
    summary = se_families.summarise(curves, agents_tested(MEANS), solved_reward=96.0)
    row = summary.iloc[0]  # returns 94, 96, 104, 106
    assert (row["test_return_mean"], row["solved"], row["num_ses"]) == (100, 0.75, 2)
    assert np.isnan(row["test_return_low"])  # of two SEs
    assert row["test_return_worst_tenth"] == 94
    assert summary["took_part"].tolist() == [True, False, True, True]
    assert summary["cpu_s"].tolist() == [3, 3, 7.5, 7.5]
    assert summary["solved_runs"].tolist() == [0.5] * 4 and summary["env_steps"].eq(300).all()
    table = se_families.make_table(summary)
    assert table["learned with"].tolist() == ["DDQN", "DDQN + PPO"]
    assert [text.endswith(se_families.LEFT_OUT) for text in table["PPO"]] == [True, False]
    assert table["DDQN"][0] == "100.0; worst tenth 94.0; 75%"
    with_ends = summary.assign(test_return_low=95.0, test_return_high=105.0)
    assert se_families.make_table(with_ends)["DDQN"][0].startswith("100.0 [95.0, 105.0]; worst")


@pytest.mark.slow
def test_a_run_ends_with_its_budget_and_goes_on_with_a_larger_one(tmp_path, monkeypatch):
    ticks = itertools.count()  # a clock that is a second later at each look
    monkeypatch.setattr(runs, "time", SimpleNamespace(process_time=lambda: float(next(ticks))))

    def costs(budget):
        given = {"cpu_budget_s": budget, "generations": 4}
        run("se_horizons", se_horizons, tmp_path, **given)
        rows = shards.read_rows(tmp_path / "rows.csv.xz")
        return shards.unstack(rows, "curves")["cpu_s"].tolist()

    assert costs(1.5) == [1, 1]  # the second began before 1.5 s were spent
    assert costs(100.0) == [1, 1, 1, 1]  # `generations` ends it


def test_an_unknown_family_is_refused_before_anything_is_learned(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "learn", refuse)
    for given in ({"sets": "ddqn+pppo"}, {"tested": "pppo"}, {"run": ["agents.ddqn.x=1"]}):
        options = {"sets": "ddqn", "tested": "ddqn", "out": str(tmp_path)} | given
        with pytest.raises(ConfigError, match=r"^agents must be one of|agents\.ddqn\.x"):
            se_families.EXPERIMENT.run(se_families.SeFamilies.of(**options))


def test_kinds_of_ses_are_told_by_what_they_override():
    settings = se_horizons.SeHorizons.of(horizons=[1, 5, None], ends=["threshold", "sigmoid"])
    assert len(settings.kinds) == 2 * (1 + 2 * 2)
    named = {kind.name: kind.words for kind in settings.kinds}
    assert named["1-learned"] == ["proxy.horizon=1", "proxy.initial_state=learned"]
    assert named["limit-real-sigmoid"] == [
        "proxy.horizon=null", "proxy.initial_state=real", "proxy.done=sigmoid"]  # fmt: skip
    assert "'horizons=[1,5,null]'" in settings.command()


def horizon_rows():
    """Two kinds with two runs of four generations of 2 CPU s each."""
    incumbents = {("1", "real", "-"): ([10, 196, 100, 197], [0, 1, 2, 199]),
                  ("limit", "real", "threshold"): ([5, 5, 5, 300], [5, 5, 5, 5])}  # fmt: skip
    curves = pd.DataFrame([
        {"horizon": horizon, "starts": starts, "end": end, "seed": seed, "generation": g,
         "incumbent_mean": float(score), "cpu_s": 2.0, "train_steps_mean": 30.0,
         "env_steps_total": 100 * (g + 1)}
        for (horizon, starts, end), runs in incumbents.items() for seed, scores in enumerate(runs)
        for g, score in enumerate(scores)
    ])  # fmt: skip
    transfer = pd.DataFrame([
        {"horizon": "1", "starts": "real", "end": "-", "kind": "ppo", "test_return_mean": 180.0},
        {"horizon": "limit", "starts": "real", "end": "threshold", "kind": "ppo",
         "test_return_mean": 20.0},
    ])  # fmt: skip
    return curves, transfer.assign(hparams="default")


def test_runs_are_compared_within_equal_cpu_seconds():
    curves, transfer = horizon_rows()
    each = se_horizons.summarise_runs(curves, 5.0, solved_reward=195)
    assert each["generations"].tolist() == [3] * 4  # begun at 0, 2 and 4 s
    assert each["best"].tolist() == [196, 2, 5, 5]
    assert each["to_solve"].tolist() == each["cpu_s_to_solve"].div(2).tolist()
    assert each["cpu_s_to_solve"].tolist() == [4, np.inf, np.inf, np.inf]
    assert each["stays_solved"][0] == 0 and each["stays_solved"][1:].isna().all()
    whole = se_horizons.summarise_runs(curves, None, solved_reward=195)
    assert whole["stays_solved"][0] == 0.5 and whole["best"].tolist() == [197, 199, 300, 5]
    assert np.isnan(whole["stays_solved"][1])  # no later generation

    summary = se_horizons.summarise(each, transfer)
    assert summary["best_mean"].tolist() == [99, 5] and summary["on_ppo"].tolist() == [180, 20]
    assert summary["best_low"].isna().all()  # of two runs
    table = se_horizons.make_table(summary)
    assert table["runs solved"].tolist() == ["1 of 2", "0 of 2"]
    assert table["CPU s to solve"].tolist() == ["-", "-"]
    assert table["stay solved"].tolist() == ["0%", "-"]
    text = se_horizons.differences(each, summary, "threshold")
    assert text == "1-real less limit-real-threshold: +94.0"
