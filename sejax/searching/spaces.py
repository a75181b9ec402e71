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
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import Trial

from sejax.options import ConfigError, nearest, require, shortened, told
from sejax.options.plain import split
from sejax.runs import compose
from sejax.runs import config as configuration

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

    def override(self, params: Mapping[str, Any]) -> str:
        """The override that sets the field to the value of stored parameters."""
        return f"{self.name}={self.value(params)}"

    def value(self, params: Mapping[str, Any]) -> str:
        """The field's value of stored parameters, as in an override."""
        value, drawn = params[self.parameter], self.distribution
        if not isinstance(drawn, FloatDistribution):
            return str(value)
        low, high = drawn.low, drawn.high  # which rounding may leave
        if self.is_inverse:
            value, low, high = 1 - value, 1 - high, 1 - low
        return f"{min(max(float(f'{value:.{DIGITS}g}'), low), high):.12g}"

    def suggest(self, trial: Trial) -> str:
        """Draws a value for a trial; the override that sets it."""
        match self.distribution:
            case CategoricalDistribution(choices=choices):
                trial.suggest_categorical(self.parameter, choices)
            case IntDistribution(low=low, high=high, step=step, log=log):
                trial.suggest_int(self.parameter, low, high, step=step, log=log)
            case FloatDistribution(low=low, high=high, log=log):
                trial.suggest_float(self.parameter, low, high, log=log)
        return self.override(trial.params)

    def parameter_of(self, value: object) -> object:
        """The stored parameter that stands for a field's value; None if it is not drawn from."""
        drawn = self.distribution
        if isinstance(drawn, CategoricalDistribution):
            return next((x for x in drawn.choices if yaml.safe_load(str(x)) == value), None)
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        number = round(1 - value, 12) if self.is_inverse else value
        if not drawn.low <= number <= drawn.high:
            return None
        if isinstance(drawn, FloatDistribution):
            return float(number)
        is_step = isinstance(number, int) and (number - drawn.low) % drawn.step == 0
        return number if is_step else None


def is_range(text: str) -> bool:
    """Whether the value of an override is searched."""
    return _CALL.fullmatch(text) is not None or len(split(text)) > 1


def parse(name: str, text: str) -> Dimension:
    """A field's range or choice.

    Raises:
      ConfigError: if it cannot be searched.

    Example:
      >>> parse("agent.num_layers", "int(interval(1, 2))").distribution
      IntDistribution(high=2, log=False, low=1, step=1)
    """
    call, tags = text.strip(), set()
    text = call if _CALL.fullmatch(call) else f"choice({call})"
    if (tagged := _CALL.fullmatch(call)) and tagged[1] == "tag":
        *given, call = split(tagged[2])
        tags = set(given)
    try:
        if not tags <= {"log", "inverse"} or tags == {"inverse"}:
            raise ValueError("tags are log, or log and inverse")
        distribution = _distribution(call, tags)
    except (ValueError, ZeroDivisionError) as error:  # also of Optuna
        raise ConfigError(
            f"{name} must be a choice, a range or an interval; got {shortened(text)} "
            f"({told(error)}). Set {name}='{EXAMPLE}'.",
            name,
        ) from error
    return Dimension(name=name, text=text, distribution=distribution, is_inverse="inverse" in tags)


def _distribution(text: str, tags: set[str]) -> Distribution:
    """Optuna's distribution of a range without tags.

    Raises:
      ValueError: if it is none.
    """
    log, is_inverse = "log" in tags, "inverse" in tags
    call = _CALL.fullmatch(text)
    if call is None or call[1] == "choice":
        choices = split(text if call is None else call[2])
        if tags or (call is None and len(choices) < 2) or "" in choices:
            raise ValueError("a choice has values, and no tags")
        return CategoricalDistribution(choices)
    kind, inner = call[1], _CALL.fullmatch(call[2])
    if kind == "int" and inner and inner[1] == "interval":
        first, last = map(int, split(inner[2]))
        return IntDistribution(first, last, log=log)
    if kind == "range":
        start, stop, *rest = map(int, split(call[2]))
        step = rest[0] if rest else 1
        return IntDistribution(start, stop - 1 - (stop - 1 - start) % step, log=log, step=step)
    if kind != "interval":
        raise ValueError(f"{kind} takes another range")
    low, high = map(float, split(call[2]))
    if is_inverse:
        low, high = round(1 - high, 12), round(1 - low, 12)
    if not float("-inf") < low <= high < float("inf"):
        raise ValueError("bounds are finite and grow")
    return FloatDistribution(low, high, log=log)


def names() -> list[str]:
    """The presets."""
    return sorted(file.stem for file in FOLDER.glob("*.yaml"))


def preset(name: str, agent: str, of_agent: bool) -> dict[str, Dimension]:
    """The dimensions of a preset, or of a file of your own.

    Args:
      name: of the preset, or a path that ends in .yaml.
      agent: the chosen agent; each of a mixture has its own ranges (`ddqn+ppo`).
      of_agent: whether agents are tuned on a proxy, so that the agent's own fields alone count.

    Raises:
      ConfigError: if it is not there, or has nothing for the agent.
    """
    path = Path(name) if name.endswith(".yaml") else FOLDER / f"{name}.yaml"
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        ranked = nearest(name, names())
        raise ConfigError(
            f"space must be one of {', '.join(ranked)}, or a YAML file; got {shortened(name)} "
            f"({told(error)}). Set space={ranked[0]}.",
            "space",
        ) from error
    ranges = dict(content) if isinstance(content, dict) else {}
    of_agents = ranges.pop("with_agent", None) or {}
    has_own = bool(ranges)
    require(
        isinstance(of_agents, dict)
        and all(isinstance(x, dict) for x in of_agents.values())
        and (ranges or of_agents),
        "space",
        "must map fields to ranges, and agents to such maps under with_agent; got other content in "
        f"{path}. Set space=paper_se.",
    )
    for each in agent.split(configuration.JOINT):
        require(
            has_own or each in of_agents,
            "agent",
            f"must be one of {', '.join(of_agents)} with space={name}; got {shortened(each)}. Set "
            f"agent={next(iter(of_agents), 'ddqn')}.",
        )
        own = of_agents.get(each, {})
        if configuration.JOINT in agent:  # what a mixture shares has no place in an agent's ranges
            prefix = f"agents.{compose.key_of(each)}."
            own = {
                field.replace("agent.", prefix, 1): text
                for field, text in own.items()
                if field.startswith("agent.")
            }
        ranges |= own
    chosen = {k: v for k, v in ranges.items() if not of_agent or k.startswith("agent.")}
    return {field: parse(field, str(text)) for field, text in chosen.items()}
