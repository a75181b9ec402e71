"""HalfCheetah on brax."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
from brax.base import State as BraxState
from brax.envs.base import State
from brax.envs.half_cheetah import Halfcheetah
from flax import struct
from jaxtyping import Array, Float

from sejax.envs.environment import Environment, EnvParams, EnvState, Step

if TYPE_CHECKING:
    from sejax.envs.mujoco.tasks import HalfCheetah

# Iterations of mjx's line search; MuJoCo has 50. Under vmap all wait for the longest search. Gaits
# earn as much with 10 iterations as with 50, but less with 8.
LS_ITERATIONS = 10


@struct.dataclass
class CheetahState(EnvState):
    physics: BraxState


class BraxHalfCheetahEnv(Environment[CheetahState, EnvParams]):
    r"""A planar cheetah with six joints that is paid for running forward.

    .. math:: r = v_x - 0.1 \lVert a \rVert^2

    Observations are the positions without the torso's x and all velocities, `[17]`; actions are
    torques, `[6]` in [-1, 1]. An episode never terminates. `info` has the torso's `x_position` (m),
    its `x_velocity` over the step (m/s), and the reward's parts `reward_run` and `reward_ctrl`.

    Each reset draws its own initial state from the key. brax's wrappers, which go back to one
    cached state, are not used.

    Source: brax 0.14, `brax.envs.half_cheetah`; Gymnasium's HalfCheetah.
    """

    def __init__(self, config: "HalfCheetah"):
        super().__init__(config.spec)
        self._info_keys = config.spec.info_keys
        self._brax = Halfcheetah(backend=config.backend)
        if config.backend == "mjx":
            self._brax.sys = self._brax.sys.tree_replace({"opt.ls_iterations": LS_ITERATIONS})

    def reset_env(self, key: Array, params: EnvParams) -> tuple[Float[Array, "17"], CheetahState]:
        state = self._brax.reset(key)
        return state.obs, CheetahState(physics=state.pipeline_state, time=jnp.int32(0))

    def step_env(
        self, key: Array, state: CheetahState, action: Array, params: EnvParams
    ) -> Step[CheetahState]:
        """One control step of 0.05 s; the key has no effect."""
        nothing = jnp.float32(0)
        metrics = dict.fromkeys(self._info_keys, nothing)
        after = self._brax.step(State(state.physics, None, nothing, nothing, metrics), action)
        info = {**after.metrics, "discount": jnp.float32(1)}
        state = CheetahState(physics=after.pipeline_state, time=state.time + 1)
        return after.obs, state, after.reward, jnp.bool_(False), info
