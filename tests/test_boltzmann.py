"""sejax.agents.boltzmann: the optimum of reward and entropy in a one-step SE."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sejax
from sejax import envs
from sejax.agents.boltzmann import BoltzmannConfig
from sejax.agents.mixture import Mixture
from sejax.bilevel import make_bilevel
from sejax.cli import config as configuration
from sejax.evaluate import evaluate
from sejax.objectives import AUC
from sejax.options import ConfigError
from sejax.proxies.configs import SyntheticConfig

CARTPOLE, PENDULUM = envs.make("cartpole"), envs.make("pendulum")
BANDIT = SyntheticConfig(hidden_size=8, horizon=1, initial_state="learned", done="threshold")
OBS = {"cartpole": jnp.array([0.1, -0.5, 0.02, 0.7]), "pendulum": jnp.array([0.6, 0.8, -2.0])}


def solved(task, **fields):
    """An agent in a bandit with random weights, its state, and the bandit's own step."""
    env = BANDIT.make(task)
    params = env.params(env.init_weights(jax.random.key(3)))
    agent = sejax.make_agent(BoltzmannConfig(**fields), task)
    state = agent.solve(env, params, agent.hparams)

    def reward(action):
        """As an agent would meet it: a step of the environment."""
        _, world = env.reset_env(jax.random.key(0), params)
        world = world.replace(vector=OBS[task.name])
        return float(env.step_env(jax.random.key(0), world, action, params)[2])

    return agent, state, reward


def softmax(rewards, temperature):
    weights = np.exp((rewards - np.max(rewards)) / temperature)
    return weights / weights.sum()


def draws(agent, state, obs, num=20_000):
    act = jax.jit(jax.vmap(lambda key: agent.act(key, state, obs, explore=False)))
    return np.asarray(act(jax.random.split(jax.random.key(1), num)))


def test_discrete_actions_come_as_often_as_their_rewards_say():
    agent, state, reward = solved(CARTPOLE, temperature=0.2)
    wanted = softmax(np.array([reward(0), reward(1)]), 0.2)
    assert 0.1 < wanted[0] < 0.9  # or little would be tested
    share = np.bincount(draws(agent, state, OBS["cartpole"]), minlength=2) / 20_000
    np.testing.assert_allclose(share, wanted, atol=0.015)  # 4 standard errors


def test_continuous_actions_come_as_often_as_their_rewards_say():
    agent, state, reward = solved(PENDULUM, temperature=0.1, num_points=5)
    points = np.array([-2.0, -1.0, 0.0, 1.0, 2.0], np.float32)
    wanted = softmax(np.array([reward(np.array([a])) for a in points]), 0.1)
    drawn = draws(agent, state, OBS["pendulum"])
    assert drawn.shape == (20_000, 1)
    share = np.array([(drawn[:, 0] == a).mean() for a in points])
    assert share.sum() == 1
    np.testing.assert_allclose(share, wanted, atol=0.015)


def test_no_other_policy_has_more_of_reward_and_entropy():
    agent, state, reward = solved(CARTPOLE, temperature=0.3)
    rewards = np.array([reward(0), reward(1)])  # of a step of the environment

    def worth(policy):
        return policy @ rewards - 0.3 * policy @ np.log(policy)

    share = np.bincount(draws(agent, state, OBS["cartpole"]), minlength=2) / 20_000
    others = np.linspace(0.001, 0.999, 200)
    assert worth(share) >= max(worth(np.array([p, 1 - p])) for p in others) - 1e-3


def test_two_numbers_of_an_action_make_a_grid():
    class Plane:
        num_actions, action_dim, max_action = None, 2, 1.0

    agent = BoltzmannConfig(num_points=3, temperature=1.0).make(Plane)
    env = BANDIT.make(PENDULUM)
    state = agent.solve(env, env.params(None), agent.hparams).replace(
        reward=jax.tree_util.Partial(lambda obs, action: -100 * (action[0] - 1) ** 2 + action[1])
    )
    drawn = draws(agent, state, jnp.zeros(3), 2000)
    np.testing.assert_array_equal(np.unique(drawn[:, 0]), [1.0])
    np.testing.assert_array_equal(np.unique(drawn[:, 1]), [-1.0, 0.0, 1.0])


def program_of(agent, **parts):
    return make_bilevel(**{
        "task": CARTPOLE, "agent": agent, "proxy": BANDIT, "devices": 1,
        "es": sejax.NESConfig(
            population_size=16, noise_std=0.1, noise_std_decay=1.0, num_incumbent_evals=4
        ),
        "training": sejax.TrainingConfig(max_steps=64, max_episodes=64, stop_rule="never"), **parts,
    })  # fmt: skip


def test_the_outer_loop_learns_a_bandit_without_a_step_of_training():
    """And a family of weight 0 trains on incumbents alone."""
    boltzmann = sejax.make_agent(BoltzmannConfig(), CARTPOLE)
    ddqn = sejax.make_agent(
        sejax.DDQNConfig(hidden_size=8, num_layers=1, batch_size=8, warmup_episodes=1), CARTPOLE
    )
    program = program_of(
        Mixture(agents=(boltzmann, ddqn), names=("boltzmann", "ddqn"), weights=(1.0, 0.0))
    )
    state = jax.jit(program.init)(jax.random.key(0))
    generation = jax.jit(program.generation)
    infos = []
    for _ in range(12):
        state, info = generation(state)
        infos.append(jax.device_get(info))
    first, last = (infos[i].by_agent.incumbent_mean[0] for i in (0, -1))
    assert first < 40 and last > 60, (first, last)
    assert all(info.train_steps.sum() == 2 * 64 for info in infos)  # of two incumbents
    np.testing.assert_array_equal(infos[0].by_agent.train_steps_mean, [0, 64])
    assert np.isnan(infos[0].by_agent.population_mean[1])
    assert np.isfinite(infos[0].by_agent.population_mean[0])


def test_where_it_cannot_be_solved_for_it_is_refused():
    agent = sejax.make_agent(BoltzmannConfig(), CARTPOLE)
    with pytest.raises(ConfigError) as error:
        program = program_of(agent, proxy=SyntheticConfig(hidden_size=8))
        jax.eval_shape(program.generation, jax.eval_shape(program.init, jax.random.key(0)))
    assert error.value.field == "agent"
    train = sejax.make_trainer(agent, CARTPOLE.env)
    with pytest.raises(ConfigError):
        jax.eval_shape(train, jax.random.key(0), CARTPOLE.params)
    with pytest.raises(ConfigError):
        program_of(agent, objective=AUC())
    with pytest.raises(ConfigError):
        BoltzmannConfig().make(
            type("Task", (), {"num_actions": None, "action_dim": 3, "max_action": 1.0})
        )


def test_the_command_asks_for_no_baseline_before_it_trains_anything():
    config = configuration.evaluate_config(["proxy=cartpole", "agent=boltzmann"])
    with pytest.raises(ConfigError, match=r"^baseline must be false with agent=boltzmann, "):
        evaluate(config)
