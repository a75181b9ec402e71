"""A world and an agent that follow a script, so that a training can be worked out by hand.

The agent says which episode it is in and at what time it believes to be; the world pays each
episode's scripted return at its end. Nothing depends on random numbers but a tag that marks an
episode's observations.
"""

import jax
import jax.numpy as jnp
from flax import struct

from sejax.agents.base import Agent, AgentSpec
from sejax.agents.buffers import Transition, replay_buffer
from sejax.envs.environment import Environment, EnvParams, EnvState
from sejax.envs.spec import Box, Discrete, TaskSpec

MAX_EPISODES = 12
MAX_STEPS = 4  # the world's step limit
WHO = 100  # an action is WHO * episode + time


@struct.dataclass
class ScriptState(EnvState):
    tag: jax.Array  # drawn at reset


@struct.dataclass
class ScriptParams(EnvParams):
    returns: jax.Array = None  # [MAX_EPISODES]
    lengths: jax.Array = None  # [MAX_EPISODES]: step at which each episode terminates
    nonfinite_episode: int = -1  # its second step is not a number
    max_steps_in_episode: int = MAX_STEPS


class ScriptedEnv(Environment[ScriptState, ScriptParams]):
    def __init__(self):
        actions = Discrete(WHO * (MAX_EPISODES + 1))
        spec = TaskSpec(
            observation=Box((0.0,) * 2, (1.0,) * 2), action=actions, max_steps=MAX_STEPS
        )
        super().__init__(spec, script([0.0] * MAX_EPISODES, [1] * MAX_EPISODES))

    def start(self, key):
        return ScriptState(time=jnp.int32(0), tag=jax.random.uniform(key))

    def step_env(self, key, state, action, params):
        episode, time = action // WHO, state.time + 1
        terminated = time >= params.lengths[episode]
        last = terminated | (time >= params.max_steps_in_episode)
        nonfinite = (episode == params.nonfinite_episode) & (time == 2)
        reward = jnp.where(last, params.returns[episode], 0.0)
        info = {"discount": 1.0 - terminated, "nonfinite": nonfinite}
        state = state.replace(time=time)
        return self.observe(state), state, reward, terminated, info

    def observe(self, state):
        return jnp.stack([state.time.astype(jnp.float32), state.tag])


@struct.dataclass
class ScriptedAgentState:
    episode: jax.Array
    num_updates: jax.Array
    batch: Transition  # of the last update
    min_discount: jax.Array  # over all batches
    weight: jax.Array  # what hparams says; a float, so that it may diverge


def script(returns, lengths, **fields):
    returns, lengths = jnp.array(returns, jnp.float32), jnp.array(lengths, jnp.int32)
    return ScriptParams(returns=returns, lengths=lengths, **fields)


def scripted_agent(warmup_episodes=2, batch_size=64):
    obs, numbers = jnp.zeros((2, batch_size)), jnp.zeros(batch_size)
    empty = Transition(obs, jnp.int32(numbers), numbers, numbers, obs)

    def init(key, hparams):
        return ScriptedAgentState(
            episode=jnp.int32(-1), num_updates=jnp.int32(0), batch=empty,
            min_discount=jnp.float32(jnp.inf), weight=jnp.float32(hparams),
        )  # fmt: skip

    def update(key, state, batch):
        discount = jnp.minimum(state.min_discount, batch.discount.min())
        return state.replace(num_updates=state.num_updates + 1, batch=batch, min_discount=discount)

    return Agent(
        init=init,
        begin_episode=lambda state, episode: state.replace(episode=episode),
        act=lambda key, state, obs, explore: WHO * state.episode + obs[0].astype(jnp.int32),
        update=update,
        hparams=0.0,
        buffer=replay_buffer(batch_size, 1000),
        spec=AgentSpec(
            stops_from=warmup_episodes, learns_from=warmup_episodes, cpu_num_parallel=None
        ),
        discount=lambda hparams: 1.0,
    )
