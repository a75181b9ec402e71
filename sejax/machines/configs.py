"""What `machines=` chooses."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from sejax.options import Options, counts, fraction, option, positive


@dataclass(frozen=True, kw_only=True)
class LocalConfig(Options):
    """This process: one compiled program over its devices."""

    group: ClassVar[str] = "machines"
    is_elsewhere: ClassVar[bool] = False

    def make(
        self, config: Any, folder: Path, say: Callable[[str], None]
    ) -> contextlib.AbstractContextManager[Any]:
        """The generations of a run, as `sejax.cli.session.Chunks`."""
        from sejax.cli import session

        return contextlib.nullcontext(session.make_chunks(config))


@dataclass(frozen=True, kw_only=True)
class RayConfig(Options):
    """Worker processes on a Ray cluster: that of `RAY_ADDRESS`, or one on this machine."""

    group: ClassVar[str] = "machines"
    is_elsewhere: ClassVar[bool] = True
    package: ClassVar[str] = "ray"

    # worker processes; null: one for each CPU core of the cluster, or for each GPU
    workers: int | None = option(None, counts("somebody must compute"))
    # 0: workers compute on a CPU core each; 0.5: two workers share a GPU
    gpus_per_worker: float = option(0.0, fraction())
    # seconds after which a worker is given up while nobody has shown how long a training takes
    patience_s: float = option(3600.0, positive("a worker needs time to compile and to train"))

    def make(
        self, config: Any, folder: Path, say: Callable[[str], None]
    ) -> contextlib.AbstractContextManager[Any]:
        """The generations of a run, as `sejax.cli.session.Chunks`."""
        from sejax.machines import ray_crew

        return ray_crew.chunks_of(self, config, folder, say)
