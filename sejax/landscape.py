"""`python -m sejax.landscape`: measure what configurations of agents reach on a real task."""

import dataclasses
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sejax.cli import commands, runtime
from sejax.cli import config as configuration
from sejax.cli.config import LearnConfig
from sejax.ops.files import as_file_name
from sejax.options import (
    ConfigError,
    Options,
    as_text,
    counts,
    help_texts,
    marks,
    option,
    registry,
    require,
    shortened,
)
from sejax.options.plain import fields_of, from_plain, parsed, split, to_plain

if TYPE_CHECKING:  # which take long to import, or need Optuna
    import jax
    import pandas as pd

    from sejax.cli.spaces import Dimension

CHUNK = 64  # trainings between two writings of the file
ABOUT = """Measure what configurations of agents reach on a real task, in one CSV file.

  python -m sejax.landscape env=cartpole agent=ddqn configs=64 seeds=8 steps=10000
  python -m sejax.landscape env=pendulum agent=[sac,ppo] file=pendulum.csv

Configurations are drawn from `space`, or from ranges as of sejax.search; other fields are those of
sejax.run with preset=ranking. The same command goes on where it stopped.
"""


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


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One kind of agent.

    Attributes:
      name: of the agent.
      config: of a run with it, whose agent has room for all configurations.
      space: what configurations set, by field.
      values: what each sets, `[config]`, by option.
    """

    name: str
    config: LearnConfig
    space: dict[str, "Dimension"]
    values: dict[str, np.ndarray]


def main(overrides: Sequence[str]) -> None:
    """Measures the landscape that the overrides describe, or what is missing of it.

    Raises:
      ConfigError: for overrides that cannot be, or a file of another landscape.
      OSError: if a file cannot be written.
    """
    import filelock

    from sejax import landscapes

    own, kinds = read(overrides)
    path = Path(own.file or Path("runs", f"landscape-{_name(kinds)}.csv"))
    path.parent.mkdir(parents=True, exist_ok=True)
    card = card_of(own, kinds)
    try:
        with filelock.FileLock(path.with_name(f"{path.name}.lock"), timeout=0):
            done = stored(path, card)
            runtime.configure_jax()
            for kind in kinds:
                done = measure(own, kind, path, card, done)
    except filelock.Timeout as error:
        raise ConfigError(
            f"file must be written by one command at a time; got {path}. Set file=FILE.csv.", "file"
        ) from error
    except KeyboardInterrupt:
        print(f"Interrupted. What has ended is in {path}; the same command goes on from there.")
        commands.leave(commands.INTERRUPTED)
    for found in landscapes.read(path, "file").values():
        means = found.mean_returns
        print(
            f"{found.agent}: {found.size} configurations reach {means.min():.1f} to "
            f"{means.max():.1f}, half of them {np.median(means):.1f} or more."
        )
    print(f"{path} holds every training.")


def read(overrides: Sequence[str]) -> tuple[LandscapeConfig, list[Kind]]:
    """The command's fields, and the kinds of agents with their configurations.

    Raises:
      ConfigError: for overrides that cannot be.
    """
    if find_spec("optuna") is None:
        raise ConfigError("spaces need Optuna. Install it with pip install 'sejax[search]'.")
    from sejax.cli import spaces

    names = [field.name for field in dataclasses.fields(LandscapeConfig)]
    values, ranges, rest, asked = {}, {}, [], ["ddqn"]
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
    return own, [kind_of(own, name, base, ranges) for name in asked]


def kind_of(own: LandscapeConfig, name: str, base: Sequence[str], ranges: dict[str, str]) -> Kind:
    """A kind of agent and the configurations that are drawn for it.

    A configuration depends on the seed, the agent's name and its own number alone.

    Raises:
      ConfigError: for ranges of what a compiled program does not take as an argument.
    """
    from sejax.cli import spaces
    from sejax.ranking import scaled

    words = [*base, f"agent={name}"]
    offered = spaces.preset(own.space, name, True, own.steps)
    fixed = {word.partition("=")[0] for word in base}
    space = {field: x for field, x in offered.items() if field not in fixed}
    space |= {field: spaces.parse(field, text, own.steps) for field, text in ranges.items()}
    plain = configuration.config(words)
    cls = type(plain.agent)
    for field in space:
        option_name = field.removeprefix("agent.")
        is_size = option_name in ("hidden_size", "batch_size")
        require(
            field.startswith("agent.") and (is_size or marks(cls, option_name).get("traced")),
            field,
            "must be a number of the agent that compiled programs take as an argument, or its "
            f"hidden_size or batch_size; got {shortened(space[field].text)}. Leave it out.",
        )
    rng = np.random.default_rng([plain.seed, zlib.crc32(name.encode())])
    quantiles = rng.random((own.configs, len(space)))
    values = {
        field.removeprefix("agent."): np.array([x.at(u) for u in quantiles[:, i]])
        for i, (field, x) in enumerate(space.items())
    }
    factor = own.steps / (plain.training.max_steps or own.steps)
    for option_name, default in to_plain(plain.agent).items():
        value = scaled(cls, option_name, default, factor)
        if option_name in ("hidden_size", "batch_size") and option_name in values:
            value = int(values[option_name].max())
            high = spaces_high(space[f"agent.{option_name}"])
            value = max(value, high)
        if value != default:
            words.append(f"agent.{option_name}={as_text(value)}")
    return Kind(name=name, config=configuration.config(words), space=space, values=values)


def spaces_high(dimension: "Dimension") -> int:
    """The largest whole number that a size is drawn from."""
    drawn: Any = dimension.distribution
    choices = getattr(drawn, "choices", None)
    return max(int(x) for x in choices) if choices else int(drawn.high)


def _name(kinds: Sequence[Kind]) -> str:
    agents = configuration.JOINT.join(kind.name for kind in kinds)
    return as_file_name(f"{kinds[0].config.name('env')}-{agents}")


def card_of(own: LandscapeConfig, kinds: Sequence[Kind]) -> dict[str, Any]:
    """What a file says of its landscape."""
    first = kinds[0].config
    return {
        "task": first.task().name,
        "env": registry.describe("env", first.env),
        "steps": own.steps,
        "test_episodes": own.test_episodes,
        "configs": own.configs,
        "seeds": own.seeds,
        "first_seed": own.first_seed,
        "seed": first.seed,
        "agents": {kind.name: to_plain(kind.config.agent) for kind in kinds},
        "space": {kind.name: {field: x.text for field, x in kind.space.items()} for kind in kinds},
        "versions": runtime.versions(),
    }


def stored(path: Path, card: dict[str, Any]) -> "pd.DataFrame":
    """The rows that a file has of a landscape.

    Raises:
      ConfigError: if it is of another landscape.
    """
    import pandas as pd

    from sejax import landscapes

    if not path.exists():
        return pd.DataFrame()
    before, table = landscapes.read_table(path, "file")
    differing = sorted(
        name for name in card if name != "versions" and before.get(name) != card[name]
    )
    require(
        not differing,
        "file",
        f"must be new or of the same landscape; got {path}, which differs in "
        f"{shortened(', '.join(differing))}. Set file=FILE.csv, another one.",
    )
    return table


def measure(
    own: LandscapeConfig, kind: Kind, path: Path, card: dict[str, Any], done: "pd.DataFrame"
) -> "pd.DataFrame":
    """Trains what is missing of one kind of agent, and writes the file after each chunk."""
    import jax
    import pandas as pd

    from sejax import landscapes

    have = set()
    if len(done):
        mine = done[done["agent"] == kind.name]
        have = set(zip(mine["config"], mine["seed"], strict=True))
    seeds = range(own.first_seed, own.first_seed + own.seeds)
    places = [(c, s) for c in range(own.configs) for s in seeds if (c, s) not in have]
    if not places:
        return done
    program, keys = _program(own, kind)
    compiled = None
    for start in range(0, len(places), CHUNK):
        some = places[start : start + CHUNK]
        filled = np.array([some[i % len(some)] for i in range(CHUNK)])
        values = {name: np.float32(x[filled[:, 0]]) for name, x in kind.values.items()}
        compiled = compiled or program.lower(keys(filled), values).compile()
        started = time.process_time()
        found = jax.device_get(compiled(keys(filled), values))
        cpu_s = (time.process_time() - started) / len(some)
        rows = pd.DataFrame(some, columns=["config", "seed"])
        rows.insert(0, "agent", kind.name)
        for name, x in kind.values.items():
            rows[f"{landscapes.PREFIX}{name}"] = x[rows["config"]]
        for name, x in found.items():
            rows[name] = x[: len(some)]
        rows["cpu_s"] = round(cpu_s, 4)
        done = pd.concat([done, rows], ignore_index=True)
        landscapes.write(path, card, _sorted(done, list(card["agents"])))
        print(
            f"{kind.name}: {len(have) + start + len(some)} of {own.configs * own.seeds} trainings, "
            f"mean return {rows['return'].mean():.1f}",
            flush=True,
        )
    return done


def _sorted(rows: "pd.DataFrame", agents: list[str]) -> "pd.DataFrame":
    order = rows["agent"].map(agents.index)
    return rows.assign(order=order).sort_values(["order", "config", "seed"]).drop(columns="order")


def _program(own: LandscapeConfig, kind: Kind) -> tuple[Any, Callable[..., "jax.Array"]]:
    """The jitted trainings of a chunk, and their keys by configuration and seed."""
    import jax
    import jax.numpy as jnp

    from sejax.agents import make_agent
    from sejax.evaluation import make_evaluator, num_parallel_on_cpu
    from sejax.ops.parallel import compiler_options, spread_over_devices
    from sejax.ranking import hparams_of
    from sejax.training import TrainingConfig

    config, task = kind.config, kind.config.task()
    agent = make_agent(config.agent, task, config.exploration)
    training = TrainingConfig(
        stop_rule="never",
        max_steps=own.steps,
        max_episodes=own.steps,
        test_episodes=own.test_episodes,
    )
    root = jax.random.fold_in(jax.random.key(config.seed), zlib.crc32(kind.name.encode()))

    def one(key: jax.Array, values: dict[str, jax.Array]) -> dict[str, jax.Array]:
        configured = dataclasses.replace(agent, hparams=hparams_of(agent, values))
        outcome = make_evaluator(configured, task.env, task, training)(key, task.params)
        return {
            "return": jnp.where(outcome.nonfinite, jnp.nan, outcome.test_return),
            "nonfinite": outcome.nonfinite.astype(int),
            "real_steps": outcome.real_steps,
        }

    spread = spread_over_devices(
        one, config.devices, config.num_parallel, num_parallel_on_cpu(agent, training)
    )

    def keys(places: np.ndarray) -> jax.Array:
        fold = jax.vmap(lambda c, s: jax.random.fold_in(jax.random.fold_in(root, c), s))
        return fold(*places.T)

    return jax.jit(spread, compiler_options=compiler_options()), jax.jit(keys)


def help_text(overrides: Sequence[str]) -> str:
    """What `--help` prints."""
    texts = help_texts(LandscapeConfig)
    lines = [
        f"  {name}={as_text(to_plain(default))}  # {texts.get(name, '')}"
        for name, default in fields_of(LandscapeConfig).items()
    ]
    return "\n".join([ABOUT, "Its own fields, with their defaults:", *lines])


if __name__ == "__main__":
    commands.start(main, help_text)
