"""`python -m sejax.landscape`: measure what configurations of agents reach on a real task."""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sejax.cli import commands, kinds, runtime
from sejax.cli import config as configuration
from sejax.cli.kinds import Kind, stored
from sejax.cli.landscape_config import LandscapeConfig, read
from sejax.ops.files import as_file_name
from sejax.options import ConfigError, as_text, help_texts, registry, require
from sejax.options.plain import fields_of, to_plain

if TYPE_CHECKING:  # which take long to import
    import pandas as pd

    from sejax.cli.landscape_workers import Train

ABOUT = """Measure what configurations of agents reach on a real task, in one CSV file.

  python -m sejax.landscape env=cartpole agent=ddqn configs=256 seeds=8 steps=10000
  python -m sejax.landscape env=pendulum agent=[sac,ppo] file=pendulum.csv

Configurations are drawn from `space`, or from ranges as of sejax.search; other fields are those of
sejax.run with preset=ranking. The same command goes on where it stopped. On a Ray cluster:
machines=ray.
"""


def main(overrides: Sequence[str]) -> None:
    """Measures the landscape that the overrides describe, or what is missing of it.

    Raises:
      ConfigError: for overrides that cannot be, or a file of another landscape.
      OSError: if a file cannot be written.
    """
    import filelock

    from sejax import landscapes

    own, agents = read(overrides)
    path = Path(own.file or Path("runs", f"landscape-{_name(agents)}.csv"))
    path.parent.mkdir(parents=True, exist_ok=True)
    card = card_of(own, agents)
    try:
        with filelock.FileLock(path.with_name(f"{path.name}.lock"), timeout=0):
            done = stored(path, card, "file", "Set file=FILE.csv, another one.")
            runtime.configure_jax()
            with trainer_of(agents[0].config.machines, overrides) as train:
                for kind in agents:
                    done = measure(own, kind, path, card, done, train)
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


def _name(agents: Sequence[Kind]) -> str:
    names = configuration.JOINT.join(kind.name for kind in agents)
    return as_file_name(f"{agents[0].config.name('env')}-{names}")


def card_of(own: LandscapeConfig, agents: Sequence[Kind]) -> dict[str, Any]:
    """What a file says of its landscape."""
    first = agents[0].config
    return {
        "task": first.task().name,
        "env": registry.describe("env", first.env),
        "steps": own.steps,
        "test_episodes": own.test_episodes,
        "configs": own.configs,
        "seeds": own.seeds,
        "first_seed": own.first_seed,
        "seed": first.seed,
        "agents": {kind.name: to_plain(kind.config.agent) for kind in agents},
        "space": {kind.name: {field: x.text for field, x in kind.space.items()} for kind in agents},
        "versions": runtime.versions(),
    }


def trainer_of(
    machines: Any, overrides: Sequence[str]
) -> contextlib.AbstractContextManager["Train"]:
    """What trains agents, as `sejax.cli.kinds.train` does here, while the context is open.

    Raises:
      ConfigError: for machines that are neither here nor on a Ray cluster.
    """
    if not getattr(machines, "is_elsewhere", False):
        return contextlib.nullcontext(kinds.train)
    from sejax.cli import landscape_workers
    from sejax.cli.workers import RayConfig

    name = registry.name_of("machines", machines)
    message = f"must be local or ray for a landscape; got {name}. Set machines=ray."
    require(isinstance(machines, RayConfig), "machines", message)
    return landscape_workers.connected(machines, overrides)


def measure(
    own: LandscapeConfig,
    kind: Kind,
    path: Path,
    card: dict[str, Any],
    done: "pd.DataFrame",
    train: "Train",
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
