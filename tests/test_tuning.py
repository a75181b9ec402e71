"""Searches on SEs that rank: what is drawn, how it is ordered, what is tried on the real task."""

import dataclasses
import shlex

import jax
import numpy as np
import pandas as pd
import pytest

pytest.importorskip("optuna", reason="needs Optuna: pip install 'sejax[search]'")

import sejax
from sejax import landscapes, ranking
from sejax import search as command
from sejax.cli import config as configuration
from sejax.cli import search_config, tuning
from sejax.ops import gaussian_process
from sejax.options import ConfigError

STEPS = 60  # on the real task; half as many on the SEs
LEARNED = [
    *("env=cartpole", "preset=ranking", "objective=max_reward", "training.max_steps=30"),
    *("training.max_episodes=30", "proxy.hidden_size=4", "agent.activation=prelu"),
    *("agent.exploration_steps=3", "agent.hidden_size=8", "agent.batch_size=4"),
]


@pytest.fixture(scope="module")
def tuner(tmp_path_factory):
    """The file of two SEs that rank."""
    path = tmp_path_factory.mktemp("tuner") / "tuner.safetensors"
    config = sejax.config(LEARNED)
    env = config.parts()["proxy"]
    weights = [env.init_weights(jax.random.key(i)) for i in range(2)]
    stored = config.plain() | {"objective": {"name": "ranking", "steps": STEPS}}
    sejax.save_set(path, env, weights, [{}, {}], stored)
    return path


def words_of(tuner, folder, *own):
    """Overrides of a small search."""
    return [
        *(f"proxy={tuner}", "agent=ddqn", "trials=6", "verify=2", "fresh_seeds=2", "seeds=2"),
        *("agent.tau=0.05", "agent.hidden_size=8", "agent.batch_size=int(interval(2,4))"),
        *("devices=1", f"search_dir={folder}", *own),
    ]


@pytest.fixture(scope="module")
def searched(tuner, tmp_path_factory):
    """The folder of a search, with nothing replaced, and its setup."""
    folder = tmp_path_factory.mktemp("search")
    words = words_of(tuner, folder)
    command.main(words)
    return folder, tuning.setup_of(search_config.read(words))


@pytest.fixture
def cheap(monkeypatch):
    """Configurations rank by their learning rate, and reach its opposite on the real task.

    Returns:
      What is trained there: configuration and seed.
    """
    trained = []

    def reached_on(ses, agent, values, *, num_seeds, **_):
        greedy = np.broadcast_to(values["learning_rate"][None, :, None], (1, 6, num_seeds))
        return ranking.Reached(greedy, greedy, np.int32(greedy > 0), np.int32(greedy > 0))

    def train(kind, places, steps, test_episodes):
        for config, seed in places:
            trained.append((config, seed))
            own = {f"agent.{name}": x[config] for name, x in kind.values.items()}
            reward = -own["agent.learning_rate"]
            row = {"agent": kind.name, "config": config, "seed": seed, **own, "return": reward}
            yield pd.DataFrame([{**row, "nonfinite": 0, "real_steps": steps, "cpu_s": 0.5}])

    monkeypatch.setattr(tuning, "reached_on", reached_on)
    monkeypatch.setattr(tuning, "train", train)
    return trained


def tuned(tuner, folder, *own):
    """What a search has found, and said."""
    said = []
    _, settings = tuning.tune(search_config.read(words_of(tuner, folder, *own)), said.append)
    return settings, said


# --- what is drawn -------------------------------------------------------------------------------


def test_a_tuner_has_defaults_of_its_own(tuner):
    search = search_config.read([f"proxy={tuner}", "agent=sac"])
    assert (search.config.trials, search.config.seeds, search.num_verified) == (1000, 4, 10)
    assert search.study == "sac-on-tuner" and "agent.target_entropy_fraction" in search.space
    assert search_config.read(["proxy=cartpole", "agent=sac"]).space == {}


def test_agents_have_room_and_fixed_options_stay(tuner, tmp_path):
    fixed = ("agent.tau=0.05", "agent.exploration_steps=20")
    words = [f"proxy={tuner}", "agent=ddqn", "trials=50", *fixed, f"search_dir={tmp_path}"]
    setup = tuning.setup_of(search_config.read(words))
    real, short = setup.kind.config.agent, setup.agent
    assert not {"tau", "exploration_steps"} & set(setup.kind.values)
    assert real.tau == short.tau == 0.05
    assert (real.exploration_steps, short.exploration_steps) == (20, 10)  # of 60 and of 30 steps
    assert real.hidden_size == short.hidden_size == 32  # of space=wide
    assert real.activation == "prelu"  # of the agent that the SEs were learned with
    assert setup.kind.values["learning_rate"].shape == (50,)


def test_agents_that_took_no_part_are_those_of_the_preset(tuner, tmp_path):
    words = [f"proxy={tuner}", "agent=td3_discrete", "trials=2", f"search_dir={tmp_path}"]
    setup = tuning.setup_of(search_config.read(words))
    # preset=ranking has temperature_steps=500, all of its trainings; of others twice as long.
    assert setup.kind.config.agent.temperature_steps == STEPS
    assert setup.agent.temperature_steps == 60 and setup.agent.activation == "tanh"


def test_agents_that_took_no_part_train_twice_as_long(tuner):
    ses = sejax.load_set(tuner)
    learned = sejax.training_of(ses)
    assert ranking.training_on(ses, "ddqn") == learned
    other = ranking.training_on(ses, "sac")
    assert (other.max_steps, other.max_episodes) == (60, 2 * learned.max_episodes)
    assert (
        dataclasses.replace(other, max_steps=learned.max_steps, max_episodes=learned.max_episodes)
        == learned
    )


def test_each_agent_of_a_mixture_is_as_it_was_learned_with(tuner, tmp_path):
    words = [word for word in LEARNED if not word.startswith("agent.")]
    words += ["agents=[ddqn,sac]", "agents.sac.activation=prelu", "agents.ddqn.activation=relu"]
    ses, path = sejax.load_set(tuner), tmp_path / "both.safetensors"
    stored = sejax.config(words).plain() | {"objective": ses.config["objective"]}
    sejax.save(path, ses.env, ses[0].params.weights, stored)
    for name, activation in (("sac", "prelu"), ("ddqn", "relu")):
        search = search_config.read([f"proxy={path}", f"agent={name}", "trials=2"])
        assert tuning.setup_of(search).agent.activation == activation


def test_draws_depend_on_the_sampler_seed_and_on_no_landscapes(tuner, tmp_path):
    drawn = [
        tuning.setup_of(search_config.read(words_of(tuner, tmp_path, *own))).kind.values
        for own in ((), ("trials=4", "seed=3"), ("sampler_seed=1",))
    ]
    rates = [x["learning_rate"] for x in drawn]
    np.testing.assert_array_equal(rates[0][:4], rates[1])
    assert not set(rates[0]) & set(rates[2])
    from sejax.landscape import read

    (kind,) = read(["env=cartpole", "agent=ddqn", "configs=6"])[1]
    assert not set(rates[0]) & set(kind.values["learning_rate"])


# --- how it is ordered, and tried ----------------------------------------------------------------


def test_configurations_are_ordered_by_their_mean_rank_on_the_ses(searched):
    folder, setup = searched
    reached = ranking.reached_on(
        setup.ses, setup.agent, setup.kind.values, num_seeds=2, seed=0, devices=1
    )
    table = pd.read_csv(folder / "trials.csv")
    assert table["rank"].tolist() == [1, 2, 3, 4, 5, 6]
    scores = ranking.mean_rank(reached)
    np.testing.assert_allclose(table["score"], scores[table["trial"]], atol=1e-6)
    assert table["score"].is_monotonic_decreasing and table["score"].nunique() > 1
    for name, x in setup.kind.values.items():
        np.testing.assert_allclose(table[f"agent.{name}"], x[table["trial"]])


def test_the_best_train_on_the_real_task_for_its_steps(searched):
    folder, _ = searched
    trials, rows = (pd.read_csv(folder / f"{x}.csv") for x in ("trials", "verification"))
    assert set(rows["trial"]) == set(trials["trial"][:2])
    assert rows["real_return"].is_monotonic_decreasing
    measured = landscapes.read(folder / tuning.TRAININGS)["ddqn"]
    assert (measured.task, measured.steps, measured.returns.shape) == ("cartpole", STEPS, (2, 2))
    np.testing.assert_allclose(sorted(rows["real_return"]), sorted(measured.mean_returns))
    each = landscapes.read_table(folder / tuning.TRAININGS)[1]
    assert rows["real_steps"].sum() == each["real_steps"].sum() >= 4 * (STEPS + 10)
    assert rows["cpu_s"].sum() == pytest.approx(each["cpu_s"].sum())


def test_the_command_of_the_best_trains_it_on_the_real_task(searched):
    folder, _ = searched
    best = pd.read_csv(folder / "verification.csv").iloc[0]
    row = pd.read_csv(folder / "trials.csv").set_index("trial").loc[best["trial"]]
    typed = shlex.split((folder / "best.txt").read_text())
    assert typed[:3] == ["python", "-m", "sejax.evaluate"]
    for words in (typed[3:], [f"preset={folder / 'preset.yaml'}"]):
        made = configuration.evaluate_config(words)
        assert (made.proxy, made.env) == ("real", "cartpole")
        assert made.real_training.max_steps == STEPS and made.real_training.is_fixed_length
        agent = made.agent
        assert (agent.tau, agent.hidden_size, agent.activation) == (0.05, 8, "prelu")
        for name in ("learning_rate", "batch_size", "discount", "exploration_steps"):
            assert getattr(agent, name) == row[f"agent.{name}"]


def test_a_verification_goes_on_where_it_stopped(tuner, tmp_path, cheap):
    settings, said = tuned(tuner, tmp_path)
    order = pd.read_csv(tmp_path / "trials.csv")["trial"].tolist()
    assert cheap == [(order[0], 0), (order[0], 1), (order[1], 0), (order[1], 1)]
    assert "240 real steps and 2.0 CPU s" in said[-1]
    found = pd.read_csv(tmp_path / "verification.csv")
    assert found["trial"].tolist() == [order[1], order[0]]  # the second is the better one there
    cheap.clear()
    assert tuned(tuner, tmp_path)[0] == settings and not cheap
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "verification.csv"), found)
    tuned(tuner, tmp_path, "verify=3", "fresh_seeds=1")
    assert cheap == [(order[2], 0)]
    with pytest.raises(ConfigError, match=r"search_dir must be new .* differs in sampler_seed"):
        tuned(tuner, tmp_path, "sampler_seed=1")


def test_without_a_verification_the_first_rank_is_the_best(tuner, tmp_path, cheap):
    settings, _ = tuned(tuner, tmp_path, "verify=0")
    first = pd.read_csv(tmp_path / "trials.csv").iloc[0]
    assert f"agent.learning_rate={first['agent.learning_rate']:g}" in settings
    assert not cheap and not (tmp_path / "verification.csv").exists()


# --- with a landscape ----------------------------------------------------------------------------

CARD = {"task": "cartpole", "steps": STEPS, "test_episodes": 10}


def landscape_of(tuner, folder, **changes):
    """A landscape of what is searched, in which low learning rates are good."""
    setup = tuning.setup_of(search_config.read(words_of(tuner, folder, "trials=40")))
    agent = configuration.plain(setup.kind.config)["agent"]
    rows = pd.DataFrame({f"agent.{k}": x for k, x in setup.kind.values.items()})
    rows = rows.assign(agent="ddqn", config=rows.index, seed=0, nonfinite=0)
    rows["return"] = -np.log(rows["agent.learning_rate"])
    path = folder / "landscape.csv"
    landscapes.write(path, {**CARD, "agents": {"ddqn": agent}, **changes}, rows)
    return path


def test_a_landscape_orders_what_was_not_measured(tuner, tmp_path, monkeypatch):
    def reached_on(ses, agent, values, *, num_seeds, **_):
        greedy = np.zeros((1, len(values["learning_rate"]), num_seeds))  # which knows nothing
        return ranking.Reached(greedy, greedy, greedy, greedy)

    monkeypatch.setattr(tuning, "reached_on", reached_on)
    path = landscape_of(tuner, tmp_path)
    tuned(tuner, tmp_path, f"landscape={path}", "verify=0", "trials=30", "sampler_seed=5")
    table = pd.read_csv(tmp_path / "trials.csv")
    assert table["predicted"].is_monotonic_decreasing and len(table) == 30
    np.testing.assert_allclose(table["predicted"], -np.log(table["agent.learning_rate"]), atol=0.3)


@pytest.mark.parametrize(
    ("card", "own", "message"),
    [
        ({"task": "acrobot"}, (), "landscape must be of cartpole; got acrobot"),
        ({"steps": 50}, (), "landscape must have trainings of as many steps .* 60; got 50"),
        ({"agents": {}}, ("agent=dqn",), "landscape must be of dqn; got one of ddqn"),
        ({"agents": {"ddqn": {"loss": "huber"}}}, (), "agent.loss must be huber, as in the"),
        ({}, ("agent.discount=0.9",), "landscape must vary what is searched"),
    ],
)
def test_landscapes_that_do_not_fit_are_refused(tuner, tmp_path, card, own, message):
    path = landscape_of(tuner, tmp_path, **card)
    with pytest.raises(ConfigError, match=message):
        tuned(tuner, tmp_path, f"landscape={path}", *own)


def test_a_gaussian_process_finds_the_feature_that_matters():
    rng = np.random.default_rng(0)
    x, x_new = rng.random((40, 3)), rng.random((100, 3))
    y = 5 + np.sin(6 * x[:, 1]) + 0.05 * rng.normal(size=40)
    predicted = gaussian_process.predict(x, y, x_new)
    assert np.abs(predicted - 5 - np.sin(6 * x_new[:, 1])).mean() < 0.1


# --- what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (["pruner=none"], "pruner must be left out on an SE that ranks"),
        (["storage=sqlite:///x.db"], "storage must be left out on an SE that ranks"),
        (["machines=ray"], "machines must be left out on an SE that ranks"),
        (["training.max_steps=9"], "training.max_steps must be left out on an SE that ranks"),
        (["agents=[ddqn,ppo]"], "agents must be left out on an SE that ranks"),
        (["agent=td3"], "agent must be one of .*; got td3"),
        (["env=acrobot"], "env must be the proxy's own task"),
        (["trials=1"], "trials must be at least 2"),
        (["agent.num_layers=1,2"], "agent.num_layers must be a number of the agent that compiled"),
        (["agent.tau=choice(a,b)"], "agent.tau must be a number of the agent that compiled"),
        (["agent.discount=interval(0.5,1.5)"], "agent.discount must"),
        (["space=paper_se"], "agent.warmup_episodes must be a number of the agent that compiled"),
    ],
)
def test_what_has_no_meaning_on_a_tuner_is_refused_before_anything_runs(
    tuner, tmp_path, own, message, cheap
):
    with pytest.raises(ConfigError, match=message) as error:
        tuned(tuner, tmp_path, *own)
    assert len(str(error.value)) <= 300 and not list(tmp_path.iterdir()) and not cheap


def test_a_landscape_needs_an_se_that_ranks():
    with pytest.raises(ConfigError, match="landscape must come with an SE that was learned with"):
        search_config.read(["proxy=cartpole", "agent=ppo", "landscape=x.csv"])


def test_a_tuner_says_how_long_its_landscape_trained(tuner, tmp_path):
    ses = sejax.load_set(tuner)
    stored = ses.config | {"objective": {"name": "ranking"}}
    sejax.save(tmp_path / "old.safetensors", ses.env, ses[0].params.weights, stored)
    with pytest.raises(ConfigError, match="proxy must say how long agents of its landscape"):
        search_config.read([f"proxy={tmp_path / 'old.safetensors'}", "agent=ddqn"])
