"""Modes of jax in which programs of sejax fail; commands and trainers refuse them."""

import jax

from sejax.options import require

# The modes, and why they must be off.
MODES = {
    "jax_enable_x64": "sejax computes in 32 bits",
    "jax_debug_nans": "episodes that did not take place are nan",
    "jax_debug_infs": "the score before the first is minus infinity",
    "jax_disable_jit": "trainings are compiled as a whole",
}


def require_modes() -> None:
    """Checks that jax is in no mode in which programs of sejax fail.

    Raises:
      ConfigError: for the mode, such as `jax_enable_x64`.
    """
    for mode, why in MODES.items():
        fix = f"Set {mode.upper()}=false."
        require(not getattr(jax.config, mode), mode, f"must be false: {why}. {fix}")
