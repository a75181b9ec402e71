"""The experiments on reward networks: what agents reach with them, and what they have learned."""

import dataclasses
import importlib
import re
import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support import is_drawn, refuse

import sejax
from experiments import (
    pieces,
    proxy_runs,
    rn_curves,
    rn_heatmap,
    rn_objectives,
    rn_performance,
    rn_studies,
    timings,
    worlds,
)
from experiments.experiment import parse
from experiments.proxy_runs import RunSettings
from experiments.rn_heatmap import RnHeatmap
from experiments.rn_objectives import RnObjectives
from experiments.rn_performance import RnPerformance
from experiments.rn_studies import RnSettings
from experiments.statistics import bootstrap_interval
from sejax.cli import build, session
from sejax.errors import ConfigError

LEARN = {"variants": ("additive_potential", "exclusive_non_potential"), "learned": 3,
         "generations": 1, "run": ("training.max_episodes=5", "es.population_size=2")}  # fmt: skip
TRAIN = {"num_agents": 2, "max_steps": 150, "rows": "default"}


@pytest.fixture(scope="module")
def rns_dir(tmp_path_factory):
    """Reward networks that all experiments here use."""
    return tmp_path_factory.mktemp("rns")


@pytest.fixture
def options(rns_dir, tmp_path):
    """`options(settings, **given)`: the settings of an experiment that uses those."""
    usual = {"quick": True, "seed": 3, "out": str(tmp_path), "rns_dir": str(rns_dir), **LEARN}
    return lambda settings, **given: settings.of(**(usual | given))


def pieces_of(folder, prefix):
    """Settings of the pieces of that name."""
    return [pd.read_json(path, typ="series")
            for path in sorted((folder / "work" / "pieces").glob(f"{prefix}-*.json"))]  # fmt: skip


def refuse_to_compute(monkeypatch):
    monkeypatch.setattr(worlds, "train", refuse)
    monkeypatch.setattr(session, "run", refuse)


@pytest.mark.slow
def test_rns_are_learned_stored_and_used_once(options, rns_dir, tmp_path, monkeypatch):
    settings = options(RnPerformance, rns=2, **TRAIN)
    run = rn_performance.EXPERIMENT.run
    table = run(settings)
    assert list(table["trained with"]) == ["real", "count_based", *settings.variants]
    assert set(table["groups, agents"]) == {"2, 4"}
    assert is_drawn(tmp_path / "performance.png")
    folder = rns_dir / "cliff_walking" / "reward_threshold"
    rns = sejax.load_set(folder / "additive_potential.safetensors", kind="rn")
    assert rns.size == 3 and rns.config["objective"]["name"] == "reward_threshold"
    assert len({rns.fingerprint(i) for i in range(3)}) == 3
    assert list(rns.seeds) == [3, 4, 5]
    with pytest.raises(ConfigError, match="proxy=se"):
        sejax.load_set(folder / "additive_potential.safetensors", kind="se")

    # The best two of three, and the worst two, by the scores of the runs' incumbents.
    curve = pieces.read_rows(folder / "additive_potential.csv.xz")
    np.testing.assert_allclose(rns.scores, curve["incumbent_mean"], rtol=1e-6)
    best, worst = rns.ranked(2), rns.ranked(2, worst=True)
    assert list(best.scores) == sorted(rns.scores)[:0:-1]
    assert list(worst.scores) == sorted(rns.scores)[:2]
    used = {one["weights"] for one in pieces_of(tmp_path, "default-additive_potential")}
    assert used == {best.fingerprint(0), best.fingerprint(1)}

    refuse_to_compute(monkeypatch)
    pd.testing.assert_frame_equal(run(settings), table)
    fewer = dataclasses.replace(settings, bonus_groups=1)
    counts = run(fewer).set_index("trained with")["groups, agents"]
    assert counts["count_based"] == "1, 2" and set(counts.drop("count_based")) == {"2, 4"}
    expected = table[table["trained with"] != "count_based"].reset_index(drop=True)
    for nothing in (("none",), ()):
        without = run(dataclasses.replace(settings, bonuses=nothing))
        pd.testing.assert_frame_equal(without, expected)
    monkeypatch.setattr(rn_studies, "stored", refuse)
    again = dataclasses.replace(settings, bonuses=(), from_rows=True)
    pd.testing.assert_frame_equal(run(again), expected)


def learning_config(settings):
    return rn_studies.learning_config(settings, "additive_potential", "reward_threshold")


def test_a_set_grows_by_the_rns_that_it_lacks(rns_dir, options, monkeypatch, tmp_path):
    settings = options(RnPerformance, **TRAIN)
    three = rn_studies.learn(settings, "additive_potential", "reward_threshold")
    before = three.path.read_bytes()
    learned = []
    run = session.run

    def run_and_count(config, *rest):
        learned.append(config.seed)
        return run(config, *rest)

    monkeypatch.setattr(session, "run", run_and_count)
    more = dataclasses.replace(settings, learned=4)
    four = rn_studies.learn(more, "additive_potential", "reward_threshold")
    assert learned == [6] and list(four.seeds) == [3, 4, 5, 6]
    assert list(four.scores[:3]) == list(three.scores)
    assert [four.fingerprint(i) for i in range(3)] == [three.fingerprint(i) for i in range(3)]
    assert four.fingerprint(3) not in [three.fingerprint(i) for i in range(3)]
    curves = pieces.read_rows(rn_studies.curves_file(four.path))
    assert list(curves["seed"]) == [3, 4, 5, 6]
    three.path.write_bytes(before)  # as if killed before the set was written
    again = rn_studies.learn(more, "additive_potential", "reward_threshold")
    assert list(again.seeds) == [3, 4, 5, 6]
    assert pieces.read_rows(rn_studies.curves_file(four.path)).equals(curves)
    longer = pd.DataFrame({"generation": [0, 1], "seed": 3, "incumbent_mean": 0.0})
    one = dataclasses.replace(learning_config(more), run_dir=str(tmp_path / "one"))
    with pytest.raises(ConfigError, match=r"^generations must be at least 2, .*got 1\. Set"):
        proxy_runs.learn_all([one], learn=lambda *rest: longer)


def test_rns_of_other_settings_are_refused_before_any_are_learned(options, monkeypatch):
    settings = options(RnPerformance, rns=2, **TRAIN)
    rn_performance.EXPERIMENT.run(settings)
    refuse_to_compute(monkeypatch)
    variants = ("exclusive_potential", *settings.variants)  # the first is yet to be learned
    other = dataclasses.replace(
        settings, run=(*settings.run, "proxy.hidden_size=7"), variants=variants
    )
    with pytest.raises(ConfigError, match=r"rns_dir must be .* another proxy\.hidden_size"):
        rn_performance.EXPERIMENT.run(other)


def test_several_runs_in_one_program_are_those_runs(options, tmp_path):
    """Seeds that are learned together get the weights that each gets alone."""
    settings = options(RnPerformance, **TRAIN)
    rns = rn_studies.learn(settings, "additive_potential", "reward_threshold")
    config = build.learn_config(rns.config)
    (together,) = proxy_runs.configs_of_runs(config, 3, tmp_path, at_once=3)
    assert together.num_seeds == 3 and together.run_dir.endswith("seeds3-5")
    alone = proxy_runs.configs_of_runs(config, 3, tmp_path)
    assert [config.seed for config in alone] == [3, 4, 5]
    proxy_runs.learn_all(alone[1:2])
    proxy_runs.collect(alone[1:2], tmp_path / "alone.safetensors")
    one = sejax.load_set(tmp_path / "alone.safetensors", kind="rn")
    assert one.seeds[0] == 4 and one.scores[0] == rns.scores[1]
    assert one.fingerprint(0) == rns.fingerprint(1)


def test_objectives_are_compared_with_the_best_and_the_worst(options, tmp_path):
    given = TRAIN | {"objectives": ("reward_threshold", "auc")}
    with pytest.raises(ConfigError, match=r"learned must be at least 4.*got 3"):
        options(RnObjectives, rns=2, **given)
    table = rn_objectives.EXPERIMENT.run(options(RnObjectives, **given))
    # The real task twice, and for each objective and choice two variants.
    assert len(table) == 2 + 2 * 2 * 2
    for name in ("best", "worst"):
        assert is_drawn(tmp_path / f"{name}.png")
    summary = pd.read_csv(tmp_path / "summary.csv")
    real = summary[summary["world"] == "real"]
    assert real["mean_return"].nunique() == 1  # the same agents beside each objective
    prefix = "reward_threshold-{}-default-additive_potential"
    best, worst = (
        [piece["weights"] for piece in pieces_of(tmp_path, prefix.format(pick))]
        for pick in ("best", "worst")
    )
    assert len(best) == len(worst) == 1 and best != worst


def test_the_heat_map_shows_what_the_rns_pay(options, tmp_path):
    settings = options(RnHeatmap)
    table = rn_heatmap.EXPERIMENT.run(settings)
    assert list(table["variant"]) == list(settings.variants)
    assert (tmp_path / "heatmap.png").stat().st_size > 10_000
    summary = pd.read_csv(tmp_path / "summary.csv").set_index(["variant", "move"])
    # 11 moves into the cliff cost 100 and only the additive RNs pay the real reward as well.
    assert summary.loc[("additive_potential", "into the cliff"), "mean"] < -90
    assert summary.loc[("exclusive_non_potential", "into the cliff"), "mean"] > -10

    rns = rn_studies.learn(settings, "exclusive_non_potential", "reward_threshold")
    rewards = rn_heatmap.rewards_of_moves(rns)
    assert rewards.shape == (3, 48, 4) and np.isnan(rewards[:, 37:]).all()
    potential = [float(rns.env.potential(rns.one(1), np.int32(s))) for s in (24, 0)]
    # From the start (row 3) UP leads to state 24, and UP from state 0 stays there.
    np.testing.assert_allclose(rewards[1, [36, 0], 3], potential, rtol=1e-5)
    stored = rn_heatmap.by_variant(settings, pieces.read_rows(settings.rows_file))
    np.testing.assert_array_equal(stored["exclusive_non_potential"], rewards)


def test_moves_are_those_of_the_map():
    moves = {kind: mask.sum() for kind, mask in rn_heatmap.kinds_of_moves().items()}
    assert moves == {
        "into the cliff": 11, "from the start up": 1, "right along the cliff": 11,
        "left along the cliff": 11, "down to the cliff's edge": 12, "up from the cliff's edge": 12,
        "into the goal": 1,
    }  # fmt: skip


def test_ignored_rewards_do_not_stretch_the_colours():
    rewards = np.array([[[-101.0, 1.0]], [[-99.0, 3.0]], [[-20.0, 2.0]]])  # [rn, state, action]
    np.testing.assert_allclose(rn_heatmap.mean_rewards(rewards, ignore=False), [[0, 1]])
    rewards = np.concatenate([rewards, [[[-60.0, 0.0]], [[-70.0, 0.0]], [[-51.0, 1.0]]]])[
        :, :, ::-1
    ]
    flat = rn_heatmap.mean_rewards(np.dstack([rewards, np.full((6, 1), 41.0)]), ignore=True)
    # Means 7/6, -20 (all others ignored) and 41, from 0 to 1.
    np.testing.assert_allclose(flat, [[(7 / 6 + 20) / 61, 0.0, 1.0]])
    nothing = rn_heatmap.mean_rewards(np.array([[[-60.0, 1.0, 2.0]]]), ignore=True)
    np.testing.assert_allclose(nothing, [[np.nan, 0.0, 1.0]])


def test_timings_are_of_the_papers_rows(tmp_path):
    settings = timings.Timings.of(quick=True, out=str(tmp_path), rows="cliff_walking-rn",
                                  generations=1)  # fmt: skip
    table = timings.EXPERIMENT.run(settings)
    assert table["paper, 16 cores"].iloc[0] == "10 s"
    timed = pd.read_csv(tmp_path / "summary.csv").iloc[0]
    # Two members with two signs and two incumbents, at most 4 episodes of 50 steps each.
    assert timed["agents"] == 6 and 0 < timed["train_steps"] <= 6 * 4 * 50
    assert timed["seconds"] > 0 and is_drawn(tmp_path / "timings.png")


def curves_of(world, num_groups):
    """Episodes of 10 steps; agent i of group g is good from its episode 5 + 2 g + i on."""
    return pd.concat([
        pd.DataFrame({
            "row": "default", "world": world, "group": g, "agent": 2 * g + i,
            "steps": np.arange(10, 310, 10),
            "test_return": ([-50.0] * (4 + 2 * g + i) + [-12.0] * 30)[:30],
        })
        for g in range(num_groups) for i in range(2)
    ])  # fmt: skip


def test_the_summary_is_over_agents():
    curves = curves_of("real", 2)
    (row,) = rn_curves.summarise(curves, -12.0, max_steps=300).itertuples()
    # Ten tests in a row: solved at episodes 14, 15, 16 and 17.
    assert row.steps_to_solve == np.mean([140, 150, 160, 170]) and row.solved == 1.0
    assert row.last_return == -12.0 and -50 < row.mean_return < -12
    never = rn_curves.summarise(curves, 0.0, max_steps=300).iloc[0]
    assert never["steps_to_solve"] == 300 and never["solved"] == 0.0


def test_shares_are_of_the_groups_of_the_same_seeds():
    # Steps to solve of group g: 140 + 20 g and 150 + 20 g.
    curves = pd.concat([curves_of("real", 5), curves_of("icm", 2), curves_of("real_rn", 5)])
    summary = rn_curves.summarise(curves, -12.0, max_steps=300).set_index("world")
    assert summary["steps_to_solve"].tolist() == [185, 155, 185]
    assert summary["share_of_bare"].tolist() == [1, 1, 1]
    turned = pd.concat([curves_of("icm", 1), curves_of("real", 5)])  # in whatever order
    assert rn_curves.summarise(turned, -12.0, max_steps=300)["share_of_bare"].tolist() == [1, 1]
    alone = rn_curves.summarise(curves_of("icm", 2), -12.0, max_steps=300)
    assert np.isnan(alone["share_of_bare"][0]) and not rn_curves.make_table(alone).iat[0, 4]


def test_rows_of_other_settings_are_refused():
    settings = RnPerformance.of(env="cartpole", rows="default", rns=5, bonus_groups=2, learned=5,
                                num_agents=2)  # fmt: skip
    rows = pd.concat(
        [curves_of("real", 5), curves_of("icm", 2), curves_of("additive_potential", 5)]
    )
    rn_curves.require_rows(settings, rows)
    for wrong, said in (({"rns": 4}, r"^rns must be 5, .*got 4\. Set rns=5, or from_rows=false"),
                        ({"bonus_groups": 5}, r"^bonus_groups must be 2, .* groups of icm; got 5"),
                        ({"rows": ("default", "tuned")}, r"^rows must be default, .*tuned"),
                        ({"num_agents": 10}, r"^num_agents must be 2, .*got 10")):  # fmt: skip
        with pytest.raises(ConfigError, match=said):
            rn_curves.require_rows(dataclasses.replace(settings, **wrong), rows)


def test_intervals_draw_rns_or_agents_and_need_five_of_them():
    for world, independent in (
        ("additive_potential", 145 + 20 * np.arange(5)),  # the groups' means
        ("real", 140 + 10 * np.arange(10)),
    ):
        (row,) = rn_curves.summarise(curves_of(world, 5), -12.0, max_steps=300).itertuples()
        assert (row.steps_low, row.steps_high) == bootstrap_interval(independent)
        assert row.return_low < row.mean_return < row.return_high
    few = rn_curves.summarise(curves_of("additive_potential", 4), -12.0, max_steps=300)
    assert few[["steps_low", "return_high"]].isna().all(axis=None)
    shown = rn_curves.make_table(few).iloc[0]
    assert shown["steps to solve"] == "175" and "[" not in shown["mean return over training"]


def test_augmented_variants_are_named_in_pictures():
    assert rn_studies.label("exclusive_potential+augm") == r"$\gamma\Phi(s', v') - \Phi(s, v)$"
    assert rn_studies.label("exclusive_potential") == r"$\gamma\Phi(s') - \Phi(s)$"


@pytest.mark.parametrize(
    ("module", "given", "said"),
    [
        (rn_performance, {"env": "acrobot"}, "cartpole"),
        (rn_performance, {"variants": "additive"}, "additive_potential"),
        (
            rn_performance,
            {"env": "cartpole", "variants": "additive_potential+augm"},
            "additive",
        ),
        (rn_performance, {"rows": ("varied", "transfers")}, "transfer"),
        (rn_performance, {"rows": "tuned"}, "rows must be one of transfer"),
        (rn_performance, {"bonuses": "icm"}, "bonuses must be one of count_based, none.*icm"),
        (rn_performance, {"rns": 0}, "at least 1"),
        (rn_performance, {"rns": 3, "learned": 2}, "rns must be at most 2"),
        (rn_performance, {"bonus_groups": 0}, "bonus_groups must be at least 1"),
        (rn_performance, {"learned": 0}, "at least 1"),
        (rn_performance, {"objective": "steps"}, "reward_threshold"),
        (rn_objectives, {"picks": "top"}, "worst"),
        (rn_objectives, {"objectives": "max"}, "max_reward"),
        (rn_heatmap, {"env": "cartpole"}, "cliff_walking"),
        (rn_heatmap, {"objective": "steps"}, "reward_threshold"),
        (timings, {"rows": "pendulum-rn"}, "halfcheetah-rn"),
        (timings, {"generations": 0}, "at least 1"),
    ],
)
def test_what_cannot_work_is_refused(tmp_path, module, given, said):
    with pytest.raises(ConfigError, match=said):
        module.EXPERIMENT.settings.of(quick=True, out=str(tmp_path), **given)


def test_settings_are_those_of_the_task():
    """What is not given is the paper's, or what makes a small version of it."""
    usual = RnPerformance.of(env="cartpole")
    assert (usual.learned, usual.rns, usual.bonus_groups, usual.max_steps) == (10, 10, 10, 50_000)
    assert usual.bonuses == ("icm",) and usual.run == ()
    assert usual.rows == ("default", "varied", "transfer", "tuned")
    training = {row: usual.training(row) for row in usual.rows}
    assert training["default"].stop_rule == "never" and training["default"].tests_between == 1
    assert training["varied"].time_limit_is_terminal > training["tuned"].time_limit_is_terminal
    assert usual.agent("default").learning_rate == 2.5e-4  # the paper's table
    assert usual.agent("tuned") == sejax.config(["env=cartpole", "agent=ddqn"]).agent
    mountain_car = RnPerformance.of(env="mountain_car_continuous")
    assert mountain_car.agent("tuned").rollout_steps == 256
    quick_td3 = mountain_car.agent("varied")
    assert quick_td3 == sejax.config(["env=mountain_car_continuous", "proxy=rn"]).agent
    ppo = RnPerformance.of(env="mountain_car_continuous", run=("agent=ppo",))
    for study, variant, scale in ((mountain_car, "exclusive_non_potential", 0.1),
                                  (mountain_car, "exclusive_potential", 1.0),
                                  (ppo, "exclusive_non_potential", 1.0)):  # fmt: skip
        learned = rn_studies.learning_config(study, variant, "reward_threshold").proxy
        assert (learned.variant, learned.output_scale) == (variant, scale)
    few = RnPerformance.of(env="cartpole", learned=5, rns=2)
    assert (few.rns, few.bonus_groups) == (2, 2) and RnPerformance.of(learned=5).rns == 5
    quick = RnPerformance.of(env="halfcheetah", quick=True)
    assert (quick.learned, quick.rns, quick.bonuses, quick.rows) == (1, 1, (), ("default",))
    assert RnObjectives.of().rns == 10 and RnObjectives.of(learned=12).rns == 6
    picked = RnObjectives.of(quick=True)
    assert (picked.learned, picked.rns) == (4, 2)
    assert RnObjectives.of(quick=True, picks="best", learned=2).rns == 2


def test_words_of_the_command_line_are_settings():
    words = ["env=cartpole", "max_steps=7", "quick=true", "variants=[a,b]", "run.es.x=1"]
    given = {name: value for name, value in parse(RnPerformance, words).items() if value}
    assert given == {"env": "cartpole", "max_steps": 7, "quick": True, "variants": ["a", "b"],
                     "run": ["es.x=1"]}  # fmt: skip
    assert not any(parse(RnPerformance, []).values())


def test_commands_in_the_docs_are_accepted():
    root = Path(__file__).parents[1]
    pages = [root / "README.md", *(root / "docs").rglob("*.md")]
    text = "\n".join(page.read_text() for page in pages)
    commands = set(re.findall(r"python -m sejax\.experiments\.([a-z]\w+)([^`\n#|]*)", text))
    assert len(commands) > 20
    for name, words in (each for each in commands if "--help" not in each[1]):
        settings = importlib.import_module(f"experiments.{name}").EXPERIMENT.settings
        made = settings.of(**parse(settings, shlex.split(words)))
        again = settings.of(**parse(settings, shlex.split(made.command())[3:]))
        assert dataclasses.replace(made, out=again.out, work=None) == again
        if made.folder.parts[0] == "results":  # and it replaces no other results
            assert again.folder == made.folder
        if isinstance(made, RunSettings):  # and so are the words of its runs
            made.learn_config(["proxy=rn"] if isinstance(made, RnSettings) else [])
