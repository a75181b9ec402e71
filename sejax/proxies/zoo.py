"""The proxies that ship with the package: what they are, what they teach and what they cost.

Their files are read without JAX. `tools/ship_proxy.py` writes them, `tools/make_zoo.py` makes
`docs/zoo.md` of them.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sejax import registry, serialize
from sejax.proxies import stored


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Fresh agents of one kind, all trained in one world and tested on the real task.

    Attributes:
      agent: the kind, such as `ddqn`.
      hparams: default, varied (drawn for each agent) or as_learned (those it was learned with).
      world: where they trained: proxy, or real, the task itself.
      num_agents: how many.
      return_mean: of the agents' mean test returns, in the task's unit.
      return_std: likewise.
      train_steps: of each agent's training, in the mean.
    """

    agent: str
    hparams: str
    world: str
    num_agents: int
    return_mean: float
    return_std: float
    train_steps: float


@dataclass(frozen=True, kw_only=True)
class Learning:
    """The run that a proxy comes from, and what all of it cost.

    Attributes:
      command: that repeats it.
      generations: of the outer loop.
      agents: that were trained.
      train_steps: of their trainings, which for an SE never touch the real task.
      real_steps: on the real task, in tests too.
      cpu_s: CPU seconds, compilation included.
    """

    command: str
    generations: int
    agents: int
    train_steps: int
    real_steps: int
    cpu_s: float


@dataclass(frozen=True, kw_only=True)
class PretrainedProxy:
    """What is known of a proxy.

    Attributes:
      name: that `sejax.load` knows it by.
      kind: se or rn.
      task: that it stands in for.
      scores: the incumbent's mean score with each family of agents that it was learned with, in the
        generation that it is of; for an SE a test return. None of them if it was not recorded.
      objective: what they score; "" if it was not recorded.
      generation: that one; None likewise.
      seed: of its run; None likewise.
      horizon: steps of its episodes at most; None for the task's limit.
      initial_state: of its episodes: real, learned or noise.
      ends: what ends them: horizon, the done output (soft, threshold, bernoulli, sigmoid) or real.
      evaluations: of fresh agents.
      learning: its run; None if it was not recorded.
      size_kb: of the file, in 1,000 bytes.
      card: all of this in Markdown, as it stands in the file.
    """

    name: str
    kind: str
    task: str
    scores: dict[str, float]
    objective: str = ""
    generation: int | None
    seed: int | None
    horizon: int | None
    initial_state: str
    ends: str
    evaluations: tuple[Evaluation, ...] = ()
    learning: Learning | None = None
    size_kb: float
    card: str = field(default="", repr=False)

    @property
    def agents(self) -> tuple[str, ...]:
        """The families of agents that it was learned with."""
        return tuple(self.scores)

    @property
    def on_proxy(self) -> tuple[Evaluation, ...]:
        """The evaluations of agents that trained on it, and not on the real task."""
        return tuple(each for each in self.evaluations if each.world == "proxy")


class Zoo(tuple[PretrainedProxy, ...]):
    """Proxies, which print as a table."""

    def __repr__(self) -> str:
        rows = [_HEAD, *(_row(proxy) for proxy in self)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [
            "  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
        return "\n".join(lines)


def pretrained() -> Zoo:
    """The proxies that ship with the package, by name; `sejax.load(name)` loads one.

    Example:
      >>> [proxy.name for proxy in pretrained() if proxy.kind == "se"][:2]
      ['acrobot', 'cartpole']
    """
    names = stored.pretrained_names()
    return Zoo(describe(stored.PRETRAINED_DIR / f"{name}.safetensors") for name in names)


def describe(path: Path, name: str | None = None) -> PretrainedProxy:
    """What a file of one proxy says of it.

    Args:
      path: of the file.
      name: of the proxy; the file's if None.

    Raises:
      ConfigError: if it is damaged, or of another format.
    """
    _, header = stored.read(path, "source")
    config, record = header["config"], header["proxies"][0]
    scores = record.get("scores")
    if scores is None and "score" in record:
        scores = dict.fromkeys(stored.learned_agents(config), record["score"])
    return PretrainedProxy(
        name=name or path.stem,
        kind=str(config["proxy"].get("name")),
        task=header["task"],
        scores=scores or {},
        objective=str((config.get("objective") or {}).get("name", "")),
        generation=record.get("generation"),
        seed=record.get("seed"),
        evaluations=tuple(
            serialize.from_plain(Evaluation, each, "evaluation")
            for each in record.get("evaluations", ())
        ),
        learning=serialize.from_plain(Learning, record["learning"], "learning")
        if "learning" in record
        else None,
        size_kb=path.stat().st_size / 1000,
        card=record.get("card", ""),
        **_world(config["proxy"]),
    )


def _world(config: Mapping[str, Any]) -> dict[str, Any]:
    """Of which kind the episodes are."""
    if config.get("name") != "se":
        return {"horizon": None, "initial_state": "real", "ends": "real"}
    se = registry.configure("proxy", config)
    ends = "horizon" if se.horizon == 1 else se.done
    return {"horizon": se.horizon, "initial_state": se.initial_state, "ends": ends}


# --- as a table ----------------------------------------------------------------------------------

_HEAD = ("name", "kind", "task", "learned with", "tested with", "return", "steps", "CPU s", "kB")


def _row(proxy: PretrainedProxy) -> tuple[str, ...]:
    tested = dict.fromkeys(each.agent for each in proxy.on_proxy)
    return (
        proxy.name,
        proxy.kind,
        proxy.task,
        " ".join(proxy.agents),
        " ".join(tested),
        spread([each.return_mean for each in proxy.on_proxy], ".1f"),
        spread([each.train_steps for each in proxy.on_proxy], ",.0f"),
        f"{proxy.learning.cpu_s:,.0f}" if proxy.learning else "",
        f"{proxy.size_kb:.1f}",
    )


def spread(values: list[float], spec: str) -> str:
    """The lowest and the highest of some numbers; nothing if there are none.

    Example:
      >>> spread([199.5, 180.0], ".1f"), spread([4000.0, 4000.2], ",.0f")
      ('180.0 to 199.5', '4,000')
    """
    ends = [format(end(values), spec) for end in (min, max)] if values else []
    return " to ".join(text for text, _ in itertools.groupby(ends))
