"""sejax.options.registry: names become objects; one's own parts take part in everything."""

import dataclasses
import importlib.metadata
import re
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

import sejax
from sejax import envs
from sejax.agents import AgentConfig
from sejax.cli import config as configuration
from sejax.es.evosax import ALGORITHMS
from sejax.options import ConfigError, registry

EVERY = [(group, name) for group in registry.GROUPS for name in registry.GROUPS[group].built_in]


def refused(group, name, **fields):
    with pytest.raises(ConfigError) as error:
        registry.configure(group, {"name": name, **fields})
    said = str(error.value)
    assert "\n" not in said and len(said) < 1500
    return said


@pytest.fixture
def module(tmp_path, monkeypatch, request):
    """Writes a module of the user's own: `module(text) -> its name`."""
    monkeypatch.syspath_prepend(str(tmp_path))
    name = f"mine_{re.sub(r'[^a-z0-9]', '_', request.node.name.lower())[:60]}"

    def write(text):
        (tmp_path / f"{name}.py").write_text(text)
        return name

    yield write
    sys.modules.pop(name, None)


# --- what comes with sejax -----------------------------------------------------------------------


@pytest.mark.parametrize(("group", "name"), EVERY)
def test_defaults_configure_and_describe_are_inverses(group, name):
    config = registry.configure(group, {"name": name})
    plain = registry.describe(group, config)
    assert plain == registry.defaults(group, name)
    assert registry.configure(group, plain) == config
    assert registry.name_of(group, config) == name
    assert type(config) is registry.find(group, name)
    assert registry.is_registered(group, name)


def test_every_algorithm_of_evosax_has_its_name():
    assert set(registry.names("es")) == {"nes", *ALGORITHMS}


def test_a_family_of_names_is_one_dataclass():
    config = registry.configure("env", {"name": "gymnax/MountainCar-v0", "max_steps": 90})
    assert config == envs.gymnax.GymnaxTask(name="gymnax/MountainCar-v0", max_steps=90)
    assert registry.configure("env", registry.describe("env", config)) == config
    assert registry.is_registered("env", "gymnax/anything")
    assert not registry.is_registered("agent", "gymnax/anything")


def test_equal_configurations_make_the_same_object():
    task = envs.make("gridworld_2x2")
    for group, values, arguments in [
        ("env", {"name": "cliff_walking", "goal_reward": -2}, ()),
        ("agent", {"name": "q_learning", "discount": 0.5}, (task,)),
        ("proxy", {"name": "se", "hidden_size": 3}, (task,)),
        ("objective", {"name": "max_reward"}, (task,)),
        ("es", {"name": "nes", "population_size": 2}, (5,)),
    ]:
        configs = [registry.configure(group, values) for _ in range(2)]
        first, second = (registry.make(group, config, *arguments) for config in configs)
        assert configs[0] is not configs[1] and first is second
    assert registry.make("es", configs[0], 6) is not first
    assert sejax.make_agent(sejax.QLearningConfig(), task) is sejax.make_agent(
        sejax.QLearningConfig(), task
    )


def test_configurations_that_differ_make_objects_that_differ():
    task = envs.make("gridworld_2x2")
    a, b = (registry.make("proxy", sejax.SyntheticConfig(hidden_size=n), task) for n in (3, 4))
    assert a is not b
    assert registry.make("env", registry.configure("env", {"name": "cliff_walking"})) is not a.task

    @dataclasses.dataclass(frozen=True)
    class Mapped:
        table: np.ndarray  # not hashable, and too long for its repr to tell it from another

        def make(self, task):
            return sejax.Objective(score=lambda outcome: self.table[0] * outcome.test_return)

    tables = [np.zeros(5000), np.arange(5000) == 2500]
    made = [registry.make("objective", Mapped(table), task) for table in tables]
    assert made[0] is not made[1]
    one = Mapped(np.zeros(5000))
    assert registry.make("objective", one, task) is registry.make("objective", one, task)


# --- entry points of installed packages ----------------------------------------------------------


@pytest.fixture
def offered(module, monkeypatch):
    """A package that offers three agents: a good one, a broken one, and a `ddqn`."""
    name = module(
        "import dataclasses, sejax\n"
        "@dataclasses.dataclass(frozen=True, kw_only=True)\n"
        "class Mine(sejax.QLearningConfig):\n"
        "    extra: int = 1\n"
    )
    points = [importlib.metadata.EntryPoint(key, f"{name}:{attribute}", "sejax.agents")
              for key, attribute in (("mine", "Mine"), ("broken", "Nope"),
                                     ("ddqn", "Mine"))]  # fmt: skip

    def entry_points(*, group):
        return points if group == "sejax.agents" else []

    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
    registry._offered.cache_clear()
    yield name
    registry._offered.cache_clear()


def test_a_packages_plugin_is_known_by_its_name_and_imported_when_it_is_chosen(offered):
    assert registry.names("agent")[-2:] == ["mine", "broken"]
    assert registry.is_registered("agent", "mine") and offered not in sys.modules
    sejax.config()  # somebody else's choice does not import it
    assert offered not in sys.modules
    words = ["env=gridworld_2x2", "agent=mine", "agent.extra=3", "agent.discount=0.5"]
    config = sejax.config(words)
    assert (config.agent.extra, config.agent.discount) == (3, 0.5)
    assert config.name("agent") == "mine"
    assert configuration.learn_config(configuration.plain(config)) == config
    assert str(config.resolved_run_dir) == "runs/gridworld_2x2-se-mine-s0"


def test_a_name_of_sejaxs_own_cannot_be_taken_over(offered):
    assert registry.find("agent", "ddqn") is sejax.DDQNConfig


def test_a_packages_plugin_that_is_broken_is_one_message(offered):
    said = refused("agent", "broken")
    assert said.startswith("agent must be a plugin that can be imported; 'broken' of ")
    assert "AttributeError" in said
    with pytest.raises(ConfigError, match="'broken' of"):
        sejax.config(["agent=broken"])


# --- module:attribute ----------------------------------------------------------------------------

SEVERAL = """
import dataclasses, functools
import sejax

@dataclasses.dataclass(frozen=True)
class Scaled:
    scale: float = 2.0
    needed: int = dataclasses.field(kw_only=True)

    def make(self, task):
        return sejax.Objective(score=lambda outcome: self.scale * outcome.test_return)

class Outer:
    Inner = Scaled

def scaled(
    task, scale: float, offset: float = 0.0, steps: tuple[int, ...] = (1, 2), also=[3]
) -> sejax.Objective:
    "Scaled returns."
    return sejax.Objective(score=lambda outcome: scale * outcome.test_return + offset)

doubled = functools.partial(scaled, scale=2.0)

def wrong(task) -> sejax.Objective:
    return 3

def too_few() -> sejax.Objective:
    return 3

def of_any(task, *values, **more) -> sejax.Objective:
    return 3

@dataclasses.dataclass(frozen=True)
class Plain:
    scale: float = 2.0

class NoDataclass:
    def make(self, task):
        return None

@dataclasses.dataclass(frozen=True)
class Vague:
    scale: "Unknown" = 1

    def make(self, task):
        return None

a_number = 3
"""


def test_a_dataclass_of_ones_own_is_found_by_its_module_and_name(module):
    name = module(SEVERAL)
    config = registry.configure("objective", {"name": f"{name}:Scaled", "scale": 3, "needed": 1})
    assert config.scale == 3.0 and type(config) is sys.modules[name].Scaled
    assert registry.name_of("objective", config) == f"{name}:Scaled"
    assert registry.configure("objective", registry.describe("objective", config)) == config
    assert registry.defaults("objective", f"{name}:Scaled") == {
        "name": f"{name}:Scaled", "scale": 2.0, "needed": "???",
    }  # fmt: skip
    objective = registry.make("objective", config, envs.make("cartpole"))
    assert isinstance(objective, sejax.Objective)
    assert registry.find("objective", f"{name}:Outer.Inner") is type(config)
    assert not registry.is_registered("objective", f"{name}:Scaled")
    said = refused("objective", f"{name}:Scaled")
    assert said == ("objective.needed must be given, because it has no default; got none. "
                    "Set objective.needed=VALUE.")  # fmt: skip


def test_a_functions_parameters_are_its_options(module):
    name = f"{module(SEVERAL)}:scaled"
    assert registry.defaults("objective", name) == {
        "name": name, "scale": "???", "offset": 0.0, "steps": [1, 2], "also": [3],
    }  # fmt: skip
    config = registry.configure("objective", {"name": name, "scale": 3, "steps": [4]})
    assert (config.scale, config.offset, config.steps) == (3.0, 0.0, (4,))
    assert config.also == (3,)
    assert registry.configure("objective", registry.describe("objective", config)) == config
    task = envs.make("cartpole")
    made = registry.make("objective", config, task)
    assert isinstance(made, sejax.Objective) and made is registry.make("objective", config, task)
    assert "objective.scale must be a number" in refused("objective", name, scale="x")
    assert "objective.scal must be a field" in refused("objective", name, scal=1)


def test_a_partial_function_is_a_plugin_too(module):
    name = f"{module(SEVERAL)}:doubled"
    config = registry.configure("objective", {"name": name})
    assert (config.scale, config.offset) == (2.0, 0.0)
    assert registry.name_of("objective", config) == name
    made = registry.make("objective", config, envs.make("cartpole"))
    assert isinstance(made, sejax.Objective)


def test_an_attribute_may_be_anything_that_is_found(module):
    name = module(SEVERAL)
    for attribute in ("a_number", "Plain", "NoDataclass"):
        said = refused("objective", f"{name}:{attribute}")
        assert said.startswith("objective must name a dataclass with make(task), or a function")
        assert f"{name}:{attribute} is " in said
    for attribute in ("too_few", "of_any"):
        said = refused("objective", f"{name}:{attribute}")
        assert said.startswith("objective must take (task, option=default, ...), because each")


def test_fields_of_unknown_types_are_one_message(module):
    said = refused("objective", f"{module(SEVERAL)}:Vague", scale=2)
    assert "must have fields of known types" in said and "'Unknown' is not defined" in said


def test_a_plugin_must_make_what_its_group_is_of(module):
    config = registry.configure("objective", {"name": f"{module(SEVERAL)}:wrong"})
    with pytest.raises(
        ConfigError,
        match=r"^objective must make a sejax\.Objective, because that "
        r"is what is used; got int from mine_.*:wrong\. Set obj",
    ):
        registry.make("objective", config, envs.make("cartpole"))  # fmt: skip


def test_a_module_that_is_not_there_or_raises_is_one_message(module):
    said = refused("agent", "no_such_module_at_all:Agent")
    assert said.startswith("agent must name a module that can be imported; no_such_module_at_all")
    assert "ModuleNotFoundError" in said and said.endswith("add that folder to PYTHONPATH.")
    said = refused("agent", f"{module('raise RuntimeError(chr(10).join([chr(120)] * 9000))')}:A")
    assert "raised RuntimeError: x" in said


@pytest.mark.parametrize("annotation", ["", " -> int", " -> 'Unknown'", " -> sejax.Agent"])
def test_a_function_that_does_not_say_what_it_makes_is_not_called(module, annotation):
    name = module(f"import sejax\ndef f(task){annotation}:\n    raise SystemExit('called')\n")
    assert "-> Objective" in refused("objective", f"{name}:f")


@pytest.mark.parametrize("annotation", ["sejax.Objective", "'Unknown | Objective'", "Mine | None"])
def test_a_function_may_say_what_it_makes_in_several_ways(module, annotation):
    name = module("import sejax\nclass Mine(sejax.Objective):\n    pass\n"
                  f"def f(task) -> {annotation}:\n    return None\n")  # fmt: skip
    assert registry.configure("objective", {"name": f"{name}:f"})


def test_a_missing_attribute_lists_what_the_module_has(module):
    said = refused("objective", f"{module(SEVERAL)}:scled")
    assert "must name a class or function of mine_" in said and "got scled" in said
    assert re.search(r"Did you mean objective=mine_\w+:scaled\?$", said)


def test_a_module_without_classes_and_functions_has_nothing_to_choose(module):
    said = refused("objective", f"{module('x = 3')}:y")
    assert said.endswith("got y. There are: none.")


@pytest.mark.parametrize("name", ["os.path:", ":join", "a b:c", "os;x:y", "os:path-x", "1:2"])
def test_what_is_no_module_and_attribute_is_not_imported(name):
    before = set(sys.modules)
    assert refused("agent", name).startswith("agent must be a name or module:attribute, because")
    assert set(sys.modules) == before


@pytest.mark.parametrize("values", [None, 3, "ddqn", [], {}, {"discount": 0.5}])
def test_values_without_a_name_are_refused(values):
    with pytest.raises(ConfigError, match=r"^agent must be a choice with its fields, because one"):
        registry.configure("agent", values)


@pytest.mark.parametrize("name", [None, 3, ["ddqn"], {"a": 1}, "", "x" * 10_000])
def test_a_name_that_is_none_lists_the_known_ones(name):
    assert refused("agent", name).startswith("agent must be one of ")


# --- everything of one's own ---------------------------------------------------------------------

WHOLE = '''
"""A line of places, a table of two numbers, a guessed reward, a search."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces

import sejax
from sejax.agents import AgentConfig, no_buffer
from sejax.es.nes import NESConfig, make_nes


@struct.dataclass
class LineState(environment.EnvState):
    place: Any


class Line(environment.Environment):
    """Goes right for 1; its end terminates. Its info is empty, its actions are two."""

    def __init__(self, length):
        self.length = length

    @property
    def default_params(self):
        return environment.EnvParams(max_steps_in_episode=6)

    def reset_env(self, key, params):
        return jnp.zeros((2, 1)), LineState(time=0, place=jnp.int32(0))

    def step_env(self, key, state, action, params):
        state = LineState(time=state.time + 1, place=state.place + action)
        ended = state.place >= self.length
        return self.get_obs(state), state, jnp.float32(action), ended, {}

    def get_obs(self, state, params=None, key=None):
        return jnp.array([[state.place], [1]], jnp.int32)

    def is_terminated(self, state, params):
        return state.place >= self.length

    def observation_space(self, params):
        return spaces.Box(0, 9, (2, 1), jnp.int32)

    def action_space(self, params):
        return spaces.Discrete(2)

    @property
    def num_actions(self):
        return 2


@dataclasses.dataclass(frozen=True)
class LineTask:
    length: int = 4

    def make(self):
        return sejax.Task(name="line", env=Line(self.length), solved_reward=3.0)


@dataclasses.dataclass(frozen=True)
class Table(AgentConfig):
    """Remembers what each action paid, whatever the place."""

    rate: float = 0.5

    def make(self, task):
        def act(key, state, obs, explore):
            best = jnp.argmax(state["paid"]).astype(jnp.int32)
            return jax.random.randint(key, (), 0, task.num_actions) if explore else best

        def update(key, state, step):
            paid = state["paid"]
            new = paid + state["rate"] * (step.reward - paid)
            return state | {"paid": jnp.where(jnp.arange(paid.size) == step.action, new, paid)}

        return sejax.Agent(
            init=lambda key, hparams: {"paid": jnp.zeros(task.num_actions),
                                       "rate": jnp.float32(hparams["rate"])},
            act=act, update=update, buffer=no_buffer(), hparams={"rate": self.rate},
            discount=lambda hparams: 1.0,
        )


class GuessEnv(sejax.ProxyEnv):
    """Pays a number of its own for each action."""

    def init_weights(self, key):
        return {"pay": jax.random.normal(key, (self.task.num_actions,))}

    def params(self, weights, discount=1.0):
        return GuessParams(weights=weights, max_steps_in_episode=self.task.max_steps)

    def reset_env(self, key, params):
        return self.task.env.reset_env(key, self.task.params)

    def step_env(self, key, state, action, params):
        obs, state, _, ended, _ = self.task.env.step_env(key, state, action, self.task.params)
        info = {"discount": 1.0 - ended}
        return obs, state, params.weights["pay"][action], ended, info

    def get_obs(self, state, params=None, key=None):
        return self.task.env.get_obs(state)


@struct.dataclass
class GuessParams(environment.EnvParams):
    weights: Any = None
    max_steps_in_episode: int = 1


@dataclasses.dataclass(frozen=True)
class Guess(sejax.ProxyConfig):
    def make(self, task):
        return GuessEnv(task, self)


def scaled(task, scale: float = 10.0) -> sejax.Objective:
    return sejax.Objective(score=lambda outcome: scale * outcome.test_return,
                           meaning="ten times the return")


def search(num_dims, pairs: int = 2) -> sejax.Strategy:
    return make_nes(NESConfig(population_size=pairs, num_incumbent_evals=1), num_dims)
'''


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A module with parts of one's own, the words that choose them, and the learner of these."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_whole.py").write_text(WHOLE)
    patch = pytest.MonkeyPatch()
    patch.syspath_prepend(str(folder))
    words = [
        "env=my_whole:LineTask", "env.length=3", "agent=my_whole:Table", "proxy=my_whole:Guess",
        "objective=my_whole:scaled", "es=my_whole:search", "training.max_steps=12",
        "training.stop_rule=never", "training.test_episodes=1", "generations=1", "devices=1",
    ]  # fmt: skip
    config = sejax.config(words)
    yield sys.modules["my_whole"], config, jax.jit(sejax.make_learner(config))
    patch.undo()
    sys.modules.pop("my_whole")


def test_parts_of_ones_own_are_chosen_by_words(own):
    mine, config, _ = own
    assert config.env == mine.LineTask(length=3) and config.agent == mine.Table()
    assert config.proxy == mine.Guess() and config.name("es") == "my_whole:search"
    assert (config.es.pairs, config.objective.scale) == (2, 10.0)
    assert configuration.learn_config(configuration.plain(config)) == config
    assert str(config.resolved_run_dir) == "runs/my_whole_LineTask-my_whole_Guess-my_whole_Table-s0"
    assert config.task().obs_dim == 2 and config.task().max_steps == 6


def test_parts_of_ones_own_learn_a_generation(own):
    _, _, learn = own
    result = jax.device_get(learn(jax.random.key(0)))
    # Whoever learns that going right pays gets 3 of it, whoever learns the other gets nothing.
    assert result.score in (0.0, 30.0) and np.isfinite(result.info.population_mean).all()
    assert result.info.train_steps_mean == 12 and result.info.num_nonfinite == 0
    paid = result.weights["pay"]
    assert result.score == (30.0 if paid[1] > max(paid[0], 0) else 0.0)


def test_the_same_parts_as_objects_are_the_same_program(own):
    mine, config, _ = own
    task = envs.make("my_whole:LineTask", length=3)
    by_objects = sejax.make_learner(
        task=task, agent=sejax.make_agent(mine.Table(), task), proxy=mine.Guess(), es=config.es,
        objective=mine.scaled(task), training=config.training, generations=1, devices=1,
    )  # fmt: skip

    def program(learn):
        return re.sub(r"0x[0-9a-f]+", "", str(jax.make_jaxpr(learn)(jax.random.key(0))))

    assert program(by_objects) == program(sejax.make_learner(config))


def test_a_task_that_says_no_discount_has_reward_networks(own):
    mine, _, _ = own
    task = mine.LineTask().make()
    env = registry.make("proxy", sejax.RewardConfig(hidden_size=2), task)
    params = env.default_params
    _, state = env.reset_env(jax.random.key(0), params)
    for place, discount in ((0, 1.0), (3, 0.0)):
        world = state.world.replace(place=place)
        *_, info = env.step_env(None, state.replace(world=world), 1, params)
        assert info["discount"] == discount


def test_a_proxy_of_another_task_does_not_fit(own):
    mine, _, _ = own
    task, other = mine.LineTask().make(), mine.LineTask().make()
    with pytest.raises(ConfigError, match=r"^proxy must be one of the task given"):
        sejax.make_learner(task=task, agent=mine.Table().make(task), proxy=mine.Guess().make(other))


def test_an_agent_of_ones_own_that_cannot_be_varied_says_so(own):
    mine, config, _ = own
    with pytest.raises(ConfigError, match=r"^agent_hparams must be default with this agent"):
        sejax.make_agent(mine.Table(), config.task(), varied=True)


def test_options_that_overrides_cannot_say_keep_their_defaults(module):
    name = module(
        "import sejax\ndef f(task, score=print) -> sejax.Objective:\n"
        "    return sejax.Objective(score=score)\n"
    )
    config = registry.find("objective", f"{name}:f")()
    assert registry.make("objective", config, envs.make("cartpole")).score is print


class Plain(nn.Module):
    features: int = 8


class Residual(nn.Module):
    features: int = 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class Torso(AgentConfig):
    """An agent's configuration that holds another dataclass, a number, a list and a function."""

    torso: nn.Module = Plain()  # noqa: RUF009 (frozen)
    rate: float = 1.0
    sizes: Any = (1, 2)
    act: Any = len

    def make(self, task):
        return dataclasses.replace(sejax.QLearningConfig().make(task))


def test_configurations_are_the_same_if_classes_and_fields_are_at_any_depth():
    task = envs.make("cliff_walking")

    def made(config):
        return sejax.make_agent(config, task)

    assert made(Torso()) is made(Torso(torso=Plain(features=8)))
    listed = Torso(sizes=[1, 2])  # not hashable: the same as itself alone
    assert made(listed) is not made(Torso(sizes=[1, 2]))
    others = [Torso(torso=Residual()), Torso(torso=Plain(features=9)), Torso(rate=2.0),
              Torso(act=sum), Torso(sizes=(1, 3)), Torso(torso=nn.Dense(3, dtype=np.float32)),
              Torso(torso=nn.Dense(3, dtype=jnp.float16))]  # fmt: skip
    agents = {id(made(config)) for config in (Torso(), *others)}
    assert len(agents) == 1 + len(others)


def test_what_is_no_dataclass_is_the_same_as_itself_alone():
    class Mine:
        make = Torso.make

    task, one = envs.make("cliff_walking"), Mine()
    assert registry.make("agent", one, task) is registry.make("agent", one, task)
    assert registry.make("agent", one, task) is not registry.make("agent", Mine(), task)


def test_a_tasks_lists_and_what_may_be_none_are_options_of_the_command_line(module):
    name = module(
        "import sejax\n"
        "def make(sizes: list[int] = [1, 2], length: float = None) -> 'sejax.Task':\n"
        "    task = sejax.envs.make('cartpole')\n"
        "    return sejax.Task(name=f'of_{sizes}_{length}', env=task.env, params=task.params)\n"
    )
    for words, named in (([], "of_[1, 2]_None"), (["env.length=null"], "of_[1, 2]_None"),
                         (["env.sizes=[3,4]", "env.length=2"], "of_[3, 4]_2.0")):  # fmt: skip
        assert sejax.config([f"env={name}:make", *words]).task().name == named
