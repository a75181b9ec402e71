"""Proxies as `VecEnv`s of Stable-Baselines3, whose own `DummyVecEnv` of single ones says the same.

They need the extra `sb3`, which `dev` has not (torch is 200 MB): `make test-examples`.
"""

import pickle
import re
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TransformObservation
from test_gym_vector import SES, world_of

import sejax.gym
from sejax.gym import SyntheticEnv
from sejax.options import ConfigError
from sejax.proxies import header

try:
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_checker import check_env
    from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

    from sejax.gym.sb3 import SyntheticVecEnv
except ImportError:
    PPO = None
PAGE = Path(__file__).parents[1] / "docs/gymnasium.md"
needs_sb3 = pytest.mark.skipif(PPO is None, reason="needs the extra sb3: make test-examples")


def test_without_it_one_message_says_what_to_install(monkeypatch):
    for module in ("stable_baselines3", "stable_baselines3.common.vec_env"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ConfigError, match=r"pip install 'sejax\[sb3\]'"):
        sejax.gym.make_sb3("cartpole")


@needs_sb3
@pytest.mark.parametrize("name", SES)
def test_lanes_are_single_environments(name):
    world, num_envs = world_of(**SES[name]), 3
    lanes = SyntheticVecEnv(world, num_envs)
    singles = DummyVecEnv([lambda: SyntheticEnv(world)] * num_envs)
    lanes.action_space.seed(0)
    assert lanes.seed(5) == singles.seed(5) == [5, 6, 7]
    np.testing.assert_allclose(lanes.reset(), singles.reset(), atol=1e-5)
    num_ended = 0
    for _ in range(40):
        actions = np.stack([lanes.action_space.sample() for _ in range(num_envs)])
        *got, infos = lanes.step(actions)
        *expected, expected_infos = singles.step(actions)
        for a, b in zip(got, expected, strict=True):
            assert a.dtype == b.dtype and a.shape == b.shape
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
        for a, b in zip(infos, expected_infos, strict=True):
            assert a.keys() == b.keys() and a["TimeLimit.truncated"] is b["TimeLimit.truncated"]
            for key in a:
                np.testing.assert_allclose(a[key], b[key], rtol=1e-5, atol=1e-5)
        num_ended += got[2].sum()
    assert num_ended > num_envs
    copy = pickle.loads(pickle.dumps(lanes))
    np.testing.assert_array_equal(lanes.step(actions)[0], copy.step(actions)[0])
    np.testing.assert_array_equal(lanes.reset(), copy.reset())


@needs_sb3
def test_lanes_share_their_attributes():
    envs = sejax.gym.make_sb3("cartpole", 3)
    assert envs.get_attr("render_mode") == [None] * 3 and not envs.has_attr("nothing")
    assert [x.horizon for x in envs.get_attr("config", indices=[0, 2])] == [1, 1]
    envs.set_attr("tag", 7)
    assert envs.get_attr("tag", 1) == [7]
    with pytest.raises(NotImplementedError, match="indices=None"):
        envs.set_attr("tag", 7, indices=[1])
    assert envs.env_method("get_wrapper_attr", "tag", indices=[0]) == [7]
    with pytest.raises(NotImplementedError, match="reset together"):
        envs.env_method("reset")
    assert envs.env_is_wrapped(gymnasium.Wrapper) == [False] * 3
    envs.close()


@needs_sb3
@pytest.mark.parametrize("name", header.pretrained_names())
@pytest.mark.filterwarnings("ignore:We recommend you to use a symmetric:UserWarning")
def test_its_checker_passes_for_what_ships(name):
    check_env(sejax.gym.make(name))
    check_env(gymnasium.make(f"sejax/{name}"))


@needs_sb3
@pytest.mark.parametrize("name", ["cartpole", "cartpole-rn"])
def test_an_agent_of_theirs_trains_there(name):
    envs = VecMonitor(sejax.gym.make_sb3(name, 4))
    model = PPO("MlpPolicy", envs, n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu")
    model.learn(128)
    assert model.num_timesteps == 128 and len(model.ep_info_buffer) > 0


@needs_sb3
@pytest.mark.filterwarnings("ignore:Evaluation environment is not wrapped:UserWarning")
def test_the_page_runs_and_its_torch_networks_are_the_se():
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) > 5
    for block in blocks:
        names = {}
        short = re.sub(r"learn\([\d_]+\)", "learn(256)", block)
        exec(compile(short, PAGE.name, "exec"), names)
        if "load_file" in block:
            world = sejax.gym.make("cartpole").world
            noise, actions = names["noise"].numpy(), names["actions"].numpy().argmax(axis=1)
            first = world.first(noise)
            encoded = np.eye(2, dtype=np.float32)[actions]
            step = world.step(first, encoded, np.ones(len(actions)))
            np.testing.assert_allclose(names["obs"].detach(), first, atol=1e-5)
            np.testing.assert_allclose(names["rewards"].detach()[:, 0], step.reward, atol=1e-5)
            return
    pytest.fail("no recipe for torch")


@needs_sb3
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


@needs_sb3
@pytest.mark.parametrize(
    ("name", "task"), [("CartPole-v1", "cartpole"), ("Pendulum-v1", "pendulum")]
)
def test_a_model_of_theirs_is_a_policy_to_distil(tmp_path, name, task):
    import jax

    from sejax.distill import main
    from sejax.distillation.policies import policy_of

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
