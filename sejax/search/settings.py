"""The words of a search: its own fields, what it searches, and what stays fixed."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from sejax import registry, serialize
from sejax.cli import build, compose
from sejax.cli.words import ENDING, FIELD
from sejax.errors import ConfigError, nearest, require
from sejax.ops.files import as_file_name
from sejax.options import Options, counts, one_of, option, positive
from sejax.search import spaces

SAMPLERS = ("tpe", "random")
PRUNERS = ("hyperband", "median", "none")
SCORES = ("mean", "worst")
SQLITE = "sqlite:///"  # of a URL, before a file's path
MEASURES = ("last", "best", "mean")
# Fields that are text, whatever YAML takes it for: study=2024-01-01.
TEXTS = ("study", "storage", "search_dir", "space")
# Fields of the command that are the search's, and which of its own to set in their place.
TAKEN = {
    "generations": "max_generations=27",
    "num_seeds": "seeds=3",
    "run_dir": "search_dir=FOLDER",
    "out_dir": "search_dir=FOLDER",
    "checkpoint_every": "min_generations=3",
}
# Fields that may differ between the workers of a study, and between its sessions.
FREE_FIELDS = (
    "trials",
    "timeout",
    "storage",
    "search_dir",
    "sampler_seed",
    "verify",
    "fresh_seeds",
)


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
    seeds: int = option(1, counts("a trial needs a run"))  # runs of a trial, in one program
    score: str = option("mean", one_of(SCORES))  # of a trial, over its seeds
    # What a seed counts for. last: its last generation's score; best: its best so far; mean: the
    # mean of all so far, which rewards learning early. null: last for a proxy, mean for an agent.
    measure: str | None = option(None, one_of(MEASURES))
    space: str | None = None  # a preset of ranges; a file of one's own
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
            f"be at least min_generations={self.min_generations}",
            "none is pruned before",
            self.max_generations,
            f"max_generations={9 * self.min_generations}",
        )


@dataclass(frozen=True, kw_only=True)
class Search:
    """What is searched.

    Attributes:
      config: the search's own fields.
      fixed: words for all trials.
      space: dimensions by the field's name.
      machines: where this process has trials made: a plugin's configuration.
    """

    config: SearchConfig
    fixed: tuple[str, ...]
    space: dict[str, spaces.Dimension]
    machines: Any

    @property
    def is_of_agent(self) -> bool:
        """Whether agents are tuned on a proxy that exists, in the place of how to learn one."""
        name = self.choice("proxy", "se")
        return name not in registry.names("proxy") and ":" not in name

    @property
    def num_verified(self) -> int:
        """How many of the best are tried again."""
        usual = 10 if self.is_of_agent else 5
        return usual if self.config.verify is None else self.config.verify

    @property
    def measure(self) -> str:
        return self.config.measure or ("mean" if self.is_of_agent else "last")

    def choice(self, group: str, default: str) -> str:
        """What the fixed words choose of a group."""
        chosen = [w.partition("=")[2] for w in self.fixed if w.startswith(f"{group}=")]
        return chosen[-1] if chosen else default

    @functools.cached_property
    def agent(self) -> str:
        """The name of the agent: what is said, or what the task and the proxy choose."""
        said = self.choice("agent", "")
        choices = [word for word in self.fixed if "." not in word.partition("=")[0]]
        if self.is_of_agent and not said:
            return registry.name_of("agent", compose.evaluate_config(choices).agent)
        return said or compose.config(choices).name("agent")

    @property
    def study(self) -> str:
        """The study's name."""
        return self.config.study or self._default_name()

    @property
    def folder(self) -> Path:
        return Path(self.config.search_dir or Path("runs", f"search-{as_file_name(self.study)}"))

    @property
    def storage(self) -> str:
        """URL of the database."""
        return self.config.storage or f"{SQLITE}{self.folder / 'study.db'}"

    def stored(self) -> dict[str, Any]:
        """What the workers of a study must have in common, as plain values."""
        return {
            "search": _common(serialize.to_plain(self.config)),
            "fixed": list(self.fixed),
            "space": {name: x.text for name, x in self.space.items()},
            "folder": str(self.folder.resolve()),
        }

    @classmethod
    def from_stored(cls, stored: dict[str, Any], config: SearchConfig, machines: Any) -> "Search":
        """Inverse of `stored`, with the free fields of a worker's own configuration.

        Its folder is that of the study's maker only where the worker's storage is a file in it.
        Else a study could name any folder to be written to.

        Raises:
          ConfigError: if the study holds words that a search does not take, or that would import
            what the user has not typed.
        """
        _require_plain_words(stored)
        search_dir, url = config.search_dir, config.storage or ""
        beside = str(Path(url.removeprefix(SQLITE)).parent.resolve())
        if search_dir is None and url.startswith(SQLITE) and stored["folder"] == beside:
            search_dir = beside
        return cls(
            config=dataclasses.replace(config, **stored["search"], search_dir=search_dir),
            fixed=tuple(stored["fixed"]),
            machines=machines,
            space={name: spaces.parse(name, text) for name, text in stored["space"].items()},
        )

    @property
    def names_study_alone(self) -> bool:
        """Whether the words ask for nothing but to join a study that exists."""
        usual = serialize.to_plain(SearchConfig())
        given = serialize.to_plain(self.config)
        asked = {k for k, v in given.items() if v != usual[k]} - {*FREE_FIELDS, "study"}
        return self.config.study is not None and not (asked or self.fixed or self.space)

    def _default_name(self) -> str:
        if self.is_of_agent:
            proxy = Path(self.choice("proxy", "")).name
            return f"{self.agent}-on-{proxy.removesuffix('.safetensors')}"
        return "-".join([self.choice("env", "cartpole"), self.choice("proxy", "se"), self.agent])


def completed(stored: Any) -> dict[str, Any]:
    """What a former version stored of a search, with the fields of today.

    Raises:
      ConfigError: if it is not what a search stores.
    """
    match stored:
        case {"search": dict(own), "fixed": list(fixed), "space": dict(space), "folder": str()}:
            texts = [*own, *fixed, *space, *space.values()]
            if all(isinstance(text, str) for text in texts):
                usual = _common(serialize.to_plain(SearchConfig()))
                return stored | {"search": usual | {k: v for k, v in own.items() if k in usual}}
    raise ConfigError(
        "study must be one that sejax.search has made, because its words are read; "
        "got another. Set study=NAME, a new one."
    )


def _require_plain_words(stored: Mapping[str, Any]) -> None:
    """Checks the words that a study holds, which somebody else may have written.

    Raises:
      ConfigError: for one that sets what a search sets itself, is Hydra's own, or names a module
        that the user has not typed.
    """
    words = [*stored["fixed"], *(f"{name}={text}" for name, text in stored["space"].items())]
    for word in words:
        name = word.partition("=")[0].lstrip("+")
        is_field = FIELD.fullmatch(name) and name.partition(".")[0] not in (*TAKEN, "machines")
        is_field = is_field and not (name == "preset" and ENDING in word)  # stored are its words
        require(
            is_field,
            "study",
            "hold choices and fields alone",
            "its words are read as if you had typed them",
            word,
            "study=NAME, another one",
        )
    foreign = registry.untyped(words)
    require(
        not foreign,
        "study",
        "name no module that you have not typed",
        "what a study names is never imported",
        ", ".join(foreign),
        "all words of the search on the command line again, if you trust the module",
    )


def _common(fields: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in fields.items() if k not in (*FREE_FIELDS, "space", "study")}


def read(words: Sequence[str]) -> Search:
    """A search from the words of its command line.

    Words that name a field of `SearchConfig` set it; sweeps in Hydra's syntax are searched; the
    rest stays fixed, those of a preset file too. A field that is fixed, or has a space of its own,
    is left out of `space=`.

    Raises:
      ConfigError: for a bad value, a word that cannot be read, or a space that cannot be searched.
    """
    own = {field.name for field in dataclasses.fields(SearchConfig)}
    values, fixed, swept = {}, [], {}
    machines = {"name": "local"}
    for word in compose.hydra_words(words):
        name, equals, text = word.partition("=")
        if equals and name in own:
            value = compose.parsed(text)
            is_text = name in TEXTS and value is not None and not isinstance(value, str)
            values[name] = text if is_text else value
            continue
        if name.partition(".")[0] == "machines":
            machines[name.partition(".")[2] or "name"] = compose.parsed(text)
            continue
        override = _parsed(word)
        require(
            name not in TAKEN,
            name,
            "be left out",
            "the search sets it for each trial",
            text,
            TAKEN.get(name, ""),
        )
        if override.is_sweep_override():
            swept[override.get_key_element()] = spaces.parse(override.get_key_element(), text)
        else:
            fixed.append(word)
    config = serialize.from_plain(SearchConfig, values, "")
    search = Search(config=config, fixed=tuple(fixed), space=swept, machines=_machines(machines))
    require(
        search.choice("proxy", "se") != "real",
        "proxy",
        "be learned, or be one to tune agents on",
        "trials on the real task cost what a proxy saves",
        "real",
        "proxy=cartpole, or env=cartpole proxy=se",
    )
    if config.space is None:
        return search
    preset = spaces.preset(config.space, search.agent, search.is_of_agent)
    given = {word.partition("=")[0] for word in fixed} | set(swept)
    offered = {name: x for name, x in preset.items() if name not in given}
    foreign = registry.untyped(x.text for x in offered.values())
    require(
        not foreign,
        "space",
        "name no module",
        "only what you type is imported",
        ", ".join(foreign),
        "agent='choice(...)' on the command line",
    )
    return dataclasses.replace(search, space={**offered, **swept})


def _machines(values: dict[str, Any]) -> Any:
    one_of(("local", "ray"))("machines", values["name"], "local")
    machines = registry.configure("machines", values)
    registry.require_package("machines", machines, "trials are made there")
    return machines


def _parsed(word: str) -> Override:
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException as error:
        raise ConfigError(
            f"A word must read name=value, because the search is made of them; got {word} "
            f"({' '.join(str(error).split())[:200]}). Put what is more than a word in quotes: "
            f"'name=tag(log, interval(0.01, 0.3))'."
        ) from error


def fields_of(search: Search, config: Any) -> dict[str, Any]:
    """Values of all fields of the command, of its choices too, by their names on the command line.

    Args:
      search: what is searched.
      config: of the command with the fixed words alone.
    """
    groups = build.EVALUATE_GROUPS if search.is_of_agent else build.LEARN_GROUPS
    values = serialize.flatten(build.to_plain(config))
    return {**{group: values.get(f"{group}.name") for group in groups}, **values}


def require_fields(search: Search, config: Any) -> None:
    """Checks that what is searched are fields of the command.

    Args:
      search: what is searched.
      config: of the command with the fixed words alone.

    Raises:
      ConfigError: if one is not.
    """
    known = fields_of(search, config)
    for name in search.space:
        if name not in known:
            close = nearest(name, known)[:5]
            raise ConfigError(
                f"{name} must be a field of the trials, because it is searched; got one that they "
                f"do not have. Did you mean {close[0]}? Others: {', '.join(close[1:])}."
            )


def help_text() -> str:
    """What `--help` prints."""
    about = {
        "sampler": SAMPLERS,
        "pruner": PRUNERS,
        "score": SCORES,
        "measure": MEASURES,
        "space": (*spaces.names(), "FILE.yaml"),
    }
    fields = "\n".join(
        f"  {name}: {'null' if value is None else value}"
        + (f"  ({', '.join(about[name])})" if name in about else "")
        for name, value in serialize.to_plain(SearchConfig()).items()
    )
    return f"""Search hyperparameters with Optuna; a trial is a run, its generations the budget.
With proxy=RUN_DIR, a file or a shipped name: those of an agent that is trained on that proxy.

  python -m sejax.search env=cartpole es.noise_std='tag(log, interval(0.01, 0.3))'
  python -m sejax.search env=cartpole preset=paper space=paper_se trials=60
  python -m sejax.search proxy=cartpole agent=ppo space=agent
  python -m sejax.search study=NAME storage=URL   # one more worker

Fields:
{fields}

All other words are those of python -m sejax.run (with a proxy: sejax.evaluate); sweeps among them
are searched: choice(a,b), range(1,9,2), interval(0,1), int(interval(1,10)), tag(log, ...), and
tag(log, inverse, ...) in 1 - x. The same command goes on where it stopped."""
