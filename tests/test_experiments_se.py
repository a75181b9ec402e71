"""The experiments with SEs: what their tables say, worked out by hand, and what they train."""

from types import SimpleNamespace

import jax
import numpy as np
import pandas as pd
import pytest
import yaml
from support import assert_equal, refused
from test_experiments import TINY, TINY_AGENT, fields, save_ses, tiny

import sejax
from experiments import se_feasibility, se_performance
from experiments.common import runs, shards
from experiments.common.statistics import mean_interval
from sejax import envs
from sejax.options import ConfigError
from sejax.runs.config import LearnConfig

tiny_agents = tiny  # a fixture


@pytest.fixture(scope="module")
def ses(tmp_path_factory):
    """A file with three SEs of random weights."""
    return save_ses(tmp_path_factory.mktemp("s") / "s.safetensors", 3, "training.max_steps=40")


def run(name, module, out, **given):
    """The table of an experiment with tiny settings."""
    options = fields(TINY[name].replace("fixed=SE", ""), out=str(out), **given)
    return module.EXPERIMENT.run(module.EXPERIMENT.settings.of(**options))


# --- feasibility, and runs with a budget ----------------------------------------------------------


@pytest.mark.slow
def test_feasibility_learns_as_sejax_run_does_and_goes_on(tmp_path):
    def learned(**given):
        run("se_feasibility", se_feasibility, tmp_path, **given)
        return shards.read_rows(tmp_path / "rows.csv.xz").drop(columns=["wall_s", "cpu_s"])

    first, made = learned(generations=1), learned(generations=3)
    assert made.groupby("seed").size().to_dict() == {3: 3, 4: 3}
    pd.testing.assert_frame_equal(made[made["generation"] == 0].reset_index(drop=True), first)
    config = yaml.safe_load((tmp_path / "work/runs/seed4/config.yaml").read_text())
    result = jax.jit(sejax.make_learner(LearnConfig.of_stored(config)))(jax.random.key(4))
    incumbents = made[made["seed"] == 4]["incumbent_mean"]
    np.testing.assert_allclose(incumbents, result.info.incumbent_mean, rtol=1e-6)
    stored = sejax.load_set(tmp_path / "ses.safetensors")
    assert stored.seeds.tolist() == [3, 4]
    assert_equal(stored[1].params.weights, result.weights)
    assert stored.scores[1] == pytest.approx(float(result.score))
    assert refused(learned, generations=2) == "generations"
    assert refused(learned, run=["proxy=rn"]) == "run.proxy"


def test_a_cost_whose_generation_was_lost_is_written_again(tmp_path):
    path = tmp_path / "cpu_s.txt"
    assert runs.read_costs(path, 3).tolist() == []
    path.write_text("0.500\n0.250\n7.000\n")
    assert runs.read_costs(path, 2).tolist() == [0.5, 0.25]
    # Generations 3 and 4 were not timed.
    runs.timed(SimpleNamespace(advance=print), path).advance(SimpleNamespace(generation=5), 2)
    assert np.isnan(runs.read_costs(path, 9)).tolist() == [False] * 3 + [True] * 2 + [False] * 2
    path.write_text("0.500\nx")
    with pytest.raises(ConfigError, match=r"cpu_s\.txt is damaged"):
        runs.read_costs(path, 2)


# --- performance, and single SEs ------------------------------------------------------------------


def made_up_agents(num_ses=4, num_agents=6):
    """Agents of a kind in a setting; SE g has mean return about 10 g."""
    rng = np.random.default_rng(0)
    return pd.DataFrame([
        {"kind": "td3_discrete", "setting": "varied", "group": f"se{g}", "se": g, "agent": a,
         "train_steps": rng.integers(10, 99), "train_episodes": rng.integers(1, 9),
         "nonfinite": False, "test_return": 10.0 * g + rng.normal()}
        for g in range(num_ses) for a in range(num_agents)
    ])  # fmt: skip


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


def test_the_best_ses_are_shown_by_agents_that_did_not_select_them():
    agents = made_up_agents()
    agents.loc[(agents["group"] == "se0") & (agents["agent"] % 2 == 1), "test_return"] = 999
    best = se_performance.select_best(agents, count=2)
    assert set(best["group"]) == {"se2", "se3"} and set(best["agent"]) == {1, 3, 5}
    assert set(se_performance.select_best(agents)["group"]) == {"se1", "se2", "se3"}
    settings = se_performance.with_best(agents)["setting"].value_counts()
    assert settings.to_dict() == {"varied": 24, "best": 9}
    assert "best" not in set(se_performance.with_best(agents[agents["group"] == "se0"])["setting"])


@pytest.mark.slow
def test_performance_trains_as_evaluation_does(ses, tmp_path, tiny_agents):
    """Agents of the second groups are those of `make_evaluator` with the same keys and draws."""
    table = run("se_performance", se_performance, tmp_path, fixed=ses, num_agents=3, num_ses=2)
    rows = shards.read_rows(tmp_path / "rows.csv.xz")
    assert rows.groupby("setting").size().to_dict() == {"real": 6, "fixed": 6}
    assert table["trained on"].tolist() == ["real", "synth., HPs fixed"]
    np.testing.assert_allclose(rows["return_0"] + rows["return_1"], 2 * rows["test_return"])
    on_se, on_task = (rows[rows["setting"] == name] for name in ("fixed", "real"))
    assert (on_se["train_steps"] == 40).all()

    one, task = sejax.load_set(ses)[1], envs.make("cartpole")
    key = jax.random.fold_in(jax.random.key(3), 1)
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(np.arange(3))
    agent = sejax.make_agent(sejax.DDQNConfig(**TINY_AGENT), task, varied=True)
    solved = {"max_steps": 4000, "max_episodes": 3, "stop_rule": "solved", "solved_by": "train"}
    never = {"max_steps": 40, "max_episodes": 1000, "stop_rule": "never"}
    for group, rows, proxy, limits in (
        (f"se-08-{one.fingerprint}", on_se, one, never),
        ("real-01", on_task, task, solved),
    ):
        training = sejax.TrainingConfig(**limits, test_episodes=2)
        evaluate = sejax.make_evaluator(agent, proxy.env, task, training)
        run_all = jax.jit(
            lambda keys, params, run=evaluate: jax.lax.map(lambda key: run(key, params), keys)
        )
        expected = run_all(keys, proxy.params)
        found = rows[rows["group"] == group]
        np.testing.assert_allclose(found["test_return"], expected.test_return, rtol=1e-6)
        np.testing.assert_array_equal(found["train_steps"], expected.train_steps)
    # Agents of equal number draw equal hyperparameters in all settings.
    for name in ("learning_rate", "batch_size", "hidden_size", "num_layers"):
        np.testing.assert_array_equal(on_task[name], on_se[name])
        assert on_task[name].nunique() > 1


def test_ses_learned_otherwise_or_of_another_task_are_refused(ses, tmp_path):
    other = save_ses(tmp_path / "other.safetensors", 1, "env=acrobot", "agent_hparams=varied")
    for field, given in (("varied", {"varied": ses, "fixed": None}),
                         ("fixed", {"fixed": ses, "varied": other})):  # fmt: skip
        assert refused(run, "se_performance", se_performance, tmp_path, **given) == field
