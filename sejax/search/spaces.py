"""The ranges and choices that a search draws from, in overrides and in presets.

================================================= =================================================
`choice(tanh, relu)`, or `tanh,relu`              these values
`interval(0.1, 1)`                                numbers between the two
`int(interval(1, 10))`                            whole numbers, both ends included
`range(16, 65, 16)`                               16, 32, 48, 64
`tag(log, interval(0.01, 0.3))`                   uniform in the logarithm; also for whole numbers
`tag(log, inverse, interval(0.9, 0.999))`         uniform in the logarithm of the distance from 1,
                                                  which the paper's tables call "True (inv.)"
================================================= =================================================

A YAML file of a space maps fields to these; under `with_agent` it maps agents to their own ranges.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optuna import distributions, trial

from sejax.options import ConfigError, as_text, nearest, require, shortened, told
from sejax.options.plain import parsed, split
from sejax.runs.words import UNREADABLE, read_yaml

FOLDER = Path(__file__).parent / "ranges"
DIGITS = 6  # of a drawn number in its override: exactly this number is tried
EXAMPLE = "tag(log, interval(0.01, 0.3))"
_CALL = re.compile(r"(choice|range|interval|int|tag)\((.*)\)", re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class Dimension:
    """A field and the distribution that it is drawn from.

    Attributes:
      name: the field's name, such as `es.noise_std`.
      text: the range or choice, as an override has it.
      distribution: Optuna's.
      is_inverse: whether 1 - value is drawn instead of the value.
    """

    name: str
    text: str
    distribution: distributions.BaseDistribution
    is_inverse: bool = False

    @property
    def parameter(self) -> str:
        """Its name in the study."""
        return f"1 - {self.name}" if self.is_inverse else self.name

    def value(self, params: Mapping[str, Any]) -> str:
        """The field's value in stored parameters, as an override writes it."""
        value = params[self.parameter]
        known = getattr(self.distribution, "choices", (value,))
        require(value in known, self.name, "must be in its range", got=value)
        if isinstance(value, float):
            value = f"{1 - value if self.is_inverse else value:.{DIGITS}g}"
        return str(value)

    def parameter_of(self, value: float | str | None) -> float | str | None:
        """The stored parameter for a field's value; None if the value is outside of the range."""
        try:
            if isinstance(self.distribution, distributions.CategoricalDistribution):
                choices = self.distribution.choices
                value = next(x for x in choices if as_text(value) in (x, as_text(parsed(str(x)))))
            elif self.is_inverse and isinstance(value, int | float):
                value = round(1 - value, 12)
            # It raises for a value outside of the range.
            trial.create_trial(value=0, params={"x": value}, distributions={"x": self.distribution})
        except (StopIteration, TypeError, ValueError):
            return None
        return value


def is_range(text: str) -> bool:
    """Whether an override's value is searched; in other commands a comma makes a sweep."""
    return _CALL.fullmatch(text) is not None or len(split(text)) > 1


def parse(name: str, text: str) -> Dimension:
    """A field's range or choice.

    Raises:
      ConfigError: if it cannot be searched.

    Example:
      >>> parse("agent.num_layers", "int(interval(1, 2))").distribution
      IntDistribution(high=2, log=False, low=1, step=1)
    """
    tagged = re.fullmatch(r"tag\((.*)\)", text.strip())
    *tags, call = split(tagged[1]) if tagged else [text.strip()]
    try:
        distribution = _distribution(call, tags)
    except (LookupError, TypeError, ValueError, ZeroDivisionError) as error:  # also of Optuna
        rule = f"must be a choice, a range or an interval; got {shortened(text)} ({told(error)})"
        raise ConfigError(name, rule, use=f"'{EXAMPLE}'") from error
    return Dimension(name=name, text=text, distribution=distribution, is_inverse="inverse" in tags)


def _distribution(text: str, tags: list[str]) -> distributions.BaseDistribution:
    """Optuna's distribution of a range without its tags.

    Raises:
      LookupError, TypeError, ValueError, ZeroDivisionError: if it is none.
    """
    call = _CALL.fullmatch(text)
    function, inner = (call[1], call[2]) if call else ("choice", text)
    match function, tags:
        case "interval", [] | ["log"] | ["log", "inverse"]:
            low, high = map(float, split(inner))
            if "inverse" in tags:
                low, high = round(1 - high, 12), round(1 - low, 12)
            if -math.inf < low <= high < math.inf:
                return distributions.FloatDistribution(low, high, log=bool(tags))
        case "int", [] | ["log"]:
            first, last = split(inner.removeprefix("interval(").removesuffix(")"))
            return distributions.IntDistribution(int(first), int(last), log=bool(tags))
        case "range", []:
            whole = range(*map(int, split(inner)))
            return distributions.IntDistribution(whole[0], whole[-1], step=whole.step)
        case "choice", [] if "" not in split(inner) and (call or len(split(inner)) > 1):
            return distributions.CategoricalDistribution(split(inner))
    raise ValueError("bounds, tags or values are wrong")


def preset(name: str, agents: Mapping[str, str]) -> dict[str, Dimension]:
    """The dimensions of a preset, or of a file of your own.

    Args:
      name: the preset's name, or a path that ends in .yaml.
      agents: the names of the agents by the group of their fields: `agent`, or `agents.KEY` in a
        mixture. In a mixture, `with_agent` gives ranges only to the agents' own fields.

    Raises:
      ConfigError: if it is missing, is no such file, or names a `module:attribute`.
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else FOLDER / f"{name}.yaml"
    try:
        texts = dict(read_yaml(path))
        with_agent = texts.pop("with_agent", None) or {}
        for group, agent in agents.items():
            for field, text in with_agent.get(agent, {}).items():
                if group == "agent" or field.startswith("agent."):
                    texts[field.replace("agent", group, 1)] = text
    except UNREADABLE as error:
        known = nearest(name, (file.stem for file in FOLDER.glob("*.yaml")))
        rule = f"must be one of {', '.join(known)}, or a YAML file of ranges"
        got = f"{shortened(name)} ({told(error)[:120]})"
        raise ConfigError("space", f"{rule}; got {got}", use="paper_se") from error
    foreign = [text for text in texts.values() if ":" in str(text)]
    fix = "Type this range on the command line."
    require(not foreign, "space", "must name no module", got=", ".join(map(str, foreign)), fix=fix)
    try:
        return {str(field): parse(str(field), str(text)) for field, text in texts.items()}
    except ConfigError as error:
        rule = f"must hold ranges; in {shortened(path, 40)} {error.field} {error.rule}"
        raise ConfigError("space", rule, fix=f"Write {EXAMPLE} there.") from error
