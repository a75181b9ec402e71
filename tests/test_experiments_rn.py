"""The experiment on what agents reach with reward networks."""

import numpy as np
import pandas as pd
import pytest
from support import experiment_options, refuse

from sejax.errors import ConfigError
from sejax.experiments import common, proxy_runs, rn_performance
from sejax.experiments.proxy_sets import load_set

TINY = ["--variants", "additive_potential", "--rns", "2", "--num-agents", "2", "--generations", "1",
        "--max-steps", "150", "--rows", "default"]  # fmt: skip


def test_rns_are_learned_stored_and_used_once(tmp_path, monkeypatch):
    monkeypatch.setattr(rn_performance, "QUICK_POPULATION", 2)
    args = experiment_options(rn_performance, tmp_path, *TINY)
    table = rn_performance.run(args)
    assert list(table["trained with"]) == ["real", "count_based", "additive_potential"]
    assert set(table["groups, agents"]) == {"2, 4"}
    assert (tmp_path / "performance.png").stat().st_size > 10_000
    rns = load_set(tmp_path / "rns-additive_potential.safetensors", kind="rn")
    assert rns.size == 2 and rns.config.objective.name == "reward_threshold"
    assert rns.fingerprint(0) != rns.fingerprint(1)
    with pytest.raises(ConfigError, match="proxy=se"):
        load_set(tmp_path / "rns-additive_potential.safetensors")

    monkeypatch.setattr(rn_performance, "train_group", refuse)
    monkeypatch.setattr(proxy_runs, "learn_one", refuse)
    pd.testing.assert_frame_equal(rn_performance.run(args), table)


def test_the_summary_is_over_agents_and_its_intervals_over_groups():
    # Episodes of 10 steps; agent i of group g is good from its episode 5 + 2 g + i on.
    frames = [
        pd.DataFrame({
            "row": "default", "world": "real", "group": g, "agent": 2 * g + i,
            "steps": np.arange(10, 310, 10),
            "test_return": ([-50.0] * (4 + 2 * g + i) + [-12.0] * 30)[:30],
        })
        for g in range(2) for i in range(2)
    ]  # fmt: skip
    summary = rn_performance.summarise(pd.concat(frames), -12.0, max_steps=300)
    (row,) = summary.itertuples()
    # Ten tests in a row: solved at episodes 14, 15, 16 and 17.
    assert row.steps_to_solve == np.mean([140, 150, 160, 170]) and row.solved == 1.0
    assert row.steps_low == 145 and row.steps_high == 165  # the groups' means
    assert row.last_return == -12.0
    # Returns held over the next episode's steps, on a grid that begins before the first one ends.
    assert -50 < row.return_low < row.mean_return < row.return_high < -12
    never = rn_performance.summarise(pd.concat(frames), 0.0, max_steps=300).iloc[0]
    assert never["steps_to_solve"] == 300 and never["solved"] == 0.0


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--env", "acrobot"], "cartpole"),
        (["--variants", "additive"], "additive_potential"),
        (["--rows", "varied", "transfers"], "transfer"),
        (["--rns", "0"], "at least 1"),
        (["--objective", "steps"], "reward_threshold"),
    ],
)
def test_what_cannot_work_is_refused(tmp_path, given, said):
    with pytest.raises(ConfigError, match=said):
        rn_performance.run(experiment_options(rn_performance, tmp_path, *given))


def test_leading_words_are_options_too():
    words = ["env=cartpole", "max_steps=7", "--quick", "--set", "a=1"]
    expected = ["--env", "cartpole", "--max-steps", "7", "--quick", "--set", "a=1"]
    assert common.as_options(words) == expected
    assert common.as_options([]) == []
