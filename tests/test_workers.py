"""Trainings that workers compute: the numbers of a single process, without Ray."""

import json
import os
import sys
from pathlib import Path

import jax
import pytest
from support import ROOM, bits, printed, refusal, refused

import sejax
from sejax.runs import ray, runtime
from sejax.runs.chunks import Chunks
from sejax.runs.ray import RemoteChunks


def require_equal_numbers(words, generations):
    """Runs generations in one program, and in shares, of which the last one comes first."""
    config = sejax.config(words)
    setup = json.dumps(config.plain())
    sizes = []

    def compute(shares):
        sizes.extend(len(trainings.active) for _, trainings in shares)
        return [ray.outcomes_of(setup, share) for share in reversed(shares)][::-1]

    remote = RemoteChunks(config, compute)
    local = Chunks(config, devices=1)
    local.compile(1)
    remote.compile(1)
    state, other = local.init(jax.random.key(0)), remote.init(jax.random.key(0))
    for _ in range(generations):
        state, info = local.advance(state, 1)
        other, other_info = remote.advance(other, 1)
        assert bits((state, info)) == bits((other, other_info))
    assert remote.cpu_s > 0 and len(sizes) > generations
    return state


SOLVING = [*ROOM, "es.population_size=4", "stop_when_solved=true", "num_parallel=2"]


def test_workers_give_the_numbers_of_one_process_to_the_last_bit():
    state = require_equal_numbers([*SOLVING, "agent.learning_rate=0.5"], 4)
    assert bool(state.solved)  # so that nothing was computed in some of them


CASES = {
    "mixture": [*SOLVING, "agents=[q_learning,sarsa]"],
    "batches": ["env=cartpole", "es.population_size=4"],
    "curriculum": [
        *("env=pendulum", "es.population_size=4", "training.max_steps=200"),
        *("training.max_episodes=200", "objective.first_eval_steps=50"),
    ],
    "evosax": ["env=cliff_walking", "proxy=rn", "es=cma_es", "es.population_size=8"],
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_so_they_do_with_the_flags_of_a_command(case):
    program = (
        "from sejax.runs import runtime; runtime.configure_xla(1)\n"
        "import sys, test_workers\n"
        "test_workers.require_equal_numbers(sys.argv[1:], 3)"
    )
    environment = {name: x for name, x in os.environ.items() if name != "XLA_FLAGS"}
    folder = Path(__file__).parent
    printed(sys.executable, "-c", program, *CASES[case], env=environment, cwd=folder)


def make_room():
    return sejax.envs.make("gridworld_2x2")


def test_a_worker_imports_the_plugins_that_were_typed():
    config = sejax.config(["env=test_workers:make_room", *SOLVING[1:]])
    assert len(ray._share_programs(json.dumps(config.plain()))) == 1


def test_a_worker_with_other_versions_is_refused(monkeypatch):
    versions = runtime.versions()
    monkeypatch.setattr(runtime, "versions", lambda: {"jax": "0.1"})
    error = refusal(ray.call, versions, ray.outcomes_of, (0, ()))
    assert error.field == "machines" and "0.1" in str(error)


@pytest.mark.parametrize(
    ("words", "field"), [(["devices=2"], "devices"), (["machines.workers=0"], "machines.workers")]
)
def test_settings_that_no_worker_can_have_are_refused(words, field, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: "there")
    assert refused(sejax.config, ["machines=ray", *words]) == field
