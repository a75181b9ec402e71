"""sejax.options.registry: names become objects; one's own parts take part in everything."""

import dataclasses
import importlib.metadata
import re
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from support import refusal
from support import refused as field_of

import sejax
from sejax import envs
from sejax.agents import AgentConfig
from sejax.options import registry
from sejax.options.plain import configure, to_plain
from sejax.runs.config import LearnConfig

EVERY = [(group, name) for group in registry.GROUPS for name in registry.BUILT_IN[group]]
EXAMPLES = Path(__file__).parents[1] / "examples"


def refused(group, name, **fields):
    """The message of what cannot be configured; short, and at fault is the group or a field."""
    error = refusal(configure, group, {"name": name, **fields})
    assert error.field.partition(".")[0] == group
    return str(error)


@pytest.fixture
def module(tmp_path, monkeypatch, request):
    """Writes a module of the user's own: `module(text) -> its name`."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    name = f"mine_{abs(hash(request.node.nodeid)) % 10**6}"

    def write(text):
        (tmp_path / f"{name}.py").write_text(text)
        return name

    yield write
    sys.modules.pop(name, None)


# --- what comes with sejax -----------------------------------------------------------------------


@pytest.mark.parametrize(("group", "name"), EVERY)
def test_a_configuration_is_read_back_from_its_plain_values(group, name, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)  # also without Ray
    config = configure(group, {"name": name})
    assert configure(group, to_plain(config, group)) == config
    assert registry.name_of(group, config) == name
    assert type(config) is registry.find(group, name)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Torso(AgentConfig):
    """An agent's configuration that holds another dataclass, a number, a list and a function."""

    torso: nn.Module = nn.Dense(8)  # noqa: RUF009 (frozen)
    rate: float = 1.0
    sizes: Any = (1, 2)
    act: Any = len

    def make(self, task):
        return dataclasses.replace(sejax.QLearningConfig().make(task))


def test_configurations_are_the_same_if_classes_and_fields_are_at_any_depth():
    task = envs.make("cliff_walking")
    assert sejax.make_agent(Torso(), task) is sejax.make_agent(Torso(torso=nn.Dense(8)), task)
    unhashable, other = Torso(sizes=[1, 2]), envs.make("gridworld_2x2")
    first, again, elsewhere = (sejax.make_agent(unhashable, x) for x in (task, task, other))
    assert first is again and first is not elsewhere  # the same as itself alone
    variants = [
        {}, {"torso": nn.DenseGeneral(8)}, {"torso": nn.Dense(9)}, {"rate": 2.0}, {"act": sum},
        {"torso": nn.Dense(8, dtype=jnp.float16)}, {"sizes": [1, 2]}, {"sizes": (1, 3)},
        {"sizes": np.arange(5000)},  # too long for its repr to tell it from another
    ]  # fmt: skip
    agents = [sejax.make_agent(Torso(**fields), task) for fields in variants]
    assert len(set(map(id, agents))) == len(variants)


# --- entry points of installed packages ----------------------------------------------------------


MINE = """
import dataclasses, sejax

@dataclasses.dataclass(frozen=True, kw_only=True)
class Mine(sejax.QLearningConfig):
    extra: int = 1
"""


@pytest.fixture
def offered(module, monkeypatch):
    """A package that offers three agents: a good one, a broken one, and a `ddqn`."""
    name = module(MINE)
    points = [
        importlib.metadata.EntryPoint(key, f"{name}:{attribute}", "sejax.agents")
        for key, attribute in (("mine", "Mine"), ("broken", "Nope"), ("ddqn", "Mine"))
    ]
    offers = {"sejax.agents": points}
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: offers.get(group, []))
    registry._paths.cache_clear()
    yield name
    registry._paths.cache_clear()


def test_a_packages_plugin_is_known_by_its_name_and_imported_when_it_is_chosen(offered):
    assert registry.names("agent")[-2:] == ["mine", "broken"]
    sejax.config()  # somebody else's choice does not import it
    assert offered not in sys.modules
    config = sejax.config(["env=gridworld_2x2", "agent=mine", "agent.extra=3"])
    assert (config.agent.extra, config.name("agent")) == (3, "mine")
    assert LearnConfig.of_stored(config.plain()) == config
    assert registry.find("agent", "ddqn") is sejax.DDQNConfig  # a name of sejax's own stays
    assert "'Nope'" in refused("agent", "broken")


# --- module:attribute ----------------------------------------------------------------------------

SEVERAL = """
import dataclasses, functools
import sejax
from sejax.es.nes import NESConfig

@dataclasses.dataclass(frozen=True)
class Scaled:
    scale: float = 2.0
    needed: int = dataclasses.field(kw_only=True)

    def make(self, task):
        return sejax.Objective(score=lambda outcome: self.scale * outcome.test_return)

class Outer:
    Inner = Scaled

def scaled(task, scale: float, offset: float = 0.0, steps: tuple[int, ...] = (1, 2), also=[3]):
    return sejax.Objective(score=lambda outcome: scale * outcome.test_return + offset)

def unknown(task, scale=2.0) -> "Unknown | Objective":
    return scaled(task, scale)

wrong = lambda task: 3
named = lambda task, name="pole": 3
too_few = lambda: 3
def unsized(task, size: int = "large"): return 3
of_any = lambda task, *values, **more: 3
Named = dataclasses.make_dataclass("Named", ["name"], namespace={"make": staticmethod(wrong)})
Swapped = dataclasses.make_dataclass("Swapped", [], namespace={"make": lambda self: 3})

class Decorated(Scaled):
    make = functools.wraps(too_few)(lambda self, task: Scaled.make(self, task))

@dataclasses.dataclass(frozen=True)
class Plain:
    scale: "Unknown" = 2.0

class Vague(Plain):
    def make(self, task):
        return None

a_number = 3

def search(num_dims, pairs: int = 2) -> sejax.Strategy:
    return NESConfig(population_size=pairs).make(num_dims)

def task(sizes: list[int] = [1, 2], length: float = None) -> 'sejax.Task':
    task = sejax.envs.make('cartpole')
    return sejax.Task(name=f'of_{sizes}_{length}', env=task.env, params=task.params)
"""


@pytest.mark.parametrize(("attribute", "values"), [
    ("Scaled", {"scale": 3.0, "needed": 1}), ("Outer.Inner", {"scale": 2.0, "needed": 1}),
    ("scaled", {"scale": 3.0, "offset": 0.0, "steps": (4,), "also": [3]}),
    ("Decorated", {"needed": 1}), ("unknown", {"scale": 2.0}),  # no known return type
])  # fmt: skip
def test_a_dataclass_or_a_function_of_ones_own_is_found_by_its_module_and_name(
    module, attribute, values
):
    name = f"{module(SEVERAL)}:{attribute}"
    config = configure("objective", {"name": name, **values})
    assert {field: getattr(config, field) for field in values} == values
    assert registry.name_of("objective", config) == name
    assert configure("objective", to_plain(config, "objective")) == config
    task = envs.make("cartpole")
    objective = registry.make("objective", config, task)
    assert isinstance(objective, sejax.Objective)
    assert objective is registry.make("objective", config, task)


@pytest.mark.parametrize(("attribute", "fields", "said"), [
    ("Scaled", {}, "objective.needed"), ("scaled", {"scale": "x"}, "objective.scale"),
    ("scaled", {"scal": 1}, "objective.scale"), ("a_number", {}, "a dataclass with make(task)"),
    ("Plain", {}, "a dataclass with make(task)"), ("Outer", {}, "a dataclass with make(task)"),
    ("named", {}, "must take (task, option=default, ...)"),
    ("Swapped", {}, "a dataclass with make(task)"), ("unsized", {}, "objective.size must"),
    ("too_few", {}, "must take (task, option=default, ...)"),
    ("Vague", {"scale": 2}, "'Unknown' is not defined"), ("a_number.nope", {}, "'nope'"),
    ("of_any", {}, "must take (task, option=default, ...)"), ("Named", {}, "no field `name`"),
])  # fmt: skip
def test_what_is_no_plugin_is_one_message(module, attribute, fields, said):
    assert said in refused("objective", f"{module(SEVERAL)}:{attribute}", **fields)


def test_parameters_are_options_of_the_command_line(module):
    name = module(SEVERAL)
    for words, task in (("env.length=null", "of_[1, 2]_None"),
                        ("env.sizes=[3,4] env.length=2", "of_[3, 4]_2.0")):  # fmt: skip
        assert sejax.config([f"env={name}:task", *words.split()]).task().name == task
    config = sejax.config([f"es={name}:search", "es.pairs=3"])
    assert registry.make("es", config.es, 2).num_candidates == 6


def test_a_plugin_must_make_what_its_group_is_of(module):
    config = configure("objective", {"name": f"{module(SEVERAL)}:wrong"})
    error = refusal(registry.make, "objective", config, envs.make("cartpole"))
    assert error.field == "objective" and "got int from mine_" in str(error)


def test_a_module_that_is_not_there_or_raises_is_one_message(module):
    assert "ModuleNotFoundError" in refused("agent", "no_such_module_at_all:Agent")
    said = refused("agent", f"{module('raise RuntimeError(chr(10).join([chr(120)] * 9000))')}:A")
    raised = r"raised RuntimeError: x.*\(mine_\d+\.py:1: raise RuntimeError\(.*\)\)\.$"
    assert re.search(raised, said)


@pytest.mark.parametrize(("typed", "meant"), [
    ("my_package.tasks.make", "env=my_package.tasks:make"), ("CartPole-v1", "env=cartpole_v1"),
    ("my_tasks.py:make_long_pole", "env=my_tasks:make_long_pole"), ("CARTPOLE", "env=cartpole."),
    ("examples/own_task.py:make", "env=examples.own_task:make"), ("1:2", "env=my_module:MyClass"),
])  # fmt: skip
def test_a_name_in_another_notation_is_answered_with_ours(typed, meant):
    assert meant in refused("env", typed)


@pytest.mark.parametrize("name", ["tabnanny:", ":join", "a b:c", "tabnanny:path-x"])
def test_what_is_no_module_and_attribute_is_not_imported(name):
    before = set(sys.modules)
    refused("agent", name)
    assert set(sys.modules) == before


@pytest.mark.parametrize("values", [None, "ddqn", {}, {"discount": 0.5}, {"name": 3}, {"name": {}},
                                    {"name": ""}, {"name": "x" * 10_000}])  # fmt: skip
def test_values_without_a_known_name_are_refused(values):
    assert field_of(configure, "agent", values) == "agent"


# --- everything of one's own ---------------------------------------------------------------------


@pytest.fixture
def own(monkeypatch):
    """A configuration with a task, an agent, a proxy and an objective of the examples."""
    monkeypatch.syspath_prepend(EXAMPLES)
    parts = ("env=own_task:make_reacher", "agent=own_agent:SAC", "proxy=own_proxy:LinearSE")
    words = [*parts, "objective=own_objective:RiskAverse", "env.size=4", "training.max_steps=200"]
    yield sejax.config([*words, "generations=1", "devices=1"])
    for name in ("own_task", "own_agent", "own_proxy", "own_objective"):
        del sys.modules[name]


def test_the_same_parts_as_objects_are_the_same_program(own):
    task = envs.make("own_task:make_reacher", size=4)
    agent, objective = sejax.make_agent(own.agent, task), own.objective.make(task)
    parts = {"proxy": own.proxy, "es": own.es, "objective": objective, "training": own.training}
    by_objects = sejax.make_learner(task=task, agent=agent, **parts, generations=1, devices=1)

    def program(learn):
        return re.sub(r"0x[0-9a-f]+", "", str(jax.make_jaxpr(learn)(jax.random.key(0))))

    assert program(by_objects) == program(sejax.make_learner(own))
    with pytest.raises(TypeError, match="must be set"):
        sejax.make_learner(own, devices=1)


def test_parts_that_do_not_fit_are_refused(own):
    task, other = own.env.make(), own.env.make()
    parts = {"task": task, "agent": own.agent.make(task), "proxy": own.proxy.make(other)}
    assert field_of(sejax.make_learner, **parts) == "proxy"
    walk = envs.make("cliff_walking")
    assert field_of(sejax.make_agent, Torso(), walk, varied=True) == "agent_hparams"
