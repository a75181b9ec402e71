"""The experiments on SEs that teach through their dynamics."""

import numpy as np
import pandas as pd
import pytest
from support import refuse, refused
from test_experiments import save_ses

from experiments import se_dynamics, se_myopia
from experiments.common import runs
from experiments.common.statistics import mean_interval

# --- the myopia test ------------------------------------------------------------------------------


def agent_rows(group, by_discount):
    """Rows of agents on one SE, given their returns by discount."""
    return pd.concat(
        pd.DataFrame({"group": group, "discount": discount, "agent": range(len(returns)),
                      "test_return": np.asarray(returns, float), "train_steps": 100,
                      "train_episodes": 20})
        for discount, returns in by_discount.items()
    )  # fmt: skip


@pytest.mark.parametrize(("myopic", "far", "verdict"), [
    ([98, 99, 100, 101, 102], [100, 100, 100, 100, 100], "policy"),
    ([0, 1, 2, 3, 4], [98, 99, 100, 101, 102], "dynamics"),
    ([0, 1, 2, 3, 4], [3, 4, 2, 1, 0], "teaches little"),
    ([0, 100, 0, 100, 0], [100, 100, 100, 100, 100], "open"),
    ([0, 100, 0, 100, 0], [0, 100, 0, 100, 0], "open"),  # equal, but does it teach anything?
    ([100, 100, 100, 100, 100], [0, 0, 0, 0, 0], "teaches little"),
    ([0, 0, 0, 0], [100, 100, 100, 100], "open"),  # too few agents for an interval
])  # fmt: skip
def test_a_verdict_is_read_off_intervals(myopic, far, verdict):
    rows = agent_rows("a", {0.0: myopic, 0.5: [7] * len(far), 0.99: far})
    (found,) = se_myopia.verdicts(rows, 0.0, 100.0).to_dict("records")
    assert found["verdict"] == verdict and found["group"] == "a"
    lost = np.subtract(far, myopic)
    expected = [lost.mean(), *mean_interval(lost)]
    np.testing.assert_allclose([found[x] for x in ("loss", "loss_low", "loss_high")], expected)


def test_sets_are_summarised_over_their_ses_and_share_those_that_are_in_both():
    same = {"horizon": 9, "at_limit": "cut", "done": "soft", "initial_state": "real"}
    ses = pd.DataFrame([{"set": "one", "group": "a", **same}, {"set": "two", "group": "a", **same},
                        {"set": "two", "group": "b", **same}])  # fmt: skip
    agents = pd.concat([
        agent_rows("a", {0.0: [100] * 10, 0.99: [100] * 10}),
        agent_rows("b", {0.0: [0] * 10, 0.99: [100] * 9 + [20]}).assign(train_episodes=5),
        agent_rows("untrained", {np.nan: [-1.0, 1.0]}),
    ])  # fmt: skip
    one, two = se_myopia.summarise(ses, agents, 100.0).to_dict("records")
    assert one["verdict"] == "policy" and one["num_ses"] == 1 and one["untrained"] == 0
    assert two["verdict"] == "policy 1 of 2, dynamics 1 of 2" and two["num_ses"] == 2
    assert (one["steps"], two["steps"]) == (5, 8), "2000 steps in 250 episodes"
    assert one["return_0_mean"] == 100 and two["return_0_mean"] == 50
    assert one["return_0_low"] == 100 and np.isnan(two["return_0_low"]), "two SEs are too few"
    assert two["return_0_99_worst"] == 60, "of twenty agents the two worst, 20 and 100"


def test_ses_are_found_by_their_task_and_named_by_their_file(tmp_path):
    files = [save_ses(tmp_path / "set" / "ses.safetensors", 3),
             save_ses(tmp_path / "runs" / "seed0" / "proxy.safetensors", 1),
             save_ses(tmp_path / "other.safetensors", 1, "env=acrobot"), "cartpole"]  # fmt: skip
    found = list(se_myopia.find(se_myopia.SeMyopia.of(ses=files, num_ses=2)))
    names = [str(tmp_path / "set")] * 2 + [str(tmp_path / "runs"), "cartpole (shipped)"]
    assert [se.set for se in found] == names
    assert [se.proxy.record["seed"] for se in found[:3]] == [7, 8, 7]
    (other,) = se_myopia.find(se_myopia.SeMyopia.of(ses=files, env="acrobot"))
    assert other.set == str(tmp_path / "other") and other.ses.task.name == "acrobot"


# --- kinds of SEs ---------------------------------------------------------------------------------


def curve_rows(kind, seed, incumbents):
    """The generations of a run, each of 10 real steps and 2 CPU seconds."""
    steps = range(1, len(incumbents) + 1)
    return pd.DataFrame({"kind": kind, "seed": seed, "generation": range(len(incumbents)),
                         "incumbent_mean": np.asarray(incumbents, float), "population_mean": 0.0,
                         "env_steps_total": [10 * x for x in steps], "cpu_s": 2.0})  # fmt: skip


def test_a_run_costs_what_it_spent_until_its_first_incumbent_that_solves():
    curves = pd.concat([curve_rows("bandit", 0, [3, 100, 50]), curve_rows("bandit", 1, [1, 2, 3])])
    solved, unsolved = runs.summarise(curves, ["kind", "seed"], 100.0).to_dict("records")
    costs = ["generations_to_solve", "steps_to_solve", "cpu_s_to_solve"]
    assert [solved[x] for x in costs] == [2, 20, 4]
    assert [unsolved[x] for x in costs] == [np.inf] * 3
    reached = ["generations", "best_incumbent_mean", "last_incumbent_mean", "steps", "cpu_s"]
    assert [solved[x] for x in reached] == [3, 100, 50, 30, 2]


def test_kinds_are_summarised_over_their_runs():
    curves = pd.concat([curve_rows("bandit", 0, [100]), curve_rows("bandit", 1, [0, 0]),
                        curve_rows("soft", 0, [0, 100, 100])])  # fmt: skip

    def agents(kind, seed, myopic, far, fresh):
        students = {np.nan: [fresh] * 5, 0.0: [myopic] * 5, 0.99: [far] * 5}
        rows = agent_rows(f"seed{seed}", students).assign(kind=kind, seed=seed)
        return rows.assign(student=np.where(rows["discount"].isna(), "ddqn", None))

    rows = pd.concat([agent_rows("untrained", {np.nan: [-1.0, 1.0]}),
                      agents("bandit", 0, 100, 100, 80), agents("bandit", 1, 0, 0, 20),
                      agents("soft", 0, 10, 100, 40)])  # fmt: skip
    found = se_dynamics.summarise(curves, rows, 100.0).set_index("kind").T
    expected = {
        "runs": (2, 1), "first_solved": (1, 1), "solved": (1, 1), "untrained": (0, 0),
        "generations_to_solve": (np.inf, 2), "policy": (1, 0), "teaches little": (1, 0),
        "dynamics": (0, 1), "on_ddqn_mean": (50, 40), "return_0_mean": (50, 10),
        "return_0_99_mean": (50, 100), "episode_steps": (5, 5),  # 100 steps in 20 episodes
    }  # fmt: skip
    assert {name: tuple(found.loc[name]) for name in expected} == expected


@pytest.mark.parametrize(("page", "given", "field"), [
    (se_dynamics, {"kinds": ["hard"]}, "kinds"), (se_dynamics, {"students": ["dqnn"]}, "students"),
    (se_dynamics, {"students": ["ddqn", "td3"]}, "agent"),
    (se_dynamics, {"max_steps": 100, "kinds": ["soft"]}, "training"),
    (se_myopia, {"discounts": [0.9]}, "discounts"),
    (se_myopia, {"env": "pendulum", "ses": "cartpole"}, "ses"),
])  # fmt: skip
def test_settings_that_cannot_work_are_refused_before_any_run(
    page, given, field, tmp_path, monkeypatch
):
    monkeypatch.setattr(se_dynamics.runs, "learn", refuse)

    def run():
        page.EXPERIMENT.run(page.EXPERIMENT.settings.of(out=str(tmp_path), **given))

    assert refused(run).startswith(field)
