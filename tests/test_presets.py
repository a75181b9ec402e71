"""sejax.presets: the settings that were published are the paper's, number for number."""

import functools
from pathlib import Path

import pytest
import yaml
from support import paper_training, refused

import sejax
from experiments.common.reward_networks import STUDIES
from sejax.options import registry
from sejax.runs import presets

composed_with = functools.cache(lambda *overrides: sejax.config(overrides))
ENVS = ("cartpole", "acrobot")

# The paper's tables, a column for each task.
TABLES = yaml.safe_load((Path(__file__).parent / "golden" / "paper_tables.yaml").read_text())
RN_TASKS = ("cliff_walking", "cartpole", "mountain_car_continuous", "halfcheetah")
ROWS = [("se", ENVS, path) for path in TABLES["se"]]
ROWS += [("rn", RN_TASKS, path) for path in TABLES["rn"]]


@pytest.mark.parametrize(("proxy", "tasks", "path"), ROWS)
def test_the_papers_preset_holds_the_numbers_of_its_tables(proxy, tasks, path):
    group, _, name = path.rpartition(".")
    for env, expected in zip(tasks, TABLES[proxy][path], strict=True):
        composed = composed_with(f"env={env}", f"proxy={proxy}", "preset=paper")
        part = getattr(composed, group) if group else composed
        value = composed.name(group) if name == "name" else getattr(part, name, None)
        assert expected is None or value == expected


def test_the_performance_preset_is_how_those_ses_were_made():
    # The authors' configuration files: sigma 0.05, alpha 1, 128 LeakyReLU units, at most 50
    # generations, stopped when solved; epsilon from 1 to 0.01.
    for env in ENVS:
        composed = composed_with(f"env={env}", "preset=paper_performance")
        assert (composed.es.noise_std, composed.es.step_size) == (0.05, 1.0)
        assert (composed.es.update_rule, composed.es.score_transform) == ("authors", "all_better_2")
        assert (composed.proxy.hidden_size, composed.proxy.activation) == (128, "leaky_relu")
        assert composed.generations == 50
        assert (composed.agent.epsilon_init, composed.agent.epsilon_min) == (1.0, 0.01)
        assert composed.training == paper_training()
        assert composed.stop_when_solved


@pytest.mark.parametrize("agent", TABLES["agents"])
def test_agents_of_the_performance_preset_are_those_of_their_papers(agent):
    config = composed_with("env=cartpole", "preset=paper_performance", f"agent={agent}").agent
    for name, expected in TABLES["agents"][agent].items():
        assert getattr(config, name) == expected, name


@pytest.mark.parametrize("agent", [*TABLES["agents"], "ppo", "td3"])
def test_classes_have_the_defaults_of_the_command(agent):
    env = "gymnax/MountainCarContinuous-v0" if agent == "td3" else "gymnax/MountainCar-v0"
    composed = composed_with(f"env={env}", f"agent={agent}")
    assert composed.agent == type(composed.agent)()
    assert composed.proxy == sejax.SyntheticConfig()
    # An SE has no real time limit; those that are stored were learned with this value.
    assert composed.training == sejax.TrainingConfig(time_limit_is_terminal=True)
    assert composed.es == sejax.NESConfig()


@pytest.mark.parametrize("env", ["mountain_car_continuous", "halfcheetah", "pendulum"])
def test_the_best_preset_has_a_quick_td3_for_continuous_tasks(env):
    composed = composed_with(f"env={env}", "proxy=rn")
    assert composed.name("agent") == "td3"
    assert composed.agent.hidden_size == composed.agent.batch_size == 64
    assert composed.agent.warmup_episodes <= composed.training.max_episodes // 5
    # Only on Pendulum, which never terminates, does it matter whether it learns at all.
    assert composed.training.time_limit_is_terminal == (env != "pendulum")


@pytest.mark.parametrize(
    ("env", "preset"),
    [("mountain_car_continuous", "paper"), ("halfcheetah", "paper"), ("halfcheetah", "best")],
)
def test_ppo_on_rns_is_the_papers_and_trains_for_more_episodes(env, preset):
    composed = composed_with(f"env={env}", "proxy=rn", f"preset={preset}", "agent=ppo")
    assert composed.training.max_episodes == 1000
    assert composed.agent == STUDIES[env].transfer_agent  # see test_experiments_rn.py


# --- the files -----------------------------------------------------------------------------------


def test_every_file_is_of_a_task_and_proxy_and_has_settings_of_known_choices():
    for stem in presets.PRESETS.keys() - {presets.BASES}:
        env, _, proxy = stem.rpartition("-")
        assert proxy in registry.names("proxy")
        assert env in (presets.GENERAL, *registry.names("env"))
        for section in presets.sections_of(env, proxy).values():
            for group in ("agent", "es", "objective"):
                assert set(section.get(f"with_{group}", {})) <= set(registry.names(group))


@pytest.mark.parametrize(("proxy", "generations"), [("se", 100), ("rn", 50)])
def test_a_task_without_a_file_has_general_settings(proxy, generations):
    words = ["env=gymnax/MountainCar-v0", f"proxy={proxy}"]
    assert composed_with(*words).generations == generations
    assert refused(sejax.config, [*words, "preset=paper"]) == "preset"


@pytest.mark.parametrize(("env", "steps"), [("mountain_car", 2000), ("halfcheetah", 200)])
def test_settings_of_an_objective_hold_for_that_objective(env, steps):
    assert sejax.config([f"env={env}"]).objective.first_eval_steps == steps
    assert not hasattr(sejax.config([f"env={env}", "objective=auc"]).objective, "first_eval_steps")
