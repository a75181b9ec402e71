"""A MuJoCo model's reset and step as pure functions of JAX."""

import functools
import hashlib
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, UInt32

from sejax.envs.mujoco import library


class Report(NamedTuple):
    """MuJoCo's numbers after a step, in single precision; lengths in m, angles in rad, times in s.

    Attributes:
      qpos: `[nq]` positions of the joints.
      qvel: `[nv]` their velocities.
      qpos_change: `[nq]` change of the positions in the step, subtracted in double precision; 0
        after a reset.
      xpos: `[nbody, 3]` positions of the bodies as MuJoCo computed them last. That is before the
        end of the step: after its start, or after the last stage of the Runge-Kutta method.
      xpos_change: `[nbody, 3]` change of `xpos` since the previous report.
      cfrc_ext: `[nbody, 6]` external torques and forces on each body, in N m and N; 0 after a
        reset. `[0, 6]` without `with_forces`.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    qpos_change: Float[Array, " nq"]
    xpos: Float[Array, "nbody 3"]
    xpos_change: Float[Array, "nbody 3"]
    cfrc_ext: Float[Array, "nbody 6"]


class Physics:
    """A model, stepped by MuJoCo on the CPU, in double precision.

    From a state MuJoCo goes on to the same bits. It has `mjSTATE_INTEGRATION`, and the bodies'
    positions for the next `Report.xpos_change`: doubles, as pairs of 32-bit words, `[num_words]`.
    A state in single precision would lead to another trajectory within a hundred steps.

    `reset` and `step` take one element. Under `vmap` a batch is one call, which steps its elements
    one after the other. Devices step at the same time.

    Args:
      path: the model's XML, which must not include other files.
      frame_skip: MuJoCo's steps in one step.
      with_forces: whether reports have `cfrc_ext`, which takes time.
    """

    def __init__(self, path: Path, frame_skip: int, with_forces: bool = False):
        self.model = mujoco.MjModel.from_xml_path(str(path))
        self.frame_skip = frame_skip
        # The id comes from the content: a cached program finds the model in another process too.
        digest = hashlib.sha256(path.read_bytes() + version("mujoco").encode()).digest()
        self._id = np.frombuffer(digest, np.int64)[0]
        handlers = library.load()
        handlers.SejaxMujocoRegister(self._id, self.model._address)
        self.num_words = 2 * handlers.SejaxMujocoLength(self.model._address)
        nq, nv, nbody = self.model.nq, self.model.nv, self.model.nbody
        # As step.cc reports them, one after the other.
        shapes = (nq,), (nv,), (nq,), (nbody, 3), (nbody, 3), (nbody if with_forces else 0, 6)
        zeros: list[Any] = [np.zeros(shape, np.float32) for shape in shapes]
        vector, self._report_of = ravel_pytree(Report(*zeros))
        self._num_reported = vector.size

    @property
    def dt(self) -> float:
        """Seconds of a step."""
        return self.model.opt.timestep * self.frame_skip

    def reset(
        self, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]
    ) -> tuple[UInt32[Array, " num_words"], Report]:
        """A new simulation with these positions and velocities."""
        arguments = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        return self._call("sejax_mujoco_reset", *arguments)

    def step(
        self, state: UInt32[Array, " num_words"], ctrl: Float[Array, " nu"]
    ) -> tuple[UInt32[Array, " num_words"], Report]:
        """`frame_skip` steps of MuJoCo with the same controls, which it clips to their range.

        As in MuJoCo, all controls count as 0 if one is not a number, and a simulation that explodes
        begins anew from the model's own pose.
        """
        arguments = state, jnp.asarray(ctrl, jnp.float32)
        return self._call("sejax_mujoco_step", *arguments, frame_skip=np.int64(self.frame_skip))

    def _call(self, target: str, *arguments: Array, **attributes: np.int64) -> tuple[Array, Report]:
        results = (
            jax.ShapeDtypeStruct((self.num_words,), jnp.uint32),
            jax.ShapeDtypeStruct((self._num_reported,), jnp.float32),
        )
        call = jax.ffi.ffi_call(target, results, vmap_method="broadcast_all")
        state, numbers = call(*arguments, model=self._id, **attributes)
        return state, self._report_of(numbers)


@functools.cache
def of_gymnasium(file: str, frame_skip: int, with_forces: bool = False) -> Physics:
    """The physics of one of the models that come with Gymnasium, such as `"hopper.xml"`."""
    assets = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
    return Physics(assets / file, frame_skip, with_forces)
