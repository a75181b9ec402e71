"""benchmarks/gpu.py on the CPU, and the loops that a GPU runs in blocks of steps."""

import json
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from support import printed

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def gpu(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import gpu

    return gpu


@pytest.mark.slow
def test_the_command_measures_and_writes_its_result(tmp_path):
    path = tmp_path / "gpu.json"
    said = printed(sys.executable, BENCHMARKS / "gpu.py", "--quick", "--json", path)
    result = json.loads(path.read_text())
    assert result["checks"] == {
        "largest_difference_of_weights": 0.0, "visits_of_the_host": 0, "copies_of_large_arrays": 0
    }  # fmt: skip
    (row,) = result["figures"]
    assert row["agents"] == 16 and row["steps"] == 16 * 64 and row["steps_per_s"] > 0
    assert 10 < result["kernels"]["quick DDQN"]["a_step"] < 100
    assert "Kernels of an agent step" in said


def test_kernels_are_counted_in_loops_and_functions_below_them(gpu):
    @jax.jit
    def inner(x):
        return x @ x

    def program(x):
        def step(_, x):
            return jax.lax.fori_loop(0, 3, lambda _, y: inner(y) + 1, x).sum(axis=0) + x

        return jax.lax.fori_loop(0, 5, step, x @ x)

    lowered = jax.jit(program).trace(np.ones((4, 4), np.float32))
    module = lowered.lower(lowering_platforms=("cuda",)).compiler_ir()
    functions = {x.attributes["sym_name"].value: x for x in module.body.operations}
    (loop,) = gpu.loops_of(functions["main"], functions)
    assert gpu.count(loop, functions) == {"dot_general": 1, "reduce": 1}  # not the first product


def test_facts_of_a_program_are_visits_and_large_copies(gpu):
    text = "%a = f32[300,400] copy(%b)\n%c = f32[30] copy(%d)\n%e = token[] outfeed(%f)\n"
    assert gpu.facts_of(text) == {"visits_of_the_host": 1, "copies_of_large_arrays": 1}
