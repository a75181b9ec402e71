"""Modes of jax in which programs of sejax fail; commands and trainers refuse them."""

import jax

from sejax.options import as_text, require

# For each mode: the allowed values, and why there are no others.
MODES: dict[str, tuple[tuple[object, ...], str]] = {
    "jax_enable_x64": ((False,), "sejax computes in 32 bits"),
    "jax_debug_nans": ((False,), "episodes that did not take place are nan"),
    "jax_debug_infs": ((False,), "the score before the first is minus infinity"),
    "jax_disable_jit": ((False,), "trainings are compiled as a whole"),
    "jax_debug_key_reuse": ((False,), "the state of a run that has ended keeps its key"),
    "jax_numpy_rank_promotion": (("allow", "warn"), "operands are broadcast"),
    "jax_numpy_dtype_promotion": (("standard",), "numbers of several types are combined"),
    "jax_transfer_guard": (("allow", None, "log"), "numbers of Python are moved to devices"),
}


def require_modes() -> None:
    """Checks that jax is in no mode in which programs of sejax fail.

    Raises:
      ConfigError: for the mode, such as `jax_enable_x64`.
    """
    for mode, (allowed, reason) in MODES.items():
        got = getattr(jax.config, mode)
        off = f"Set {mode.upper()}={as_text(allowed[0])}."
        require(got in allowed, mode, f"must be {as_text(allowed[0])}: {reason}; got {got}. {off}")
