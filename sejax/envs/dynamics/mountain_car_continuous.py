"""MountainCarContinuous-v0 with Gymnasium's dynamics."""

from typing import Any

import jax.numpy as jnp
from gymnax.environments.classic_control.continuous_mountain_car import (
    ContinuousMountainCar,
    EnvParams,
    EnvState,
)
from jaxtyping import Array, Float


class MountainCarContinuousEnv(ContinuousMountainCar):
    r"""An underpowered car in a valley, with an engine that is costly to use.

    .. math::
        v' &= clip(v + 0.0015\, clip(a, -1, 1) - 0.0025 \cos 3x,\ \pm 0.07) \\
        x' &= clip(x + v',\ -1.2,\ 0.6) \\
        r &= 100 [x' \ge 0.45 \wedge v' \ge 0] - 0.1 a^2

    The left wall stops the car: v' = 0 where x' = -1.2 and v' < 0. The goal terminates. The cost
    is of the action as given, before it is clipped, as in Gymnasium.

    gymnax's own version, from which the numbers, the reset and the spaces come, has no stop at
    that wall and stops a car that rolls back over the goal: another task.

    Source: Gymnasium 1.3, `Continuous_MountainCarEnv`.
    """

    def step_env(
        self, key: Array | None, state: EnvState, action: Any, params: EnvParams
    ) -> tuple[Float[Array, "2"], EnvState, Array, Array, dict[Any, Any]]:
        """One step.

        Args:
          key: has no effect.
          state: position and velocity per step, each `[]`.
          action: engine force, `[1]` or `[]`.
          params: gymnax's.

        Returns:
          `(obs, state, reward, terminated, info)` with `obs` = (position, velocity), `[2]`.
        """
        action = jnp.reshape(action, ())
        force = jnp.clip(action, params.min_action, params.max_action)
        acceleration = params.power * force - params.gravity * jnp.cos(3 * state.position)
        velocity = jnp.clip(state.velocity + acceleration, -params.max_speed, params.max_speed)
        position = state.position + velocity
        position = jnp.clip(position, params.min_position, params.max_position)
        at_wall = (position <= params.min_position) & (velocity < 0)
        velocity = jnp.where(at_wall, 0.0, velocity)
        state = EnvState(position=position, velocity=velocity, time=state.time + 1)
        terminated = self.is_terminated(state, params)
        reward = jnp.where(terminated, 100.0, 0.0) - 0.1 * action**2
        obs, state = self._apply_transition_gradient_policy(self.get_obs(state), state)
        return obs, state, reward, terminated, {"discount": self.discount(state, params)}
