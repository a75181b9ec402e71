"""The overrides of a search: its own fields, what it searches, and what stays fixed."""

import dataclasses
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from sejax.ops.files import as_file_name
from sejax.options import (
    Options,
    as_text,
    counts,
    help_texts,
    option,
    registry,
    require,
    shortened,
)
from sejax.options.plain import from_plain, parsed, split, to_plain, unknown_field
from sejax.proxies import hub
from sejax.runs import compose
from sejax.runs import config as configuration
from sejax.runs.worlds import proxy_setup
from sejax.searching import spaces

REDUCTION_FACTOR = 3  # eta of Hyperband
DEFAULT = "agent_hparams=default"  # an agent's fields are searched around its class's
TEXTS = ("study", "search_dir", "space")  # whatever YAML takes them for: 2024-01-01
# Fields of the command that the search sets for each trial.
TAKEN = ("generations", "num_seeds", "run_dir", "out_dir", "checkpoint_every", "machines")
# Fields that may differ between the workers of a study and between its sessions, and names.
FREE = ("trials", "search_dir", "verify", "fresh_seeds", "study", "space")


@dataclass(frozen=True, kw_only=True)
class SearchConfig(Options):
    """The fields of `python -m sejax.search`; all others are those of the command it searches for.

    The defaults are the paper's setting, BOHB with a reduction factor of 3 (appendix, "SE
    hyperparameters"; `docs/reference.md` 7.10).

    Attributes:
      trials: trials that end, pruned or complete
      min_generations: before a trial may be pruned; as many as max_generations: none is
      max_generations: of a trial that is not pruned
      seeds: runs of a trial, whose mean counts
      space: a preset of ranges, or FILE.yaml
      study: null: <env>-<proxy>-<agent>, or <agent>-on-<proxy>
      search_dir: null: runs/search-<study>
      verify: The best trials that are tried again, as the best score of many is the luckiest too:
        on the real task after a search on a proxy, else with seeds that are new.
      fresh_seeds: new seeds of each that is tried again
    """

    group: ClassVar[str] = ""

    trials: int = option(60, counts("there is nothing to compare otherwise"))
    min_generations: int = option(3, counts("a trial must show something"))
    max_generations: int = option(27, counts("there is nothing to do otherwise"))
    seeds: int = option(1, counts("a trial needs a run"))
    space: str | None = None
    study: str | None = None
    search_dir: str | None = None
    verify: int = option(5, counts("the best are tried again", least=0))
    fresh_seeds: int = option(5, counts("the best are tried again with them"))

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.max_generations >= self.min_generations,
            "max_generations",
            f"must be at least min_generations={self.min_generations}; got "
            f"{self.max_generations}. Set max_generations={9 * self.min_generations}.",
        )

    @property
    def rungs(self) -> tuple[int, ...]:
        """Generations after which a trial may be pruned, and the last one."""
        rungs = [self.min_generations]
        while rungs[-1] < self.max_generations:
            rungs.append(min(rungs[-1] * REDUCTION_FACTOR, self.max_generations))
        return tuple(rungs)


@dataclass(frozen=True, kw_only=True)
class Search:
    """What is searched.

    Attributes:
      config: the search's own fields.
      fixed: overrides of all trials.
      space: dimensions by the field's name.
    """

    config: SearchConfig
    fixed: tuple[str, ...]
    space: dict[str, spaces.Dimension]

    @property
    def is_of_agent(self) -> bool:
        """Whether agents are tuned on a stored proxy; else proxies are learned."""
        proxy = dict(word.split("=", 1) for word in self.fixed).get("proxy", "se")
        is_learned = proxy in registry.names("proxy") or ":" in proxy
        return hub.is_address(proxy) or not is_learned

    @property
    def command(self) -> str:
        """The module that repeats a trial."""
        return "sejax.evaluate" if self.is_of_agent else "sejax.run"

    def trial_config(self, overrides: Sequence[str]) -> Any:
        """The configuration of a trial: that of an evaluation if `is_of_agent`, else of a run.

        Raises:
          ConfigError: if it is none that can run.
        """
        if not self.is_of_agent:
            own = f"generations={self.config.max_generations}", "checkpoint_every=1"
            return configuration.config([*self.fixed, *overrides, *own])
        config = configuration.evaluate_config([DEFAULT, *self.fixed, *overrides])
        require(
            len(config.agents) == 1 and config.agent_hparams == "default",
            "agent",
            "must be one with agent_hparams=default, where its settings are searched; got others. "
            "Set agent=ppo.",
        )
        proxy_setup(config)  # which checks what is asked of the proxy
        return config

    @cached_property
    def default(self) -> Any:
        """The configuration of a trial whose overrides are the fixed ones."""
        return self.trial_config([])

    @property
    def plain(self) -> dict[str, Any]:
        """The plain values of `default`."""
        values: dict[str, Any] = configuration.plain(self.default)
        return values

    @property
    def agents(self) -> dict[str, str]:
        """The names of the agents that are trained, by the group of their fields."""
        names = {key: registry.name_of("agent", x) for key, x in self.default.agents.items()}
        is_one = len(names) == 1
        return {"agent" if is_one else f"agents.{key}": name for key, name in names.items()}

    @property
    def study(self) -> str:
        """The study's name."""
        agents = "+".join(self.agents.values())
        if self.is_of_agent:
            default = f"{agents}-on-{Path(self.plain['proxy']).name.removesuffix('.safetensors')}"
        else:
            default = f"{self.plain['env']['name']}-{self.plain['proxy']['name']}-{agents}"
        return self.config.study or default

    @property
    def folder(self) -> Path:
        return Path(self.config.search_dir or Path("runs", f"search-{as_file_name(self.study)}"))

    def current(self) -> dict[str, object]:
        """The value of each field that is searched where only the fixed overrides are given.

        Raises:
          ConfigError: if nothing is searched, or something that is no field.
        """
        require(
            self.space,
            "space",
            "must be given and have ranges for these agents, or ranges of fields; got none. Set "
            f"space=paper_se, or es.noise_std='{spaces.EXAMPLE}'.",
        )
        values = configuration.words_of(self.default)
        for name in self.space:
            if name not in values:
                raise unknown_field(name, values)
        return {name: values[name] for name in self.space}

    def overrides(self, params: Mapping[str, Any]) -> list[str]:
        """The overrides that set what is searched to stored parameters."""
        return [f"{name}={x.value(params)}" for name, x in self.space.items()]

    def stored(self) -> dict[str, object]:
        """What all workers of a study have in common, by field."""
        return {
            **{name: x for name, x in to_plain(self.config).items() if name not in FREE},
            **dict(override.split("=", 1) for override in self.fixed),
            **{name: dimension.text for name, dimension in self.space.items()},
        }

    def require_same(self, stored: object) -> None:
        """Checks that a study is of this search; what it stores is compared and never read.

        Raises:
          ConfigError: if it is of another one.
        """
        own, theirs = self.stored(), stored if isinstance(stored, dict) else {}
        names = own.keys() | theirs.keys()
        differing = sorted(str(name) for name in names if own.get(name) != theirs.get(name))
        require(
            not differing,
            "study",
            f"must be new or of the same search; got {shortened(self.study)}, which differs in "
            f"{shortened(', '.join(differing))}. Set study=NAME, another one.",
        )


def read(overrides: Sequence[str]) -> Search:
    """A search from its command's overrides.

    Those that name a field of `SearchConfig` set it, ranges and choices are searched, and all
    others stay fixed, those of a preset file too. A field that is fixed, or has a range of its own,
    is left out of `space=`.

    Raises:
      ConfigError: for a bad value, and for what cannot be searched.
    """
    own = {field.name for field in dataclasses.fields(SearchConfig)}
    words = [  # a comma makes a sweep elsewhere
        f"{name}=choice({text})" if len(split(text)) > 1 else f"{name}{equals}{text}"
        for name, equals, text in (override.partition("=") for override in overrides)
    ]
    values, fixed, space = {}, [], {}
    for name, value in compose.read(words).items():
        text = value if isinstance(value, str) else as_text(value)
        require(
            name.partition(".")[0] not in TAKEN,
            name,
            f"must be left out, because the search sets it for each trial; got {shortened(text)}. "
            "Set max_generations, seeds or search_dir; the same command again is one more worker.",
        )
        if name in own:
            values[name] = text if name in TEXTS and text != "null" else parsed(text)
        elif spaces.is_range(text):
            space[name] = spaces.parse(name, text)
        else:
            fixed.append(f"{name}={text}")
    _require_typed("preset", fixed, overrides)
    config = from_plain(SearchConfig, values, "")
    search = Search(config=config, fixed=tuple(fixed), space=space)
    if config.space is None:
        return search
    given = {word.partition("=")[0] for word in fixed} | set(space)
    offered = {
        name: dimension
        for name, dimension in spaces.preset(config.space, search.agents).items()
        if name not in given and (name.startswith("agent.") or not search.is_of_agent)
    }
    _require_typed("space", [dimension.text for dimension in offered.values()], overrides)
    return dataclasses.replace(search, space={**offered, **space})


def _require_typed(field: str, texts: Sequence[str], overrides: Sequence[str]) -> None:
    """Checks that a file names no module that the user has not typed."""
    typed = registry.paths_in(overrides)
    foreign = [path for path in registry.paths_in(texts) if path not in typed]
    require(
        not foreign,
        field,
        f"must name no module that you have not typed; got {shortened(', '.join(foreign))}. Type "
        "it on the command line too.",
    )


def help_text() -> str:
    """What `--help` prints."""
    texts = help_texts(SearchConfig)
    fields = "\n".join(
        textwrap.fill(f"  {name}={as_text(value)}  # {texts[name]}", 98, subsequent_indent=" " * 6)
        for name, value in to_plain(SearchConfig()).items()
    )
    return f"""Search hyperparameters with Optuna; a trial is a run, its generations the budget.
With proxy=RUN_DIR, a file or a shipped name: those of an agent that is trained on that proxy.

  python -m sejax.search env=cartpole es.noise_std='{spaces.EXAMPLE}'
  python -m sejax.search env=cartpole preset=paper space=paper_se trials=60
  python -m sejax.search proxy=cartpole agent=ppo space=agent

The same command goes on where it stopped, or is one more worker of the same study.

Fields (space: {", ".join(spaces.names())} or FILE.yaml):
{fields}

All other overrides are those of python -m sejax.run (with a proxy: sejax.evaluate). Searched are
choice(a,b), range(1,9,2), interval(0,1), int(interval(1,10)), tag(log, ...), and
tag(log, inverse, ...) in 1 - x."""
