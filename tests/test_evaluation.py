"""sejax.evaluation: what is counted."""

import functools
import math

import jax
import jax.numpy as jnp
import pytest
from scripted import MAX_EPISODES, MAX_STEPS, ScriptedEnv, script, scripted_agent
from support import paper_training, refused

import sejax
from sejax import envs, evaluation
from sejax.evaluation import _evaluation_program
from sejax.training import TrainingConfig

ENV, KEY = ScriptedEnv(), jax.random.key(0)
WORLD = script([5] * 12, [3] * 12)  # where agents train


@functools.cache
def evaluator(*returns, **fields):
    """Jitted: trains a scripted agent, and tests it on a task whose episodes return this."""
    task = envs.Task(name="script", env=ENV, params=script(returns, [99] * 12), solved_reward=99.0)
    training = {"max_episodes": MAX_EPISODES, "stop_rule": "never", "test_episodes": 3} | fields
    return jax.jit(
        evaluation.make_evaluator(scripted_agent(), ENV, task, paper_training(**training))
    )


def test_tests_between_are_as_many_as_configured_and_the_area_is_over_all_steps():
    """Trained to 31 steps: ten episodes of three that return 0 to 9 in tests, and one step more."""
    outcome = evaluator(*range(12), max_steps=31, tests_between=2)(KEY, WORLD)
    assert (outcome.train_steps, outcome.train_episodes) == (31, 10)
    # The state of the agent says the episode that begins; the last tests are after its last step.
    assert outcome.real_steps == 31 + 10 * 2 * MAX_STEPS + 3 * MAX_STEPS
    assert outcome.test_return == 10
    assert outcome.auc == 3 * sum(range(10)) + 1 * 10


def test_returns_that_are_no_numbers_make_an_outcome_of_an_agent_that_diverged():
    assert evaluator(*[math.nan] * 12)(KEY, WORLD).nonfinite


def test_an_outcome_counts_training_and_tests():
    # Trained 12 episodes of 3 steps; its state then says episode 12, which the test world pays
    # as the last of its script (an index out of range).
    evaluate = evaluator(2.5, *[1] * 11)
    outcome = evaluate(KEY, WORLD)
    assert outcome.train_steps == 36 and outcome.train_episodes == 12
    assert outcome.test_return == 1.0 and not outcome.nonfinite
    # The world is no proxy: its steps are real, and so are 3 tests of MAX_STEPS.
    assert outcome.real_steps == 36 + 3 * MAX_STEPS
    diverged = evaluate(KEY, script([5] * 12, [3] * 12, nonfinite_episode=1))
    assert diverged.nonfinite and diverged.train_steps == 5
    nothing = evaluate(KEY, WORLD, jnp.bool_(False))
    assert nothing.train_steps == 0 and nothing.real_steps == 0


@pytest.mark.parametrize("source", ["cartpole", "cliff_walking-rn"])
def test_agents_are_those_that_a_stored_proxy_was_learned_with(source):
    proxy = sejax.load_proxy(source)
    learned = proxy.learned_agents().items()
    agents = {key: sejax.make_agent(config, proxy.task) for key, config in learned}
    assert {key: sejax.agent_of(proxy.env, key) for key in agents} == agents
    assert sejax.agent_of(proxy) is next(iter(agents.values()))
    assert sejax.training_of(proxy.env) == sejax.training_of(proxy)
    assert refused(sejax.agent_of, proxy, "nope") == "name"
    assert refused(sejax.agent_of, proxy.env.bare) == "proxy"
    assert refused(sejax.training_of, sejax.load_proxy("cartpole"), "ppo") == "agent"
    other, training = sejax.envs.make("acrobot"), sejax.training_of(proxy)
    assert refused(sejax.make_evaluator, agents.popitem()[1], proxy.env, other, training) == "env"


def test_equal_arguments_compile_once():
    keys = jax.random.split(jax.random.key(0), 4)
    training = TrainingConfig(max_steps=30, test_episodes=1)
    before = _evaluation_program.cache_info()
    for factor in (1.0, 2.0):
        env, params = sejax.load("cliff_walking-rn")
        params = params.replace(weights=jax.tree.map(lambda x, f=factor: f * x, params.weights))
        arguments = sejax.agent_of(env), env, params, env.task, training, keys
        sejax.evaluate_agents(*arguments, devices=1)
    after = _evaluation_program.cache_info()
    assert (after.misses - before.misses, after.hits - before.hits) == (1, 1)
    assert refused(sejax.evaluate_agents, *arguments, devices=True) == "devices"
    assert refused(sejax.evaluate_agents, *arguments, num_parallel=-1) == "num_parallel"
