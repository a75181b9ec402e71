"""Landscapes, and SEs that rank as they do."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy.stats import spearmanr

import sejax
from sejax import landscape as command
from sejax import landscapes, ranking
from sejax.bilevel import make_bilevel
from sejax.cli import config as configuration
from sejax.cli import kinds, landscape_config
from sejax.options import ConfigError
from sejax.ranking import agreement, ranks

CARD = {
    "task": "cartpole",
    "steps": 1000,
    "test_episodes": 2,
    "agents": {"ddqn": {"hidden_size": 8, "batch_size": 4, "exploration_steps": 100}},
}
RUN = [
    *("env=cartpole", "preset=ranking", "devices=1", "training.max_steps=60"),
    *("training.max_episodes=60", "agent.hidden_size=8", "agent.batch_size=4"),
    *("agent.exploration_steps=6", "es.population_size=2", "proxy.hidden_size=4"),
    *("objective.num_tests=2", "objective.num_judging_seeds=2"),
]


def table(num_configs=8, num_seeds=2, agent="ddqn", seed=0):
    """Rows of a landscape of drawn configurations with drawn returns."""
    rng = np.random.default_rng(seed)
    drawn = {
        "agent.learning_rate": 10.0 ** rng.uniform(-4, -1, num_configs),
        "agent.hidden_size": rng.integers(2, 9, num_configs),
    }
    rows = pd.DataFrame({"agent": agent, "config": np.repeat(range(num_configs), num_seeds)})
    rows["seed"] = np.tile(range(num_seeds), num_configs)
    for name, x in drawn.items():
        rows[name] = x[rows["config"]]
    return rows.assign(nonfinite=0, **{"return": rng.uniform(9, 200, len(rows))})


def file_of(folder):
    """The file of a landscape."""
    path = folder / "landscape.csv"
    landscapes.write(path, CARD, table())
    return path


def two_agents(path):
    """Overrides of a run with two agents, and their landscape in a file."""
    agents = dict.fromkeys(("dqn", "ddqn"), CARD["agents"]["ddqn"])  # not as a mixture sorts them
    rows = pd.concat([table(agent="dqn", seed=1), table()])
    landscapes.write(path, CARD | {"agents": agents}, rows)
    own = [word for word in RUN if not word.startswith(("agent.", "devices="))]
    fields = ("hidden_size=8", "batch_size=4", "exploration_steps=6")
    each = [f"agents.{name}.{field}" for name in agents for field in fields]
    return [*own, *each, "agents=[ddqn,dqn]", f"objective.landscape={path}"]


@pytest.fixture
def file(tmp_path):
    return file_of(tmp_path)


# --- ranks ---------------------------------------------------------------------------------------


def test_agreement_is_scipys_correlation_of_ranks():
    rng = np.random.default_rng(0)
    for _ in range(20):
        x, y = rng.integers(0, 6, 12), rng.normal(size=12)  # with ties
        got = agreement(jnp.float32(x), jnp.float32(y), "spearman")
        np.testing.assert_allclose(got, spearmanr(x, y).statistic, atol=1e-6)


def test_agreement_at_the_top_weighs_the_best_more():
    y = jnp.arange(10.0)
    top_swapped = y.at[jnp.array([8, 9])].set(jnp.array([9.0, 8.0]))
    bottom_swapped = y.at[jnp.array([0, 1])].set(jnp.array([1.0, 0.0]))
    assert agreement(top_swapped, y, "spearman") == agreement(bottom_swapped, y, "spearman")
    assert agreement(top_swapped, y, "top") < agreement(bottom_swapped, y, "top") < 1


def test_what_diverged_ranks_last_and_constants_agree_with_nothing():
    np.testing.assert_allclose(ranks(jnp.array([1.0, jnp.nan, -5.0])), [1.0, 0.0, 0.5])
    np.testing.assert_allclose(ranks(jnp.array([-jnp.inf, 2.0, -jnp.inf])), [0.25, 1.0, 0.25])
    assert agreement(jnp.ones(5), jnp.arange(5.0), "spearman") == 0


def test_several_agents_agree_within_themselves_and_pooled():
    x, y = [jnp.array([0.0, 1.0]), jnp.array([5.0, 6.0])], [jnp.array([7.0, 8.0]), jnp.arange(2.0)]
    # Within each 1; pooled, ranks 0 1 2 3 and 2 3 0 1: -0.6.
    np.testing.assert_allclose(ranking.mean_agreement(x, y, "spearman"), (1 - 0.6) / 2, atol=1e-6)


# --- the objective -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A learner, what its first generation asks for, its evaluation, and the landscape.

    Of a minibatch of four configurations on two devices.
    """
    path = tmp_path_factory.mktemp("landscape") / "x.csv"
    landscapes.write(path, CARD, table())
    own = [word for word in RUN if not word.startswith("devices=")]
    words = [f"objective.landscape={path}", "objective.num_configs=4", "objective.measure=greedy"]
    config = sejax.config([*own, *words, "devices=2"])
    learner = make_bilevel(**config.parts())
    state = learner.init(jax.random.key(3))
    asked = learner.ask(state)
    return learner, state, asked, jax.jit(learner.evaluate), landscapes.read(path)["ddqn"]


def test_a_candidate_is_worth_the_agreement_of_its_configurations(learned):
    """The compiled evaluation against a loop over configurations, trained one after the other."""
    learner, _, asked, evaluate, found = learned
    outcome, agent = evaluate(asked), learner.mixture.agents[0]
    measure = jax.jit(ranking.make_measure(agent, learner.proxy, learner.training, 2))
    key_draw, key, _ = jax.random.split(asked.keys[0], 3)
    keys = jax.random.split(jax.random.fold_in(key, 0), (4, 1))[:, 0]
    places = jax.random.permutation(jax.random.fold_in(key_draw, 0), 6)[:4]  # two of eight judge
    params = learner.params_of(asked.params[0])
    reached = []
    for place, key in zip(places, keys, strict=True):
        values = {name: x[place] for name, x in found.values.items()}
        reached.append(measure(key, params, ranking.hparams_of(agent, values)).greedy)
    expected = spearmanr(reached, found.mean_returns[places]).statistic
    np.testing.assert_allclose(outcome.agreement.learned_from[0], expected, atol=1e-6)
    assert outcome.real_steps.sum() == 0
    assert outcome.train_steps.tolist() == [4 * 60] * 4 + [(4 + 2 * 2) * 60]
    np.testing.assert_array_equal(  # the population has no judges
        outcome.agreement.judging[:4], outcome.agreement.learned_from[:4]
    )


def test_the_strategy_learns_and_people_see_the_judges(learned):
    learner, _, asked, evaluate, _ = learned
    outcome = evaluate(asked)
    population, incumbent = learner.scoring.for_strategy(outcome)
    np.testing.assert_array_equal(population, outcome.agreement.learned_from[:4])
    np.testing.assert_allclose(incumbent, outcome.agreement.learned_from[4], rtol=1e-6)
    seen = learner.scoring.judged(outcome)
    np.testing.assert_allclose(seen.incumbent_mean, outcome.agreement.judging[4], rtol=1e-6)
    assert learner.solved_score is None


def test_the_first_generation_goes_on_with_the_best_of_fresh_proxies(learned):
    learner, state, asked, evaluate, _ = learned
    later = learner.ask(state.replace(generation=jnp.int32(1))).population
    np.testing.assert_allclose(later.mean(axis=0), state.incumbent, atol=1e-5)  # mirrored
    assert jnp.abs(asked.population.mean(axis=0) - state.incumbent).max() > 0.1
    outcome = evaluate(asked)
    after, _ = learner.tell(state, asked, outcome)
    scores, incumbent = learner.scoring.for_strategy(outcome)
    best = asked.population[jnp.argmax(scores)] if scores.max() > incumbent else asked.incumbent
    np.testing.assert_array_equal(after.es_state.mean, best)


def test_all_candidates_of_a_generation_train_the_same_configurations(learned):
    """One candidate in all places, those of another device too, is worth the same in all."""
    _, _, asked, evaluate, _ = learned
    same = asked.replace(params=jnp.broadcast_to(asked.incumbent, asked.params.shape))
    assert len(set(evaluate(same).agreement.learned_from.tolist())) == 1


def test_each_agent_trains_its_own_configurations(file, monkeypatch):
    """Whatever order the file and the mixture have them in."""
    config = sejax.config(two_agents(file.with_name("two.csv")))
    found, asked = config.objective.landscapes("cartpole"), []
    assert list(found) == ["dqn", "ddqn"]
    monkeypatch.setattr(ranking, "configurations_of", lambda x, agent, cls, steps: (
        asked.append((x.agent, agent)) or ranking.Configurations(agent, {}, jnp.zeros(x.size))
    ))  # fmt: skip
    make_bilevel(**config.parts())
    of_names = {member.key: sejax.make_agent(member.agent, config.task())
                for member in config.agents.members}  # fmt: skip
    assert asked == list(of_names.items())


# --- landscapes ----------------------------------------------------------------------------------


def test_a_landscape_is_read_as_it_was_written(file):
    found = landscapes.read(file)["ddqn"]
    rows = table()
    assert (found.task, found.steps, found.size) == ("cartpole", 1000, 8)
    np.testing.assert_allclose(found.mean_returns, rows.groupby("config")["return"].mean())
    np.testing.assert_allclose(
        found.values["learning_rate"], rows.groupby("config")["agent.learning_rate"].first()
    )


def test_a_training_that_diverged_has_the_lowest_return(tmp_path):
    rows = table()
    rows.loc[3, ["return", "nonfinite"]] = [np.nan, 1]
    landscapes.write(tmp_path / "x.csv", CARD, rows)
    returns = landscapes.read(tmp_path / "x.csv")["ddqn"].returns
    assert returns[1, 1] == np.delete(rows["return"], 3).min()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda rows: rows.iloc[:-1], "a return for each configuration and seed"),
        (lambda rows: pd.concat([rows, rows.iloc[:1]]), "a return for each configuration and seed"),
        (lambda rows: rows.assign(**{"return": np.nan}), "a return for each configuration"),
        (lambda rows: rows.assign(**{"return": "high"}), "a return for each configuration"),
        (lambda rows: rows[rows["config"] == 0], "several configurations"),
        (lambda rows: rows.assign(**{"return": 9.0}), "must tell configurations apart"),
        (lambda rows: rows.drop(columns="seed"), "lacks seed"),
        (lambda rows: rows[[]], "must be the CSV file of a landscape"),
    ],
)
def test_bad_landscapes_get_one_message(tmp_path, spoil, message):
    path = tmp_path / "bad.csv"
    landscapes.write(path, CARD, spoil(table()))
    with pytest.raises(ConfigError, match=message):
        landscapes.read(path)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["agent.hidden_size=4"], r"agent.hidden_size must have room .* got 4"),
        (["agent.exploration_steps=50"], r"agent.exploration_steps must be 6, as in the landscape"),
        (["env=acrobot"], r"objective.landscape must be of acrobot; got one of cartpole"),
        (["agent=ppo"], r"agent must be ddqn, of the landscape; got ppo"),
        (["objective.judging=0.9"], r"must leave two configurations to learn from"),
        (
            ["training.stop_rule=plateau"],
            r"training.stop_rule must be never with objective=ranking",
        ),
        (["objective.landscape=nowhere.csv"], r"objective.landscape must be the CSV file"),
    ],
)
def test_runs_that_do_not_fit_the_landscape_are_refused(file, words, message):
    named = {word.partition("=")[0] for word in words}
    words = [
        x for x in [*RUN, f"objective.landscape={file}"] if x.partition("=")[0] not in named
    ] + words
    if "agent=ppo" in words:
        words = [x for x in words if not x.startswith("agent.")]
    with pytest.raises(ConfigError, match=message):
        sejax.config(words)


# --- the command ---------------------------------------------------------------------------------

WORDS = ["env=cartpole", "agent=ddqn", "configs=3", "seeds=2", "steps=60", "devices=1"]


def test_a_stopped_command_goes_on_to_the_same_rows(tmp_path, monkeypatch):
    monkeypatch.setattr(kinds, "CHUNK", 4)
    whole, stopped = tmp_path / "whole.csv", tmp_path / "stopped.csv"
    command.main([*WORDS, f"file={whole}"])
    card, rows = landscapes.read_table(whole)
    landscapes.write(stopped, card, rows.iloc[[0, 3]])
    command.main([*WORDS, f"file={stopped}"])
    again = landscapes.read_table(stopped)[1]
    pd.testing.assert_frame_equal(again.drop(columns="cpu_s"), rows.drop(columns="cpu_s"))
    with pytest.raises(ConfigError, match=r"file must be new .* differs in agents, space, steps"):
        command.main([*WORDS, f"file={stopped}", "steps=70"])


def test_a_landscapes_row_is_an_agent_with_those_options(tmp_path):
    """Each row against `make_evaluator` with the configuration's options as they are written."""
    path = tmp_path / "x.csv"
    command.main([*WORDS, f"file={path}"])
    card, rows = landscapes.read_table(path)
    own, (kind,) = landscape_config.read(WORDS)
    task = kind.config.task()
    row = rows.iloc[2]
    options = dict(card["agents"]["ddqn"])
    fields = [f"agent.{k}={'null' if x is None else x}" for k, x in options.items()]
    room = sejax.config(["env=cartpole", "agent=ddqn", *fields]).agent
    agent = sejax.make_agent(room, task)
    values = {name: x[1] for name, x in kind.values.items()}
    assert values["learning_rate"] == row["agent.learning_rate"]
    training = sejax.TrainingConfig(stop_rule="never", max_steps=60, max_episodes=60)
    _, keys = kinds.program_of(kind, own.steps, own.test_episodes)
    hparams = ranking.hparams_of(agent, values)
    evaluate = sejax.make_evaluator(
        dataclasses.replace(agent, hparams=hparams), task.env, task, training
    )
    got = jax.jit(evaluate)(keys(np.array([[1, 0]]))[0], task.params)
    np.testing.assert_allclose(got.test_return, row["return"], rtol=1e-5)


def test_an_option_that_is_fixed_stays_as_it_is():
    words = ["env=cartpole", "agent=ddqn", "steps=10000", "agent.exploration_steps=50"]
    (kind,) = landscape_config.read(words)[1]
    assert kind.config.agent.exploration_steps == 50 and "exploration_steps" not in kind.values


def test_draws_do_not_depend_on_other_agents_and_cover_the_space():
    words = ["env=cartpole", "configs=200", "steps=10000"]
    (alone,) = landscape_config.read([*words, "agent=ddqn"])[1]
    both = landscape_config.read([*words, "agent=[sac,ddqn]"])[1]
    for name, x in alone.values.items():
        np.testing.assert_array_equal(x, both[1].values[name])
    rate, steps = alone.values["learning_rate"], alone.values["exploration_steps"]
    assert 1e-4 <= rate.min() < 2e-4 and 0.05 < rate.max() <= 0.1
    assert abs(np.log10(rate).mean() + 2.5) < 0.2  # uniform in the logarithm
    assert steps.min() >= 200 and steps.max() <= 10_000
    assert alone.config.agent.hidden_size == 32 and alone.config.agent.batch_size == 32
    assert (
        alone.config.agent.exploration_steps == 1000
    )  # a tenth of the steps, as of preset=ranking


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["agent.num_layers=choice(1,2)"], "agent.num_layers must be a number of the agent"),
        (["proxy.hidden_size=range(8,33,8)"], "proxy.hidden_size must be a number of the agent"),
        (
            ["agent=[ddqn,ppo]", "agent.activation=tanh"],
            "agent.activation must come with one agent",
        ),
        (["configs=1"], "configs must be a whole number from 2"),
        (["space=narrow"], "space must be one of"),
    ],
)
def test_spaces_that_are_no_one_program_are_refused(words, message):
    named = {word.partition("=")[0] for word in words}
    with pytest.raises(ConfigError, match=message):
        landscape_config.read([*[x for x in WORDS if x.partition("=")[0] not in named], *words])


def test_a_run_with_two_agents_has_one_score(file):
    config = sejax.config(two_agents(file.with_name("two.csv")))
    assert config.scored_agents == ()  # and so no columns of each
    assert make_bilevel(**config.parts()).scoring.mixture.size == 1


@pytest.mark.slow
def test_a_run_learns_by_ranking_and_says_so(file, tmp_path, capsys):
    """With two agents: of them all a candidate has one score."""
    from sejax.run import main

    words = [*two_agents(file.with_name("two.csv")), "objective.measure=greedy"]
    main([*words, "generations=2", f"run_dir={tmp_path / 'run'}"])
    said = capsys.readouterr().out
    assert "agreement of ranks" in said and "sejax.search proxy=" in said
    stored = configuration.learn_config(sejax.load_proxy(tmp_path / "run").config)
    assert stored.name("objective") == "ranking" and stored.objective.steps == 1000
    rows = pd.read_csv(tmp_path / "run/metrics.csv")
    assert not [name for name in rows if name.startswith("incumbent_mean_")]


# --- ARLBench ------------------------------------------------------------------------------------

# Three configurations and two seeds of results/sobol/ppo_Hopper-v4 at a44d4c64 of
# github.com/automl/arlbench; BSD-3, copyright its authors.
EXCERPT = Path(__file__).parent / "arlbench" / "ppo_Hopper-v4"


def test_arlbenchs_landscapes_are_read(tmp_path):
    left_out = landscapes.from_arlbench(EXCERPT, tmp_path / "x.csv")
    assert left_out == [
        "max_grad_norm", "minibatch_size", "normalize_advantage", "vf_clip_eps",
    ]  # fmt: skip
    found = landscapes.read(tmp_path / "x.csv")["ppo"]
    assert (found.task, found.steps, found.returns.shape) == ("hopper", 1_000_000, (3, 2))
    # As in its files: configuration 2 of seed 1, and configuration 0.
    np.testing.assert_allclose(found.returns[2, 1], 182.50848)
    np.testing.assert_allclose(found.values["clip_ratio"][0], 0.2744067519636624)
    early = landscapes.from_arlbench(EXCERPT, tmp_path / "early.csv", steps=100_000)
    assert early == left_out
    np.testing.assert_allclose(
        landscapes.read(tmp_path / "early.csv")["ppo"].returns[2, 1], 184.36667
    )


def test_other_folders_and_checkpoints_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="folder must be a folder AGENT_TASK"):
        landscapes.from_arlbench(tmp_path, tmp_path / "x.csv")
    with pytest.raises(ConfigError, match="steps must be one of 100000"):
        landscapes.from_arlbench(EXCERPT, tmp_path / "x.csv", steps=5)
    (tmp_path / "ppo_Hopper-v4").mkdir()
    with pytest.raises(ConfigError, match="folder must have a folder for each seed"):
        landscapes.from_arlbench(tmp_path / "ppo_Hopper-v4", tmp_path / "x.csv")
