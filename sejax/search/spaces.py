"""Search spaces: Hydra's sweeps as Optuna's distributions, and the presets of ranges.

`choice(a, b)`, `a,b`, `range(1, 9, 2)`, `interval(0.1, 1)`, `int(interval(1, 10))`, each within
`tag(log, ...)` for a logarithmic scale, and within `tag(log, inverse, ...)` for one in the distance
from 1, which the paper's tables call "True (inv.)".

A file of a space holds sweeps by the names of fields, and under `with_agent` those of an agent.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, QuotedString, RangeSweep
from hydra.errors import HydraException

from sejax.cli import families
from sejax.cli.words import word
from sejax.errors import ConfigError, is_number, nearest, require, shortened

FOLDER = Path(__file__).parents[1] / "conf" / "spaces"
DIGITS = 6  # of a float: what the override line says is what was tried
SHOWN_DIGITS = 3
EXAMPLE = "tag(log, interval(0.01, 0.3))"


@dataclass(frozen=True, kw_only=True)
class Dimension:
    """A field and the values that it may take.

    Attributes:
      name: of the field, as `es.noise_std`.
      text: Hydra's sweep.
      values: of a choice, as the command line has them; empty for a range.
      low, high: bounds, both included.
      step: of a range of whole numbers; None for one of floats.
      log: whether the scale is logarithmic.
      inverse: whether it is so in 1 - value.
    """

    name: str
    text: str
    values: tuple[str, ...] = ()
    low: float = 0.0
    high: float = 0.0
    step: int | None = None
    log: bool = False
    inverse: bool = False

    @property
    def parameter(self) -> str:
        """The name under which the study keeps it."""
        return f"1 - {self.name}" if self.inverse else self.name

    def suggest(self, trial: Any) -> str:
        """The trial's value, as the command line has it."""
        if self.values:
            return str(trial.suggest_categorical(self.name, self.values))
        if self.inverse:
            low, high = (round(1 - x, 12) for x in (self.high, self.low))
            value = trial.suggest_float(self.parameter, low, high, log=True)
            return self._written(1 - value)
        if self.step is not None:
            return str(
                trial.suggest_int(
                    self.name, int(self.low), int(self.high), step=self.step, log=self.log
                )
            )
        value = trial.suggest_float(self.name, self.low, self.high, log=self.log)
        return self._written(value)

    def of(self, params: Mapping[str, Any]) -> str:
        """The value that stored parameters stand for."""
        value = params[self.parameter]
        if self.inverse:
            return self._written(1 - value)
        return self._written(value) if isinstance(value, float) else str(value)

    def parameter_of(self, value: Any) -> Any:
        """What stands for a field's value in stored parameters; None if it is not among these."""
        if self.values:
            same = (each for each in self.values if each == word(value) or _same(each, value))
            return next(same, None)
        if not is_number(value) or not self.low <= value <= self.high:
            return None
        if self.step is not None:
            return value if isinstance(value, int) and not (value - self.low) % self.step else None
        return round(1 - value, 12) if self.inverse else float(value)

    def shown(self, params: Mapping[str, Any]) -> str:
        """The value as tables have it: three digits, of the distance from 1 where that is drawn."""
        value = params[self.parameter]
        if not isinstance(value, float):
            return self.of(params)
        rounded = float(f"{value:.{SHOWN_DIGITS}g}")
        return f"{1 - rounded if self.inverse else rounded:.12g}"

    def _written(self, value: float) -> str:
        """Within the bounds, which rounding may leave."""
        rounded = float(f"{value:.{DIGITS}g}")
        return f"{min(max(rounded, self.low), self.high):.12g}"


def _same(written: str, value: Any) -> bool:
    """Whether a choice's word is this number, as 1 is 1.0."""
    try:
        return is_number(value) and float(written) == value
    except ValueError:
        return False


def parse(name: str, text: str) -> Dimension:
    """A dimension from a sweep in Hydra's syntax.

    Raises:
      ConfigError: if it is none, or one that cannot be searched.

    Example:
      >>> parse("agent.num_layers", "int(interval(1, 2))").high
      2
    """
    try:
        override = OverridesParser.create().parse_override(f"{name}={text}")
    except HydraException as error:
        raise _no_sweep(name, text) from error
    sweep = override.value()
    tags = set(getattr(sweep, "tags", ()))
    log, inverse = "log" in tags, "inverse" in tags
    example = f"{name}='tag(log, inverse, interval(0.9, 0.999))'"
    require(
        tags <= {"log", "inverse"} and (log or not inverse),
        name,
        "have the tags log, or log and inverse",
        "nothing else is known",
        ", ".join(sorted(tags)),
        example,
    )
    if isinstance(sweep, ChoiceSweep):
        plain = [x.text if isinstance(x, QuotedString) else x for x in sweep.list]
        return Dimension(name=name, text=text, values=tuple(map(word, plain)))
    low, high, step = _range(name, text, sweep)
    require(
        math.isfinite(low) and math.isfinite(high),
        name,
        "have finite bounds",
        "all between them is drawn",
        shortened(text),
        f"{name}='{EXAMPLE}'",
    )
    require(
        low <= high,
        name,
        "be a range that grows",
        "there is nothing in it otherwise",
        shortened(text),
        f"{name}='{EXAMPLE}'",
    )
    require(
        not log or inverse or (low > 0 and step in (None, 1)),
        name,
        "begin above 0 and have steps of 1 with log",
        "it is drawn in its logarithm",
        shortened(text),
        f"{name}='{EXAMPLE}'",
    )
    require(
        not inverse or high < 1,
        name,
        "end below 1 with inverse",
        "it is drawn in the logarithm of the distance",
        shortened(text),
        example,
    )
    return Dimension(name=name, text=text, low=low, high=high, step=step, log=log, inverse=inverse)


def _range(name: str, text: str, sweep: Any) -> tuple[float, float, int | None]:
    """Bounds, both included, and the step of a sweep that is a range; no step for floats.

    Raises:
      ConfigError: if it is none.
    """
    match sweep:
        case RangeSweep(start=int(start), stop=int(stop), step=int(step)) if step > 0:
            return start, start + step * (-(-(stop - start) // step) - 1), step  # without its end
        case IntervalSweep(start=int(start), end=int(end)):
            return start, end, 1
        case IntervalSweep(start=float(start), end=float(end)):
            return start, end, None
    raise _no_sweep(name, text)


def _no_sweep(name: str, text: str) -> ConfigError:
    return ConfigError(
        f"{name} must be a sweep of Hydra's (choice, range, interval), because it is searched; got "
        f"{shortened(text)}. Set {name}='{EXAMPLE}'."
    )


def names() -> list[str]:
    """The presets of ranges."""
    return sorted(file.stem for file in FOLDER.glob("*.yaml"))


def preset(name: str, agent: str, of_agent: bool) -> dict[str, Dimension]:
    """The dimensions of a preset, or of a file of one's own.

    Args:
      name: of the preset, or a path that ends in .yaml.
      agent: the chosen agent; of several each has the ranges of its own (`ddqn+ppo`).
      of_agent: whether agents are tuned on a proxy, so that the agent's own fields alone count.

    Raises:
      ConfigError: if it is not there, or has nothing for the agent.
    """
    is_file = name.endswith(".yaml")
    path = Path(name) if is_file else FOLDER / f"{name}.yaml"
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        ranked = nearest(name, names())
        raise ConfigError(
            f"space must be one of {', '.join(ranked)}, or a YAML file; got {shortened(name)} "
            f"({' '.join(str(error).split())[:100]}). Set space={ranked[0]}."
        ) from error
    require(
        isinstance(content, dict),
        "space",
        "map fields to sweeps",
        "they are searched",
        f"{path} with a {type(content).__name__}",
        "space=paper_se",
    )
    of_agents = content.pop("with_agent", None) or {}
    require(
        isinstance(of_agents, dict) and all(isinstance(x, dict) for x in of_agents.values()),
        "space",
        "map agents to their sweeps under with_agent",
        "each has its own",
        f"{path} with {shortened(of_agents)} there",
        "space=paper_se",
    )
    has_others, are_several = bool(content), families.JOINT in agent
    for each in families.members(agent):
        require(
            has_others or each in of_agents,
            "agent",
            f"be one of {', '.join(of_agents)} with space={name}",
            "it has no ranges for others",
            each,
            f"agent={next(iter(of_agents), 'ddqn')}",
        )
        ranges = of_agents.get(each, {})
        content |= _of_family(families.key_of(each), ranges) if are_several else ranges
    chosen = {k: v for k, v in content.items() if not of_agent or k.startswith("agent.")}
    return {field: parse(field, str(text)) for field, text in chosen.items()}


def _of_family(key: str, ranges: Mapping[str, Any]) -> dict[str, Any]:
    """An agent's own ranges where it is one of several; what all share has no place in them."""
    return {
        f"agents.{key}.{field.removeprefix('agent.')}": text
        for field, text in ranges.items()
        if field.startswith("agent.")
    }
