"""`python -m sejax.landscape`: measure what configurations of agents reach on a real task."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sejax.cli import commands, runtime
from sejax.cli import config as configuration
from sejax.cli.kinds import Kind, kind_of, stored, train
from sejax.ops.files import as_file_name
from sejax.options import (
    ConfigError,
    Options,
    as_text,
    counts,
    help_texts,
    option,
    registry,
    require,
)
from sejax.options.plain import fields_of, from_plain, parsed, split, to_plain

if TYPE_CHECKING:  # which take long to import, or need Optuna
    import pandas as pd

    from sejax.cli.spaces import Dimension

ABOUT = """Measure what configurations of agents reach on a real task, in one CSV file.

  python -m sejax.landscape env=cartpole agent=ddqn configs=64 seeds=8 steps=10000
  python -m sejax.landscape env=pendulum agent=[sac,ppo] file=pendulum.csv

Configurations are drawn from `space`, or from ranges as of sejax.search; other fields are those of
sejax.run with preset=ranking. The same command goes on where it stopped.
"""


@dataclass(frozen=True, kw_only=True)
class LandscapeConfig(Options):
    """The fields of `python -m sejax.landscape`; all others are those of `sejax.run`."""

    group: ClassVar[str] = ""

    configs: int = option(64, counts("configurations are compared", least=2))  # of each agent
    seeds: int = option(8, counts("an agent must train"))  # trainings of each configuration
    # Number of the first training of each: others are independent of it.
    first_seed: int = option(0, counts("it is a number", least=0))
    steps: int = option(10_000, counts("an agent must train"))  # of each training
    test_episodes: int = option(10, counts("it counts episodes"))  # greedy ones after it
    space: str = "wide"  # a preset of ranges, or FILE.yaml
    file: str | None = None  # null: runs/landscape-<env>-<agents>.csv


def main(overrides: Sequence[str]) -> None:
    """Measures the landscape that the overrides describe, or what is missing of it.

    Raises:
      ConfigError: for overrides that cannot be, or a file of another landscape.
      OSError: if a file cannot be written.
    """
    import filelock

    from sejax import landscapes

    own, kinds = read(overrides)
    path = Path(own.file or Path("runs", f"landscape-{_name(kinds)}.csv"))
    path.parent.mkdir(parents=True, exist_ok=True)
    card = card_of(own, kinds)
    try:
        with filelock.FileLock(path.with_name(f"{path.name}.lock"), timeout=0):
            done = stored(path, card, "file", "Set file=FILE.csv, another one.")
            runtime.configure_jax()
            for kind in kinds:
                done = measure(own, kind, path, card, done)
    except filelock.Timeout as error:
        raise ConfigError(
            f"file must be written by one command at a time; got {path}. Set file=FILE.csv.", "file"
        ) from error
    except KeyboardInterrupt:
        print(f"Interrupted. What has ended is in {path}; the same command goes on from there.")
        commands.leave(commands.INTERRUPTED)
    for found in landscapes.read(path, "file").values():
        means = found.mean_returns
        print(
            f"{found.agent}: {found.size} configurations reach {means.min():.1f} to "
            f"{means.max():.1f}, half of them {np.median(means):.1f} or more."
        )
    print(f"{path} holds every training.")


def read(overrides: Sequence[str]) -> tuple[LandscapeConfig, list[Kind]]:
    """The command's fields, and the kinds of agents with their configurations.

    Raises:
      ConfigError: for overrides that cannot be.
    """
    if find_spec("optuna") is None:
        raise ConfigError("spaces need Optuna. Install it with pip install 'sejax[search]'.")
    from sejax.cli import spaces

    names = [field.name for field in dataclasses.fields(LandscapeConfig)]
    values, ranges, rest = {}, {}, []
    given = dict(override.partition("=")[::2] for override in overrides)
    for name, text in given.items():
        if name in names:
            values[name] = text if name in ("space", "file") and text != "null" else parsed(text)
        elif spaces.is_range(text):
            ranges[name] = text
        elif name not in ("agent", "agents"):
            rest.append(f"{name}={text}")
    own = from_plain(LandscapeConfig, values, "")
    base = ["preset=ranking", "objective=max_reward", *rest]
    chosen = given.get("agents", given.get("agent"))
    if chosen is None:
        asked = [configuration.config(base).name("agent")]
    else:
        asked = split(chosen.strip("[]"))
    foreign = [name for name in given if name.startswith("agent.")]
    require(
        len(asked) == 1 or not foreign,
        foreign[0] if foreign else "agent",
        f"must come with one agent; got {','.join(asked)}. Measure each in a file of its own.",
    )
    found = [
        kind_of(
            name,
            base,
            _space(own, name, base, ranges),
            configs=own.configs,
            steps=own.steps,
            exact=foreign,
        )
        for name in asked
    ]
    return own, found


def _space(
    own: LandscapeConfig, name: str, base: Sequence[str], ranges: Mapping[str, str]
) -> dict[str, "Dimension"]:
    """What the configurations of an agent set: the preset's fields that are not fixed, and own."""
    from sejax.cli import spaces

    fixed = {word.partition("=")[0] for word in base}
    offered = spaces.preset(own.space, name, True, own.steps)
    space = {field: x for field, x in offered.items() if field not in fixed}
    return space | {field: spaces.parse(field, text, own.steps) for field, text in ranges.items()}


def _name(kinds: Sequence[Kind]) -> str:
    agents = configuration.JOINT.join(kind.name for kind in kinds)
    return as_file_name(f"{kinds[0].config.name('env')}-{agents}")


def card_of(own: LandscapeConfig, kinds: Sequence[Kind]) -> dict[str, Any]:
    """What a file says of its landscape."""
    first = kinds[0].config
    return {
        "task": first.task().name,
        "env": registry.describe("env", first.env),
        "steps": own.steps,
        "test_episodes": own.test_episodes,
        "configs": own.configs,
        "seeds": own.seeds,
        "first_seed": own.first_seed,
        "seed": first.seed,
        "agents": {kind.name: to_plain(kind.config.agent) for kind in kinds},
        "space": {kind.name: {field: x.text for field, x in kind.space.items()} for kind in kinds},
        "versions": runtime.versions(),
    }


def measure(
    own: LandscapeConfig, kind: Kind, path: Path, card: dict[str, Any], done: "pd.DataFrame"
) -> "pd.DataFrame":
    """Trains what is missing of one kind of agent, and writes the file after each chunk."""
    import pandas as pd

    from sejax import landscapes

    have = set()
    if len(done):
        mine = done[done["agent"] == kind.name]
        have = set(zip(mine["config"], mine["seed"], strict=True))
    seeds = range(own.first_seed, own.first_seed + own.seeds)
    places = [(c, s) for c in range(own.configs) for s in seeds if (c, s) not in have]
    for rows in train(kind, places, own.steps, own.test_episodes):
        done = pd.concat([done, rows], ignore_index=True) if len(done) else rows
        landscapes.write(path, card, _sorted(done, list(card["agents"])))
        print(
            f"{kind.name}: {(done['agent'] == kind.name).sum()} of {own.configs * own.seeds} "
            f"trainings, mean return {rows['return'].mean():.1f}",
            flush=True,
        )
    return done


def _sorted(rows: "pd.DataFrame", agents: list[str]) -> "pd.DataFrame":
    order = rows["agent"].map(agents.index)
    return rows.assign(order=order).sort_values(["order", "config", "seed"]).drop(columns="order")


def help_text(overrides: Sequence[str]) -> str:
    """What `--help` prints."""
    texts = help_texts(LandscapeConfig)
    lines = [
        f"  {name}={as_text(to_plain(default))}  # {texts.get(name, '')}"
        for name, default in fields_of(LandscapeConfig).items()
    ]
    return "\n".join([ABOUT, "Its own fields, with their defaults:", *lines])


if __name__ == "__main__":
    commands.start(main, help_text)
