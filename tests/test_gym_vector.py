"""Vector environments of SEs: Gymnasium's own `SyncVectorEnv` of single ones says the same."""

import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from support import paper_se, random_like, refused

from sejax.gym import RealTask, SyntheticEnv, SyntheticVectorEnv, SyntheticWorld, make, make_vec
from sejax.gym.networks import shapes_of
from sejax.gym.synthetic import PREFETCHED

TASKS = {"cartpole": RealTask.of_gymnasium("CartPole-v1", 4),
         "pendulum": RealTask.of_gymnasium("Pendulum-v1", 3)}  # fmt: skip
MODES = ["NextStep", "SameStep", "Disabled"]


def world_of(task="cartpole", **config):
    """An SE of random weights."""
    config = paper_se(hidden_size=5, **{"done": "threshold"} | config)
    obs_dim, action_dim = {"cartpole": (4, 2), "pendulum": (3, 1)}[task]
    shapes = shapes_of(config.networks(obs_dim, action_dim))
    like = {name: np.zeros(shape) for name, shape in shapes.items()}
    return SyntheticWorld(random_like(like, seed=1, scale=0.5), config, TASKS[task])


SES = {
    "bandit": {"horizon": 1, "initial_state": "learned"},
    "longer than a block of starts": {"horizon": 2, "initial_state": "noise"},
    "cut": {"horizon": 3, "horizon_is_terminal": False, "initial_state": "learned"},
    "drawn ends": {"done": "bernoulli", "initial_state": "learned"},
    "real starts and drawn ends": {"done": "sigmoid"},
    "soft": {"done": "soft"},
    "of a least length": {"done": "soft", "min_steps": 2},
    "continuous actions": {"task": "pendulum", "state_units": "bounds"},
}


def assert_same(got, expected):
    """Of what two environments return, nested infos included."""
    if isinstance(expected, tuple):
        for a, b in zip(got, expected, strict=True):
            assert_same(a, b)
    elif isinstance(expected, dict):
        assert got.keys() == expected.keys()
        for key in expected:
            assert_same(got[key], expected[key])
    elif expected.dtype.kind == "O":  # final observations
        for a, b in zip(got, expected, strict=True):
            assert (a is None) == (b is None)
            if b is not None:
                np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
    else:
        assert got.dtype == expected.dtype and got.shape == expected.shape
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", SES)
def test_lanes_are_single_environments(name, mode):
    world, num_envs = world_of(**SES[name]), 3
    lanes = SyntheticVectorEnv(world, num_envs, mode)
    singles = SyncVectorEnv([lambda: SyntheticEnv(world)] * num_envs, autoreset_mode=mode)
    assert lanes.metadata == singles.metadata | {"autoreset_mode": AutoresetMode(mode)}
    assert lanes.observation_space == singles.observation_space
    assert lanes.action_space == singles.action_space
    lanes.action_space.seed(0)
    assert_same(lanes.reset(seed=5), singles.reset(seed=5))
    num_ended = 0
    for _ in range(PREFETCHED + 4):
        actions = lanes.action_space.sample()
        got, expected = lanes.step(actions), singles.step(actions)
        assert_same(got, expected)
        ended = got[2] | got[3]
        num_ended += ended.sum()
        if mode == "Disabled" and ended.any():
            given = {"reset_mask": ended}
            assert_same(lanes.reset(options=given), singles.reset(options={**given}))
    assert num_ended > num_envs
    assert_same(lanes.reset(), singles.reset())
    assert_same(lanes.reset(seed=[7, None, 9]), singles.reset(seed=[7, None, 9]))
    assert lanes.np_random_seed == [7, 6, 9] and len(lanes.np_random) == num_envs


def test_a_pickled_one_goes_on_as_it_would_have():
    envs = SyntheticVectorEnv(world_of(**SES["bandit"]), 2)
    envs.reset(seed=0)
    copy = pickle.loads(pickle.dumps(envs))
    for _ in range(3):
        assert_same(envs.step([0, 1])[0], copy.step([0, 1])[0])


def test_what_is_returned_is_the_callers():
    envs = SyntheticVectorEnv(world_of(done="soft"), 2)
    envs.reset(seed=0)[0][:] = np.nan
    envs.step([0, 1])[0][:] = np.nan
    assert np.isfinite(envs.step([0, 1])[0]).all()


def test_actions_must_be_a_batch_of_the_space():
    envs = SyntheticVectorEnv(world_of(), 2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step([0, 1])
    envs.reset(seed=0)
    for actions in ([0, 2], [0, -1], [0], 0, [0.0, 1.0], [[0, 1]]):
        with pytest.raises(gymnasium.error.InvalidAction, match=r"none of MultiDiscrete"):
            envs.step(actions)
    pendulums = SyntheticVectorEnv(world_of("pendulum"), 2)
    pendulums.reset(seed=0)
    with pytest.raises(gymnasium.error.InvalidAction, match=r"none of Box"):
        pendulums.step([0.0, 1.0])
    pendulums.step([[0.0], [7.0]])  # clipped, as in the single one


def test_an_ended_lane_must_be_reset_where_nothing_does_it():
    envs = SyntheticVectorEnv(world_of(**SES["bandit"]), 2, "Disabled")
    envs.reset(seed=0)
    envs.step([0, 1])
    envs.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step([0, 1])


def test_gymnasium_makes_the_shipped_ones_by_their_names():
    for made in (gymnasium.make_vec("sejax/cartpole", num_envs=3),
                 gymnasium.make_vec("sejax.gym:sejax/cartpole", num_envs=3,
                                    vectorization_mode="vector_entry_point",
                                    autoreset_mode=AutoresetMode.SAME_STEP)):  # fmt: skip
        assert isinstance(made, SyntheticVectorEnv) and made.spec.id == "sejax/cartpole"
        obs, _ = made.reset(seed=4)
        assert obs.shape == (3, 4)  # products of other shapes round otherwise on some machines
        np.testing.assert_allclose(obs[0], make("cartpole").reset(seed=4)[0], rtol=0, atol=1e-6)
    synced = gymnasium.make_vec("sejax/cartpole", num_envs=2, vectorization_mode="sync")
    np.testing.assert_allclose(synced.reset(seed=4)[0], obs[:2], atol=1e-6)


def test_a_reward_networks_lanes_are_gymnasiums():
    envs = make_vec("cartpole-rn", 2, autoreset_mode="SameStep")
    single = make("cartpole-rn")
    np.testing.assert_array_equal(envs.reset(seed=3)[0][1], single.reset(seed=4)[0])
    assert envs.step([1, 1])[1][1] == single.step(1)[1]
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


def test_what_cannot_be_is_one_message():
    assert refused(make_vec, "cartpole", num_envs=0) == "num_envs"
    assert refused(make_vec, "cartpole", num_envs=2.5) == "num_envs"
    assert refused(make_vec, "cartpole", 2, autoreset_mode="samestep") == "autoreset_mode"
    envs = SyntheticVectorEnv(world_of(), 2)
    assert refused(envs.reset, seed=[1, 2, 3]) == "seed"
    for mask in (np.array([True]), np.array([1, 0])):
        assert refused(envs.reset, options={"reset_mask": mask}) == "options.reset_mask"


def test_bools_are_actions_and_no_masks():
    rewards = []
    for actions in (np.array([1, 0, 1]), np.array([True, False, True])):
        envs = SyntheticVectorEnv(world_of(), 3)
        envs.reset(seed=0)
        rewards.append(envs.step(actions)[1])
    np.testing.assert_array_equal(*rewards)
