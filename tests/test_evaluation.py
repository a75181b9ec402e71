"""sejax.evaluation: what is counted."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest
from scripted import MAX_EPISODES, MAX_STEPS, ScriptedEnv, script, scripted_agent
from support import paper_training

import sejax
from sejax import envs, evaluation
from sejax.evaluation import _evaluation_program
from sejax.options import ConfigError
from sejax.training import TrainingConfig

ENV = ScriptedEnv()
TRAINING = paper_training(max_episodes=MAX_EPISODES, stop_rule="never", test_episodes=3)


def test_tests_between_are_as_many_as_asked_and_the_area_is_over_all_steps():
    """Trained to 31 steps: ten episodes of three that return 0 to 9 in tests, and one step more."""
    params = script(range(12), [99] * 12)
    task = envs.Task(name="script", env=ENV, params=params, solved_reward=99.0)
    training = dataclasses.replace(TRAINING, max_steps=31, tests_between=2)
    evaluate = jax.jit(evaluation.make_evaluator(scripted_agent(), ENV, task, training))
    outcome = evaluate(jax.random.key(0), script([5] * 12, [3] * 12))
    assert (outcome.train_steps, outcome.train_episodes) == (31, 10)
    # The state of the agent says the episode that begins; the last tests are after its last step.
    assert outcome.real_steps == 31 + 10 * 2 * MAX_STEPS + 3 * MAX_STEPS
    assert outcome.test_return == 10
    assert outcome.auc == 3 * sum(range(10)) + 1 * 10


def test_returns_that_are_no_numbers_make_an_outcome_of_an_agent_that_diverged():
    task = envs.Task(name="script", env=ENV, params=script([float("nan")] * 12, [99] * 12))
    evaluate = jax.jit(evaluation.make_evaluator(scripted_agent(), ENV, task, TRAINING))
    assert evaluate(jax.random.key(0), script([5] * 12, [3] * 12)).nonfinite


def scripted_task(**fields):
    """A task whose first episode, which is what a fresh agent is tested on, returns 2.5."""
    params = script([2.5] + [1] * 11, [99] * 12)
    task = envs.Task(name="script", env=ENV, params=params, solved_reward=2.0)
    return dataclasses.replace(task, **fields)


def test_an_outcome_counts_training_and_tests():
    task = scripted_task()
    # Trained 12 episodes of 3 steps; its state then says episode 12, which the test world pays
    # as the last of its script (an index out of range).
    evaluate = jax.jit(evaluation.make_evaluator(scripted_agent(), ENV, task, TRAINING))
    outcome = evaluate(jax.random.key(0), script([5] * 12, [3] * 12))
    assert outcome.train_steps == 36 and outcome.train_episodes == 12
    assert outcome.test_return == 1.0
    assert not outcome.nonfinite
    # The world is no proxy: its steps are real, and so are 3 tests of MAX_STEPS.
    assert outcome.real_steps == 36 + 3 * MAX_STEPS
    diverged = evaluate(jax.random.key(0), script([5] * 12, [3] * 12, nonfinite_episode=1))
    assert diverged.nonfinite and diverged.train_steps == 5
    nothing = evaluate(jax.random.key(0), script([5] * 12, [3] * 12), jnp.bool_(False))
    assert nothing.train_steps == 0 and nothing.real_steps == 0


def test_agents_are_those_that_a_stored_proxy_was_learned_with():
    for source in ("cartpole", "cliff_walking-rn"):
        proxy = sejax.load_proxy(source)
        for key, config in proxy.learned_agents().items():
            assert sejax.agent_of(proxy.env, key) is sejax.make_agent(config, proxy.task)
        assert sejax.agent_of(proxy) is sejax.agent_of(
            proxy.env, next(iter(proxy.learned_agents()))
        )
        assert sejax.training_of(proxy.env) == sejax.training_of(proxy)
    with pytest.raises(ConfigError, match=r"^name must be .*q_learning"):
        sejax.agent_of(proxy, "ddqn")
    with pytest.raises(ConfigError, match=r"^proxy must be a stored one"):
        sejax.agent_of(proxy.env.bare)


def test_equal_arguments_compile_once():
    keys = jax.random.split(jax.random.key(0), 4)
    before = _evaluation_program.cache_info()
    for factor in (1.0, 2.0):
        env, params = sejax.load("cliff_walking-rn")
        params = params.replace(weights=jax.tree.map(lambda x, f=factor: f * x, params.weights))
        training = TrainingConfig(max_steps=30, test_episodes=1)
        agent = sejax.agent_of(env)
        sejax.evaluate_agents(agent, env, params, env.task, training, keys, devices=1)
    after = _evaluation_program.cache_info()
    assert (after.misses - before.misses, after.hits - before.hits) == (1, 1)
    program = _evaluation_program(agent, env.bare, env.task, training, None, 1, None)
    assert program._cache_size() == 1
