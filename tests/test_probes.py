"""Tasks with a known answer that every agent must find, and learning curves on real tasks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces
from support import paper_ppo

import sejax
from sejax import envs
from sejax.evaluation import make_tester

TrainingConfig = sejax.TrainingConfig
KEY = jax.random.key(0)


@struct.dataclass
class Context(environment.EnvState):
    obs: jax.Array


@dataclasses.dataclass(eq=False)
class Bandit(environment.Environment):
    """Episodes of one step.

    Discrete: 1 for the action that is the sign of the first of three numbers. Continuous:
    `-(action - 1.5)^2` for actions in [-2, 2], with zeros to observe; 1.5 is beyond the
    reach of a tanh.
    """

    is_discrete: bool
    default_params = environment.EnvParams(max_steps_in_episode=1)

    def reset_env(self, key, params):
        obs = self.is_discrete * jax.random.normal(key, (3,))
        return obs, Context(time=jnp.int32(0), obs=obs)

    def step_env(self, key, state, action, params):
        is_right = jnp.float32(action == (state.obs[0] > 0))
        reward = is_right if self.is_discrete else -jnp.sum((action - 1.5) ** 2)
        return state.obs, state.replace(time=state.time + 1), reward, jnp.bool_(True), {}

    def observation_space(self, params):
        return spaces.Box(-10.0, 10.0, (3,))

    def action_space(self, params):
        return spaces.Discrete(2) if self.is_discrete else spaces.Box(-2.0, 2.0, (1,))


SMALL = {"hidden_size": 16, "num_layers": 1, "learning_rate": 0.01}
OFF_POLICY = SMALL | {"batch_size": 32, "tau": 0.05}
ACTOR_CRITIC = OFF_POLICY | {
    "num_layers": 2, "learning_rate": 3e-3, "batch_size": 64, "warmup_episodes": 500,
}  # fmt: skip
AGENTS = {
    "ddqn": sejax.DDQNConfig(**OFF_POLICY),
    "td3": sejax.TD3Config(**ACTOR_CRITIC),
    "td3_discrete": sejax.DiscreteTD3Config(
        **OFF_POLICY, target_noise_std=0.0, final_temperature=1.0
    ),
    "sac": sejax.SACConfig(**ACTOR_CRITIC, alpha=0.05),
    "ppo": sejax.PPOConfig(hidden_size=16, num_layers=1),
    "paper_ppo": paper_ppo(**SMALL, rollout_steps=64, epochs=5),
}


@pytest.mark.parametrize(("name", "kind"), [
    pytest.param(name, kind, marks=[pytest.mark.slow] * (name not in ("ddqn", "ppo")))
    for name, config in AGENTS.items() for kind in config.actions
])  # fmt: skip
def test_a_bandits_best_action_is_found(name, kind):
    config = AGENTS[name]
    task = sejax.Task(name="bandit", env=Bandit(kind == "discrete"))
    agent = sejax.make_agent(config, task)
    training = TrainingConfig(max_episodes=2000, stop_rule="never")
    train = sejax.make_trainer(agent, task.env, training)

    @jax.jit
    def actions_in(contexts):
        state = train(jax.random.key(0), task.params).agent_state
        act = jax.vmap(lambda obs: agent.env_action(agent.act(KEY, state, obs, False)))
        return act(contexts)

    contexts = (kind == "discrete") * jax.random.normal(jax.random.key(1), (1000, 3))
    actions = np.asarray(actions_in(contexts))
    if kind == "discrete":
        assert (actions == (contexts[:, 0] > 0)).mean() > 0.95
    else:
        assert np.abs(actions - 1.5).mean() < 0.2


# --- learning curves -----------------------------------------------------------------------------

CURVES = {  # task, agent, training, and the least mean test return
    "td3": (
        "pendulum", sejax.TD3Config(warmup_episodes=5, batch_size=128, learning_rate=1e-3),
        TrainingConfig(max_steps=20_000, stop_rule="never", time_limit_is_terminal=False), -250,
    ),
    "td3_discrete": (
        "cartpole",
        sejax.DiscreteTD3Config(warmup_episodes=10, batch_size=128, hidden_size=128, num_layers=2,
                                learning_rate=5e-4),
        TrainingConfig(max_episodes=1000, max_steps=50_000, stop_rule="solved", solved_by="train",
                       time_limit_is_terminal=True),
        195,
    ),
    "ppo": (
        "cartpole",
        paper_ppo(activation="tanh", learning_rate=1e-3, update_episodes=4, epochs=20,
                              discount=0.98),
        TrainingConfig(max_steps=80_000, stop_rule="never"), 195,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", CURVES)
def test_an_agent_learns_a_real_task(name):
    # One that has not learned returns about 20 in CartPole and -1200 in Pendulum.
    task_name, config, training, wanted = CURVES[name]
    task = envs.make(task_name)
    agent = sejax.make_agent(config, task)
    train = sejax.make_trainer(agent, task.env, training, task.solved_reward)

    @jax.jit
    def run(key):
        key_train, key_test = jax.random.split(key)
        result = train(key_train, task.params)
        return result, make_tester(agent, task, 20)(key_test, result.agent_state)[0]

    result, returns = run(KEY)
    assert not result.nonfinite
    assert returns.mean() >= wanted, (returns, result.train_steps)
