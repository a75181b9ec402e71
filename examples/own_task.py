"""A task of one's own: a synthetic environment is learned for it, from a script or a command line.

    python own_task.py
    python -m sejax.run env=own_task:make_reacher env.size=3    # in this folder

The script takes 50 seconds on four cores:

    returns of agents that trained on the proxy: -12.7 -7.3 -5.3 -2.2 -2.3 -2.1 -0.9 -1.4
    best -0.75 in generation 31; solved at -1

A task is any gymnax environment; networks and agents take their sizes from its spaces.
"""

import argparse

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces
from jax import Array

import sejax


@struct.dataclass
class ReacherState(environment.EnvState):
    hand: Array  # [2], metres
    target: Array  # [2], metres
    time: Array | int


@struct.dataclass
class ReacherParams(environment.EnvParams):
    size: float = 3.0  # of the room, metres
    max_steps_in_episode: int = 20


class Reacher(environment.Environment[ReacherState, ReacherParams]):
    """A hand reaches for a target in a square room.

    Action: `Box(-1, 1, (2,))`, how far the hand moves along each axis; 1 is a sixth of the room.
    Observation: `Box(-size, size, (2,))`, from the hand to the target in metres.
    Reward: minus the distance between hand and target after the step, in rooms.
    Start: hand and target anywhere. End: the hand is within a tenth of a room of the target, or
    after 20 steps. Walls stop the hand.
    """

    def reset_env(self, key: Array, params: ReacherParams) -> tuple[Array, ReacherState]:
        hand, target = jax.random.uniform(key, (2, 2), maxval=params.size)
        return target - hand, ReacherState(hand=hand, target=target, time=jnp.int32(0))

    def step_env(
        self, key: Array, state: ReacherState, action: Array, params: ReacherParams
    ) -> tuple[Array, ReacherState, Array, Array, dict]:
        hand = jnp.clip(state.hand + action * params.size / 6, 0.0, params.size)
        state = state.replace(hand=hand, time=state.time + 1)
        obs = state.target - hand
        distance = jnp.linalg.norm(obs) / params.size
        return obs, state, -distance, distance < 0.1, {}

    @property
    def default_params(self) -> ReacherParams:
        return ReacherParams()

    def action_space(self, params: ReacherParams) -> spaces.Box:
        return spaces.Box(-1.0, 1.0, (2,), jnp.float32)

    def observation_space(self, params: ReacherParams) -> spaces.Box:
        return spaces.Box(-params.size, params.size, (2,), jnp.float32)


def make_reacher(size: int = 3) -> sejax.Task:
    """The reacher in a room.

    Args:
      size: metres of the room
    """
    params = ReacherParams(size=float(size))
    return sejax.Task(name=f"reacher{size}", env=Reacher(), params=params, solved_reward=-1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description="Learns a synthetic reacher.")
    parser.add_argument("--generations", type=int, default=40)
    parser.add_argument("--population", type=int, default=16)
    parser.add_argument("--steps", type=int, default=600, help="of each training")
    args = parser.parse_args()
    sejax.configure_xla()  # a device for each core
    task = make_reacher(size=3)
    agent = sejax.make_agent(sejax.TD3Config(
        tau=0.005,
    ), task)  # fmt: skip
    learn = sejax.make_learner(
        task=task, agent=agent,
        proxy=sejax.SyntheticConfig(hidden_size=32, initial_state="real", horizon=None),
        es=sejax.NESConfig(population_size=args.population, noise_std=0.1, noise_std_decay=1.0,
                           num_incumbent_evals=args.population),
        training=sejax.TrainingConfig(max_steps=args.steps, stop_rule="never"),
        generations=args.generations,
    )  # fmt: skip
    result = jax.jit(learn)(jax.random.key(0))
    every_fifth = result.info.incumbent_mean[::5]
    print("returns of agents that trained on the proxy:", *(f"{x:.1f}" for x in every_fifth))
    print(f"best {result.score:.2f} in generation {result.generation}; solved at -1")


if __name__ == "__main__":
    main()
