"""Imports of gymnax without what it draws pictures with.

Importing any module of gymnax imports all its environments, as its packages list them, and some of
those import seaborn, and with it pandas, scipy.stats and matplotlib: 1.4 of the 2.2 CPU seconds of
`import gymnax.environments.classic_control.cartpole`. After `install`, gymnax's two packages are
there before their `__init__.py` has run. Asked for a submodule (`gymnax.environments.spaces`), they
import it alone; asked for another name (`gymnax.make`), they run the `__init__.py`, and are from
then on what they are without sejax. `importlib.util.LazyLoader` is of no use here: with it, a
package runs as soon as one of its submodules is imported.
"""

import importlib
import importlib.util
import sys
import threading
import types
from typing import Any

_PACKAGES = ("gymnax", "gymnax.environments")
_lock = threading.RLock()
_running: set[str] = set()  # packages whose `__init__.py` is at work


def install() -> None:
    """Makes imports of gymnax light from here on, unless it is imported already.

    The packages of sejax whose modules import gymnax call this first.
    """
    if "gymnax" in sys.modules or importlib.util.find_spec("gymnax") is None:
        return
    for name in _PACKAGES:
        spec = importlib.util.find_spec(name)
        assert spec is not None
        package = importlib.util.module_from_spec(spec)
        package.__class__ = _UnreadPackage
        sys.modules[name] = package
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, package)


class _UnreadPackage(types.ModuleType):
    """A package that runs its `__init__.py` when asked for a name that is no submodule's."""

    def __getattr__(self, name: str) -> Any:
        submodule = f"{self.__name__}.{name}"
        if importlib.util.find_spec(submodule) is not None:
            return importlib.import_module(submodule)
        with _lock:
            if type(self) is _UnreadPackage and self.__name__ not in _running:
                self._run()
        return object.__getattribute__(self, name)

    def _run(self) -> None:
        assert self.__spec__ is not None and self.__spec__.loader is not None
        _running.add(self.__name__)
        try:
            self.__spec__.loader.exec_module(self)
            self.__class__ = types.ModuleType  # type: ignore[assignment]
        finally:
            _running.remove(self.__name__)
