"""Proxies as `VecEnv`s of Stable-Baselines3, whose own `DummyVecEnv` of single ones says the same.

They need the extra `sb3`, which `dev` has not (torch is 200 MB): `make test-examples`.
"""

import pickle
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TransformObservation
from test_gym import SES, assert_same, world_of

import sejax.gym
from sejax.gym import SyntheticGymEnv
from sejax.proxies import header

pytest.importorskip("stable_baselines3", reason="needs the extra sb3: make test-examples")

from stable_baselines3 import DQN, PPO, TD3
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sejax.gym.sb3 import SyntheticVecEnv

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", SES)
def test_lanes_are_single_environments(name):
    world, num_envs = world_of(**SES[name]), 3
    lanes = SyntheticVecEnv(world, num_envs)
    singles = DummyVecEnv([lambda: SyntheticGymEnv(world)] * num_envs)
    lanes.action_space.seed(0)
    assert lanes.seed(5) == singles.seed(5) == [5, 6, 7]
    assert_same(lanes.reset(), singles.reset())
    num_ended = 0
    for _ in range(40):
        actions = np.stack([lanes.action_space.sample() for _ in range(num_envs)])
        got = lanes.step(actions)
        assert_same(got, singles.step(actions))
        num_ended += got[2].sum()
    assert num_ended > num_envs
    copy = pickle.loads(pickle.dumps(lanes))
    assert_same(lanes.step(actions), copy.step(actions), tolerance=0)
    assert_same(lanes.reset(), copy.reset(), tolerance=0)


def test_lanes_have_their_own_attributes_and_step_together():
    envs = sejax.gym.make_sb3("cartpole", 3)
    assert envs.get_attr("render_mode") == [None] * 3 and not envs.has_attr("nothing")
    envs.set_attr("tag", 7)
    envs.set_attr("tag", 8, indices=[1])
    assert envs.get_attr("tag") == [7, 8, 7]
    assert envs.env_method("get_wrapper_attr", "tag", indices=[0]) == [7]
    assert envs.env_is_wrapped(gymnasium.Wrapper) == [False] * 3
    envs.close()


@pytest.mark.parametrize("name", header.pretrained_files())
@pytest.mark.filterwarnings("ignore:We recommend you to use a symmetric:UserWarning")
def test_its_checker_passes_for_what_ships(name):
    check_env(sejax.gym.make(name))
    check_env(gymnasium.make(f"sejax/{name}"))


@pytest.mark.parametrize("name", ["cartpole", "cartpole-rn"])
def test_an_agent_of_theirs_trains_there(name):
    envs = VecMonitor(sejax.gym.make_sb3(name, 4))
    model = PPO("MlpPolicy", envs, n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu")
    model.learn(128)
    assert model.num_timesteps == 128 and len(model.ep_info_buffer) > 0


ONE_STEP = ["acrobot", "cartpole_v1", "mountain_car", "mountain_car_continuous", "pendulum"]


@pytest.mark.filterwarnings("ignore:Evaluation environment is not wrapped:UserWarning")
@pytest.mark.parametrize(
    "name", ["cartpole", *(pytest.param(x, marks=pytest.mark.slow) for x in ONE_STEP)]
)
def test_an_agent_of_theirs_solves_a_task_of_which_it_has_never_seen_a_step(name):
    task = sejax.envs.make(name)
    real = gymnasium.make(sejax.gym.GYMNASIUM_IDS[name], max_episode_steps=task.max_steps)
    options = {"learning_rate": 1e-3, "learning_starts": 200, "train_freq": 1, "device": "cpu"}
    if task.num_actions is not None:
        options |= {"target_update_interval": 100, "exploration_final_eps": 0.05}
    cls, network = TD3 if task.num_actions is None else DQN, {"net_arch": [64, 64]}
    agents = (
        cls("MlpPolicy", sejax.gym.make(name), policy_kwargs=network, seed=seed, **options)
        for seed in range(2)
    )
    assert any(evaluate_policy(x.learn(4000), real)[0] >= task.solved_reward for x in agents)


@pytest.mark.filterwarnings("ignore:Evaluation environment is not wrapped:UserWarning")
@pytest.mark.parametrize(("page", "num_blocks"), [("README.md", 3), ("docs/gymnasium.md", 5)])
def test_the_page_runs(page, num_blocks):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)
    assert len(blocks) == num_blocks
    for block in blocks:
        block = block.replace("generations=8", "generations=1")
        short = re.sub(r"learn\([\d_]+\)", "learn(256)", block)
        exec(compile(short, page, "exec"), {})


def test_sb3s_own_entry_takes_an_se_and_an_agent_goes_on_with_the_real_task():
    """docs/gymnasium.md: make_vec_env asks for pictures, and set_env compares spaces."""
    from stable_baselines3.common.env_util import make_vec_env

    envs = make_vec_env("sejax/cartpole", n_envs=2)
    assert envs.reset().shape == (2, 4)
    agent = PPO("MlpPolicy", envs, n_steps=32, batch_size=32).learn(64)

    def real():
        env = gymnasium.make("CartPole-v1")
        return TransformObservation(env, lambda obs: obs, envs.observation_space)

    agent.set_env(make_vec_env(real, n_envs=2))
    agent.learn(64)


@pytest.mark.parametrize(
    ("name", "task"), [("CartPole-v1", "cartpole"), ("Pendulum-v1", "pendulum")]
)
def test_a_model_of_theirs_is_a_policy_to_distil(tmp_path, name, task):
    import jax

    from sejax.distill.__main__ import main
    from sejax.distill.policies import policy_of

    model = PPO("MlpPolicy", gymnasium.make(name), n_steps=16, batch_size=16, seed=0, device="cpu")
    model.save(tmp_path / "model.zip")
    act = policy_of(f"ppo:{tmp_path}/model.zip", sejax.envs.make(task), 1, jax.random.key(0))
    obs = np.random.default_rng(0).normal(size=(9, *model.observation_space.shape)).astype("f4")
    np.testing.assert_allclose(act(obs), model.predict(obs, deterministic=True)[0])
    main([
        *(f"env={task}", f"policy=ppo:{tmp_path}/model.zip", "copy.rounds=1", "copy.episodes=2"),
        *("copy.steps=50", "num_tested=2", "training.max_steps=600", "training.max_episodes=600"),
        *("devices=1", f"run_dir={tmp_path}/run"),
    ])  # fmt: skip
    assert sejax.load_proxy(tmp_path / "run").record["policy_return"] < 200.1
