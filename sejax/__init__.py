"""Synthetic environments and reward networks for reinforcement learning, in JAX.

Learn a small network that stands in for a task (`make_learner`), load one that was learned
(`load`), and train agents on it (`make_trainer`; `make_evaluator` tests them on the real task too).
All functions take objects. Your own tasks (`Task`, `sejax.envs.make`), agents (`make_agent`),
proxies, objectives and strategies work like those of sejax.

Names are imported on first use, as `__init__.pyi` lists them: importing `sejax` costs nothing, sets
no environment variable and touches no flag.
"""

import lazy_loader

__version__ = "1.1.0.dev0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
