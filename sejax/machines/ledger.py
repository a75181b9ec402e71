"""`machines.csv` of a run directory: who computed what."""

import dataclasses
from collections.abc import Hashable, Mapping
from pathlib import Path

from sejax.machines.handout import Done
from sejax.machines.scorer import About

COLUMNS = ("generation", "wall_s", "node", "pid", *(x.name for x in dataclasses.fields(Done)))


class Ledger:
    """Appends a row for each generation and worker that had a share of it.

    It is a log and no result: what a killed driver did not save is there, and again when it was
    computed again.
    """

    def __init__(self, folder: Path):
        self._path = folder / "machines.csv"

    def write(
        self,
        generation: int,
        wall_s: float,
        about: Mapping[Hashable, About],
        done: Mapping[Hashable, Done],
    ) -> None:
        """Adds a generation.

        Args:
          generation: from 0 on.
          wall_s: seconds that its trainings took, from the first share's leaving on.
          about: who the workers are.
          done: what they did.

        Raises:
          OSError: if the file cannot be written.
        """
        rows = [
            (
                generation,
                f"{wall_s:.3f}",
                about[worker].node,
                about[worker].pid,
                *(f"{x:.3f}" if isinstance(x, float) else x for x in dataclasses.astuple(each)),
            )
            for worker, each in done.items()
        ]
        with self._path.open("a", encoding="utf-8") as file:
            if file.tell() == 0:
                file.write(",".join(COLUMNS) + "\n")
            file.writelines(",".join(map(str, row)) + "\n" for row in rows)
