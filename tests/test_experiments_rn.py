"""The experiments on reward networks: what agents reach with them, and what they have learned."""

import dataclasses
import json
import lzma

import numpy as np
import pandas as pd
import pytest
from test_experiments import CURVES, RNS, fields, refuse_to_compute

import sejax
from experiments import rn_heatmap, rn_performance
from experiments.common import curves, rn_curves, shards
from experiments.common import reward_networks as rn
from experiments.common.statistics import mean_interval
from experiments.rn_heatmap import RnHeatmap
from experiments.rn_performance import RnPerformance
from sejax.options import ConfigError
from sejax.runs import session


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
    np.testing.assert_allclose(rns.scores, curve["incumbent_mean"], rtol=1e-6)
    best = rns.ranked(2)
    assert list(best.scores) == sorted(rns.scores)[:0:-1]
    used = weights_of(settings, "default-additive_potential")
    assert used == {best[0].fingerprint, best[1].fingerprint}

    refuse_to_compute(monkeypatch)
    counts = run(dataclasses.replace(settings, bonus_groups=1)).set_index("trained with")
    assert counts["groups, agents"].tolist() == ["2, 4", "1, 2", "2, 4", "2, 4"]
    for nothing in (("none",), ()):
        without = run(dataclasses.replace(settings, bonuses=nothing))
        expected = table[table["trained with"] != "count_based"].reset_index(drop=True)
        pd.testing.assert_frame_equal(without, expected)


@pytest.mark.slow
def test_a_set_grows_by_the_rns_that_it_lacks(options, monkeypatch):
    settings = options(RnPerformance)
    three = rn.learn(settings, "additive_potential", "reward_threshold")
    before, run, learned = three.path.read_bytes(), session.run, []

    def run_and_count(config, *rest):
        learned.append(config.seed)
        return run(config, *rest)

    monkeypatch.setattr(session, "run", run_and_count)
    more = dataclasses.replace(settings, learned=4)
    four = rn.learn(more, "additive_potential", "reward_threshold")
    assert learned == [6] and list(four.seeds) == [3, 4, 5, 6]
    assert list(four.scores[:3]) == list(three.scores)
    assert [x.fingerprint for x in four][:3] == [x.fingerprint for x in three]
    assert len({x.fingerprint for x in four}) == 4
    grown = shards.read_rows(four.path.with_name("curves.csv.xz"))
    assert list(grown["seed"]) == [3, 4, 5, 6]
    three.path.write_bytes(before)  # as if killed before the set was written
    again = rn.learn(more, "additive_potential", "reward_threshold")
    assert list(again.seeds) == [3, 4, 5, 6]
    assert shards.read_rows(four.path.with_name("curves.csv.xz")).equals(grown)


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


def test_the_heat_map_shows_what_the_rns_pay(options):
    settings = options(RnHeatmap, RNS)
    table = rn_heatmap.EXPERIMENT.run(settings)
    assert list(table["variant"]) == list(settings.variants)
    summary = pd.read_csv(settings.summary_file).set_index(["variant", "move"])
    # 11 moves into the cliff cost 100 and only the additive RNs pay the real reward as well.
    assert summary.loc[("additive_potential", "into the cliff"), "mean"] < -90
    assert summary.loc[("exclusive_non_potential", "into the cliff"), "mean"] > -10

    rns = rn.learn(settings, "exclusive_non_potential", "reward_threshold")
    rewards = rn_heatmap.rewards_of_moves(rns)
    assert rewards.shape == (3, 48, 4) and np.isnan(rewards[:, 37:]).all()
    potential = [float(rns.env.potential(rns[1].params, np.int32(s))) for s in (24, 0)]
    # From the start (row 3) UP leads to state 24, and UP from state 0 stays there.
    np.testing.assert_allclose(rewards[1, [36, 0], 3], potential, rtol=1e-5)
    stored = rn_heatmap.by_variant(settings, shards.read_rows(settings.rows_file))
    np.testing.assert_allclose(stored["exclusive_non_potential"], rewards, rtol=1e-6)


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
    alone = rn_curves.summarise(curves_of("icm", 2), max_steps=300)
    assert rn_curves.make_table(alone)["share of those without an RN"].tolist() == [""]


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


def test_settings_are_those_of_the_task():
    """What is not given is the paper's, or what makes a small version of it."""
    usual = RnPerformance.of(env="cartpole")
    assert (usual.learned, usual.rns, usual.bonus_groups, usual.max_steps) == (10, 10, 10, 50_000)
    assert usual.bonuses == ("icm",) and usual.rows == ("default", "varied", "transfer", "tuned")
    training = {row: usual.training(row) for row in usual.rows}
    assert training["default"].stop_rule == "never" and training["default"].tests_between == 1
    assert training["varied"].time_limit_is_terminal > training["tuned"].time_limit_is_terminal
    assert usual.agent("tuned") == sejax.config(["env=cartpole", "agent=ddqn"]).agent
    car = RnPerformance.of(env="mountain_car_continuous")
    assert car.agent("tuned").rollout_steps == 256
    assert car.agent("varied") == sejax.config([f"env={car.env}", "proxy=rn"]).agent
    for variant, scale in (("exclusive_non_potential", 0.1), ("exclusive_potential", 1.0)):
        assert rn.learning_config(car, variant, "reward_threshold").proxy.output_scale == scale
