"""The experiments with SEs: what their tables say, worked out by hand, and what they train."""

import jax
import numpy as np
import pandas as pd
import pytest
import yaml
from support import paper_training, refused
from test_experiments import TINY, TINY_AGENT, save_ses

import sejax
from experiments import se_feasibility, se_performance
from experiments.common import agents, figures, runs, shards
from experiments.common.statistics import (
    mean_interval,
)
from sejax import envs
from sejax.options import ConfigError
from sejax.runs import config as configuration


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


@pytest.mark.parametrize("solved, text", [
    ([100, 300, 200], "200"), ([100, 200, np.inf], "200"), ([100, np.inf, np.inf], "> 900"),
])  # fmt: skip
def test_a_run_that_did_not_solve_the_task_took_more_steps_than_all(solved, text):
    runs = pd.DataFrame({"steps_to_solve": solved, "steps": [900, 950, 1000], "wall_min": 1.0,
                         "generations": 9, "generations_to_solve": 3.0,
                         "best_incumbent_mean": 0.0, "last_incumbent_mean": 0.0})  # fmt: skip
    table = se_feasibility.make_table(sejax.config(["env=cartpole"]), runs)
    row = table["of the NES runs"] == "real steps to the first passage, median"
    assert table["sejax"][row].item() == text


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
    assert refused(learned, run=["proxy=rn"]) == "run.proxy"


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
    assert "[" not in se_performance.make_table("cartpole", few, 1000)["return"][0]


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


def check_as_evaluation(ses, rows):
    """Agents of the second groups are those of `make_evaluator` with the same keys and draws."""
    loaded, task = sejax.load_set(ses), envs.make("cartpole")
    key = jax.random.fold_in(jax.random.key(3), 1)
    keys = jax.numpy.stack([jax.random.fold_in(key, i) for i in range(3)])
    mine = rows[rows["group"] == f"se-{loaded.seeds[1]:02d}-{loaded[1].fingerprint}"]
    training = paper_training(max_steps=40, stop_rule="never", test_episodes=2)
    expected = evaluated(loaded.env, loaded[1].params, task, training, keys)
    np.testing.assert_allclose(mine["test_return"], expected.test_return, rtol=1e-6)
    np.testing.assert_allclose(mine["return_0"] + mine["return_1"], 2 * mine["test_return"])
    assert (mine["train_steps"] == 40).all() and mine["hidden_size"].between(1, 6).all()
    mine = rows[rows["group"] == "real-01"]
    training = sejax.TrainingConfig(max_episodes=3, max_steps=4000, stop_rule="solved",
                                    solved_by="train", test_episodes=2)  # fmt: skip
    expected = evaluated(task.env, task.params, task, training, keys)
    np.testing.assert_allclose(mine["test_return"], expected.test_return, rtol=1e-6)
    np.testing.assert_array_equal(mine["train_steps"], expected.train_steps)


def evaluated(env, params, task, training, keys):
    """Outcomes of agents that draw their hyperparameters, one after another."""
    varied = sejax.make_agent(sejax.DDQNConfig(**TINY_AGENT), task, varied=True)
    evaluate = sejax.make_evaluator(varied, env, task, training)
    return jax.jit(lambda keys: jax.lax.map(lambda key: evaluate(key, params), keys))(keys)


def test_ses_learned_otherwise_or_of_another_task_are_refused(ses, tmp_path):
    other = save_ses(tmp_path / "other.safetensors", 1, "env=acrobot", "agent_hparams=varied")
    for field, given in (("varied", {"varied": ses, "fixed": None}),
                         ("fixed", {"fixed": ses, "varied": other})):  # fmt: skip
        assert refused(run, "se_performance", se_performance, tmp_path, **given) == field
