"""Synthetic environments and reward networks for reinforcement learning, in JAX.

Learn a small network that stands in for a task (`make_learner`), load one that was learned
(`load`), and train agents on it (`make_trainer`; `make_evaluator` tests them on the real task too).
Names are imported on first use: importing `sejax` costs nothing, sets no environment variable and
touches no flag.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_EXPORTS = {
    "ConfigError": "sejax.errors",
    "config": "sejax.configs",
    "load": "sejax.proxies.io",
    "load_proxy": "sejax.proxies.io",
    "load_set": "sejax.proxies.sets",
    "save": "sejax.proxies.io",
    "make_agent": "sejax.agents.registry",
    "make_evaluator": "sejax.evaluation",
    "make_learner": "sejax.bilevel",
    "make_trainer": "sejax.trainer",
    "register_gymnax": "sejax.proxies.io",
}
__all__ = ["ConfigError", "config", "load", "load_proxy", "load_set", "make_agent",
           "make_evaluator", "make_learner", "make_trainer", "register_gymnax", "save"]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(_EXPORTS[name]), name)
    raise AttributeError(f"module 'sejax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
