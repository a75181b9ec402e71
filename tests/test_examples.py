"""The scripts in examples/: each runs, in a small size, in a folder that is not the repository."""

import importlib
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import paper_training, random_like, shapes_of

import sejax

EXAMPLES = Path(__file__).parents[1] / "examples"
TINY = {
    "own_task": ["--generations=1", "--population=2", "--steps=60"],
    "own_agent": ["--seeds=2", "--steps=20"],
    "own_objective": ["--generations=1", "--population=2", "--agents=2", "--steps=250"],
    "own_proxy": ["--generations=1", "--population=2", "--steps=250"],
    "read_a_set": ["--agents=3", "--size=2", "--generations=2"],
    "suite_reward_network": ["gymnax/Catch-bsuite", "--solved=0.8", "--generations=1",
                             "--population=2", "--agents=2", "--steps=30"],
    "train_thousands": ["--agents=6", "--num_parallel=2"],
    "sb3_agents": ["--steps=10", "--seeds=1", "--episodes=1"],
    "sbx_agent": ["--steps=10", "--seeds=1", "--episodes=1"],
    "cleanrl_dqn": ["--total-steps=60", "--test-every=30", "--test-episodes=1",
                    "--learning-starts=40", "--batch-size=4", "--target-frequency=2"],
    "reward_network_wrapper": ["--agents=A2C", "--seeds=1", "--max-steps=10", "--test-every=5",
                               "--episodes=1"],
    "rejax_agent": ["--steps=80", "--test-every=40", "--agents=2", "--episodes=2"],
}  # fmt: skip
PRINTS = {
    "own_task": r"best -\d+\.\d+ in generation 0; solved at -1",
    "own_agent": r"test return of each agent: -\d+ -\d+\nmean -\d+",
    "own_objective": r"MaxReward: mean return .*\nRiskAverse: mean return",
    "own_proxy": r"linear_cartpole\.safetensors: best \d+, 35 weights",
    "read_a_set": r"seed 0, .*3 fresh agents return .*\nseed 1,",
    "suite_reward_network": r"with the RN: \d of 2 agents .*\nwithout it: \d of 2 agents",
    "train_thousands": r"proxy: 6 agents .*\n.*test return -12\.0\nreal task: 6 agents",
    "sb3_agents": r"(?s)cartpole  PPO +\d+\.0 ± 0.*DQN.*acrobot   PPO.*DQN +-\d+\.0 ± 0.0 +-\d",
    "sbx_agent": r"after 10 steps on the SE: \d+\n.*on CartPole: \d+\n",
    "cleanrl_dqn": r"return on CartPole-v1 every 30 steps on sejax\.gym:sejax/cartpole: \d+ \d+\n",
    "reward_network_wrapper": r"A2C with the RN: solved after .*median .*\nA2C without it: ",
    "rejax_agent": r"every 40 steps on the SE: \d+ \d+ \d+\n.*on CartPole: \d+ \d+ \d+\n",
}
# What is not in the development environment; `make test-examples` has it.
NEEDS = {
    "sb3_agents": "stable_baselines3",
    "sbx_agent": "sbx",
    "cleanrl_dqn": "torch",
    "reward_network_wrapper": "stable_baselines3",
    "rejax_agent": "rejax",
}


@pytest.fixture
def examples(monkeypatch, tmp_path):
    """Imports an example by its name, in an empty folder."""
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.chdir(tmp_path)
    yield importlib.import_module
    for name in TINY:
        sys.modules.pop(name, None)


def test_every_example_is_tested():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(TINY)


def _marked(name):
    """An example with its marks: warnings of another package are its own."""
    own = [pytest.mark.filterwarnings("default")] if name in NEEDS else []
    # The dearest, whose objective a command uses below.
    return pytest.param(name, marks=[*own, *[pytest.mark.slow] * (name == "own_objective")])


@pytest.mark.parametrize("name", [_marked(name) for name in TINY])
def test_it_runs(name, examples, monkeypatch, capsys):
    pytest.importorskip(NEEDS.get(name, "sejax"), reason="make test-examples installs it")
    monkeypatch.setattr(sys, "argv", [name, *TINY[name]])
    examples(name).main()
    assert re.search(PRINTS[name], capsys.readouterr().out)


def test_a_command_takes_a_task_an_agent_a_proxy_and_an_objective_from_its_folder(tmp_path):
    for name in ("own_task", "own_agent", "own_proxy", "own_objective"):
        shutil.copy(EXAMPLES / f"{name}.py", tmp_path)
    choices = ["env=own_task:make_reacher", "env.size=4", "agent=own_agent:SAC",
               "agent.hidden_size=8", "agent.warmup_episodes=1", "proxy=own_proxy:LinearSE",
               "objective=own_objective:RiskAverse", "objective.aversion=2"]  # fmt: skip
    small = ["generations=1", "es.population_size=2", "es.num_incumbent_evals=1", "devices=1",
             "training.max_steps=30", "run_dir=here"]  # fmt: skip
    command = [sys.executable, "-m", "sejax.run", *choices, *small]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with pytest.raises(sejax.ConfigError, match="what a file names is never imported"):
        sejax.load(tmp_path / "here")


# --- own_agent -----------------------------------------------------------------------------------

OBS_DIM, ACTION_DIM, BATCH, HIDDEN = 3, 2, 5, 4


class NumpySAC:
    """SAC's losses once more, in float64, as Haarnoja et al. (2018) write them."""

    def __init__(self, params, target_critics, hparams):
        self.params = params
        self.target_critics, self.discount = target_critics, float(hparams.discount)

    @staticmethod
    def mlp(tree, x):
        layers = [tree["params"][f"Dense_{i}"] for i in range(3)]
        for layer in layers[:-1]:
            x = np.maximum(x @ layer["kernel"] + layer["bias"], 0)
        return x @ layers[-1]["kernel"] + layers[-1]["bias"]

    def q_values(self, critics, obs, action):
        inputs = np.concatenate([obs, action], axis=1)
        return [self.mlp(jax.tree.map(lambda x, i=i: x[i], critics), inputs)[:, 0] for i in (0, 1)]

    def sample(self, actor, obs, noise):
        mean, log_std = np.split(self.mlp(actor, obs), 2, axis=1)
        std = np.exp(np.clip(log_std, -20, 2))
        action = np.tanh(mean + std * noise)
        density = np.exp(-(noise**2) / 2) / (std * np.sqrt(2 * np.pi)) / (1 - action**2)
        return action, np.log(density).sum(axis=1)

    def losses(self, moved, batch, noise):
        """Those of critics, actor and temperature, each with its own of `moved` parameters."""
        now, alpha = self.params, np.exp(self.params["log_alpha"])
        next_action, next_log_p = self.sample(now["actor"], batch["next_obs"], noise[1])
        next_q = np.minimum(*self.q_values(self.target_critics, batch["next_obs"], next_action))
        soft_value = next_q - alpha * next_log_p
        target = batch["reward"] + self.discount * batch["discount"] * soft_value
        errors = np.array(self.q_values(moved["critics"], batch["obs"], batch["action"])) - target
        action, log_p = self.sample(moved["actor"], batch["obs"], noise[0])
        q = np.minimum(*self.q_values(now["critics"], batch["obs"], action))
        _, log_p_now = self.sample(now["actor"], batch["obs"], noise[0])
        entropy_gap = -log_p_now - (-ACTION_DIM)
        each = [
            0.5 * (errors**2).sum(axis=0), alpha * log_p - q,
            np.exp(moved["log_alpha"]) * entropy_gap,
        ]  # fmt: skip
        return sum(np.average(loss, weights=batch["weight"]) for loss in each)


def test_a_sac_update_is_one_that_was_derived_anew(examples):
    """Gradients of the losses above by differences; then Adam's first step and the soft update."""
    own_agent = examples("own_agent")
    networks = own_agent.Networks(own_agent.Actor(ACTION_DIM, HIDDEN), own_agent.Critic(HIDDEN))
    rng = np.random.default_rng(0)
    shapes = shapes_of(networks.init, jax.random.key(0), np.zeros(OBS_DIM), np.zeros(ACTION_DIM))
    params = random_like(shapes, seed=1)
    target_critics = jax.tree.map(lambda x: x + np.float32(0.1), params["critics"])
    hparams = sejax.agents.traced(own_agent.SAC(discount=0.9, tau=0.1))
    state = own_agent.SACState(params=params, target_critics=target_critics, hparams=hparams,
                               opt_state=own_agent.ADAM.init(params),
                               is_warming_up=jnp.bool_(False))  # fmt: skip
    arrays = {"obs": rng.normal(size=(BATCH, OBS_DIM)), "reward": rng.normal(size=BATCH),
              "action": rng.uniform(-1, 1, (BATCH, ACTION_DIM)),
              "next_obs": rng.normal(size=(BATCH, OBS_DIM)),
              "discount": rng.uniform(-0.2, 1.2, BATCH),
              "weight": np.array([1, 1, 1, 1, 0])}  # fmt: skip
    noise = rng.normal(size=(2, BATCH, ACTION_DIM))
    batch = sejax.agents.Transition(**{name: np.float32(x) for name, x in arrays.items()})
    after = jax.jit(lambda *args: own_agent.learn(networks, *args))(state, batch, noise)

    in_float64 = jax.tree.map(lambda x: np.asarray(x, np.float64), (params, target_critics))
    reference = NumpySAC(*in_float64, hparams)
    leaves, structure = jax.tree.flatten(in_float64[0])
    gradient = [np.zeros_like(leaf) for leaf in leaves]
    for i, leaf in enumerate(leaves):
        for place in np.ndindex(leaf.shape):
            values = []
            for step in (1e-6, -1e-6):
                moved = [x.copy() for x in leaves]
                moved[i][place] += step
                values.append(reference.losses(structure.unflatten(moved), arrays, noise))
            gradient[i][place] = (values[0] - values[1]) / 2e-6
    # The first moment after the first step is a tenth of the gradient.
    for got, expected in zip(jax.tree.leaves(after.opt_state.mu), gradient, strict=True):
        np.testing.assert_allclose(10 * got, expected, rtol=1e-3, atol=1e-5)
    is_clear = [np.abs(g) > 1e-4 for g in gradient]
    for new, old, g, clear in zip(jax.tree.leaves(after.params), leaves, gradient, is_clear,
                                  strict=True):  # fmt: skip
        expected = old - hparams.learning_rate * np.sign(g)
        np.testing.assert_allclose(np.asarray(new)[clear], expected[clear], rtol=1e-5, atol=1e-6)
    mixed = jax.tree.map(lambda new, old: 0.1 * new + 0.9 * old, after.params["critics"],
                         target_critics)  # fmt: skip
    for got, expected in zip(jax.tree.leaves(after.target_critics), jax.tree.leaves(mixed),
                             strict=True):  # fmt: skip
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-7)


def test_the_reacher_is_solved_by_moving_towards_the_target(examples):
    task = examples("own_task").make_reacher(size=5)

    def episode(key):
        obs, state = task.env.reset_env(key, task.params)

        def step(carry, _):
            obs, state, total, over = carry
            action = jnp.clip(obs * 6 / task.params.size, -1, 1)
            obs, state, reward, terminated, _ = task.env.step_env(key, state, action, task.params)
            return (obs, state, total + jnp.where(over, 0.0, reward), over | terminated), None

        start = obs, state, jnp.float32(0), jnp.bool_(False)
        (_, _, total, over), _ = jax.lax.scan(step, start, length=task.max_steps)
        return total, over

    totals, over = jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0), 100))
    assert over.all() and totals.mean() > task.solved_reward


def test_risk_is_a_deviation_between_an_agents_episodes(examples):
    objective = examples("own_objective").RiskAverse(aversion=2.0).make(None)
    returns = jnp.array([[1.0, 3.0], [2.0, 2.0], [5.0, 5.0]])
    outcome = sejax.Outcome(
        test_returns=returns, scored_returns=returns, train_steps=jnp.ones(3, int),
        train_episodes=jnp.ones(3, int), auc=jnp.zeros(3), real_steps=jnp.ones(3, int),
        nonfinite=jnp.array([False, False, True]),
    )  # fmt: skip
    np.testing.assert_allclose(objective(outcome), [2.0 - 2.0, 2.0, jnp.nan])  # mean 2, std 1


@pytest.mark.slow
def test_sac_learns_pendulum(examples):
    own_agent = examples("own_agent")
    task = sejax.envs.make("pendulum")
    agent = sejax.make_agent(own_agent.SAC(), task)
    training = paper_training(stop_rule="never", max_steps=15_000)
    keys = jax.random.split(jax.random.key(7), 6)
    outcome = sejax.evaluate_agents(agent, task.env, task.params, task, training, keys)
    assert (outcome.test_return > -300).sum() >= 4
