"""The configuration of a landscape: its own fields, and configurations of kinds of agents."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, ClassVar

from sejax.cli import config as configuration
from sejax.cli.kinds import Kind, kind_of
from sejax.options import ConfigError, Options, counts, option, require
from sejax.options.plain import from_plain, parsed, split

if TYPE_CHECKING:  # which needs Optuna
    from sejax.cli.spaces import Dimension


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
