"""The contract of every registered agent, and what those with a replay buffer have in common."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import arrays_of, assert_close, assert_equal, refused

import sejax
from sejax import agents, envs, make_agent, make_trainer
from sejax.agents import AgentConfig, Transition, traced
from sejax.options import registry
from sejax.options.plain import configure

NUM_STEPS, BATCH = 16, 7  # a batch has one column of padding
SMALL = {
    "hidden_size": 4, "num_layers": 1, "batch_size": BATCH, "warmup_episodes": 3,
    "feature_dim": 4, "stream_hidden_size": 4,
    "rollout_steps": NUM_STEPS, "epochs": 2, "num_minibatches": 2,
    "learning_rate": 0.01, "discount": 0.9, "init_alpha": 0.5,
}  # fmt: skip
TASKS = ("cartpole", "pendulum", "gridworld_2x2")  # discrete, continuous, and an index to observe


def config_of(name):
    """A small configuration of a registered agent."""
    fields = {field.name for field in dataclasses.fields(registry.find("agent", name))}
    return configure("agent", {"name": name} | {k: SMALL[k] for k in SMALL if k in fields})


def fits(name, task):
    spec = envs.spec_of(configure("env", {"name": task}))
    config = registry.find("agent", name)
    return config.states in (None, spec.states) and spec.actions in config.actions


PLAIN = [(name, task, "none") for name in agents.names() for task in TASKS if fits(name, task)]
EXPLORING = [
    ("ddqn", "cartpole", "icm"),
    ("td3", "pendulum", "icm"),
    ("ppo", "cartpole", "icm"),
    ("sarsa", "gridworld_2x2", "count_based"),
]
every_agent = pytest.mark.parametrize("case", [*PLAIN, *EXPLORING], ids="-".join)
# DQN is DDQN with another target.
OFF_POLICY = [case for case in PLAIN if case[0] not in ("dqn", "ppo", "q_learning", "sarsa")]
# The others compile for long.
QUICK = ("ddqn", "td3", "ppo", "q_learning", "sarsa")


def cases(of_agents):
    marks = {x: [pytest.mark.slow] * (x[0] not in QUICK or x[2] == "icm") for x in of_agents}
    return [pytest.param(x, marks=marks[x]) for x in of_agents]


every_off_policy_agent = pytest.mark.parametrize("case", cases(OFF_POLICY), ids="-".join)


@functools.cache
def parts(case):
    """An agent, and `start(key, hparams) -> (state, batch)` after some steps of random outcome."""
    name, task_name, exploration = case
    task = envs.make(task_name)
    small = {"hidden_size": 4, "num_layers": 1, "num_residual_blocks": 1, "feature_dim": 3}
    fields = {"name": exploration} | (small if exploration == "icm" else {})
    exploration = configure("exploration", fields)
    agent = agents.make_agent(config_of(name), task, exploration)

    def start(key, hparams):
        state = agent.begin_episode(agent.init(key, hparams), jnp.int32(3))

        def transition(key):
            key_obs, key_next, key_act, key_reward = jax.random.split(key, 4)
            obs, next_obs = (
                jax.random.randint(k, (), 0, task.num_states)
                if task.num_states
                else jax.random.normal(k, (task.obs_dim,))
                for k in (key_obs, key_next)
            )
            action = agent.act(key_act, state, obs, explore=True)
            reward = jax.random.normal(key_reward)
            return Transition(obs, action, reward, jnp.float32(0.7), next_obs)

        buffer = agent.buffer(jax.eval_shape(transition, key), NUM_STEPS)

        def store(arrays, number):
            step = transition(jax.random.fold_in(key, number))
            return buffer.store(arrays, number, step, number % 5 == 4, True), None

        arrays, _ = jax.lax.scan(store, buffer.init(), jnp.arange(NUM_STEPS))
        last = transition(jax.random.fold_in(key, NUM_STEPS - 1))
        return state, buffer.batch(key, arrays, jnp.int32(NUM_STEPS), last, agent.batch_size(state))

    return task, agent, jax.jit(start)


@functools.cache
def started(case):
    _, agent, start = parts(case)
    return start(jax.random.key(1), agent.hparams)


@functools.cache
def update_of(case):
    return jax.jit(parts(case)[1].update)


def moved(a, b):
    """Whether a number of two states differs by more than rounding."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return any(not np.allclose(x, y, rtol=1e-4, atol=1e-6) for x, y in pairs)


# --- every agent ---------------------------------------------------------------------------------


@every_agent
def test_a_state_keeps_its_types_and_an_action_fits_its_space(case):
    task, agent, start = parts(case)
    key = jax.random.key(0)
    state, batch = jax.eval_shape(start, key, agent.hparams)

    def types(fn, *args):
        return jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), jax.eval_shape(fn, *args))

    kept = types(agent.init, key, agent.hparams)
    assert types(agent.begin_episode, state, jnp.int32(1)) == kept
    assert types(agent.update, key, state, batch) == kept
    obs = jnp.int32(0) if task.num_states else jnp.zeros(task.obs_dim)
    for explore in (True, False):
        act = functools.partial(agent.act, explore=explore)
        action = jax.eval_shape(agent.env_action, jax.eval_shape(act, key, state, obs))
        shape = () if task.num_actions else (task.action_dim,)
        assert action.shape == shape
        assert action.dtype == (jnp.int32 if task.num_actions else jnp.float32)


@every_agent
def test_the_default_hyperparameters_are_the_traced_options_of_the_configuration(case):
    _, agent, _ = parts(case)
    config = config_of(case[0])
    hparams = agent.hparams if case[2] == "none" else agent.hparams.agent
    options = vars(traced(config))
    assert options.items() <= vars(hparams).items()
    assert {"learning_rate", "discount"} <= set(options)
    assert agent.discount(agent.hparams) == 0.9
    assert (agent.spec.stops_from, agent.spec.learns_from) == (3, 0 if case[0] == "ppo" else 3)


@pytest.mark.parametrize("case", cases([*PLAIN, *EXPLORING]), ids="-".join)
def test_agents_of_other_hyperparameters_learn_in_one_program_as_each_would_alone(case):
    _, agent, start = parts(case)
    hparams = agent.hparams if case[2] == "none" else agent.hparams.agent
    varied = [hparams.replace(learning_rate=rate) for rate in (0.01, 0.3)]
    if case[2] != "none":
        varied = [agent.hparams.replace(agent=each) for each in varied]
    key = jax.random.key(2)
    started_with = [start(key, jax.tree.map(np.float32, each)) for each in varied]
    states, batches = zip(*started_with, strict=True)
    stacked = jax.tree.map(lambda *x: np.stack(x), *states)
    together = jax.jit(jax.vmap(agent.update, (None, 0, None)))(key, stacked, batches[0])
    alone = [update_of(case)(key, state, batches[0]) for state in states]
    for i, each in enumerate(alone):
        assert_close([x[i] for x in arrays_of(together)], each, rtol=1e-3, atol=1e-4)
    assert moved(*alone)


@pytest.mark.parametrize("case", EXPLORING[::3], ids="-".join)
def test_an_exploring_agent_begins_episodes_and_acts_as_the_one_inside(case):
    task, agent, _ = parts(case)
    plain = parts((*case[:2], "none"))[1]
    assert agent.buffer is plain.buffer and agent.env_action is plain.env_action
    state, obs = started(case)[0], jnp.int32(0) if task.num_states else jnp.ones(task.obs_dim)

    @functools.partial(jax.jit, static_argnums=0)
    def begun_and_actions(agent, state):
        begun, keys = agent.begin_episode(state, jnp.int32(5)), jax.random.split(jax.random.key(0))
        acts = [jax.vmap(lambda key, e=e: agent.act(key, begun, obs, e)) for e in (True, False)]
        return begun, [act(keys) for act in acts]

    begun, actions = begun_and_actions(agent, state)
    assert_equal((begun.agent_state, actions), begun_and_actions(plain, state.agent_state))


# --- agents with a replay buffer -----------------------------------------------------------------


@pytest.mark.parametrize("case", cases([*OFF_POLICY, *EXPLORING[:2]]), ids="-".join)
def test_columns_of_no_weight_change_nothing(case):
    state, batch = jax.device_get(started(case))
    update, key = update_of(case), jax.random.key(0)
    assert batch.weight.sum() == BATCH
    is_padding = 1 - batch.weight
    other = batch._replace(
        reward=batch.reward + 3 * is_padding,
        obs=batch.obs + 3 * is_padding,
        next_obs=batch.next_obs - is_padding,
    )
    assert_close(update(key, state, batch), update(key, state, other), rtol=1e-5, atol=1e-7)
    all_count = batch._replace(weight=np.ones_like(batch.weight))
    assert moved(update(key, state, batch), update(key, state, all_count))


@every_off_policy_agent
def test_units_and_columns_out_of_use_take_no_part(case):
    _, agent, start = parts(case)
    hparams = agent.hparams.replace(hidden_size=np.float32(2), batch_size=np.float32(5))
    state, batch = jax.device_get(start(jax.random.key(1), hparams))
    assert agent.batch_size(state) == 5 and batch.weight.sum() == 5
    # Parameters that init narrowed to 0, in whichever of the state's vectors.
    leaves = [x for x in jax.tree.leaves(state) if x.ndim]
    after = jax.jit(agent.update)(jax.random.key(3), state, batch)
    for before, then in zip(leaves, [x for x in jax.tree.leaves(after) if x.ndim], strict=True):
        kept = (before == 0) & np.any(before != 0)  # not Adam's moments, which begin at 0
        np.testing.assert_array_equal(np.asarray(then)[kept], 0.0)
    assert sum(int((x == 0).sum()) for x in leaves) > 10 and moved(after, state)


# --- what is refused -----------------------------------------------------------------------------

CARTPOLE, ACROBOT, ROOM, CLIFF = (
    envs.make(name) for name in ("cartpole", "acrobot", "gridworld_2x2", "cliff_walking")
)
COUNTS = sejax.CountBasedConfig()


@dataclasses.dataclass(frozen=True)
class Unrelated:
    def make(self, task):
        return parts(PLAIN[0])[1]


@dataclasses.dataclass(frozen=True)
class Fixed(AgentConfig):
    """Of an agent that fits every task and knows nothing of sejax's options."""

    learning_rate: float = 0.5

    def make(self, task):
        return parts(PLAIN[0])[1]


@pytest.mark.parametrize(("make", "field"), [
    (lambda: sejax.DDQNConfig(learning_rate=1e300), "agent.learning_rate"),
    (lambda: sejax.DDQNConfig(learning_rate=5e-324), "agent.learning_rate"),
    (lambda: sejax.DDQNConfig(batch_size=65, buffer_size=64), "agent.buffer_size"),
    (lambda: make_agent(sejax.SACConfig(target_entropy=-5.0), CARTPOLE), "agent.target_entropy"),
    (lambda: make_agent(Unrelated(), CARTPOLE), "agent"),
    (lambda: make_agent("ppo", CARTPOLE), "agent"),
    (lambda: make_agent(sejax.DDQNConfig, CARTPOLE), "agent"),
    (lambda: make_agent(sejax.QLearningConfig(), CARTPOLE), "agent"),
    (lambda: make_agent(sejax.DDQNConfig(), CARTPOLE, Unrelated()), "exploration"),
    (lambda: make_agent(sejax.DDQNConfig(), CARTPOLE, COUNTS), "exploration"),
    (lambda: make_agent(Fixed(), ROOM, varied=True), "agent_hparams"),
    (lambda: make_trainer(make_agent(sejax.QLearningConfig(), ROOM), CLIFF.env), "agent"),
    (lambda: make_trainer(make_agent(sejax.DDQNConfig(), ACROBOT), CARTPOLE.env), "agent"),
])  # fmt: skip
def test_an_agent_that_cannot_work_is_refused(make, field):
    assert refused(make) == field
