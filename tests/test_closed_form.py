"""SEs whose best policy is known: their rewards, that policy, and learning by it alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import paper_se

import sejax
from sejax import envs
from sejax.bilevel import make_bilevel
from sejax.cli import config as configuration
from sejax.evaluation import best_policy, make_tester
from sejax.objectives import CLOSED_FORM, MaxReward
from sejax.options import ConfigError
from sejax.proxies import header, zoo
from sejax.proxies.configs import SyntheticConfig
from sejax.run import main

CARTPOLE, PENDULUM = envs.make("cartpole"), envs.make("pendulum")
CHOICE = SyntheticConfig(hidden_size=8, horizon=1, initial_state="learned", done="threshold")
FORMS = {
    form: paper_se(
        hidden_size=8, horizon=1, initial_state="noise", state_units="bounds", reward_form=form,
        reward_slope=0.7,
    )
    for form in ("distance", "quadratic")
}  # fmt: skip
OBS = jnp.array([0.6, 0.8, -2.0])


def made(config, task=PENDULUM, seed=3):
    env = config.make(task)
    return env, env.init_weights(jax.random.key(seed))


def step_reward(env, weights, obs, action):
    """As an agent would meet it."""
    params = env.params(weights)
    _, state = env.reset_env(jax.random.key(0), params)
    state = state.replace(vector=jnp.asarray(obs))
    return float(env.step_env(jax.random.key(0), state, jnp.asarray(action), params)[2])


@pytest.mark.parametrize("form", FORMS)
def test_the_reward_is_what_the_form_says(form):
    env, weights = made(FORMS[form])
    # The network by hand: leaky ReLUs of the state in units of half the way to the bounds.
    seen = np.asarray(OBS) / np.array([0.5, 0.5, 4.0])
    first, last = weights["reward"]["Dense_0"], weights["reward"]["Dense_1"]
    hidden = np.asarray(first["kernel"]) @ seen + np.asarray(first["bias"])
    hidden = np.where(hidden > 0, hidden, 0.01 * hidden)
    output = np.asarray(last["kernel"]) @ hidden + np.asarray(last["bias"])
    best = 2.0 * np.clip(output, -1, 1)
    np.testing.assert_allclose(env.best_action(weights, OBS), best, rtol=1e-5)
    for action in (-2.0, 0.3, 5.0):  # the last is clipped to 2
        apart = abs(min(action, 2.0) - best[0])
        wanted = -0.7 * (apart if form == "distance" else apart**2)
        assert step_reward(env, weights, OBS, [action]) == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("bias", [0.1, 0.98, -5.0])  # best actions inside, near and at the bounds
def test_soft_actions_come_as_often_as_rewards_say(form, bias):
    env, weights = made(FORMS[form])
    weights["reward"]["Dense_1"] = {
        "kernel": jnp.zeros((1, 8)), "bias": jnp.array([bias])
    }  # fmt: skip
    draw = jax.jit(jax.vmap(lambda key: env.soft_action(key, weights, OBS, 0.4)))
    drawn = np.asarray(draw(jax.random.split(jax.random.key(1), 40_000)))[:, 0]
    assert np.abs(drawn).max() <= 2.0 and np.isfinite(drawn).all()
    grid = np.linspace(-2, 2, 4001)
    rewards = np.array(jax.vmap(lambda a: env.bandit_reward(weights, OBS, a[None]))(grid))
    mass = np.exp(rewards / 0.4)
    for edge in (-1.0, 0.0, 0.2, 1.0, 1.9):
        wanted = mass[grid <= edge].sum() / mass.sum()
        assert (drawn <= edge).mean() == pytest.approx(wanted, abs=0.012)  # 4 standard errors


def test_of_discrete_actions_the_best_is_known_and_soft_ones_are_a_softmax():
    env, weights = made(CHOICE, CARTPOLE)
    obs = jnp.array([0.1, -0.5, 0.02, 0.7])
    rewards = np.array([step_reward(env, weights, obs, action) for action in (0, 1)])
    assert int(env.best_action(weights, obs)) == rewards.argmax()
    draw = jax.jit(jax.vmap(lambda key: env.soft_action(key, weights, obs, 0.2)))
    share = np.asarray(draw(jax.random.split(jax.random.key(1), 20_000))).mean()
    wanted = 1 / (1 + np.exp((rewards[0] - rewards[1]) / 0.2))
    assert 0.1 < wanted < 0.9  # or little would be tested
    assert share == pytest.approx(wanted, abs=0.015)


def test_discrete_states_are_indices_for_the_policy():
    task = envs.make("cliff_walking")
    env, weights = made(paper_se(hidden_size=8, horizon=1, initial_state="learned"), task)
    params = env.params(weights)
    _, state = env.reset_env(jax.random.key(0), params)
    state = state.replace(vector=jax.nn.one_hot(7, 48))
    step = lambda a: float(env.step_env(jax.random.key(0), state, a, params)[2])  # noqa: E731
    assert int(env.best_action(weights, jnp.int32(7))) == np.argmax([step(a) for a in range(4)])


def test_it_is_stored_and_plays_in_numpy_alike(tmp_path):
    for form, config in FORMS.items():
        env, weights = made(config)
        sejax.save(tmp_path / f"{form}.safetensors", env, weights)
        alike = sejax.gym.make(str(tmp_path / f"{form}.safetensors"))
        obs, _ = alike.reset(seed=1)
        action = np.array([-1.3], np.float32)
        _, reward, terminated, *_ = alike.step(action)
        assert terminated
        np.testing.assert_allclose(reward, env.bandit_reward(weights, obs, action), rtol=1e-4)


# --- learning by it -------------------------------------------------------------------------------


def program_of(agent, task=CARTPOLE, proxy=CHOICE, **fields):
    return make_bilevel(
        task=task, agent=agent, proxy=proxy, devices=1,
        es=sejax.NESConfig(
            population_size=16, noise_std=0.1, noise_std_decay=1.0, num_incumbent_evals=4
        ),
        training=sejax.TrainingConfig(max_steps=64, max_episodes=64, stop_rule="never"),
        objective=MaxReward(**fields),
    )  # fmt: skip


DDQN = sejax.make_agent(
    sejax.DDQNConfig(hidden_size=8, num_layers=1, batch_size=8, warmup_episodes=1), CARTPOLE
)


def test_the_outer_loop_learns_without_a_step_of_training():
    program = program_of(DDQN, closed_form=1.0)
    assert program.mixture.names == (CLOSED_FORM,)
    state = jax.jit(program.init)(jax.random.key(0))
    generation = jax.jit(program.generation)
    infos = []
    for _ in range(12):
        state, info = generation(state)
        infos.append(jax.device_get(info))
    assert infos[0].incumbent_mean < 60 < 100 < infos[-1].incumbent_mean
    assert all(info.train_steps.sum() == 0 for info in infos)
    # In CartPole a step pays 1: tests are all that is played.
    returns = infos[-1].population_scores.sum() * 10 + infos[-1].incumbent_mean * 10 * 4
    assert infos[-1].real_steps.sum() == pytest.approx(returns, rel=1e-5)
    # The incumbent's score is that of its policy, tested by itself.
    policy = best_policy(program.proxy)
    params = program.params_of(state.best)
    tests = make_tester(policy, CARTPOLE, 200)(jax.random.key(9), params)
    assert float(tests.returns.mean()) == pytest.approx(float(state.best_score), abs=25)


def test_a_share_of_the_candidates_has_no_agent():
    program = program_of(DDQN, closed_form=0.75, temperature=0.1)
    info = jax.device_get(jax.jit(lambda key: program.generation(program.init(key))[1])(
        jax.random.key(0)))  # fmt: skip
    assert program.mixture.names == ("0", CLOSED_FORM)
    steps = info.train_steps
    assert (steps[:-4] > 0).mean() == 0.25 and (steps[-4:] > 0).sum() == 2
    np.testing.assert_array_equal(info.by_agent.train_steps_mean, [64, 0])


def test_the_command_names_it_in_its_files(tmp_path):
    words = [
        *("env=pendulum", "proxy.horizon=1", "proxy.initial_state=noise", "devices=1"),
        *("proxy.reward_form=quadratic", "objective.closed_form=1", "es.population_size=4"),
        *(
            "generations=3",
            "training.test_episodes=2",
            f"run_dir={tmp_path}",
            "proxy.done=threshold",
        ),
    ]
    main(words)
    columns = (tmp_path / "metrics.csv").read_text().splitlines()[0]
    assert CLOSED_FORM not in columns  # one score
    proxy = sejax.load_proxy(tmp_path)
    assert proxy.config["objective"]["closed_form"] == 1.0
    assert list(zoo.describe(header.read(tmp_path)).scores) == [CLOSED_FORM]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["env=cartpole", "preset=soft"], r"objective.closed_form must be 0 .* proxy.horizon=1,"),
        (["env=pendulum", "proxy.reward_form=network"], r"proxy.reward_form=distance,"),
        (["env=cartpole", "proxy=rn", "objective=max_reward"], "objective.closed_form must be 0"),
        (["env=cartpole", "objective.closed_form=2"], "objective.closed_form must lie between"),
        (["env=cartpole", "proxy.reward_form=distance", "proxy.horizon=1"],
         "proxy.reward_form must be network for discrete actions"),
        (["env=pendulum", "proxy.reward_form=distance", "proxy.horizon=null"],
         "proxy.reward_form must be network where episodes have several steps"),
        (["env=cartpole", "objective.temperature=0.1", "objective.closed_form=0"],
         "objective.temperature must be 0 with objective.closed_form=0"),
        (["env=cartpole", "proxy.reward_slope=2"],
         "proxy.reward_slope must be 1 with proxy.reward_form=network"),
    ],
)  # fmt: skip
def test_where_the_best_policy_is_not_known_it_is_refused(words, message):
    asked = [] if any("closed_form" in x for x in words) else ["objective.closed_form=1"]
    with pytest.raises(ConfigError, match=message):
        configuration.config([*words, *asked])


def test_the_parts_refuse_it_too():
    with pytest.raises(ConfigError, match=r"objective.closed_form must be 0"):
        program_of(DDQN, proxy=paper_se(hidden_size=8), closed_form=1.0)
