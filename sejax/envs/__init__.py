"""The real tasks: gymnax environments with the paper's step limits and solved thresholds."""

from sejax.envs.kinds import check_choices, kind
from sejax.envs.registry import Task, make, names

__all__ = ["Task", "check_choices", "kind", "make", "names"]
