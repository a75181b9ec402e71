"""What a search draws from: ranges and choices in overrides, and presets of them.

================================================= =================================================
`choice(tanh, relu)`, or `tanh,relu`              these values
`interval(0.1, 1)`                                numbers between the two
`int(interval(1, 10))`                            whole numbers, both ends included
`range(16, 65, 16)`                               16, 32, 48, 64
`tag(log, interval(0.01, 0.3))`                   uniform in the logarithm; also of whole numbers
`tag(log, inverse, interval(0.9, 0.999))`         uniform in the logarithm of the distance from 1,
                                                  which the paper's tables call "True (inv.)"
================================================= =================================================

A YAML file of a space maps fields to these, and under `with_agent` agents to ranges of their own.
"""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from sejax.options import ConfigError, as_text, nearest, shortened, told
from sejax.options.plain import split

Distribution = CategoricalDistribution | FloatDistribution | IntDistribution
FOLDER = Path(__file__).parent / "ranges"
DIGITS = 6  # of a number: the override says exactly what was tried
EXAMPLE = "tag(log, interval(0.01, 0.3))"
_CALL = re.compile(r"(choice|range|interval|int|tag)\((.*)\)", re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class Dimension:
    """A field and what it is drawn from.

    Attributes:
      name: of the field, such as `es.noise_std`.
      text: the range or choice, as an override has it.
      distribution: Optuna's.
      is_inverse: whether 1 - value is drawn in the place of the value.
    """

    name: str
    text: str
    distribution: Distribution
    is_inverse: bool = False

    @property
    def parameter(self) -> str:
        """Its name in the study."""
        return f"1 - {self.name}" if self.is_inverse else self.name

    def value(self, params: Mapping[str, Any]) -> str:
        """The field's value of stored parameters, as in an override."""
        value = params[self.parameter]
        if isinstance(value, float):
            value = f"{1 - value if self.is_inverse else value:.{DIGITS}g}"
        return str(value)

    def parameter_of(self, value: object) -> object:
        """The stored parameter that stands for a field's value; None if it is not drawn from."""
        drawn = self.distribution
        if isinstance(drawn, CategoricalDistribution):
            return as_text(value) if as_text(value) in drawn.choices else None
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        number = round(1 - value, 12) if self.is_inverse else value
        is_step = isinstance(drawn, FloatDistribution) or (number - drawn.low) % drawn.step == 0
        return number if is_step and drawn.low <= number <= drawn.high else None


def is_range(text: str) -> bool:
    """Whether the value of an override is searched."""
    return _CALL.fullmatch(text) is not None


def parse(name: str, text: str) -> Dimension:
    """A field's range or choice.

    Raises:
      ConfigError: if it cannot be searched.

    Example:
      >>> parse("agent.num_layers", "int(interval(1, 2))").distribution
      IntDistribution(high=2, log=False, low=1, step=1)
    """
    call, tags = text.strip(), set[str]()
    if (tagged := _CALL.fullmatch(call)) and tagged[1] == "tag":
        *given, call = split(tagged[2])
        tags = set(given)
    try:
        distribution = _distribution(call, tags)
    except (LookupError, TypeError, ValueError, ZeroDivisionError) as error:  # also of Optuna
        raise ConfigError(
            f"{name} must be a choice, a range or an interval; got {shortened(text)} "
            f"({told(error)}). Set {name}='{EXAMPLE}'.",
            name,
        ) from error
    return Dimension(name=name, text=text, distribution=distribution, is_inverse="inverse" in tags)


def _distribution(text: str, tags: Collection[str]) -> Distribution:
    """Optuna's distribution of a range without its tags.

    Raises:
      ValueError: if it is none.
    """
    call = _CALL.fullmatch(text)
    kind, inner = (call[1], call[2]) if call else ("choice", text)
    log, is_inverse = "log" in tags, "inverse" in tags
    if set(tags) not in ({"log", "inverse"}, {"log"}, set()):
        raise ValueError("tags are log, or log and inverse")
    if kind == "interval":
        low, high = map(float, split(inner))
        if is_inverse:
            low, high = round(1 - high, 12), round(1 - low, 12)
        if not float("-inf") < low <= high < float("inf"):
            raise ValueError("bounds are finite and grow")
        return FloatDistribution(low, high, log=log)
    if kind == "int" and (interval := re.fullmatch(r"interval\((.*)\)", inner)):
        first, last = map(int, split(interval[1]))
        return IntDistribution(first, last, log=log)
    if kind == "range" and not tags:
        whole = range(*map(int, split(inner)))
        return IntDistribution(whole[0], whole[-1], step=whole.step)
    choices = split(inner)
    if kind != "choice" or tags or "" in choices or (call is None and len(choices) < 2):
        raise ValueError(f"{kind} takes other values, or no tags")
    return CategoricalDistribution(choices)


def names() -> list[str]:
    """The presets."""
    return sorted(file.stem for file in FOLDER.glob("*.yaml"))


def preset(name: str, agents: Mapping[str, str]) -> dict[str, Dimension]:
    """The dimensions of a preset, or of a file of your own.

    Args:
      name: of the preset, or a path that ends in .yaml.
      agents: the agents that are trained, by the group of their fields: `agent`, or in a mixture
        `agents.KEY`, where what agents share has no ranges.

    Raises:
      ConfigError: if it is not there, or is no such file.
    """
    path = Path(name) if name.endswith(".yaml") else FOLDER / f"{name}.yaml"
    try:
        ranges = dict(yaml.safe_load(path.read_text(encoding="utf-8")))
        with_agent = dict(ranges.pop("with_agent", None) or {})
        of_agents = {agent: dict(x) for agent, x in with_agent.items()}
    except (OSError, yaml.YAMLError, TypeError, ValueError, RecursionError) as error:
        ranked = nearest(name, names())
        raise ConfigError(
            f"space must be one of {', '.join(ranked)}, or a YAML file that maps fields to ranges; "
            f"got {shortened(name)} ({told(error)[:120]}). Set space={ranked[0]}.",
            "space",
        ) from error
    for group, agent in agents.items():
        for field, text in of_agents.get(agent, {}).items():
            if group == "agent" or str(field).startswith("agent."):
                ranges[str(field).replace("agent", group, 1)] = text
    return {str(field): parse(str(field), str(text)) for field, text in ranges.items()}
