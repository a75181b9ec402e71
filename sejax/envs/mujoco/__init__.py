"""Tasks on MuJoCo's own C library, with Gymnasium's semantics, as pure environments.

`tasks` is the table of tasks and `models` their environments, which `environment` has the common
part of. `physics` is a model's reset and step in JAX; `step.cc` calls MuJoCo from within compiled
programs, and `library` builds it. They need the extra `mujoco`, a C++ compiler when they are first
used, and the CPU. `brax` has other physics for halfcheetah.
"""

from typing import TYPE_CHECKING

from sejax.options import ConfigError

if TYPE_CHECKING:
    from sejax.envs.mujoco.environment import MujocoEnv
    from sejax.envs.mujoco.tasks import MujocoTask


def make_env(config: "MujocoTask", otherwise: str = "") -> "MujocoEnv[MujocoTask]":
    """The environment of a task.

    Args:
      config: of the task.
      otherwise: what else can be done where MuJoCo cannot be used, for messages.

    Raises:
      ConfigError: without the extra `mujoco`, a C++ compiler that works or a CPU as jax's default
        device.
    """
    field = f"env={config.name}"
    try:
        import gymnasium  # noqa: F401, whose models are read
        import mujoco  # noqa: F401
    except ImportError as error:
        fix = f"Install them with pip install 'sejax[mujoco]'{otherwise}."
        raise ConfigError(f"{field} needs MuJoCo and Gymnasium; {error}. {fix}", "env") from error
    import jax

    from sejax.envs.mujoco import library, models

    if (backend := jax.default_backend()) != "cpu":
        fix = f"Set JAX_PLATFORMS=cpu{otherwise}."
        raise ConfigError(f"{field} must run on the CPU; got {backend}. {fix}", "env")
    try:
        library.load()
    except library.BuildError as error:
        message = f"{field} needs a library of its own; {error}{otherwise}."
        raise ConfigError(message, "env") from error
    env: MujocoEnv[MujocoTask] = getattr(models, config.model)(config)
    return env
