"""The overrides of a search: its own fields, what it searches, and what stays fixed."""

import dataclasses
import functools
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from sejax.ops.files import as_file_name
from sejax.options import (
    ConfigError,
    Options,
    as_text,
    counts,
    help_texts,
    nearest,
    one_of,
    option,
    positive,
    registry,
    require,
    shortened,
)
from sejax.options.plain import from_plain, parsed, split, to_plain
from sejax.proxies import hub
from sejax.runs import compose
from sejax.runs import config as configuration
from sejax.runs.config import EvaluateConfig, LearnConfig
from sejax.searching import spaces

if TYPE_CHECKING:  # which nobody needs who searches on one machine
    from sejax.runs.workers import LocalConfig, RayConfig

SAMPLERS = ("tpe", "random")
PRUNERS = ("hyperband", "median", "none")
SCORES = ("mean", "worst")
MEASURES = ("last", "best", "mean")
REDUCTION_FACTOR = 3  # eta of Hyperband
SQLITE = "sqlite:///"  # of a URL, before a file's path
TEXTS = ("study", "storage", "search_dir", "space")  # whatever YAML takes them for: 2024-01-01
# Fields of the command that are the search's, and which of its own to set in their place.
TAKEN = {
    "generations": "max_generations=27",
    "num_seeds": "seeds=3",
    "run_dir": "search_dir=FOLDER",
    "out_dir": "search_dir=FOLDER",
    "checkpoint_every": "min_generations=3",
}
# Fields that may differ between the workers of a study, and between its sessions.
OWN = {"trials", "timeout", "storage", "search_dir", "sampler_seed", "verify", "fresh_seeds"}
DEFAULT = "agent_hparams=default"  # an agent's fields are searched around its class's
NAMES = {"study", "space"}  # which stand for what is compared


@dataclass(frozen=True, kw_only=True)
class SearchConfig(Options):
    """The fields of `python -m sejax.search`; all others are those of the command it searches for.

    The defaults of sampler, pruner and generations are the paper's setting, BOHB with a reduction
    factor of 3 (appendix, "SE hyperparameters"; `docs/reference.md` 7.10).
    """

    group: ClassVar[str] = ""

    trials: int = option(
        60,
        counts("there is nothing to compare otherwise"),
        help="trials that end, pruned or complete",
    )
    sampler: str = option("tpe", one_of(SAMPLERS), help="tpe or random")
    sampler_seed: int | None = option(
        None,
        counts("it seeds a generator", least=0),
        help="null: drawn, so that workers do not draw alike",
    )
    pruner: str = option("hyperband", one_of(PRUNERS), help="hyperband, median or none")
    min_generations: int = option(
        3, counts("a trial must show something"), help="before a trial may be pruned"
    )
    max_generations: int = option(
        27, counts("there is nothing to do otherwise"), help="of a trial that is not pruned"
    )
    seeds: int = option(1, counts("a trial needs a run"), help="runs of a trial")
    score: str = option("mean", one_of(SCORES), help="of a trial, over its seeds: mean or worst")
    measure: str | None = option(
        None,
        one_of(MEASURES),
        help=(
            "The score of a seed. last: of its last generation; best: its best so far; mean: the "
            "mean of all so far, which rewards learning early. null: last for a proxy, mean for "
            "an agent"
        ),
    )
    space: str | None = option(None, help="a preset of ranges, or FILE.yaml")
    study: str | None = option(None, help="null: <env>-<proxy>-<agent>, or <agent>-on-<proxy>")
    storage: str | None = option(None, help="null: SQLite in search_dir; any URL that Optuna takes")
    search_dir: str | None = option(None, help="null: runs/search-<study>")
    timeout: float | None = option(
        None, positive("no trial would start"), help="s, after which no trial is begun"
    )
    heartbeat: int = option(
        15,
        counts("workers must show that they live"),
        help="seconds between signs of life of a worker",
    )
    verify: int | None = option(
        None,
        counts("the best are tried again", least=0),
        help=(
            "The best trials that are tried again, as the best score of many is the luckiest too:"
            " on the real task after a search on a proxy (null: 10), else with seeds that are new"
            " (null: 5)"
        ),
    )
    fresh_seeds: int = option(
        5,
        counts("the best are tried again with them"),
        help="new seeds of each that is tried again",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.max_generations >= self.min_generations,
            "max_generations",
            f"must be at least min_generations={self.min_generations}; got "
            f"{self.max_generations}. Set max_generations={9 * self.min_generations}.",
        )


@dataclass(frozen=True, kw_only=True)
class Search:
    """What is searched.

    Attributes:
      config: the search's own fields.
      fixed: overrides of all trials.
      space: dimensions by the field's name.
      machines: where trials are run.
    """

    config: SearchConfig
    fixed: tuple[str, ...]
    space: dict[str, spaces.Dimension]
    machines: "LocalConfig | RayConfig"

    @property
    def is_of_agent(self) -> bool:
        """Whether agents are tuned on a stored proxy; else proxies are learned."""
        name = self.choice("proxy", "se")
        is_kind = name in registry.names("proxy") or ":" in name
        return hub.is_address(name) or not is_kind

    @property
    def num_verified(self) -> int:
        """How many of the best are tried again."""
        default = 10 if self.is_of_agent else 5
        return default if self.config.verify is None else self.config.verify

    @property
    def measure(self) -> str:
        return self.config.measure or ("mean" if self.is_of_agent else "last")

    @property
    def rungs(self) -> tuple[int, ...]:
        """Generations after which a trial may be pruned, and the last one."""
        last, rungs = self.config.max_generations, [self.config.min_generations]
        while rungs[-1] < last:
            rungs.append(min(rungs[-1] * REDUCTION_FACTOR, last))
        return tuple(rungs)

    def choice(self, group: str, default: str) -> str:
        """What the fixed overrides choose of a group."""
        chosen = [x.partition("=")[2] for x in self.fixed if x.startswith(f"{group}=")]
        return chosen[-1] if chosen else default

    @functools.cached_property
    def agent(self) -> str:
        """The name of the agent: the given one, or that of the task and the proxy."""
        given = self.choice("agent", "")
        choices = [x for x in self.fixed if "." not in x.partition("=")[0]]
        if self.is_of_agent and not given:
            config = configuration.evaluate_config([*choices, DEFAULT])
            return configuration.JOINT.join(config.agents)
        return given or configuration.config(choices).name("agent")

    @functools.cached_property
    def study(self) -> str:
        """The study's name."""
        if self.config.study:
            return self.config.study
        if self.is_of_agent:
            proxy = Path(self.choice("proxy", "")).name
            return f"{self.agent}-on-{proxy.removesuffix('.safetensors')}"
        return "-".join([self.choice("env", "cartpole"), self.choice("proxy", "se"), self.agent])

    @property
    def folder(self) -> Path:
        return Path(self.config.search_dir or Path("runs", f"search-{as_file_name(self.study)}"))

    @property
    def storage(self) -> str:
        """URL of the database."""
        return self.config.storage or f"{SQLITE}{self.folder / 'study.db'}"

    def stored(self) -> dict[str, object]:
        """What all workers of a study have in common, by field."""
        own = to_plain(self.config).items()
        return {
            **{name: value for name, value in own if name not in OWN | NAMES},
            **dict(override.split("=", 1) for override in self.fixed),
            **{name: dimension.text for name, dimension in self.space.items()},
        }

    def require_same(self, stored: object) -> None:
        """Checks that a study is of this search; what it stores is compared and never read.

        Raises:
          ConfigError: if it is of another one.
        """
        asked, found = self.stored(), stored if isinstance(stored, dict) else {}
        differing = sorted(
            str(name) for name in asked.keys() | found.keys() if asked.get(name) != found.get(name)
        )
        require(
            not differing,
            "study",
            f"must be new or of the same search; got {shortened(self.study)}, which differs in "
            f"{shortened(', '.join(differing))}. Set study=NAME, another one.",
        )

    def overrides(self) -> list[str]:
        """The overrides of a worker that runs in any folder of any machine."""
        own = to_plain(self.config) | {
            "study": self.study,
            "search_dir": str(self.folder.resolve()),
            "storage": self.config.storage or f"{SQLITE}{self.folder.resolve() / 'study.db'}",
            "space": None,  # which are there already
            "sampler_seed": None,  # or workers would draw alike
        }
        return [
            *self.fixed,
            *(f"{name}={dimension.text}" for name, dimension in self.space.items()),
            *(f"{name}={as_text(value)}" for name, value in own.items() if value is not None),
        ]


def read(overrides: Sequence[str]) -> Search:
    """A search from its command's overrides.

    Those that name a field of `SearchConfig` set it, ranges and choices are searched, and all
    others stay fixed, those of a preset file too. A field that is fixed, or has a range of its own,
    is left out of `space=`.

    Raises:
      ConfigError: for a bad value, and for what cannot be searched.
    """
    own = {field.name for field in dataclasses.fields(SearchConfig)}
    values, fixed, space = {}, [], {}
    machines = {"name": "local"}
    choices = [  # a comma makes a sweep elsewhere
        f"{name}=choice({text})" if len(split(text)) > 1 else f"{name}{equals}{text}"
        for name, equals, text in (override.partition("=") for override in overrides)
    ]
    for name, given in compose.read(choices).items():
        text = given if isinstance(given, str) else as_text(given)
        require(
            name not in TAKEN,
            name,
            f"must be left out, because the search sets it for each trial; got {shortened(text)}. "
            f"Set {TAKEN.get(name)}.",
        )
        if name in own:
            is_text = name in TEXTS and text != "null"
            values[name] = text if is_text else parsed(text)
        elif name.partition(".")[0] == "machines":
            machines[name.partition(".")[2] or "name"] = parsed(text)
        elif spaces.is_range(text):
            space[name] = spaces.parse(name, text)
        else:
            fixed.append(f"{name}={text}")
    _require_typed("preset", fixed, overrides)
    config = from_plain(SearchConfig, values, "")
    where = registry.configure("machines", machines)
    search = Search(config=config, fixed=tuple(fixed), space=space, machines=where)
    registry.require_package("machines", where)
    require(
        search.choice("proxy", "se") != "real",
        "proxy",
        "must be learned, or one to tune agents on; got real. Set proxy=cartpole, or "
        "env=cartpole proxy=se.",
    )
    if config.space is None:
        return search
    given = {override.partition("=")[0] for override in fixed} | set(space)
    preset = spaces.preset(config.space, search.agent, search.is_of_agent)
    offered = {name: x for name, x in preset.items() if name not in given}
    _require_typed("space", [x.text for x in offered.values()], overrides)
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


def require_fields(search: Search, config: LearnConfig | EvaluateConfig) -> dict[str, object]:
    """Checks that what is searched are fields of the command.

    Args:
      search: what is searched.
      config: of the command with the fixed overrides alone.

    Returns:
      The current value of each field that is searched.

    Raises:
      ConfigError: if one is no field.
    """
    require(
        search.space,
        "space",
        "must be given, or ranges of fields; got none. Set space=paper_se, or "
        f"es.noise_std='{spaces.EXAMPLE}'.",
    )
    values = configuration.words_of(config)
    for name in search.space:
        if name not in values:
            raise ConfigError(
                f"{name} must be a field of the trials, because it is searched; got one that they "
                f"do not have. Did you mean {nearest(name, values)[0]}?",
                name,
            )
    return {name: values[name] for name in search.space}


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
