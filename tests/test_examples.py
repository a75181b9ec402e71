"""The scripts in examples/: each runs, in a small size, in a folder that is not the repository."""

import importlib
import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from support import printed, refused

import sejax
from sejax.proxies import header

EXAMPLES = Path(__file__).parents[1] / "examples"
TINY = {
    "algorithm1": ["--generations=0"],
    "own_task": ["--generations=1", "--population=2", "--steps=60"],
    "own_agent": ["--seeds=2", "--steps=20"],
    "own_objective": ["--generations=1", "--population=2", "--agents=2", "--steps=250"],
    "own_proxy": ["--generations=1", "--population=2", "--steps=250"],
    "read_a_set": ["--agents=3", "--size=2", "--generations=2"],
    "other_suites": ["env=gymnax/Catch-bsuite", "env.solved_reward=0.8", "generations=1",
                     "es.population_size=2", "training.max_steps=200"],
    "train_thousands": ["--agents=6", "--num_parallel=2"],
    "sb3_agents": ["--steps=10", "--seeds=1", "--episodes=1"],
    "sbx_agent": ["--steps=10", "--seeds=1", "--episodes=1"],
    "cleanrl_dqn": ["--total-steps=60", "--test-every=30", "--test-episodes=1",
                    "--learning-starts=40", "--batch-size=4", "--target-frequency=2"],
    "reward_network_wrapper": ["--agents=A2C", "--seeds=1", "--max-steps=10", "--test-every=5",
                               "--episodes=1"],
    "rejax_agent": ["--steps=80", "--test-every=40", "--agents=2", "--episodes=2"],
    "rejax_mujoco": ["--env=reacher", "--steps=128", "--test-every=64", "--rollout=64"],
}  # fmt: skip
PRINTS = {
    "algorithm1": r"^generation 0: new agents return \d+\.\d\n$",
    "own_task": r"best -\d+\.\d+ in generation 0; solved at -1",
    "own_agent": r"test return of each agent: -\d+ -\d+\nmean -\d+",
    "own_objective": r"MaxReward: mean return .*\nRiskAverse: mean return",
    "own_proxy": r"linear_cartpole\.safetensors: best \d+, 35 weights",
    "read_a_set": r"seed 0, .*3 fresh agents return .*\nseed 1,",
    "other_suites": r"with the RN: \d of 8 agents .*\nwithout it: \d of 8 agents",
    "train_thousands": r"proxy: 6 agents .*\n.*test return -12\.0\nreal task: 6 agents",
    "sb3_agents": r"(?s)cartpole  PPO +\d+\.0 ± 0.*DQN.*acrobot   PPO.*DQN +-\d+\.0 ± 0.0 +-\d",
    "sbx_agent": r"after 10 steps on the SE: \d+\n.*on CartPole: \d+\n",
    "cleanrl_dqn": r"return on CartPole-v1 every 30 steps on sejax\.gym:sejax/cartpole: \d+ \d+\n",
    "reward_network_wrapper": r"A2C with the RN: solved after .*median .*\nA2C without it: ",
    "rejax_agent": r"every 40 steps on the SE: \d+ \d+ \d+\n.*on CartPole: \d+ \d+ \d+\n",
    "rejax_mujoco": r"^score on reacher every 64 steps: -\d+ -\d+ -\d+\n$",
}
# What is not in the development environment; `make test-examples` has it.
NEEDS = {
    "sb3_agents": "stable_baselines3",
    "sbx_agent": "sbx",
    "cleanrl_dqn": "torch",
    "reward_network_wrapper": "stable_baselines3",
    "rejax_agent": "rejax",
    "rejax_mujoco": "rejax",
}


@pytest.fixture
def examples(monkeypatch, tmp_path):
    """Imports an example by its name, in an empty folder."""
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.chdir(tmp_path)
    yield importlib.import_module
    for name in TINY:
        sys.modules.pop(name, None)


def test_every_example_is_tested():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(TINY)


def _marked(name):
    """An example with its marks: warnings of another package are its own."""
    own = [pytest.mark.filterwarnings("default")] if name in NEEDS else []
    # Those without another package compile for seconds.
    return pytest.param(name, marks=[*own, *([] if name in NEEDS else [pytest.mark.slow])])


@pytest.mark.parametrize("name", [_marked(name) for name in TINY])
def test_it_runs(name, examples, monkeypatch, capsys):
    pytest.importorskip(NEEDS.get(name, "sejax"), reason="make test-examples installs it")
    monkeypatch.setattr(sys, "argv", [name, *TINY[name]])
    examples(name).main()
    assert re.search(PRINTS[name], capsys.readouterr().out)


@pytest.mark.slow
def test_a_command_takes_parts_from_its_folder_and_a_file_imports_none(examples, tmp_path):
    """What the command stores names them; it loads if task and proxy are given."""
    for name in ("own_task", "own_agent", "own_proxy", "own_objective"):
        shutil.copy(EXAMPLES / f"{name}.py", tmp_path)
    choices = ["env=own_task:make_reacher", "env.size=4", "agent=own_agent:SAC",
               "agent.hidden_size=8", "agent.warmup_episodes=1", "proxy=own_proxy:LinearSE",
               "objective=own_objective:RiskAverse", "objective.aversion=2"]  # fmt: skip
    small = ["generations=1", "es.population_size=2", "es.num_incumbent_evals=1", "devices=1",
             "training.max_steps=30", "run_dir=here"]  # fmt: skip
    printed(sys.executable, "-m", "sejax.run", *choices, *small, cwd=tmp_path)
    here, before = tmp_path / "here", set(sys.modules)
    assert header.read(here).header.config["env"] == {"name": "own_task:make_reacher", "size": 4}
    assert refused(sejax.load, here) == "proxy"
    assert set(sys.modules) == before
    proxy = examples("own_proxy").LinearSE()
    task = sejax.envs.make("own_task:make_reacher", size=4)
    assert refused(sejax.load, here, task=task) == "proxy"
    assert refused(sejax.load, here, proxy=proxy) == "task"
    env, _ = sejax.load(here, task=task, proxy=proxy)
    assert env.task is task and env.config == proxy


# --- algorithm1 ----------------------------------------------------------------------------------


def test_algorithm_1_is_one_short_file_without_sejax():
    text = (EXAMPLES / "algorithm1.py").read_text()
    imported = set(re.findall(r"^ *(?:from|import) (\w+)", text, re.MULTILINE))
    assert imported == {"argparse", "jax", "optax"}
    assert len(text.splitlines()) <= 160


@pytest.mark.slow
def test_algorithm_1_learns_an_se_whose_agents_solve_cartpole(tmp_path):
    compiled_in_full = os.environ | {"XLA_FLAGS": ""}
    said = printed(sys.executable, EXAMPLES / "algorithm1.py", cwd=tmp_path, env=compiled_in_full)
    returns = [float(line.rpartition(" ")[2]) for line in said.splitlines()]
    assert len(returns) == 51 and returns[0] < 60 and np.mean(returns[-5:]) > 170
