"""benchmarks/gpu.py on the CPU."""

import json
import sys
from pathlib import Path

import pytest
from support import printed

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.slow
def test_the_command_measures_and_writes_its_result(tmp_path):
    path = tmp_path / "gpu.json"
    said = printed(sys.executable, BENCHMARKS / "gpu.py", "--quick", "--json", path)
    result = json.loads(path.read_text())
    zeros = "largest_difference_of_weights", "visits_of_the_host", "copies_of_large_arrays"
    assert result["checks"] == dict.fromkeys(zeros, 0)
    (row,) = result["figures"]
    assert row["agents"] == 16 and row["steps"] == 16 * 64 and row["steps_per_s"] > 0
    assert "quick DDQN trains" in said
