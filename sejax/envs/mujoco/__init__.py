"""Tasks on MuJoCo's own C library, with Gymnasium's semantics, as pure gymnax environments.

`step.cc` calls MuJoCo from within compiled programs, `library` builds it, `physics` is a model's
reset and step in JAX, `environment` a task on them; the other modules are the tasks. They need the
extra `mujoco`, a C++ compiler when they are first used, and the CPU.
"""

import importlib
from typing import Any

from sejax.envs.base import Task
from sejax.errors import ConfigError, require


def make_task(name: str, config: Any, solved_reward: float, otherwise: str = "") -> Task:
    """The task whose environment is the class `Env` of the module of that name.

    Args:
      name: of the task.
      config: its configuration.
      solved_reward: as of `Task`.
      otherwise: what else can be done where MuJoCo cannot be had, for messages.

    Raises:
      ConfigError: without the extra `mujoco`, a C++ compiler that works or a CPU as jax's default
        device.
    """
    try:
        import gymnasium  # noqa: F401, whose models are read
        import mujoco  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"env={name} needs MuJoCo and Gymnasium, because its physics and its model are theirs; "
            f"got {error}. Install them with pip install 'sejax[mujoco]'{otherwise}."
        ) from error
    import jax

    from sejax.envs.mujoco import library

    require(
        jax.default_backend() == "cpu",
        f"env={name}",
        "run on the CPU",
        "MuJoCo's C library does",
        jax.default_backend(),
        f"JAX_PLATFORMS=cpu{otherwise}",
    )
    try:
        library.load()
    except library.BuildError as error:
        raise ConfigError(
            f"env={name} needs the code between XLA and MuJoCo, which is compiled on first use; "
            f"{error}{otherwise}."
        ) from error
    env = importlib.import_module(f"{__name__}.{name}").Env(config)
    return Task(
        name=name,
        env=env,
        max_steps=config.facts.max_steps,
        solved_reward=solved_reward,
        info_keys=env.info_keys,
        augmented_keys=env.augmented_keys,
    )
