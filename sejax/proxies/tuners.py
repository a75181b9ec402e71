"""The tuners that ship with the package: sets of SEs that rank configurations of agents.

Read without JAX. `tools/ship_tuner.py` writes their files.
"""

from dataclasses import dataclass
from typing import Any

from sejax.options.plain import from_plain
from sejax.proxies import header
from sejax.proxies.zoo import table

TRANSFER = 2  # times as long trainings of kinds of agents that no SE was learned with


@dataclass(frozen=True, kw_only=True)
class Ranked:
    """How a tuner ranks configurations of one kind of agent that took no part in its making.

    Attributes:
      agent: name of the kind, such as `ddqn`.
      configs: number of configurations.
      rho: Spearman's correlation with their returns on the real task.
      rho_low: lower end of its 95% interval (BCa, over configurations).
      rho_high: upper end.
      rho_process: rho of a Gaussian process on as many configurations of the tuner's own kind, in
        the ranges of those that are ranked, over the options that both kinds share.
      regret: the highest return less that of the tuner's first, in the task's unit.
      regret_process: that of the Gaussian process's first.
      regret_chance: that of a random one on average.
    """

    agent: str
    configs: int
    rho: float
    rho_low: float
    rho_high: float
    rho_process: float
    regret: float
    regret_process: float
    regret_chance: float


@dataclass(frozen=True, kw_only=True)
class Tuner:
    """What a tuner's file tells about it.

    Attributes:
      name: name that `sejax.load_set` and `sejax.search` know it by.
      task: name of the task.
      ses: number of SEs.
      train_steps: of a training on one of them.
      agent: kind of agent whose configurations it was learned from.
      configs: number of these, those that judge included.
      seeds: trainings of each on the real task.
      steps: of a training on the real task.
      real_steps: of all of them, tests included.
      landscape: command that measures them.
      command: command that learns the SEs from them, in the file `landscape.csv`.
      cpu_s: CPU seconds of both, without compilation.
      chosen: what it was chosen from, and by what.
      ranked: how it ranks other configurations.
    """

    name: str
    task: str
    ses: int
    train_steps: int
    agent: str
    configs: int
    seeds: int
    steps: int
    real_steps: int
    landscape: str
    command: str
    cpu_s: float
    chosen: str
    ranked: tuple[Ranked, ...]

    @property
    def card(self) -> str:
        """The tuner's card, in Markdown."""
        facts = {
            "task": self.task,
            "SEs": str(self.ses),
            "a training on one": f"{self.train_steps:,} steps of {self.agent}, "
            f"{TRANSFER * self.train_steps:,} of other agents",
            "learned from": f"{self.configs} configurations of {self.agent}, each trained with "
            f"{self.seeds} seeds for {self.steps:,} steps",
            "steps on the real task": f"{self.real_steps:,}, once",
            "cost": f"{self.cpu_s:,.0f} CPU seconds, the landscape's included",
            "chosen": self.chosen,
        }
        rows = [{"property": name, "value": x} for name, x in facts.items()]
        found = [
            {
                "agent": x.agent,
                "configurations": str(x.configs),
                "rho": f"{x.rho:.2f} [{x.rho_low:.2f}, {x.rho_high:.2f}]",
                "rho, Gaussian process": f"{x.rho_process:.2f}",
                "regret": f"{x.regret:.1f}",
                "regret, Gaussian process": f"{x.regret_process:.1f}",
                "regret, chance": f"{x.regret_chance:.1f}",
            }
            for x in self.ranked
        ]
        return (
            f"# {self.name}\n\nA tuner for the task `{self.task}`: SEs on which configurations of "
            "an agent reach what ranks them as the real task does.\n\n"
            f"{table(rows)}\n\n## What it ranks\n\nConfigurations that took no part in learning or "
            "choosing. Rho: Spearman's correlation with their returns on the real task; regret: "
            "the highest of these less that of the first. The Gaussian process learns from as many "
            f"others of {self.agent}, in the ranges that are ranked, and trains nobody.\n\n"
            f"{table(found)}\n\n## How it was learned\n\n"
            f"    {self.landscape}\n    {self.command}\n\n## How to use it\n\n"
            f"    python -m sejax.search proxy={self.name} agent={self.agent}\n"
        )


def pretrained_tuners() -> tuple[Tuner, ...]:
    """The tuners that ship with the package, by name; `sejax.load_set(name)` loads one.

    Example:
      >>> [tuner.name for tuner in pretrained_tuners()]
      ['cartpole-tuner']
    """
    files = (header.TUNERS_DIR / f"{name}.safetensors" for name in header.tuner_names())
    return tuple(map(describe, map(header.read, files)))


def describe(stored: header.Stored) -> Tuner:
    """What a tuner's file tells about it; the record of its first SE speaks of all of them.

    Raises:
      ConfigError: for a file that does not tell it.
    """
    path, _, told = stored
    record: dict[str, Any] = dict(told.proxies[0].get("tuner") or {})
    own = {"name": path.stem, "task": told.task, "ses": len(told.proxies)}
    described: Tuner = from_plain(Tuner, {**record, **own}, "tuner")
    return described
