"""Configurations of one kind of agent that share a compiled program: drawn, and trained for real.

What they set are numbers that the program takes as arguments. Networks and batches have room for
the largest of them.
"""

import dataclasses
import functools
import time
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sejax.cli import config as configuration
from sejax.cli.config import LearnConfig
from sejax.landscapes import PREFIX
from sejax.options import as_text, is_number, marks, require, shortened
from sejax.options.plain import to_plain

if TYPE_CHECKING:  # which take long to import, or need Optuna
    import jax
    import pandas as pd

    from sejax.cli.spaces import Dimension

CHUNK = 64  # most trainings of one call of the program


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One kind of agent.

    Attributes:
      name: of the agent.
      stream: of random numbers; those of two names are independent.
      config: of a run with it, whose agent has room for all configurations.
      space: what configurations set, by field.
      values: what each sets, `[config]`, by option.
    """

    name: str
    stream: str
    config: LearnConfig
    space: dict[str, "Dimension"]
    values: dict[str, np.ndarray]


def kind_of(
    name: str,
    base: Sequence[str],
    space: Mapping[str, "Dimension"],
    *,
    configs: int,
    steps: int,
    seed: int | None = None,
    stream: str | None = None,
    exact: Collection[str] = (),
) -> Kind:
    """A kind of agent and the configurations that are drawn for it.

    A configuration depends on the seed, the stream and its own number alone.

    Args:
      name: of the agent.
      base: overrides of `sejax.run`. Options of its agent that count steps are those of a training
        of `training.max_steps`, and are scaled.
      space: what configurations set, by field.
      configs: number of configurations.
      steps: of a training on the real task.
      seed: of the draws; None for that of `base`.
      stream: see `Kind`; None for the agent's name.
      exact: fields of the agent that are not scaled.

    Raises:
      ConfigError: for overrides that cannot be, ranges of what a compiled program does not take as
        an argument, and values that an agent does not take.
    """
    from sejax.ranking import SIZES, scaled

    words = [*base, f"agent={name}"]
    plain = configuration.config(words)
    cls = type(plain.agent)
    for field, dimension in space.items():
        option = field.removeprefix(PREFIX)
        is_argument = option in SIZES or marks(cls, option).get("traced")
        require(
            field.startswith(PREFIX) and is_argument and is_number(dimension.at(0.0)),
            field,
            "must be a number of the agent that compiled programs take as an argument, or its "
            f"hidden_size or batch_size; got {shortened(dimension.text)}. Leave it out, or fix it.",
        )
    stream = name if stream is None else stream
    rng = np.random.default_rng([plain.seed if seed is None else seed, zlib.crc32(stream.encode())])
    quantiles = rng.random((configs, len(space)))
    values = {
        field.removeprefix(PREFIX): np.array([x.at(u) for u in quantiles[:, i]])
        for i, (field, x) in enumerate(space.items())
    }
    factor = steps / (plain.training.max_steps or steps)
    for option, default in to_plain(plain.agent).items():
        is_exact = f"{PREFIX}{option}" in exact
        value = default if is_exact else scaled(cls, option, default, factor)
        if option in SIZES and option in values:
            value = _largest(space[f"{PREFIX}{option}"])
        if value != default:
            words.append(f"{PREFIX}{option}={as_text(value)}")
    for option, x in values.items():  # the rules of an option hold between two values that obey
        for end in (x.min(), x.max()):
            configuration.config([*words, f"{PREFIX}{option}={end}"])
    config = configuration.config(words)
    return Kind(name=name, stream=stream, config=config, space=dict(space), values=values)


def _largest(dimension: "Dimension") -> int:
    """The largest whole number that a size is drawn from."""
    drawn: Any = dimension.distribution
    choices = getattr(drawn, "choices", None)
    return max(int(x) for x in choices) if choices else int(drawn.high)


# --- trainings on the real task ------------------------------------------------------------------

Place = tuple[int, int]  # configuration and seed of a training


def chunks_of(places: Sequence[Place], size: int) -> list[Sequence[Place]]:
    """At most `size` trainings each."""
    return [places[start : start + size] for start in range(0, len(places), size)]


def train(
    kind: Kind, places: Sequence[Place], steps: int, test_episodes: int
) -> Iterator["pd.DataFrame"]:
    """Trains agents on the real task; yields rows of a landscape, those of a chunk at a time.

    Args:
      kind: of agent.
      places: of the trainings.
      steps: of each.
      test_episodes: greedy ones after it.
    """
    if places:
        trained = make_chunk_trainer(kind, steps, test_episodes, min(CHUNK, len(places)))
        yield from map(trained, chunks_of(places, CHUNK))


def make_chunk_trainer(
    kind: Kind, steps: int, test_episodes: int, size: int
) -> Callable[[Sequence[Place]], "pd.DataFrame"]:
    """Builds what trains at most `size` agents in one call of a program: rows of a landscape."""
    import jax
    import pandas as pd

    program, keys = program_of(kind, steps, test_episodes)

    def of_places(filled: np.ndarray) -> tuple[jax.Array, dict[str, np.ndarray]]:
        values = {name: x[filled[:, 0]].astype(np.float32) for name, x in kind.values.items()}
        return keys(filled), values

    @functools.cache
    def compiled() -> Any:
        return program.lower(*of_places(np.zeros((size, 2), int))).compile()

    def train_chunk(places: Sequence[Place]) -> pd.DataFrame:
        compute = compiled()
        filled = np.array([places[i % len(places)] for i in range(size)])
        started = time.process_time()
        found = jax.device_get(compute(*of_places(filled)))
        cpu_s = (time.process_time() - started) / len(places)
        rows = pd.DataFrame(places, columns=["config", "seed"])
        rows.insert(0, "agent", kind.name)
        for name, x in kind.values.items():
            rows[f"{PREFIX}{name}"] = x[rows["config"]]
        for name, x in found.items():
            rows[name] = x[: len(places)]
        rows["cpu_s"] = round(cpu_s, 4)
        return rows

    return train_chunk


def program_of(
    kind: Kind, steps: int, test_episodes: int
) -> tuple[Any, Callable[[np.ndarray], "jax.Array"]]:
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
        stop_rule="never", max_steps=steps, max_episodes=steps, test_episodes=test_episodes
    )
    root = jax.random.fold_in(jax.random.key(config.seed), zlib.crc32(kind.stream.encode()))

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


def stored(path: Path, card: Mapping[str, Any], option: str, fix: str) -> "pd.DataFrame":
    """The rows that a file has of a landscape; none if it is not there.

    Args:
      path: the file.
      card: of the landscape.
      option: the field that says where the file is, and how to set it, for messages.
      fix: what to do about a file of another landscape, for messages.

    Raises:
      ConfigError: if it is of another landscape.
    """
    import pandas as pd

    from sejax import landscapes

    if not path.exists():
        return pd.DataFrame(columns=landscapes.KEYS)
    before, table = landscapes.read_table(path, option)
    differing = sorted(
        name for name in card if name != "versions" and before.get(name) != card[name]
    )
    require(
        not differing,
        option,
        f"must be new or of the same landscape; got {path}, which differs in "
        f"{shortened(', '.join(differing))}. {fix}",
    )
    return table
