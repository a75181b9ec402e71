"""Who needs the dynamics: what agents that look ahead less learn on each stored and shipped SE.

An agent with a discount of 0 sees the reward of its next step alone. An SE that teaches it as well
as a far-sighted one is a policy in disguise, however long its episodes are; one that teaches the
far-sighted alone teaches through its dynamics.

On each SE, DDQN (TD3 for continuous actions) trains with each discount, with equal seeds, as long
and with the hyperparameters as it was learned with. R(d) is the return of agents with discount d on
the real task. Verdicts are those of `sejax.myopia.judge`, as in `python -m sejax.check`.
"""

import dataclasses
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

import sejax
from experiments.common import agents, figures, tables
from experiments.common.agents import Condition, Group
from experiments.common.experiment import Experiment, Settings, setting
from experiments.common.shards import stack, unstack
from experiments.common.statistics import worst_tenth
from sejax import Proxy, ProxySet, Task, TrainingConfig, envs
from sejax.myopia import MARGIN, judge
from sejax.options import Count, require
from sejax.options.plain import configure
from sejax.proxies import header

STORED = (  # below results/
    "soft_ses/*.safetensors",
    "se_feasibility/*/ses.safetensors",
)
DISCOUNTS = (0.0, 0.5, 0.9, 0.99)
UNTRAINED = "untrained"


@dataclass(frozen=True, kw_only=True)
class SeMyopia(Settings):
    """Settings of this experiment.

    Attributes:
      env: task of the SEs
      ses: Files of SEs, run directories or shipped names; all that are shipped and in results/.
      num_ses: the first SEs of each set
      num_agents: on each SE with each discount
      test_episodes: of each agent
      max_steps: of training; as the SE's configuration says
    """

    name = "se_myopia"

    env: str = setting("cartpole")
    ses: tuple[str, ...] = setting((), quick=("cartpole", agents.SOFT_SE))
    num_ses: Count = setting(5, quick=1)
    num_agents: Count = setting(20, quick=5)
    test_episodes: Count = setting(10)
    max_steps: Count | None = setting(None, quick=1000)


class Se(NamedTuple):
    """An SE of a set."""

    set: str
    ses: ProxySet
    proxy: Proxy


def find(settings: SeMyopia) -> Iterator[Se]:
    """The SEs that are tested."""
    files: list[str] = list(settings.ses)
    if not files:
        shipped = [proxy.name for proxy in sejax.pretrained() if proxy.kind == "se"]
        files = [*shipped, *(str(x) for name in STORED for x in sorted(Path("results").glob(name)))]
    for file in files:
        if header.read(file, "ses").header.config["env"]["name"] == settings.env:
            ses = sejax.load_set(file, option="ses", kind="se")
            for place in range(min(len(ses), settings.num_ses)):
                yield Se(set_name(file), ses, ses[place])


def set_name(file: str) -> str:
    """A file's name for people: of those that are one set, the folder that they are in."""
    if file in header.pretrained_files():
        return f"{file} (shipped)"
    ends = r"^results/|/ses\.safetensors$|/[^/]+/proxy\.safetensors$|\.safetensors$"
    return re.sub(ends, "", file)


def make_run(agent: Any, env: Any, task: Any, training: TrainingConfig) -> Any:
    """Builds `run(key, (discount, env_params), active) -> Outcome`, for all discounts."""

    def run(key: Any, params: tuple[Any, Any], active: Any) -> Any:
        discount, env_params = params
        hparams = agent.hparams.replace_innermost(discount=discount)
        sighted = dataclasses.replace(agent, hparams=hparams)
        return sejax.make_evaluator(sighted, env, task, training)(key, env_params, active)

    return run


MEASURE = dataclasses.replace(agents.OUTCOMES, make_run=make_run)


def agent_on(settings: SeMyopia, ses: ProxySet) -> Any:
    """DDQN, or TD3, as the set was learned with it; else as it is tuned for the task."""
    kind = agents.usual_kind(ses.task)
    for values in ses.config["agents"].values():
        if values["name"] == kind:
            return configure("agent", values)
    return agents.tuned_agent(settings.env, kind)


def compute(settings: SeMyopia) -> pd.DataFrame:
    """Trains what is missing; a row for each SE, and one for each agent."""
    found = list(find(settings))
    require(found, "ses", f"must hold SEs of {settings.env}; there are none. Set env=acrobot.")
    distinct: dict[str, Se] = {}
    for se in found:  # some SEs are in several files
        distinct.setdefault(se.proxy.fingerprint, se)
    programs: dict[Any, list[Se]] = {}
    for se in distinct.values():
        agent, limits = agent_on(settings, se.ses), (settings.test_episodes, settings.max_steps)
        training = agents.training_as_learned(se.ses, agent, *limits)
        programs.setdefault((se.ses.env.config, agent, training), []).append(se)
    tables = [untrained(settings, found[0].ses.task, agent_on(settings, found[0].ses))]
    for (_, agent, training), each in programs.items():
        condition = Condition(
            name="",
            env=each[0].ses.env,
            task=each[0].ses.task,
            groups=tuple(Group.of(se.proxy.fingerprint, se.proxy) for se in each),
            agent=agent,
            training=training,
            settings={"proxy": each[0].ses.config["proxy"]},
        )
        tables.append(train_with_discounts(settings, condition))
    return stack({"ses": pd.DataFrame(map(describe, found)), "agents": pd.concat(tables)})


def describe(se: Se) -> dict[str, Any]:
    """A row about an SE and its episodes."""
    config = se.ses.env.config
    return {
        "set": se.set,
        "group": se.proxy.fingerprint,
        "seed": se.proxy.record.get("seed", -1),
        "horizon": se.ses.env.max_steps,
        "at_limit": "ends" if config.horizon else "cut",
        "done": "-" if config.is_bandit else config.done,
        "initial_state": config.initial_state,
    }


def train_with_discounts(settings: Any, condition: Condition) -> pd.DataFrame:
    """Rows of the agents of a condition with each discount, in the column `discount`."""
    tables = []
    for discount in DISCOUNTS:
        pairs = [group._replace(params=(discount, group.params)) for group in condition.groups]
        sighted = dataclasses.replace(
            condition,
            name=f"{condition.name}{discount:g}",
            groups=tuple(pairs),
            settings=condition.settings | {"discount": discount},
        )
        rows = agents.train_groups(sighted, settings, settings.num_agents, MEASURE)
        tables.append(rows.assign(discount=discount))
    return pd.concat(tables, ignore_index=True)


def untrained(settings: Any, task: Task, agent: Any) -> pd.DataFrame:
    """Agents that trained for one step, tested on the real task."""
    condition = Condition.real(
        task,
        [UNTRAINED],
        name=UNTRAINED,
        agent=agent,
        training=TrainingConfig(
            max_steps=1, max_episodes=1, stop_rule="never", test_episodes=settings.test_episodes
        ),
    )
    return agents.train_groups(condition, settings, settings.num_agents)


def verdicts(agents: pd.DataFrame, floor: float, solved_reward: float) -> pd.DataFrame:
    """A row for each SE: what it loses with the least discount, and what it is.

    Args:
      agents: rows with the columns `group`, `discount`, `agent` and `test_return`.
      floor: mean return of untrained agents.
      solved_reward: of the task.

    Returns:
      The columns `group`, `loss` (mean difference of returns) with the ends of its interval
      `loss_low` and `loss_high`, and `verdict`.
    """
    found = []
    for group, rows in agents.groupby("group", sort=False):
        returns = rows.pivot(index="agent", columns="discount", values="test_return")
        judgement = judge(returns.iloc[:, 0], returns.iloc[:, -1], floor, solved_reward)
        loss, low, high = judgement.loss, judgement.low, judgement.high
        columns = {"loss": loss, "loss_low": low, "loss_high": high, "verdict": judgement.verdict}
        found.append({"group": group, **columns})
    return pd.DataFrame(found)


def summarise(ses: pd.DataFrame, agents: pd.DataFrame, solved_reward: float) -> pd.DataFrame:
    """A row for each set of SEs, with columns for each discount (`return_0_5_mean`)."""
    is_untrained = agents["group"] == UNTRAINED
    floor = agents[is_untrained]["test_return"].mean()
    agents = agents[~is_untrained]
    judged = verdicts(agents, floor, solved_reward)
    far = agents[agents["discount"] == agents["discount"].max()]

    def statistics(mine: pd.DataFrame) -> dict[str, Any]:
        verdict = judged[judged["group"].isin(mine["group"])]["verdict"].value_counts()
        lasted = far[far["group"].isin(mine["group"])]
        columns: dict[str, Any] = {
            **mine.iloc[0][["horizon", "at_limit", "done", "initial_state"]],
            "num_ses": len(mine),
            "steps": lasted["train_steps"].sum() / lasted["train_episodes"].clip(lower=1).sum(),
            "verdict": ", ".join(
                name if len(mine) == 1 else f"{name} {count} of {len(mine)}"
                for name, count in verdict.items()
            ),
            "untrained": floor,
        }
        own = agents[agents["group"].isin(mine["group"])]
        for discount, at in own.groupby("discount"):
            returns = at["test_return"]
            name = column(discount)
            columns |= tables.mean_columns(returns, name, at["group"] if len(mine) > 1 else None)
            columns[f"{name}_worst"] = worst_tenth(returns)
        return columns

    return tables.summary_by(ses, ["set"], statistics)


def report(settings: SeMyopia, rows: pd.DataFrame) -> pd.DataFrame:
    task = envs.make(settings.env)
    summary = summarise(unstack(rows, "ses"), unstack(rows, "agents"), task.solved_reward)
    draw(settings, summary)
    shown: dict[str, Any] = {
        "SEs": lambda row: name_of(row.set),
        "number": "{num_ses}",
        "horizon": "{horizon:.0f} ({at_limit})",
        "terminations": "{done}",
        "initial states": "{initial_state}",
        "steps of an episode": "{steps:.1f}",
    }
    for discount in DISCOUNTS:
        shown[f"discount {discount:g}"] = cell(column(discount))
    shown["verdict"] = "{verdict}"
    table = tables.as_texts(summary, shown)
    kind = figures.agent_name(agents.usual_kind(task))
    least, most = DISCOUNTS[0], DISCOUNTS[-1]
    untrained = summary["untrained"].iloc[0]
    none = MARGIN * (task.solved_reward - untrained)
    note = (
        f"{settings.num_agents} {kind} on each SE with each discount. Cells: mean return on "
        f"{task.name} (mean of the worst tenth). "
        f"{tables.interval_note('SEs, agents where there is one SE')} Steps of an episode: mean "
        f"over the training of agents with discount {most:g}. Verdict on each SE, by differences "
        f"of {none:.3g}, {MARGIN:.0%} of the way from untrained agents ({untrained:.1f}) to the "
        f"solved return ({task.solved_reward:g}). Dynamics: discounts {most:g} and {least:g} "
        "differ by more. Policy: by less. Teaches little: the far-sighted are less than that above "
        "untrained ones. Open: the intervals hold both."
    )
    title = f"Which SEs of {task.name} teach agents that look ahead less"
    return tables.publish(settings, title, table, summary, note)


def name_of(ses: str) -> str:
    """A set of SEs as people write it."""
    return NAMES.get(ses.rpartition("/")[2].partition("-")[2], ses)


def column(discount: float) -> str:
    """Name of the columns about agents with this discount."""
    return f"return_{discount:g}".replace(".", "_")


def cell(name: str) -> Any:
    """What agents with one discount reach."""
    mean = tables.mean_text(name, 1)
    return lambda row: f"{mean(row)} ({getattr(row, f'{name}_worst'):,.1f})"


def draw(settings: SeMyopia, summary: pd.DataFrame) -> None:
    """Mean returns against discounts: a line for each set."""
    task = envs.make(settings.env)
    with figures.panels(settings.folder / "myopia.png", 1, 1, (7.6, 3.8)) as (figure, [[axes]]):
        for row in summary.to_dict("records"):
            means = [row[f"{column(discount)}_mean"] for discount in DISCOUNTS]
            axes.plot(range(len(DISCOUNTS)), means, "o-", ms=4, lw=1.4, label=name_of(row["set"]))
        figures.threshold(axes, task.solved_reward, f"solved ({task.solved_reward:g})")
        axes.set_xticks(range(len(DISCOUNTS)), [f"{x:g}" for x in DISCOUNTS])
        axes.set(xlabel="discount of the agents", ylabel=f"mean return on {task.name}")
        figure.legend(loc="outside right center", fontsize=8)


NAMES = {  # of sets, by the folders of se_feasibility
    "fixed": "preset=soft",
    "varied": "preset=soft, random hyperparameters",
    "one-step": "one step",
    "one-step-varied": "one step, random hyperparameters",
    "paper": "preset=paper",
    "performance": "preset=paper_performance",
}
KINDS = ("policy", "dynamics", "open", "teaches little")  # of verdicts
EXPERIMENT = Experiment(settings=SeMyopia, compute=compute, report=report, about=__doc__)

if __name__ == "__main__":
    EXPERIMENT.main()
