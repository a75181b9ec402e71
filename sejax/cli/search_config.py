"""The overrides of a search: its own fields, what it searches, and what stays fixed."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from sejax.cli import compose, preset_files, spaces
from sejax.cli import config as configuration
from sejax.cli.config import EvaluateConfig, LearnConfig
from sejax.ops.files import as_file_name
from sejax.options import (
    ConfigError,
    Options,
    as_text,
    counts,
    nearest,
    one_of,
    option,
    positive,
    registry,
    require,
    shortened,
)
from sejax.options.plain import flatten, from_plain, parsed, split, to_plain

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


@dataclass(frozen=True, kw_only=True)
class SearchConfig(Options):
    """The fields of `python -m sejax.search`; all others are those of the command it searches for.

    The defaults of sampler, pruner and generations are the paper's setting, BOHB with a reduction
    factor of 3 (appendix, "SE hyperparameters"; `docs/reference.md` 7.10).
    """

    group: ClassVar[str] = ""

    trials: int = option(60, counts("there is nothing to compare otherwise"))  # that end
    sampler: str = option("tpe", one_of(SAMPLERS))
    # null: drawn, so that workers do not draw alike.
    sampler_seed: int | None = option(None, counts("it seeds a generator", least=0))
    pruner: str = option("hyperband", one_of(PRUNERS))
    min_generations: int = option(3, counts("a trial must show something"))  # before one is pruned
    max_generations: int = option(27, counts("there is nothing to do otherwise"))
    seeds: int = option(1, counts("a trial needs a run"))  # runs of a trial
    score: str = option("mean", one_of(SCORES))  # of a trial, over its seeds
    # What a seed counts for. last: its last generation's score; best: its best so far; mean: the
    # mean of all so far, which rewards learning early. null: last for a proxy, mean for an agent.
    measure: str | None = option(None, one_of(MEASURES))
    space: str | None = None  # a preset of ranges, or a file of your own
    study: str | None = None  # null: <env>-<proxy>-<agent>, or <agent>-on-<proxy>
    storage: str | None = None  # null: SQLite in search_dir; any URL that Optuna takes
    search_dir: str | None = None  # null: runs/search-<study>
    timeout: float | None = option(None, positive("no trial would start"))  # s; none starts later
    heartbeat: int = option(15, counts("workers must show that they live"))  # s
    # The best trials that are tried again, as the best score of many is the luckiest too: on the
    # real task after a search on a proxy (null: 10), else with seeds that are new (null: 5).
    verify: int | None = option(None, counts("the best are tried again", least=0))
    fresh_seeds: int = option(5, counts("the best are tried again with them"))

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.max_generations >= self.min_generations,
            "max_generations",
            f"must be at least min_generations={self.min_generations}, because none is pruned "
            f"before; got {shortened(self.max_generations)}. Set "
            f"max_generations={9 * self.min_generations}.",
        )


@dataclass(frozen=True, kw_only=True)
class Search:
    """What is searched.

    Attributes:
      config: the search's own fields.
      fixed: overrides of all trials.
      space: dimensions by the field's name.
      machines: where trials are run: a plugin's configuration.
    """

    config: SearchConfig
    fixed: tuple[str, ...]
    space: dict[str, spaces.Dimension]
    machines: Any

    @property
    def is_of_agent(self) -> bool:
        """Whether agents are tuned on a stored proxy; else proxies are learned."""
        name = self.choice("proxy", "se")
        return name not in registry.names("proxy") and ":" not in name

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
            return registry.name_of("agent", configuration.evaluate_config(choices).agent)
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

    @property
    def joins(self) -> bool:
        """Whether the overrides only name a study that exists."""
        given, default = to_plain(self.config), to_plain(SearchConfig())
        changed = {k for k, v in given.items() if v != default[k]} - OWN - {"study"}
        return self.config.study is not None and not (changed or self.fixed or self.space)

    def stored(self) -> dict[str, Any]:
        """What the workers of a study must have in common, as plain values."""
        return {
            "search": _common(to_plain(self.config)),
            "fixed": list(self.fixed),
            "space": {name: x.text for name, x in self.space.items()},
            "folder": str(self.folder.resolve()),
        }

    def joined(self, stored: Any) -> "Search":
        """The search that a study stores, with this worker's own fields.

        Its folder is that of the study's maker only where the worker's storage is a file in it, as
        a study could name any folder otherwise.

        Raises:
          ConfigError: if the study holds what no search stores, overrides that would write or
            import what the user has not typed, or another search than was asked for.
        """
        stored = _checked(stored)
        if not self.joins:
            _require_same(self, stored)
        search_dir, url = self.config.search_dir, self.config.storage or ""
        beside = str(Path(url.removeprefix(SQLITE)).parent.resolve())
        if search_dir is None and url.startswith(SQLITE) and stored["folder"] == beside:
            search_dir = beside
        return dataclasses.replace(
            self,
            config=dataclasses.replace(self.config, **stored["search"], search_dir=search_dir),
            fixed=tuple(stored["fixed"]),
            space={name: spaces.parse(name, text) for name, text in stored["space"].items()},
        )


def _common(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in fields.items() if k not in {*OWN, "space", "study"}}


def _checked(stored: Any) -> dict[str, Any]:
    """What a study stores, with the fields that an older version did not have.

    Raises:
      ConfigError: as of `Search.joined`.
    """
    match stored:
        case {"search": dict(own), "fixed": list(fixed), "space": dict(space), "folder": str()}:
            pass
        case _:
            own, fixed, space = {}, [None], {}
    overrides = [*fixed, *(f"{name}={text}" for name, text in space.items())]
    for override in overrides:
        name, _, text = str(override).partition("=")
        is_known = isinstance(override, str) and compose.NAME.fullmatch(name)
        writes = name.partition(".")[0] in (*TAKEN, "machines")
        reads = name == "preset" and preset_files.ENDING in text
        require(
            is_known and not (writes or reads) and not registry.untyped([override]),
            "study",
            "must hold choices and fields alone, without modules that you have not typed, because "
            f"its overrides are read as if you had typed them; got {shortened(override)}. Set "
            "study=NAME, another one, or repeat its overrides if you trust it.",
        )
    default = _common(to_plain(SearchConfig()))
    return stored | {"search": default | {k: v for k, v in own.items() if k in default}}


def _require_same(search: Search, stored: Mapping[str, Any]) -> None:
    asked = search.stored()
    differing = sorted(
        name
        for part in ("search", "space")
        for name in stored[part].keys() | asked[part].keys()
        if stored[part].get(name) != asked[part].get(name)
    )
    differing += sorted(set(stored["fixed"]) ^ set(asked["fixed"]))
    require(
        not differing,
        "study",
        "must be new or of the same search, because its trials are compared with each other; got "
        f"{search.study}, which differs in {', '.join(differing)[:80]}. Set study=NAME, or give "
        "study and storage alone to join.",
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
    values, fixed, space = {}, [], {}
    machines = {"name": "local"}
    choices = [  # a comma makes a sweep elsewhere
        f"{name}=choice({text})" if len(split(text)) > 1 else f"{name}{equals}{text}"
        for name, equals, text in (override.partition("=") for override in overrides)
    ]
    for name, given in compose.read(choices).items():
        text = given if isinstance(given, str) else as_text(given)
        override, value = f"{name}={text}", parsed(text)
        is_text = name in TEXTS and value is not None and not isinstance(value, str)
        require(
            name not in TAKEN,
            name,
            f"must be left out, because the search sets it for each trial; got {shortened(text)}. "
            f"Set {TAKEN.get(name, f'{name}=VALUE')}.",
        )
        if name in own:
            values[name] = text if is_text else value
        elif name.partition(".")[0] == "machines":
            machines[name.partition(".")[2] or "name"] = value
        elif spaces.is_range(text):
            space[name] = spaces.parse(name, text)
        else:
            fixed.append(override)
    config = from_plain(SearchConfig, values, "")
    where = registry.configure("machines", machines)
    registry.require_package("machines", where)
    search = Search(config=config, fixed=tuple(fixed), space=space, machines=where)
    require(
        search.choice("proxy", "se") != "real",
        "proxy",
        "must be learned, or be one to tune agents on, because trials on the real task cost what "
        "a proxy saves; got real. Set proxy=cartpole, or env=cartpole proxy=se.",
    )
    if config.space is None:
        return search
    given = {override.partition("=")[0] for override in fixed} | set(space)
    preset = spaces.preset(config.space, search.agent, search.is_of_agent)
    offered = {name: x for name, x in preset.items() if name not in given}
    foreign = registry.untyped(x.text for x in offered.values())
    require(
        not foreign,
        "space",
        "must name no module, because only what you type is imported; got "
        f"{shortened(', '.join(foreign))}. Set agent='choice(...)' on the command line.",
    )
    return dataclasses.replace(search, space={**offered, **space})


def require_fields(search: Search, config: Any) -> dict[str, Any]:
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
        "must be given, or ranges of fields, because there is nothing to search otherwise; got "
        "none. Set space=paper_se, or es.noise_std='tag(log, interval(0.01, 0.3))'.",
    )
    groups = EvaluateConfig.groups if search.is_of_agent else LearnConfig.groups
    values = flatten(configuration.plain(config))
    values |= {group: values.get(f"{group}.name") for group in groups}
    for name in search.space:
        if name not in values:
            close = nearest(name, values)[0]
            raise ConfigError(
                f"{name} must be a field of the trials, because it is searched; got one that they "
                f"do not have. Did you mean {close}?",
                name,
            )
    return {name: values[name] for name in search.space}


def help_text() -> str:
    """What `--help` prints."""
    values = {
        "sampler": SAMPLERS,
        "pruner": PRUNERS,
        "score": SCORES,
        "measure": MEASURES,
        "space": (*spaces.names(), "FILE.yaml"),
    }
    fields = "\n".join(
        f"  {name}: {'null' if default is None else default}"
        + (f"  ({', '.join(values[name])})" if name in values else "")
        for name, default in to_plain(SearchConfig()).items()
    )
    return f"""Search hyperparameters with Optuna; a trial is a run, its generations the budget.
With proxy=RUN_DIR, a file or a shipped name: those of an agent that is trained on that proxy.

  python -m sejax.search env=cartpole es.noise_std='tag(log, interval(0.01, 0.3))'
  python -m sejax.search env=cartpole preset=paper space=paper_se trials=60
  python -m sejax.search proxy=cartpole agent=ppo space=agent
  python -m sejax.search study=NAME storage=URL   # one more worker

Fields:
{fields}

All other overrides are those of python -m sejax.run (with a proxy: sejax.evaluate). Searched are
choice(a,b), range(1,9,2), interval(0,1), int(interval(1,10)), tag(log, ...), and
tag(log, inverse, ...) in 1 - x. The same command goes on where it stopped."""
