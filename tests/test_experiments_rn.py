"""The experiments on reward networks: what agents reach with them, and what they have learned."""

import dataclasses
import json
import lzma

import numpy as np
import pandas as pd
import pytest
from test_experiments import CURVES, fields, refuse_to_compute

import sejax
from experiments import rn_performance
from experiments.common import curves, rn_curves, shards
from experiments.common import reward_networks as rn
from experiments.common.statistics import mean_interval
from experiments.rn_performance import RnPerformance
from sejax.options import ConfigError


@pytest.fixture(scope="module")
def rns_dir(tmp_path_factory):
    """Reward networks that all experiments here use."""
    return tmp_path_factory.mktemp("rns")


@pytest.fixture
def options(rns_dir, tmp_path):
    """`options(settings, tiny, **given)`: the settings of an experiment that uses those."""

    def make(settings, tiny=CURVES, **given):
        folders = {"out": str(tmp_path), "rns_dir": str(rns_dir)}
        return settings.of(**fields(tiny, **folders, **{"learned": 3} | given))

    return make


def weights_of(settings, prefix):
    """Fingerprints of the RNs that a condition used, as its settings say."""
    made_with = json.loads(lzma.decompress(settings.settings_file.read_bytes()))
    return {x["weights"] for name, x in made_with.items() if name.startswith(f"{prefix}-0")}


@pytest.mark.slow
def test_rns_are_learned_stored_and_used_once(options, rns_dir, monkeypatch):
    settings = options(RnPerformance, rns=2)
    run = rn_performance.EXPERIMENT.run
    table = run(settings)
    assert list(table["trained with"]) == ["real", "count_based", *settings.variants]
    assert set(table["groups, agents"]) == {"2, 4"}
    folder = rns_dir / "cliff_walking" / "reward_threshold"
    rns = sejax.load_set(folder / "additive_potential.safetensors", kind="rn")
    assert len(rns) == 3 and rns.config["objective"]["name"] == "reward_threshold"
    assert list(rns.seeds) == [3, 4, 5]

    # The best two of three, by the scores of the runs' incumbents.
    curve = shards.read_rows(folder / "curves.csv.xz")
    curve = curve[curve["variant"] == "additive_potential"]
    np.testing.assert_allclose(rns.scores, curve["incumbent_mean"], rtol=1e-6)
    best = rns.ranked(2)
    assert list(best.scores) == sorted(rns.scores)[:0:-1]
    used = weights_of(settings, "default-additive_potential")
    assert used == {best[0].fingerprint, best[1].fingerprint}

    refuse_to_compute(monkeypatch)
    without = run(dataclasses.replace(settings, bonuses=("none",)))
    expected = table[table["trained with"] != "count_based"].reset_index(drop=True)
    pd.testing.assert_frame_equal(without, expected)


@pytest.mark.slow
def test_rns_of_other_settings_are_refused_before_any_are_learned(options, monkeypatch):
    settings = options(RnPerformance, rns=2)
    for variant in settings.variants:
        rn.learn(settings, variant, settings.objective)
    refuse_to_compute(monkeypatch)
    variants = ("exclusive_potential", *settings.variants)  # the first is yet to be learned
    run = (*settings.run, "proxy.hidden_size=7")
    other = dataclasses.replace(settings, run=run, variants=variants)
    with pytest.raises(ConfigError, match=r"another proxy\.hidden_size"):
        rn_performance.EXPERIMENT.run(other)


def curves_of(world, num_groups, solved_reward=-12.0):
    """Episodes of 10 steps; agent i of group g is good from its episode 5 + 2 g + i on."""
    rows = pd.concat([
        pd.DataFrame({
            "row": "default", "world": world, "group": g, "agent": 2 * g + i,
            "steps": np.arange(10, 310, 10),
            "test_return": ([-50.0] * (4 + 2 * g + i) + [-12.0] * 30)[:30],
        })
        for g in range(num_groups) for i in range(2)
    ])  # fmt: skip
    return curves.thinned(rows, rn_curves.step_grid(300), solved_reward)


def test_the_summary_is_over_agents():
    (row,) = rn_curves.summarise(curves_of("real", 2), max_steps=300).itertuples()
    # Ten tests in a row: solved at episodes 14, 15, 16 and 17.
    assert row.steps_mean == np.mean([140, 150, 160, 170]) and row.solved == 1.0
    assert row.last_return == -12.0 and -50 < row.return_mean < -12
    never = rn_curves.summarise(curves_of("real", 2, 0.0), max_steps=300).iloc[0]
    assert never["steps_mean"] == 300 and never["solved"] == 0.0


def test_shares_are_of_the_groups_of_the_same_seeds():
    # Steps to solve of group g: 140 + 20 g and 150 + 20 g.
    turned = pd.concat([curves_of("icm", 2), curves_of("real", 5), curves_of("real_rn", 5)])
    summary = rn_curves.summarise(turned, max_steps=300)
    assert summary["steps_mean"].tolist() == [155, 185, 185]
    assert summary["share_of_bare"].tolist() == [1, 1, 1]
    assert rn_curves.summarise(curves_of("icm", 2), max_steps=300)["share_of_bare"].isna().all()


@pytest.mark.parametrize(("world", "groups", "drawn", "independent"), [
    ("real", 5, "10 agents", 140 + 10 * np.arange(10)), ("icm", 2, "", None),
    ("additive_potential", 5, "5 RNs", 145 + 20 * np.arange(5)),  # the groups' means
    ("exclusive_potential", 4, "", None),
])  # fmt: skip
def test_intervals_are_over_rns_or_agents_and_need_five_of_them(world, groups, drawn, independent):
    summary = rn_curves.summarise(curves_of(world, groups), max_steps=300)
    (row,), (cells,) = summary.itertuples(), rn_curves.make_table(summary).to_dict("records")
    assert cells["interval over"] == drawn
    assert ("[" in cells["mean return over training"]) == bool(drawn)
    if drawn:
        assert (row.steps_low, row.steps_high) == mean_interval(independent)
        assert row.return_low < row.return_mean < row.return_high
