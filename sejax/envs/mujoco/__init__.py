"""Tasks on MuJoCo's own C library, with Gymnasium's semantics, as pure environments.

`tasks` is the table of tasks and `models` their environments, which `environment` has the common
part of. `physics` is a model's reset and step in JAX; `step.cc` calls MuJoCo from within compiled
programs, and `library` builds it. They need the extra `mujoco`, a C++ compiler when they are first
used, and the CPU. `brax` has other physics for halfcheetah.
"""

from typing import TYPE_CHECKING

from sejax.options import ConfigError, require, shortened

if TYPE_CHECKING:
    from sejax.envs.mujoco.environment import MujocoEnv
    from sejax.envs.mujoco.tasks import MujocoTask


def make_env(config: "MujocoTask", otherwise: str = "") -> "MujocoEnv":
    """The environment of a task.

    Args:
      config: of the task.
      otherwise: what else can be done where MuJoCo cannot be used, for messages.

    Raises:
      ConfigError: without the extra `mujoco`, a C++ compiler that works or a CPU as jax's default
        device.
    """
    try:
        import gymnasium  # noqa: F401, whose models are read
        import mujoco  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"env={config.name} needs MuJoCo and Gymnasium, because its physics and its model are "
            f"theirs; got {error}. Install them with pip install 'sejax[mujoco]'{otherwise}."
        ) from error
    import jax

    from sejax.envs.mujoco import library, models

    require(
        jax.default_backend() == "cpu",
        f"env={config.name}",
        "must run on the CPU, because MuJoCo's C library does; got "
        f"{shortened(jax.default_backend())}. Set JAX_PLATFORMS=cpu{otherwise}.",
    )
    try:
        library.load()
    except library.BuildError as error:
        raise ConfigError(
            f"env={config.name} needs the code between XLA and MuJoCo, which is compiled on first "
            f"use; {error}{otherwise}."
        ) from error
    env: MujocoEnv = getattr(models, config.model)(config)
    return env
