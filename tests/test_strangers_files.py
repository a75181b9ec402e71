"""What a stranger's file names is shown as text: only what the command line names is imported.

Every command reads one file of each kind that names code: a module that leaves a file when it is
imported, or a function of Python's own that runs a shell command.
"""

import functools
import importlib
import sys
from dataclasses import make_dataclass
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml
from support import ended, forge, paper_se, refusal

import sejax
from experiments import se_histograms
from sejax import evaluate, run
from sejax.distill import __main__ as distill
from sejax.ops import checksummed
from sejax.options import registry
from sejax.options.plain import plugin
from sejax.runs import commands
from sejax.runs.config import LearnConfig
from sejax.runs.run_directory import COLUMNS
from sejax.runs.store import Store
from sejax.search import __main__ as search
from sejax.search import config as settings

IMPORTED, SHELL = "strangers_module:make", {"name": "subprocess:getoutput", "cmd": "touch PWNED"}
TASK = ["env=gridworld_2x2", "agent=q_learning"]
MODULE = """
from pathlib import Path
import sejax
Path("PWNED").touch()
def make() -> sejax.Task:
    return sejax.envs.make("gridworld_2x2")
"""
SPACE = "es.noise_std=interval(0.1, 0.9)"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, where nobody may leave a file PWNED, and a module that does."""
    (tmp_path / "strangers_module.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    was_imported = sys.modules.pop("strangers_module", None) is not None
    assert not was_imported and not (tmp_path / "PWNED").exists()


@pytest.fixture
def refused(monkeypatch, capsys):
    """Runs a command that must end with one message and exit code 2; returns the message."""

    def refuse(command, *words):
        status, _, said = ended(monkeypatch, capsys, command, *words)
        assert status == commands.BAD_INPUT, said
        assert said.startswith("error: ") and said.count("\n") == 1
        return said

    return refuse


run_command, evaluate_command, search_command, distill_command, check_command = (
    functools.partial(commands.start, module.main, module.help_text)
    for module in (run, evaluate, search, distill, importlib.import_module("sejax.check"))
)


def stored(*words, **changes):
    """A run's configuration as plain values, with some of somebody else's."""
    return sejax.config([*TASK, *words]).plain() | changes


def write_run(path, config):
    """A run directory with rows of one generation."""
    path.mkdir()
    (path / "config.yaml").write_text(yaml.safe_dump(config))
    row = "0,0,1.0,0.0,0.0,1.0,1.0,20,20,2.0,0,10,0.5"
    (path / "metrics.csv").write_text(f"{','.join(COLUMNS)}\n{row}\n")
    return path


FOREIGN = [
    {"env": SHELL},
    {"env": {"name": IMPORTED}},
    {"agents": None, "agent": {"name": IMPORTED}},
    {"proxy": {"name": IMPORTED}},
    {"es": {"name": IMPORTED}},
    {"objective": {"name": IMPORTED}},
    {"es": {"name": "nes", "score_transform": IMPORTED}},
    {"exploration": {"name": IMPORTED}},
    {"agents": {"ddqn": {"name": IMPORTED, "weight": 1.0}}},
]
NAMES = [f"{next(iter(x))}-{i}" for i, x in enumerate(FOREIGN)]


@pytest.mark.parametrize("foreign", FOREIGN, ids=NAMES)
def test_what_a_run_stores_is_compared_and_shown_as_text(folder, refused, foreign):
    assert isinstance(refusal(LearnConfig.of_stored, stored(**foreign)), sejax.ConfigError)
    path = write_run(folder / "run", stored(**foreign))
    assert "run_dir must be new or hold" in refused(run_command, *TASK, f"run_dir={path}")
    rows = {"metrics": np.frombuffer(f"{','.join(COLUMNS)}\n".encode(), np.uint8)}
    manifest = {"format_version": 1, "config": stored(**foreign), "id": "0", "cpu_s": 1.0}
    (path / "checkpoint.safetensors").write_bytes(checksummed.pack(rows, "sejax_run", manifest))
    assert "the same settings" in refused(run_command, *TASK, f"run_dir={path}")


PRESETS = [
    {"env": SHELL["name"], "env.cmd": SHELL["cmd"]},
    {"env": {"name": IMPORTED}}, {"env": IMPORTED}, {"agent": IMPORTED},
    {"agents": ["ddqn", IMPORTED]},
    {"agents": ["ddqn", "ppo"], "agents.ddqn.name": IMPORTED},
    {"agents": {"ppo": {"name": IMPORTED}}},
    {"agents.ppo": {"name": "${oc.decode:strangers_module}:make"}, "agents": ["ddqn", "ppo"]},
    {"es.score_transform": IMPORTED}, {"tracker": IMPORTED}, {"policy": IMPORTED},
    {"es.score_transform": f"'{IMPORTED}'"}, {"agents": f"[ddqn, '{IMPORTED}']"},
    {"es.score_transform": IMPORTED.encode()}, {"policy": IMPORTED.encode()},  # !!binary
    {"es.score_transform": "strangers_module:é".encode()}, {"algorithms": [IMPORTED]},
]  # fmt: skip


@pytest.mark.parametrize("preset", PRESETS, ids=range(len(PRESETS)))
def test_a_preset_file_names_no_module(folder, refused, preset):
    (folder / "p.yaml").write_text(yaml.safe_dump(preset))
    refused(run_command, "preset=p.yaml")
    refused(distill_command, "preset=p.yaml")
    refused(evaluate_command, "preset=p.yaml", "proxy=cartpole")
    refused(check_command, "preset=p.yaml", "proxy=cartpole")
    refused(search_command, "preset=p.yaml", SPACE)


def test_what_is_typed_beside_a_preset_file_is_imported(folder):
    (folder / "p.yaml").write_text("env: mine_beside:make\nes.noise_std: 0.3\n")
    (folder / "mine_beside.py").write_text(MODULE.replace("PWNED", "typed"))
    config = sejax.config(["preset=p.yaml", "env=mine_beside:make"])
    assert config.name("env") == "mine_beside:make" and config.es.noise_std == 0.3
    assert (folder / "typed").exists()


def test_other_texts_with_a_colon_are_taken_but_no_address_of_a_cluster(folder):
    (folder / "p.yaml").write_text("run_dir: runs/env:cartpole\n")
    assert sejax.config(["preset=p.yaml"]).run_dir == "runs/env:cartpole"
    assert distill.DistillConfig.of_words([r"policy=ppo:models\best.zip"]).policy
    (folder / "p.yaml").write_text("machines: ray\nmachines.address: theirs:6379\n")
    assert refusal(sejax.config, ["preset=p.yaml"]).field == "machines.address"


STUDIES = [
    {"env": SHELL},
    {"env": {"name": IMPORTED}},
    {"ranges": {"agent": f"choice(q_learning,{IMPORTED})"}},
    {"run_dir": "victim"},
]


@pytest.mark.parametrize("stored", STUDIES, ids=range(len(STUDIES)))
def test_a_study_is_compared_as_text(folder, refused, stored):
    words = [*TASK, SPACE, f"search_dir={folder / 'theirs'}"]
    Store(folder / "theirs", settings.plan_of(words).settings() | stored).put("search")
    assert "search_dir must be" in refused(search_command, *words)
    assert not (folder / "victim").exists()


PROXIES = [x for x in FOREIGN if {"env", "proxy", "agents"} & {*x}]
PROXIES += [{"agents": {"x": {}}}, {"exploration": {}}]  # without names


def write_proxy(config):
    """An SE of several steps with random weights that was learned with somebody else's parts."""
    task = sejax.envs.make("cartpole")
    env = registry.make("proxy", paper_se(hidden_size=2), task)
    weights, usual = env.init_weights(jax.random.key(0)), sejax.config().plain()
    sejax.save("evil.safetensors", env, weights, config=usual)
    forge(Path("evil.safetensors"), **config)


@pytest.mark.parametrize("foreign", PROXIES, ids=range(len(PROXIES)))
def test_a_proxys_file_names_no_module(folder, refused, foreign):
    write_proxy(foreign)
    refused(evaluate_command, "proxy=evil.safetensors", "agent_hparams=as_learned", "out_dir=out")


FIELDS, OPTIONS = [("inner", object, plugin("es"))], {"frozen": True, "kw_only": True}
Nested = make_dataclass("Nested", FIELDS, bases=(sejax.QLearningConfig,), **OPTIONS)


def test_nor_does_it_with_a_key_of_a_preset_or_within_an_agent(folder, refused, monkeypatch):
    (folder / "p.yaml").write_text(f"{IMPORTED}: 1\n")
    write_proxy({"agents": {"x": {"name": IMPORTED}}})
    refused(evaluate_command, "preset=p.yaml", "proxy=evil.safetensors")
    monkeypatch.setitem(registry._paths("agent"), "nested", f"{__name__}:Nested")
    write_proxy({"agents": {"x": {"name": "nested", "inner": {"name": IMPORTED}}}})
    refused(evaluate_command, "proxy=evil.safetensors", "agent=nested")
    assert refusal(sejax.training_of, sejax.load("evil.safetensors")[0], sejax.PPOConfig())


@pytest.mark.parametrize("foreign", [x for x in FOREIGN if {"env", "proxy"} & {*x}])
def test_an_experiment_imports_nothing_that_a_set_names(folder, refused, foreign):
    write_proxy(foreign)
    refused(se_histograms.EXPERIMENT.main, "quick=true", "proxy=evil.safetensors", "out=out")
