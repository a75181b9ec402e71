"""What an experiment is: settings, rows that are computed, and a report that is made of them.

The command `python -m experiments.NAME` has the grammar of `python -m sejax.run`: words
`field=value`, read by Hydra. Nothing that takes long is imported before they are checked.
"""

import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from experiments.pieces import by_pattern, read_rows, write_rows
from experiments.settings import RUN_PREFIX, Settings, as_word
from sejax import registry, serialize
from sejax.cli import commands, runtime
from sejax.errors import ConfigError, nearest, require, shortened
from sejax.ops.files import write_text


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """A table or figure of the paper."""

    settings: type[Settings]  # what it can be told
    # settings -> rows: computes the pieces that are missing. It checks what a field alone cannot
    # tell, before anything that takes long.
    compute: Callable[[Any], pd.DataFrame]
    # (settings, rows) -> table: writes tables and pictures, of stored rows as well as new ones.
    report: Callable[[Any, pd.DataFrame], pd.DataFrame]
    about: str | None  # the module's docstring

    def run(self, settings: Settings) -> pd.DataFrame:
        """Computes what is missing, writes everything and returns the table.

        Raises:
          ConfigError: for settings or files that cannot work, or a folder of other settings.
        """
        fields = serialize.to_plain(settings).items()
        with registry.only_typed(f"{name}={value}" for name, value in fields):
            return self._run(settings)

    def _run(self, settings: Settings) -> pd.DataFrame:
        if not settings.from_rows:
            write_rows(settings.rows_file, self.compute(settings))
            if settings.pieces.made_with:
                made_with = by_pattern(settings.pieces.made_with)
                write_text(settings.made_with_file, json.dumps(made_with, indent=1) + "\n")
        return self.report(settings, read_rows(settings.rows_file))

    def main(self, words: Sequence[str] | None = None) -> None:
        """Runs the experiment as the command line says; bad input ends it with one message."""
        words = sys.argv[1:] if words is None else words
        if {"--help", "-h"} & {*words}:
            print(self.help())
            return
        try:
            with registry.only_typed(words):
                settings = self.settings.of(**parse(self.settings, words))
        except ConfigError as error:
            commands.fail(str(error), commands.BAD_INPUT)
        runtime.configure_xla(settings.devices)
        runtime.configure_jax()
        try:
            commands.guarded(self.run)(settings)
        except KeyboardInterrupt:
            print(
                f"Interrupted. What is finished is kept in {settings.work_folder}; the same "
                "command goes on from there."
            )
            commands.leave(commands.INTERRUPTED)

    def help(self) -> str:
        """What `--help` prints: all fields with their values."""
        full, quick = (self.settings.defaults({"quick": quick}) for quick in (False, True))
        rows = {}
        for field in dataclasses.fields(self.settings):
            usual, other = as_word(full[field.name]), as_word(quick[field.name])
            differs = f" (quick: {other})" if usual != other else ""
            rows[f"{field.name}={usual}"] = f"{field.metadata['about']}{differs}"
        width = min(34, max(map(len, rows)))
        if "run" in full:
            rows[f"{RUN_PREFIX}FIELD=VALUE"] = "override of the NES runs, as of sejax.run"
        lines = [f"  {shown:{width}}  {about}" for shown, about in rows.items()]
        usage = f"python -m experiments.{self.settings.name} [FIELD=VALUE ...]"
        return "\n".join([usage, "", (self.about or "").strip(), "", "Fields:", *lines])


def parse(settings: type[Settings], words: Sequence[str]) -> dict[str, Any]:
    """The fields that the words of a command line give, by Hydra's grammar; lists are `[a,b]`.

    Words `run.FIELD=VALUE` make the list `run`: they are read by the NES runs' own configuration.
    """
    from hydra import compose, initialize
    from hydra.core.config_store import ConfigStore
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from sejax.cli.compose import to_plain, translate_hydra_error

    fields = [field.name for field in dataclasses.fields(settings)]
    has_runs = "run" in fields
    runs = [word for word in words if has_runs and word.startswith(RUN_PREFIX)]
    own = [word for word in words if word not in runs]
    _require_words(settings, own, fields)
    # Null stands for "not given": what a default is may depend on what is given. The fields are in
    # a node of their own, as Hydra would take some for the groups of `sejax.run`.
    node: Any = {"settings": dict.fromkeys(fields)}
    ConfigStore.instance().store(name=settings.name, node=node)
    try:
        with initialize(config_path=None, version_base="1.3"):
            words = [f"settings.{word}" for word in own]
            given = to_plain(compose(settings.name, overrides=words))["settings"]
    except (HydraException, OmegaConfBaseException) as error:
        raise translate_hydra_error(error, own) from error
    if runs:
        given["run"] = [*(given["run"] or []), *(word.removeprefix(RUN_PREFIX) for word in runs)]
    return given


def _require_words(settings: type[Settings], words: Sequence[str], fields: list[str]) -> None:
    """Refuses what is not `field=value` with a message of our own, as Hydra's know no fields."""
    for word in words:
        name, equals, value = word.partition("=")
        if equals and name in fields:
            require(
                "," not in value or value[0] in "[\"'",
                name,
                "be one value or a list in brackets",
                "commas separate a list's values",
                value,
                f"{name}=[{value}]",
            )
            continue
        ranked = nearest(name.lstrip("-").replace("-", "_"), fields)
        raise ConfigError(
            f"{settings.name} must be given words field=value, because nothing else is read; got "
            f"{shortened(word)}. Did you mean {ranked[0]}=...? Fields: {', '.join(ranked)}."
        )
