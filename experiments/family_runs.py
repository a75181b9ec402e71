"""What the experiments share that learn SEs with some families of agents and test them with others.

A set of families is written as in file names, `ddqn+ppo`. Agents are configured for tests as for
learning: by the preset, and by words such as `run.agents.ppo.epochs=10`.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

import sejax
from experiments import budgets, proxy_runs
from experiments.proxy_runs import RunSettings
from experiments.settings import count, each_of, setting
from experiments.tables import iqm_columns, spread
from experiments.worlds import HPARAMS, World, groups_at_once, train_groups
from sejax import registry
from sejax.cli.families import JOINT, key_of
from sejax.options import positive

# A little world and agents that learn enough to be seen moving.
QUICK = [
    "es.population_size=12",
    "es.num_incumbent_evals=6",
    "training.max_steps=1000",
    "proxy.hidden_size=32",
]
QUICK_AGENT = {"hidden_size": 32, "batch_size": 32, "num_layers": 1, "warmup_episodes": 1}


@dataclass(frozen=True, kw_only=True)
class FamilyRuns(RunSettings):
    """Settings about SEs that are learned and tested with families of agents."""

    runs: int = count(5, "runs", quick=2, about="NES runs of each, of the same seeds everywhere")
    tested: tuple[str, ...] = setting((), about="families of agents that SEs are tested with")
    tested_hparams: tuple[str, ...] = setting(
        HPARAMS,
        each_of(HPARAMS),
        quick=("default",),
        about="their hyperparameters; varied: drawn for each",
    )
    num_agents: int = count(10, "agents", quick=4, about="of each family on each SE")
    test_episodes: int = count(10, "episodes", about="of each agent")
    cpu_budget_s: float | None = setting(
        None,
        positive("it is time"),
        about="CPU seconds after which a run ends, without compilation",
    )

    def config_with(self, names: Sequence[str], others: Iterable[str], words: Any = ()) -> Any:
        """The configuration of NES runs with these families.

        Args:
          names: of the families.
          others: further ones, about which `run` may hold words; these are left out.
          words: overrides beside those of `run`, which win.
        """
        foreign = tuple(f"agents.{key_of(name)}." for name in others if name not in names)
        own = dataclasses.replace(
            self, run=tuple(word for word in self.run if not word.startswith(foreign))
        )
        chosen = [f"agents=[{','.join(names)}]", *words]
        if self.cpu_budget_s is not None and self.generations is None:
            chosen.append(f"generations={budgets.UNLIMITED}")
        if self.quick:
            chosen += QUICK
            for name in names:
                known = registry.defaults("agent", name)
                chosen += [
                    f"agents.{key_of(name)}.{field}={value}"
                    for field, value in QUICK_AGENT.items()
                    if field in known
                ]
        return own.learn_config(chosen)


def learn(settings: FamilyRuns, name: str, config: Any) -> tuple[pd.DataFrame, Any]:
    """Learns the SEs of some runs: curves with the column `cpu_s`, and the set of the best ones."""
    runs = proxy_runs.configs_of_runs(config, settings.runs, settings.work_folder / "runs" / name)
    curves = proxy_runs.learn_all(runs, learn=budgets.timed(settings.cpu_budget_s))
    path = settings.folder / f"{name}.safetensors"
    proxy_runs.collect(runs, path)
    return curves, sejax.load_set(path)


def evaluate(settings: FamilyRuns, name: str, ses: Any, config: Any) -> pd.DataFrame:
    """Agents of one family on each SE of a set, a row each; columns `kind`, `hparams` and `seed`.

    Args:
      settings: how many agents.
      name: of the set, in the names of files.
      ses: the set.
      config: `config_with` the family; agents train as long as it says.
    """
    (family,) = config.agents.families
    training = dataclasses.replace(config.training, test_episodes=settings.test_episodes)
    seeds = {f"{name}-{seed:02d}-{ses.fingerprint(i)}": seed for i, seed in enumerate(ses.seeds)}
    tables = []
    for hparams in settings.tested_hparams:
        world = World.of_set(
            ses,
            seeds,
            name=f"{family.key}-{hparams}",
            agent=family.agent,
            training=training,
            hparams=hparams,
        )
        rows = train_groups(
            world, settings, settings.num_agents, at_once=groups_at_once(settings.devices)
        )
        tables.append(rows.assign(kind=family.key, hparams=hparams, seed=rows["group"].map(seeds)))
    return pd.concat(tables, ignore_index=True)


def summarise(agents: pd.DataFrame, by: list[str], solved_reward: float) -> pd.DataFrame:
    """Statistics of the returns (`test_return_...`) for each value of the columns `by`.

    The mean's interval draws SEs, of which there must be five, and agents where there is one SE;
    that of the interquartile mean draws agents within their SE.
    """
    rows = []
    for values, mine in agents.groupby(by, sort=False):
        returns = mine["test_return"]
        of_ses = returns.groupby(mine["seed"]).mean()
        rows.append(
            dict(zip(by, values, strict=True))
            | {
                "num_ses": len(of_ses),
                "num_agents": len(mine),
                **spread(returns, of_ses if len(of_ses) > 1 else returns, "test_return"),
                **iqm_columns(returns, "test_return", mine["seed"]),
                "solved": (returns >= solved_reward).mean(),
            }
        )
    return pd.DataFrame(rows)


def families_in(name: str) -> list[str]:
    """The families of a set's name."""
    return name.split(JOINT)


def known_families(names: Iterable[str]) -> list[str]:
    """All families in some sets' names, each once."""
    return list(dict.fromkeys(family for name in names for family in families_in(name)))
