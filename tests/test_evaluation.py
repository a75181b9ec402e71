"""sejax.evaluation: what is counted."""

import dataclasses

import jax
import jax.numpy as jnp
from scripted import MAX_EPISODES, MAX_STEPS, ScriptedEnv, script, scripted_agent

from sejax import envs, evaluation
from sejax.training import TrainingConfig

ENV = ScriptedEnv()
TRAINING = TrainingConfig(max_episodes=MAX_EPISODES, stop_rule="never", test_episodes=3)


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
