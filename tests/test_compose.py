"""sejax.cli.compose: every choice composes, bad words are refused with one message."""

import dataclasses
import functools
import os
import re
import subprocess
import sys
import typing

import pytest
from hydra.core.config_store import ConfigStore

import sejax
from sejax import envs, registry
from sejax.cli import commands, runtime
from sejax.cli.config import LearnConfig
from sejax.envs.gridworld import CliffWalking
from sejax.es.evosax import ALGORITHMS, EvosaxConfig
from sejax.options import ConfigError

composed_with = functools.cache(lambda *overrides: sejax.config(overrides))
ENVS = ("cartpole", "acrobot")
PRESETS = ("best", "paper", "paper_performance", "soft")


def message(*overrides):
    """What a user is told about these overrides."""
    with pytest.raises(ConfigError) as error:
        sejax.config(overrides)
    said = str(error.value)
    assert "\n" not in said and len(said) < 1500
    return said


# --- every choice composes -----------------------------------------------------------------------


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("env", ENVS)
def test_every_task_composes_with_every_preset(env, preset):
    composed = composed_with(f"env={env}", f"preset={preset}")
    assert isinstance(composed, LearnConfig)
    assert (composed.name("env"), composed.preset) == (env, preset)
    # An SE gives no sign of the agent's progress: its own returns level off, or a budget ends.
    assert composed.training.stop_rule == "plateau" or composed.training.max_steps is not None


def test_every_algorithm_of_evosax_composes():
    assert sejax.config(["es=cma_es"]).es == EvosaxConfig(name="cma_es")
    store = ConfigStore.instance()  # which has them all since
    for name in ALGORITHMS:
        node = store.load(f"es/{name}.yaml").node
        assert registry.configure("es", node) == EvosaxConfig(name=name)


@pytest.mark.parametrize("name", ["max_reward", "reward_threshold"])
def test_every_objective_composes(name):
    assert sejax.config([f"objective={name}"]).name("objective") == name


def test_a_reward_network_chooses_its_objective_where_none_is_chosen():
    assert composed_with("proxy=rn").name("objective") == "reward_threshold"
    assert sejax.config(["proxy=rn", "objective=max_reward"]).name("objective") == "max_reward"


def test_a_task_chooses_its_agent_where_none_is_chosen():
    names = {env: composed_with(f"env={env}").name("agent") for env in envs.names()}
    assert names == {
        "cartpole": "ddqn", "cartpole_v1": "ddqn", "acrobot": "ddqn", "cliff_walking": "q_learning",
        "gridworld_2x2": "q_learning", "mountain_car": "ddqn", "mountain_car_continuous": "td3",
        "pendulum": "td3", "halfcheetah": "td3", "hopper": "td3", "walker2d": "td3",
        "swimmer": "td3", "inverted_pendulum": "td3", "ant": "td3", "reacher": "td3",
    }  # fmt: skip
    assert sejax.config(["env=pendulum", "agent=ppo"]).name("agent") == "ppo"


def test_without_overrides_it_is_the_best_cartpole_se():
    composed = composed_with()
    names = [composed.name(group) for group in registry.GROUPS]
    assert names == ["cartpole", "ddqn", "none", "se", "max_reward", "nes", "none", "local"]
    assert composed.preset == "best"
    assert str(composed.resolved_run_dir) == "runs/cartpole-se-ddqn-s0"


def test_the_yaml_files_give_every_field_a_value_of_its_type():
    for env in ENVS:
        for preset in PRESETS:
            composed = composed_with(f"env={env}", f"preset={preset}")
            for group in (composed, composed.agent, composed.es, composed.training):
                for name, kind in typing.get_type_hints(type(group)).items():
                    if kind in (int, float, bool, str):
                        assert type(getattr(group, name)) is kind, name


def test_overrides_win_over_presets():
    composed = sejax.config(
        ["preset=paper", "es.noise_std=0.7", "agent.batch_size=3", "generations=9"]
    )
    assert (composed.es.noise_std, composed.agent.batch_size, composed.generations) == (0.7, 3, 9)
    assert composed.es.step_size == 0.148  # the preset's, where nothing was said


def test_the_run_directory_names_the_run():
    composed = sejax.config(["env=acrobot", "seed=7"])
    assert str(composed.resolved_run_dir) == "runs/acrobot-se-ddqn-s7"
    assert str(sejax.config(["run_dir=elsewhere"]).resolved_run_dir) == "elsewhere"
    for changes, name in [
        ({"exploration": sejax.ICMConfig()}, "cartpole-se-ddqn_icm-s0"),
        ({"agent_hparams": "varied"}, "cartpole-se-ddqn_varied-s0"),
        ({"env": registry.configure("env", {"name": "gymnax/CartPole-v1"})},
         "gymnax_CartPole-v1-se-ddqn-s0"),
    ]:  # fmt: skip
        changed = dataclasses.replace(composed_with(), **changes)
        assert str(changed.resolved_run_dir) == f"runs/{name}"


def test_an_interpolation_is_what_it_names():
    for value in ("true", "false"):
        words = ["es.mirrored=${es.common_random_numbers}", f"es.common_random_numbers={value}"]
        assert sejax.config(words).es.mirrored is (value == "true")
    assert sejax.config(["seed=3", "agent.num_layers='${seed}'"]).agent.num_layers == 3


def test_only_cliff_walking_has_a_choice_of_goal_reward():
    config = sejax.config(["env=cliff_walking", "env.goal_reward=-1"])
    assert config.env == CliffWalking(goal_reward=-1.0)
    assert config.task().params.goal_reward == -1
    assert message("env=cliff_walking", "env.goal_reward=nan").startswith("env.goal_reward must be")
    with pytest.raises(ConfigError, match=r"env\.goal_reward must be a field of GridWorld2x2"):
        envs.make("gridworld_2x2", goal_reward=1.0)
    said = message("env=cartpole", "env.goal_reward=-1")
    assert "env.goal_reward, which another choice of env has" in said


# --- several agents ------------------------------------------------------------------------------

SEVERAL = ("agents=[td3_discrete,ddqn]",)


def test_several_agents_compose_with_fields_of_their_own():
    words = ("agents.ddqn.batch_size=32", "agents.td3_discrete.weight=2", "agents.aggregate=min",
             "agents.compared_by=rank")  # fmt: skip
    composed = sejax.config([*SEVERAL, *words])
    agents = composed.agents
    assert composed.agent is None and composed.name("agent") == "ddqn+td3_discrete"
    assert (agents.aggregate, agents.compared_by) == ("min", "rank")
    assert [(x.key, x.weight) for x in agents.families] == [("ddqn", 1.0), ("td3_discrete", 2.0)]
    assert agents.families[0].agent.batch_size == 32
    assert str(composed.resolved_run_dir) == "runs/cartpole-se-ddqn+td3_discrete-s0"


@pytest.mark.parametrize("preset", ["best", "paper"])
def test_each_of_several_agents_has_the_tuned_settings_that_it_has_alone(preset):
    words = ("env=acrobot", f"preset={preset}", "training.max_steps=null")
    for family in composed_with(*words, *SEVERAL).agents.families:
        assert family.agent == composed_with(*words, f"agent={family.key}").agent
    ddqn = sejax.config([*words, *SEVERAL, "agents.ddqn.batch_size=7"]).agents.families[0].agent
    alone = sejax.config([*words, "agent=ddqn", "agent.batch_size=7"]).agent
    assert ddqn == alone  # what is said wins


@pytest.mark.parametrize(
    "words",
    [("agent=[td3_discrete,ddqn]",), ("agents=[ddqn,td3_discrete]",), ("agents=ddqn+td3_discrete",),
     ("agents=[ddqn,'td3_discrete']",), ("agents=[]", "agent=[ddqn,td3_discrete]")],
    ids=" ".join,
)  # fmt: skip
def test_several_agents_may_be_written_so(words):
    assert sejax.config(words) == composed_with(*SEVERAL)


def test_one_agent_in_a_list_has_a_list_of_fields_and_none_are_none():
    (family,) = composed_with("agents=ddqn").agents.families
    assert composed_with("agents=[ddqn]") == composed_with("agents=ddqn")
    assert family.agent == composed_with().agent
    assert sejax.config(["agents=[]"]) == sejax.config(["agents=null"]) == composed_with()


def test_an_agent_of_ones_own_may_be_one_of_several(monkeypatch, tmp_path):
    (tmp_path / "my_words.py").write_text(
        "import dataclasses, sejax\n"
        "@dataclasses.dataclass(frozen=True, kw_only=True)\n"
        "class Mine(sejax.DDQNConfig):\n"
        "    extra: int = 3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    words = ["agents=[ppo,my_words:Mine]", "agents.my_words_Mine.extra=4",
             "agents.my_words_Mine.warmup_episodes=1"]  # fmt: skip
    mine, ppo = sejax.config(words).agents.families
    assert (mine.key, mine.agent.extra, ppo.key) == ("my_words_Mine", 4, "ppo")
    own = registry.find("agent", "my_words:Mine")
    assert registry.name_of("agent", own()) == "my_words:Mine"


def test_sweeps_over_tasks_and_agents_have_the_settings_of_each(tmp_path, monkeypatch):
    words = ["env=cartpole,acrobot", "agents=[ddqn,sac],ddqn", "agent=ddqn,[ddqn,sac]"]
    written = families.in_one_choice(words[:2])
    assert written == ["env=cartpole,acrobot", "agent=ddqn+sac,ddqn+"]
    assert families.in_one_choice(words[2:]) == ["agent=ddqn,ddqn+sac"]
    compose.register("run", written)
    store = ConfigStore.instance()
    for task in ("cartpole", "acrobot"):
        alone = {name: store.load(f"tuned_agent/best/{task}-se-{name}.yaml").node.agent
                 for name in ("ddqn", "sac")}  # fmt: skip
        both = store.load(f"tuned_agent/best/{task}-se-ddqn+sac.yaml").node.agents
        one = store.load(f"tuned_agent/best/{task}-se-ddqn+.yaml").node.agents
        assert both == alone and one == {"ddqn": alone["ddqn"]}


def test_several_agents_are_in_the_help():
    said = compose.help_text("run", ["agent=[ddqn,ppo]"])
    assert "agents=[ddqn,td3_discrete,ppo]" in said  # how they are chosen
    assert "  agents:\n    aggregate: mean\n    compared_by: advantage\n    ddqn:\n" in said
    assert "\n  agent:\n" not in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("agents=[ddqn,td3_discret]",
         "agents must be one of td3_discrete, .*Did you mean agents=td3_discrete?"),
        ("agents=[ddqn,ddqn]", "agents must name each agent once, .* got ddqn"),
        ("agents=3", "agents must be one of .* got '3'"),
        ("agent=[1,2]", "agent must be one of .* got '1'"),
        ("agents=[[ddqn]]", "agents must be one of "), ("agents={a:1}", "agents must be one of "),
        ("agents=[ddqn,no_module_of:mine]", "agent must name a module that can be imported"),
        ("agents=[ddqn,ppo] agent.batch_size=3",
         "agent.batch_size must be left out with agents=[ddqn,ppo].*agents.ddqn.batch_size=3."),
        ("agents=[ddqn,ppo] agent=td3_discrete",
         "agent must be left out with agents=[ddqn,ppo], .*Set agents=[ddqn,ppo,td3_discrete]"),
        ("agents=[ddqn,ppo] agents.ddqn.batchsize=3", "Did you mean agents.ddqn.batch_size?"),
        ("agents=[ddqn,ppo] agents.td3.batch_size=3",
         "agents.td3.batch_size must be of one of the agents ddqn, ppo, .*[ddqn,ppo,td3]"),
        ("agents=[ddqn,ppo] agents.wieght=3", "got agents.wieght"),
        ("agents=[ddqn,ppo] +agents.more=3", "agents.more must be an agent with its fields"),
        ("agents.aggregate=min", "agents.aggregate must come with several agents"),
        ("agents=[ddqn,ppo] agents.aggregate=worst", "agents.aggregate must be one of"),
        ("agents=[ddqn,ppo] agents.compared_by=x", "agents.compared_by must be one of"),
        ("agents=[ddqn,ppo] agents.ddqn.weight=-1", "agents.ddqn.weight must lie in [0, 1e6]"),
        ("agents=[ddqn,ppo] agents.ddqn.weight=x", "agents.ddqn.weight must lie in [0, 1e6]"),
        ("agents=[ddqn,ppo] agents.ddqn.batch_size=0",
         "agents.ddqn.batch_size must be at least 1, .*Set agents.ddqn.batch_size=128."),
        ("agents=[ddqn,ppo] agents.ddqn.name=ddqnn", "agents.ddqn must be one of ddqn"),
        ("agents=[ddqn,td3]", "agents.td3 must be one of .* in cartpole"),
        ("env=cliff_walking agents=[sarsa,q_learning] exploration=icm",
         "exploration must fit q_learning"),
        ("proxy.done=soft proxy.horizon=null agents=[ddqn,ppo] agents.ppo.rollout_steps=3000",
         "training.max_steps must exceed 3000, "),
    ],
)  # fmt: skip
def test_several_agents_that_cannot_be_are_one_message(words, said):
    pattern = ".*".join(re.escape(part) for part in said.split(".*"))
    assert re.search(pattern, message(*words.split()))


# --- bad input -----------------------------------------------------------------------------------


def test_a_population_of_one_is_refused_with_the_whole_message():
    assert message("es.population_size=1") == (
        "es.population_size must be at least 2, because scores are compared within a generation; "
        "got 1. Set es.population_size=16."
    )


def test_a_value_that_is_no_number_is_refused_with_the_whole_message():
    assert message("es.noise_std=nan") == (
        "es.noise_std must be above 0 and finite, because candidates must differ; got nan. "
        "Set es.noise_std=0.05."
    )


def test_an_odd_population_is_refused_where_evosax_pairs_perturbations():
    assert message("es=open_es", "es.population_size=3") == (
        "es.population_size must be even, because evosax's algorithms pair opposite perturbations; "
        "got 3. Set es.population_size=4."
    )


@pytest.mark.parametrize(
    ("override", "field", "nearest"),
    [
        ("env=cartpol", "env", "cartpole"),
        ("agent=ddqnn", "agent", "ddqn"),
        ("es=nez", "es", "nes"),
        ("es=open-es", "es", "open_es"),
        ("preset=papers", "preset", "paper"),
        ("objective=max_rewards", "objective", "max_reward"),
        ("es.score_transform=all_beter_2", "es.score_transform", "all_better_2"),
        ("proxy.activation=leakyrelu", "proxy.activation", "leaky_relu"),
        ("training.stop_rule=plato", "training.stop_rule", "plateau"),
    ],
)
def test_an_unknown_choice_lists_the_known_ones_nearest_first(override, field, nearest):
    got = override.partition("=")[2]
    said = message(override)
    assert said.startswith(f"{field} must be one of {nearest}")
    assert f"got '{got}'" in said and f"Did you mean {field}={nearest}?" in said


@pytest.mark.parametrize(
    ("override", "nearest"),
    [
        ("es.populaton_size=3", "es.population_size"),
        ("generation=3", "generations"),
        ("agent.learningrate=0.1", "agent.learning_rate"),
        ("es=open_es es.populationsize=4", "es.population_size"),
        ("proxy=rn variant=additive_potential", "proxy.variant"),  # the right field, without group
    ],
)
def test_an_unknown_field_names_the_nearest_one(override, nearest):
    *choices, last = override.split()
    said = message(*choices, last)
    assert last.partition("=")[0] in said and f"Did you mean {nearest}?" in said


def test_a_field_that_another_algorithm_has_is_not_suggested():
    assert "Did you mean es.mirrored?" not in message("es=open_es", "es.mirrored=true")


@pytest.mark.parametrize(
    "overrides",
    [("proxy.name=rn",), ("env.name=no_such_task",), ("agent.name=nope",)],
    ids=" ".join,
)
def test_a_name_that_no_choice_has_is_refused(overrides):
    message(*overrides)


@pytest.mark.parametrize(
    ("override", "field"),
    [
        ("es.population_size=abc", "es.population_size"),
        ("es.population_size=1.5", "es.population_size"),
        ("es.noise_std=much", "es.noise_std"),
        ("stop_when_solved=maybe", "stop_when_solved"),
        ("agent.hidden_size=[1,2]", "agent.hidden_size"),
        ("training.max_episodes=null", "training.max_episodes"),
        ("seed=x", "seed"),
    ],
)
def test_a_value_of_another_type_is_refused_and_the_field_named(override, field):
    said = message(override)
    assert said.startswith(f"{field} must be ") and said.endswith(".")


SOFT = ("proxy.done=soft", "proxy.horizon=null")


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ((*SOFT, "env=acrobot", "agent=dueling_ddqn", "agent.warmup_episodes=10"),
         "training.max_steps must exceed 5000, because dueling_ddqn learns nothing before; "
         "got 2000."),
        ((*SOFT, "agent=ppo", "agent.rollout_steps=null", "agent.update_episodes=20"),
         "training.max_steps must exceed 4001, because ppo learns nothing before; got 2000."),
        ((*SOFT, "agent=ppo", "agent.rollout_steps=3000"),
         "training.max_steps must exceed 3000, because ppo learns nothing before; got 2000."),
        (("training.stop_rule=solved", "training.solved_by=train"),
         "training.solved_by must be test with stop_rule=solved"),
        (("env=cliff_walking", "proxy=rn", "training.solved_by=train"),
         "training.solved_by must be test with stop_rule=solved"),
    ],
)  # fmt: skip
def test_trainings_that_cannot_teach_or_judge_are_refused(overrides, said):
    assert message(*overrides).startswith(said)


def test_episodes_that_may_end_early_need_no_long_budget():
    sejax.config(["proxy.done=threshold", "training.max_steps=100"])
    sejax.config(["proxy=rn", "training.max_steps=100"])


@pytest.mark.parametrize("env", presets.tuned("se"))
def test_agents_learn_within_the_default_budget_of_an_se(env):
    spec = envs.spec_of(registry.configure("env", {"name": env}))
    for name in registry.names("agent"):
        agent = registry.find("agent", name)
        if agent.states == spec.states and spec.actions in agent.actions:
            config = sejax.config([f"env={env}", f"agent={name}"])
            longest = config.proxy.max_steps(spec.max_steps)
            before = config.agent.steps_before_learning(longest, spec.max_steps)
            budget = config.training.max_episodes * longest
            budget = min(budget, config.training.max_steps or budget)
            assert budget >= 2 * before, name


# --- words that made a traceback, or were taken for something else -------------------------------

LONG = "d" * 5000
WILD = [
    # A choice that is no name.
    ("env=2", "env must be one of"), ("es=1.5", "es must be one of"),
    ("es=false", "es must be one of"), ("preset=[1,2]", "preset must be one of"),
    ("env=null", "env must be one of"), ("env=???", "env must be one of"),
    (f"agent={LONG}", "(5000 characters)"), (f"env={LONG}", "(5000 characters)"),
    (f"agent=a:{LONG}", "(5002 characters)"), ("agent=choice(1,2)", "agent must be one of"),
    ("agent.name=0", "Set agent=0."), ("agent.name=???", "agent.name must not be set"),
    ("env.name=acrobot", "Set env=acrobot."),
    # A choice that is taken away.
    ("~env=[[1]]", "env must be chosen"), ("~env", "env must be chosen"),
    ("~seed", "seed must be given"),
    # What is not there.
    ("agent.num_layers=${nope}", "Interpolation key 'nope' not found in agent.num_layers"),
    ("seed=${seed}", "Recursive interpolation detected in seed"),
    ("+new=1", "new must be a field of LearnConfig, because nothing else is read; got 1"),
    ("+agent.new=1", "agent.new must be a field of DDQNConfig"),
    ("=1", "override must name a field"), ("tuned_agent=x", "override must name a field"),
    # Numbers that cannot be counted or computed with; see test_build.py for all of them.
    ("es.population_size=2147483648", "es.population_size must be at most 100000"),
    ("num_parallel=99999999999999999999", "num_parallel must be at most 2147483647"),
    ("es.noise_std=1e38", "es.noise_std must be at most 1e+06"),
    ("es.step_size=1e300", "es.step_size must be at most 1e+06"),
]  # fmt: skip


@pytest.mark.parametrize(("word", "said"), WILD, ids=lambda text: text[:30])
def test_wild_words_are_one_message(word, said):
    assert said in message(word)


@pytest.mark.parametrize(
    "words",
    [("env=2",), ("~env=[[1]]",), ("preset=[1,2]",), (f"agent={LONG}",), ("=1",), ("+new=1",),
     ("agent.num_layers=${nope}",), ("agent.name=???",), ("proxy.hidden_size=2147483648",),
     ("es.noise_std=1e38",), ("a b",), ("--multirun", "env=1,2"), ("env=ä",)],
    ids=lambda words: " ".join(words)[:30],
)  # fmt: skip
def test_the_command_ends_them_with_the_message_and_status_2(words, monkeypatch, capsys):
    from sejax import run

    monkeypatch.setattr(sys, "argv", ["sejax.run", *words])
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(SystemExit) as ended:
        commands.start("run", run.main)
    said = capsys.readouterr()
    assert ended.value.code == 2 and not said.out
    assert said.err.startswith("error: ") and said.err.count("\n") == 1 and len(said.err) < 1500


# --- imports -------------------------------------------------------------------------------------


def test_importing_sejax_and_composing_imports_nothing_slow_and_starts_nothing():
    program = (
        "import os, sys\n"
        "before = dict(os.environ)\n"
        "import sejax\n"
        "from sejax import errors\n"
        "slow = {'gymnax.registration', 'gymnax.environments.environment', 'evosax', 'torch', "
        "'brax', 'orbax', 'pandas', 'matplotlib'}\n"
        "heavy = slow | {'jax', 'jaxlib', 'flax', 'optax', 'numpy', 'hydra', 'omegaconf'}\n"
        "print(sorted(heavy & set(sys.modules)), dict(os.environ) == before)\n"
        "sejax.config(['env=acrobot', 'es=cma_es'])\n"
        "try:\n"
        "    sejax.config(['env=acrobat'])\n"
        "except sejax.ConfigError:\n"
        "    pass\n"
        "import sejax.envs\n"
        "sejax.envs.names()\n"
        "from sejax.cli import runtime\n"
        "changed = {k for k in os.environ if os.environ[k] != before.get(k)}\n"
        "set_by_jax = {'TF_CPP_MIN_LOG_LEVEL', 'TPU_SKIP_MDS_QUERY'}\n"
        "print(sorted(slow & set(sys.modules)), changed <= set_by_jax, runtime.is_started())\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.splitlines() == ["[] True", "[] True False"], done.stdout + done.stderr


@pytest.mark.parametrize(("files", "cores"), [
    ({}, 64), ({"cpu.max": "max 100000\n"}, 64), ({"cpu.max": "250000 100000\n"}, 2),
    ({"cpu.max": "50000 100000\n"}, 1), ({"cpu.max": "9000000 100000\n"}, 64),
    ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 64),
    ({"cpu/cpu.cfs_quota_us": "300000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 3),
])  # fmt: skip
def test_a_containers_quota_is_a_number_of_cores(files, cores, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(64), raising=False)
    monkeypatch.setattr(runtime, "CGROUPS", tmp_path)
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert runtime.available_cores() == cores


def test_a_process_keeps_to_its_share_of_a_gpu_and_to_single_precision():
    """In processes of their own, as jax is told before it starts."""
    program = (
        "import os, sys, jax\n"
        "from sejax.cli import runtime\n"
        "runtime.take_share_of_gpu(float(sys.argv[1])); runtime.configure_jax()\n"
        "print(jax.config.jax_platforms, os.environ.get('XLA_CLIENT_MEM_FRACTION'),"
        " jax.config.jax_default_matmul_precision)\n"
    )
    unset = ("JAX_PLATFORMS", "XLA_CLIENT_MEM_FRACTION", "JAX_DEFAULT_MATMUL_PRECISION")
    clean = {name: x for name, x in os.environ.items() if name not in unset}

    def told(share, **variables):
        done = subprocess.run([sys.executable, "-c", program, str(share)], text=True, check=True,
                              capture_output=True, env=clean | variables)  # fmt: skip
        return done.stdout.split()

    assert told(0) == ["cpu", "None", "highest"]
    assert told(0.5, JAX_DEFAULT_MATMUL_PRECISION="float32") == ["None", "0.450", "float32"]
    assert told(1) == ["None", "None", "highest"]


def test_flags_of_xla_are_left_alone_once_jax_has_started(monkeypatch):
    import jax

    jax.devices()
    monkeypatch.setenv("XLA_FLAGS", "--mine=1")
    assert runtime.is_started()
    runtime.configure_xla(3)
    assert os.environ["XLA_FLAGS"] == "--mine=1"
