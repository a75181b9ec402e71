"""benchmarks/agent_families.py: what its rows train."""

import sys
from pathlib import Path

import jax
import pytest

import sejax

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
import agent_families


@pytest.mark.parametrize("name", agent_families.FAMILIES)
def test_a_row_is_a_training_in_which_the_agent_learns_on_an_se_of_the_papers_kind(name):
    family = agent_families.FAMILIES[name]
    agent, proxy, training = family.parts(500)
    task = sejax.envs.make(family.env)
    sejax.make_trainer(sejax.make_agent(agent, task), proxy.make(task), training)
    assert (agent.warmup_episodes, proxy.done, training.stop_rule) == (0, "soft", "never")
    phase = agent.steps_before_learning(task.max_steps, task.max_steps)
    assert training.max_steps >= max(500, 2 * phase) and training.max_steps % max(phase, 1) == 0
    if family.reference:  # whose world is of these networks
        weights = jax.eval_shape(proxy.make(task).init_weights, jax.random.key(0))
        assert set(weights) == {"state", "reward", "done"}
