"""The overrides of a search: its own fields, the searched ranges, and the fixed settings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from optuna.distributions import FloatDistribution

from sejax.ops.files import as_file_name
from sejax.options import Count, Options, WholeNumber, registry, require
from sejax.options.plain import defaults_of, from_plain, to_plain, unknown_field
from sejax.runs.config import LearnConfig
from sejax.runs.words import texts_of
from sejax.search import spaces

REDUCTION_FACTOR = 3  # eta of Hyperband
# Fields of a run that the search sets for each trial.
SET_BY_SEARCH = ("generations", "num_seeds", "run_dir", "checkpoint_every", "machines")
# Fields that a search cannot vary: scores would not compare, or not depend on them.
ONE_VALUE = ("env", "proxy", "objective", "seed", "tracker", "devices", "num_parallel")


@dataclass(frozen=True, kw_only=True)
class StudyConfig(Options):
    """The fields of `python -m sejax.search`; all other fields are those of `sejax.run`.

    The defaults are the paper's setting, BOHB with a reduction factor of 3 (appendix, "SE
    hyperparameters").

    Attributes:
      trials: trials that end, pruned or complete
      min_generations: generations before a trial may be pruned; equal to max_generations: never
      max_generations: generations of a trial that is not pruned
      seeds: runs of a trial; their mean counts
      space: a preset of ranges, or FILE.yaml
      study: null: <env>-<proxy>-<agent>
      search_dir: null: runs/search-<study>
      verify: How many of the best trials are tried again with new seeds, as the best score of many
        is the luckiest too.
      fresh_seeds: new seeds of each trial that is tried again
    """

    trials: Count = 60
    min_generations: Count = 3
    max_generations: Count = 27
    seeds: Count = 1
    space: str | None = None
    study: str | None = None
    search_dir: str | None = None
    verify: WholeNumber = 5
    fresh_seeds: Count = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.min_generations, self.max_generations
        rule = f"must be at least min_generations={low}"
        require(high >= low, "max_generations", rule, got=high, use=9 * low)

    @property
    def rungs(self) -> list[int]:
        """Generations after which a trial may be pruned, and the last one."""
        rungs = (self.min_generations * REDUCTION_FACTOR**i for i in range(32))
        return [*(rung for rung in rungs if rung < self.max_generations), self.max_generations]


@dataclass(frozen=True, kw_only=True)
class StudyPlan:
    """A search: its own fields, the fixed overrides, and the searched fields.

    Attributes:
      config: the search's own fields.
      fixed: overrides of all trials.
      space: dimensions by the field's name.
      free: settings that may differ between the workers of a study and between its sessions.
    """

    free = ("trials", "search_dir", "verify", "fresh_seeds", "space", "devices")

    config: StudyConfig
    fixed: tuple[str, ...]
    space: dict[str, spaces.Dimension]

    def trial_config(self, overrides: Sequence[str] = ()) -> LearnConfig:
        """The configuration of a trial's runs.

        Raises:
          ConfigError: if it cannot run.
        """
        length = f"generations={self.config.max_generations}", "checkpoint_every=1"
        return LearnConfig.of_words([*self.fixed, *overrides, *length])

    @cached_property
    def default(self) -> LearnConfig:
        """The configuration of a trial with only the fixed overrides."""
        return self.trial_config()

    @property
    def study_name(self) -> str:
        """The study's name."""
        return self.config.study or "-".join(map(self.default.name, ("env", "proxy", "agent")))

    @property
    def folder(self) -> Path:
        return Path(self.config.search_dir or f"runs/search-{as_file_name(self.study_name)}")

    def overrides(self, params: Mapping[str, Any]) -> list[str]:
        """The overrides that set the searched fields to stored parameters."""
        return [f"{name}={x.value(params)}" for name, x in self.space.items()]

    def settings(self) -> dict[str, object]:
        """The settings of a study, plain values; workers may differ in those that are `free`."""
        ranges = {name: dimension.text for name, dimension in self.space.items()}
        return {**self.default.plain(), **to_plain(self.config), "ranges": ranges}


def plan_of(overrides: Sequence[str]) -> StudyPlan:
    """A search from its command's overrides.

    Overrides of `StudyConfig`'s fields set these. Ranges and choices are searched. All other
    overrides stay fixed. `space=` gives no range to a field that is fixed, also by a preset file,
    or that has its own range.

    Raises:
      ConfigError: for a bad value, for a field that cannot be searched, or if nothing is searched.
    """
    known = defaults_of(StudyConfig)
    by_name = {x.partition("=")[0]: x for x in overrides}
    of_run = [name for name in by_name if name.partition(".")[0] not in known]
    texts = {name: by_name[name].partition("=")[2] for name in of_run}
    ranges = {name: text for name, text in texts.items() if spaces.is_range(text)}
    others = texts_of([x for name, x in by_name.items() if name not in ranges])
    of_study = {name: others.pop(name) for name in [*others] if name.partition(".")[0] in known}
    for name, text in ranges.items():
        require(name not in ONE_VALUE, name, "must be one value in a search", got=text, use="VALUE")
    for name, text in (ranges | others).items():
        rule = "must be left out, as the search sets it"
        fix = "Set max_generations, seeds or search_dir, or type the command again for a worker."
        require(name.partition(".")[0] not in SET_BY_SEARCH, name, rule, got=text, fix=fix)
    space = {name: spaces.parse(name, text) for name, text in ranges.items()}
    fixed = tuple(f"{name}={text}" for name, text in others.items())
    plan = StudyPlan(config=from_plain(StudyConfig, of_study, ""), fixed=fixed, space=space)
    default = plan.default
    if plan.config.space is not None:
        by_key = default.agents.items()
        agents = {default.group_of(key): registry.name_of("agent", x) for key, x in by_key}
        typed = default.in_words(LearnConfig.layers_of(fixed)["typed"])
        for name, dimension in spaces.preset(plan.config.space, agents).items():
            if name not in typed:
                space.setdefault(name, dimension)
    fields = default.in_words(default.plain())
    if unknown := space.keys() - fields.keys():
        raise unknown_field(min(unknown), fields)
    for name, x in space.items():
        is_fit = type(fields[name]) is not int or not isinstance(x.distribution, FloatDistribution)
        use = f"'{x.text.replace('interval(', 'int(interval(').replace(')', '))', 1)}'"
        require(is_fit, name, "must be whole numbers", got=x.text, use=use)
    rule = "must be given and have ranges for these agents, or fields must have some; got none"
    require(space, "space", rule, use=f"paper_se, or es.noise_std='{spaces.EXAMPLE}'")
    return plan
