"""sejax.options: a field written once checks itself, and says whether it is traced or varied."""

import dataclasses
import pickle
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydantic import Field
from support import refusal

import sejax
from sejax import options
from sejax.agents import traced
from sejax.agents.tabular import QLearningConfig
from sejax.agents.varied import ranges_of
from sejax.options import Options, Positive, option
from sejax.runs.commands import help_texts

NAN, INF = float("nan"), float("inf")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(Options):
    """One option of each rule."""

    group: ClassVar[str] = "group"

    size: options.Count = 4
    episodes: options.WholeNumber = 2
    limit: options.Count | None = None
    weight: options.NonNegative = option(0.5, traced=True)
    rate: Annotated[float, Field(ge=1e-30, le=10)] = option(0.1, varied="triple")
    share: options.Fraction = option(0.9, traced=True, varied="tenth_to_one")
    goal: options.Finite = -1.0
    decay: options.Decay = 1.0
    kind: Literal["plain", "fancy"] = "plain"
    free: Any = "anything"  # a field like any other, which nothing holds for
    unruled: float = 3.0


# --- rules ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("field", "values"), [
    ("size", [0, NAN, True, "x", None, 2**31, 1.5, np.bool_(True), np.ones(2)]),
    ("episodes", [-1, NAN]), ("limit", [0, "x"]), ("weight", [-0.1, NAN, INF, 1e31]),
    ("share", [1.5, -0.5, NAN]), ("rate", [0, INF, NAN, 11, 5e-324, "x"]),
    ("goal", [INF, NAN, "low", -1e300]), ("decay", [0, 1.5, NAN]), ("kind", ["fency", None, 3]),
])  # fmt: skip
def test_a_value_that_breaks_its_rule_is_refused(field, values):
    for value in values:
        error = refusal(Config, **{field: value})
        assert error.field == f"group.{field}"
        assert f"group.{field}=" in str(error)  # how to mend it


@pytest.mark.parametrize(("field", "values"), [
    ("size", [1, 2**31 - 1]), ("episodes", [0]), ("limit", [None, 1]), ("weight", [0, 1e30]),
    ("rate", [1e-30, 10]), ("share", [0, 1]), ("decay", [1, 1e-6]), ("goal", [-3]),
    ("kind", ["fancy"]), ("free", [-1]),
])  # fmt: skip
def test_a_value_at_the_edge_of_its_rule_is_taken(field, values):
    for value in values:
        assert getattr(Config(**{field: value}), field) == value


# --- what is traced, and what is varied ----------------------------------------------------------


def test_a_subclass_that_changes_a_default_keeps_marks_and_help_text():
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Mine(QLearningConfig):
        learning_rate: Positive = 0.5

    assert traced(Mine()).learning_rate == 0.5
    assert "agent.learning_rate=0.5." in str(refusal(Mine, learning_rate=0))
    assert list(ranges_of(Mine())) == ["learning_rate", "discount"]
    assert help_texts(Mine) == help_texts(QLearningConfig) != {}


def test_numbers_of_numpy_and_jax_become_pythons_and_a_path_becomes_text():
    config = Config(size=np.int64(3), rate=np.float32(0.5), share=jnp.float32(0.25),
                    unruled=np.float64(2), limit=jnp.int32(9), free=Path("x"))  # fmt: skip
    assert config == Config(size=3, rate=0.5, share=0.25, unruled=2.0, limit=9, free="x")
    assert type(config.size) is type(config.limit) is int
    assert {type(getattr(config, name)) for name in ("rate", "share", "unruled")} == {float}
    key = jax.random.key(0)
    assert Config(free=key).free is key and Config(free=np.float32).free is np.float32


def test_errors_name_the_field_and_survive_pickling():  # workers on other machines send them
    error = refusal(sejax.DDQNConfig, batch_size=0)
    assert error.field == pickle.loads(pickle.dumps(error)).field == "agent.batch_size"
