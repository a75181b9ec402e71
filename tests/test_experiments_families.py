"""The experiments with families of agents, horizons, and tuning on SEs; runs with a budget."""

import dataclasses
import itertools

import jax
import numpy as np
import pandas as pd
import pytest
from scipy.stats import spearmanr
from support import is_drawn, refuse

import sejax
from experiments import (
    budgets,
    family_runs,
    pieces,
    se_families,
    se_horizons,
    se_transfer_of_hparams,
)  # fmt: skip
from sejax import envs
from sejax.cli import session
from sejax.errors import ConfigError

TINY_RUN = ["es.population_size=2", "es.num_incumbent_evals=2", "proxy.hidden_size=4",
            "training.max_steps=30", "training.test_episodes=1",
            *(f"agents.{name}.{field}" for name in ("ddqn", "dueling_ddqn")
              for field in ("hidden_size=4", "batch_size=4", "warmup_episodes=0"))]  # fmt: skip


# Budgets, with one tiny run of `se_horizons`.


def horizons(out, **given):
    """SEs of one step, whose best one is tested with one other family."""
    options = {"horizons": [1], "starts": "real", "runs": 1, "generations": 4, "num_agents": 2,
               "test_episodes": 1, "run": TINY_RUN} | given  # fmt: skip
    return se_horizons.EXPERIMENT.run(
        se_horizons.SeHorizons.of(quick=True, seed=3, out=str(out), **options)
    )


class Clock:
    """A clock that is a second later at each look."""

    def __init__(self):
        self.ticks = itertools.count()

    def process_time(self):
        return float(next(self.ticks))


@pytest.fixture
def clock(monkeypatch):
    monkeypatch.setattr(budgets, "time", Clock())


@pytest.mark.slow
def test_a_run_ends_with_its_budget_and_goes_on_with_a_larger_one(tmp_path, clock, monkeypatch):
    table = horizons(tmp_path, cpu_budget_s=1.5)
    rows = pieces.read_rows(tmp_path / "rows.csv.xz")
    curves = pieces.unstack(rows, "curves")
    assert curves["cpu_s"].tolist() == [1, 1]  # the second began before 1.5 s were spent
    assert table["generations"].tolist() == ["2"] and is_drawn(tmp_path / "horizons.png")
    agents = pieces.unstack(rows, "agents")
    assert set(agents["kind"]) == {"dueling_ddqn"} and len(agents) == 2
    stored = sejax.load_set(tmp_path / "1-real.safetensors")
    assert stored.env.config.horizon == 1 and stored.config["agents"]["ddqn"]["hidden_size"] == 4

    with monkeypatch.context() as patch:
        patch.setattr(session.Chunks, "advance", refuse)
        pd.testing.assert_frame_equal(horizons(tmp_path, cpu_budget_s=1.5), table)
    longer = horizons(tmp_path, cpu_budget_s=100.0)  # `generations` ends it
    assert longer["generations"].tolist() == ["4"]
    again = pieces.unstack(pieces.read_rows(tmp_path / "rows.csv.xz"), "curves")
    pd.testing.assert_frame_equal(
        again.iloc[:2].drop(columns="wall_s"), curves.drop(columns="wall_s")
    )
    remade = horizons(tmp_path, cpu_budget_s=1.5, from_rows=True)
    assert remade["generations"].tolist() == ["2"]


def test_a_cost_whose_generation_was_lost_is_written_again(tmp_path):
    path = tmp_path / "cpu_s.txt"
    assert budgets.read_costs(path, 3).tolist() == []
    path.write_text("0.500\n0.250\n7.000\n")
    assert budgets.read_costs(path, 2).tolist() == [0.5, 0.25]


# Families.


def config_with(names, others=(), **given):
    settings = se_families.SeFamilies.of(quick=True, **given)
    return settings.config_with(names, others)


def test_words_on_a_family_reach_the_sets_that_have_it():
    run = ["agents.ppo.epochs=3", "es.noise_std=0.5"]
    both = config_with(["ddqn", "ppo"], ["ddqn", "ppo"], run=run)
    assert [(x.key, x.weight) for x in both.agents.families] == [("ddqn", 1), ("ppo", 1)]
    assert both.agents.families[1].agent.epochs == 3 and both.es.noise_std == 0.5
    alone = config_with(["ddqn"], ["ddqn", "ppo"], run=run)
    assert [x.key for x in alone.agents.families] == ["ddqn"] and alone.es.noise_std == 0.5
    with pytest.raises(ConfigError, match="agents"):
        config_with(["ddqn"], ["ddqn"], run=["agents.ppo.epochs=3"])
    assert config_with(["ddqn"], cpu_budget_s=5.0).generations == budgets.UNLIMITED
    assert config_with(["ddqn"], cpu_budget_s=5.0, generations=7).generations == 7


def made_up_agents(means):
    """Two agents on each of two SEs; `means` by (set, tested family), SEs 10 apart."""
    return pd.DataFrame([
        {"learned_with": name, "kind": kind, "hparams": "default", "seed": seed, "agent": agent,
         "test_return": mean + 10 * (seed - 0.5) + 2 * (agent - 0.5)}
        for (name, kind), mean in means.items() for seed in (0, 1) for agent in (0, 1)
    ])  # fmt: skip


MEANS = {("ddqn", "ddqn"): 100.0, ("ddqn", "ppo"): 20.0, ("ddqn+ppo", "ddqn"): 90.0,
         ("ddqn+ppo", "ppo"): 80.0}  # fmt: skip


def family_summary():
    curves = pd.DataFrame([
        {"learned_with": name, "seed": seed, "generation": g, "cpu_s": cost,
         "incumbent_mean": 50.0 + 30 * g * seed, "env_steps_total": 100 * (g + 1)}
        for name, cost in (("ddqn", 1.0), ("ddqn+ppo", 2.5)) for seed in (0, 1) for g in range(3)
    ])  # fmt: skip
    return se_families.summarise(curves, made_up_agents(MEANS), solved_reward=96.0)


def test_the_matrix_has_means_costs_and_marks_families_that_took_no_part():
    summary = family_summary()
    row = summary.iloc[0]  # returns 94, 96, 104, 106
    assert (row["test_return_mean"], row["solved"], row["num_ses"]) == (100, 0.75, 2)
    assert np.isnan(row["test_return_low"])  # of two SEs
    assert row["test_return_iqm"] == 100  # of 96 and 104
    assert summary["took_part"].tolist() == [True, False, True, True]
    assert summary["cpu_s"].tolist() == [3, 3, 7.5, 7.5]
    assert summary["solved_runs"].tolist() == [0.5] * 4 and summary["env_steps"].eq(300).all()
    table = se_families.make_table(summary)
    assert table["learned with"].tolist() == ["DDQN", "DDQN + PPO"]
    assert [text.endswith(se_families.LEFT_OUT) for text in table["PPO"]] == [True, False]
    assert table["DDQN"][0].startswith("100.0; IQM 100.0 [")
    with_ends = summary.assign(test_return_low=95.0, test_return_high=105.0)
    assert se_families.make_table(with_ends)["DDQN"][0].startswith("100.0 [95.0, 105.0]; IQM 100.0")


def test_what_is_said_of_families_follows_from_the_rows(tmp_path):
    summary = family_summary()
    left_out = se_families.left_out(summary)  # without DDQN there is no set
    assert left_out.to_dict("list") == {
        "hparams": ["default"], "kind": ["ppo"], "included": [80], "left_out": [20]
    }  # fmt: skip
    text = se_families.findings(summary)
    assert "mean return is 90.0 on SEs that were learned with it and 20.0 on others" in text
    assert "reaches most, 80.0, where SEs were learned with DDQN + PPO, for 8 CPU s" in text
    assert "PPO (default) reaches 20.0 where it alone is left out, and 80.0" in text
    se_families.draw(summary, envs.make("cartpole"), tmp_path / "map.png")
    assert is_drawn(tmp_path / "map.png")
    single = se_families.findings(summary[:1])
    assert single == "With default hyperparameters a family's mean return is 100.0 on SEs that " \
        "were learned with it."  # fmt: skip


def test_an_unknown_family_is_refused_before_anything_is_learned(tmp_path, monkeypatch):
    monkeypatch.setattr(family_runs, "learn", refuse)
    for given in ({"sets": "ddqn+pppo"}, {"tested": "pppo"}, {"run": ["agents.ddqn.x=1"]}):
        options = {"sets": "ddqn", "tested": "ddqn", "out": str(tmp_path)} | given
        with pytest.raises(ConfigError, match=r"^agents must be one of|agents\.ddqn\.x"):
            se_families.EXPERIMENT.run(se_families.SeFamilies.of(**options))
    with pytest.raises(ConfigError, match="sets must name a family"):
        se_families.SeFamilies.of(sets=[])


# Horizons.


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


def test_runs_are_compared_within_equal_cpu_seconds(tmp_path):
    curves, transfer = horizon_rows()
    runs = se_horizons.summarise_runs(curves, 5.0, solved_reward=195)
    assert runs["generations"].tolist() == [3] * 4  # begun at 0, 2 and 4 s
    assert runs["best"].tolist() == [196, 2, 5, 5]
    assert runs["to_solve"].tolist() == runs["cpu_s_to_solve"].div(2).tolist()
    assert runs["cpu_s_to_solve"].tolist() == [4, np.inf, np.inf, np.inf]
    assert runs["stays_solved"][0] == 0 and runs["stays_solved"][1:].isna().all()
    whole = se_horizons.summarise_runs(curves, None, solved_reward=195)
    assert whole["stays_solved"][0] == 0.5 and whole["best"].tolist() == [197, 199, 300, 5]
    assert np.isnan(whole["stays_solved"][1])  # no later generation

    summary = se_horizons.summarise(runs, transfer)
    assert summary["best"].tolist() == [99, 5] and summary["on_ppo"].tolist() == [180, 20]
    assert (summary["best_low"][0], summary["best_high"][0]) == (2, 196)
    table = se_horizons.make_table(summary)
    assert table["runs solved"].tolist() == ["1 of 2", "0 of 2"]
    assert table["CPU s to solve"].tolist() == ["-", "-"]
    assert table["stay solved"].tolist() == ["0%", "-"]
    text = se_horizons.findings(runs, summary, "threshold")
    assert "horizon 1 less horizon limit: +94.0 [-3.0, 191.0]" in text
    assert "the tested families reach 180.0 and 20.0" in text
    se_horizons.draw(envs.make("cartpole"), runs, summary, "threshold", tmp_path / "h.png")
    assert is_drawn(tmp_path / "h.png")


# Tuning.


def test_rank_correlations_are_those_of_scipy():
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 5, 30), rng.normal(size=30)  # with ties
    expected = spearmanr(a, b).statistic
    assert se_transfer_of_hparams.rank_correlation(a, b) == pytest.approx(expected)
    assert np.isnan(se_transfer_of_hparams.rank_correlation(np.ones(4), b[:4]))


def tuning_rows():
    """Three configurations with two agents each; on the SE the last is best, in truth the first."""
    returns = {"se": [[10, 10], [20, 20], [30, 30]], "same": [[90, 80], [50, 100], [40, 30]]}
    return pd.DataFrame([
        {"world": world, "config": config, "agent": agent, "test_return": float(x),
         "train_steps": 100, "cpu_s": 0.5}
        for world, configs in returns.items() for config, agents in enumerate(configs)
        for agent, x in enumerate(agents)
    ])  # fmt: skip


def test_one_half_of_the_real_agents_judges_what_the_other_chose(tmp_path):
    rows = tuning_rows()
    se, same = (se_transfer_of_hparams.returns_by_half(rows, x) for x in ("se", "same"))
    np.testing.assert_array_equal(se, [[10, 20, 30]] * 2)
    np.testing.assert_array_equal(same, [[90, 50, 40], [80, 100, 30]])
    # Even agents choose the first, worth 80 to the odd ones; these the second, worth 50 to those.
    # The SE chooses the last, worth 30 and 40; a random one is worth 65. Ranks of the means 85, 75
    # and 35 are those of the SE turned round; the halves rank 3 2 1 and 2 3 1.
    own = se_transfer_of_hparams.quality(same, same)
    assert own == pytest.approx({"rho": 0.5, "chosen": 65, "regret": 0, "regret_random": 0})
    by_se = se_transfer_of_hparams.quality(se, same)
    assert by_se == pytest.approx({"rho": -1, "chosen": 35, "regret": 30, "regret_random": 0})

    summary = se_transfer_of_hparams.summarise(rows)
    assert summary["chosen_by"].tolist() == ["se", "same"]
    assert summary["train_steps"].tolist() == [600, 300]
    assert summary["cpu_s"].tolist() == [3, 1.5]
    assert summary["regret_high"][0] >= 30 >= summary["regret_low"][0]
    assert (summary["regret_low"][1], summary["regret_high"][1]) == (0, 0)
    text = se_transfer_of_hparams.findings(summary)
    assert "loses 30.0 [" in text and "took 2.00 times the steps" in text
    se_transfer_of_hparams.draw(envs.make("cartpole"), rows, tmp_path / "s.png")
    assert is_drawn(tmp_path / "s.png")


def test_agents_of_a_configuration_share_what_is_drawn():
    """Stands in for training: an agent's "return" is its learning rate, and a number of its own."""
    config = sejax.DDQNConfig(hidden_size=2, num_layers=1)
    agent = sejax.make_agent(config, envs.make("cartpole"), varied=True)
    hparams = {"learning_rate": 0.0}

    def evaluator(agent, env, task, training):
        hparams["learning_rate"] = agent.hparams.learning_rate
        return lambda key, env_params, active: (
            agent.hparams.learning_rate, jax.random.uniform(key)
        )  # fmt: skip

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sejax, "make_evaluator", evaluator)
        run = se_transfer_of_hparams.make_shared_draws(agent, None, None, None)
        places = [np.asarray(jax.random.key_data(jax.random.key(i))) for i in (0, 1)]
        made = {(i, seed): run(jax.random.key(seed), (None, places[i]), True)
                for i in (0, 1) for seed in (0, 1)}  # fmt: skip
    rates = {place: float(result[0]) for place, (result, _) in made.items()}
    assert rates[0, 0] == rates[0, 1] != rates[1, 0] == rates[1, 1]
    assert rates[0, 0] == float(made[0, 0][1]["learning_rate"])
    assert rates[0, 0] == float(agent.drawn_values(jax.random.key(0))["learning_rate"])
    assert made[0, 0][0][1] != made[0, 1][0][1]


def test_a_tuned_agent_trains_on_the_real_task_as_long_as_on_the_se():
    of = se_transfer_of_hparams.SeTransferOfHparams.of
    parts = se_transfer_of_hparams.parts_of(of(run=["agent.batch_size=7"]))
    assert parts.agent.batch_size == 7 and parts.ses.size == 1
    trainings = parts.trainings
    assert list(trainings) == ["se", "same", "long"]
    assert trainings["same"].max_steps == trainings["se"].max_steps == 2000
    assert trainings["same"].stop_rule == "never" and trainings["long"].stop_rule == "solved"
    assert dataclasses.asdict(trainings["long"])["max_steps"] == 100_000
    with pytest.raises(ConfigError, match=r"ses must be of acrobot.*env=cartpole"):
        se_transfer_of_hparams.parts_of(of(env="acrobot", ses="cartpole"))
    with pytest.raises(ConfigError, match="num_agents must be at least 2"):
        of(num_agents=1)
