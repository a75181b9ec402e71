"""Is a learned environment more than a policy? Four comparisons and a verdict.

  python -m sejax.check proxy=RUN_DIR
  python -m sejax.check proxy=cartpole num_agents=40 'algorithms=[sac]'

- Myopia: the agents that it was learned with, at discounts 0, 0.5 and 0.9. Left out if episodes
  have one step, where a discount has no effect.
- Algorithms: other agents than those that it was learned with.
- Null baseline: for an SE, the same agents on a one-step SE made of a cheap policy; for a reward
  network (RN), the same agents without it, and tuned agents.
- Cost: how many agents must train on it to save the real steps that learning it took.

Hyperparameters are fixed, also if it was learned with random ones.
Writes check.json and check.png into out_dir. The same command resumes where it stopped.
"""

import contextlib
import dataclasses
import functools
import json
from collections.abc import Sequence
from math import ceil
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias

import jax
import pandas as pd
import yaml
from pydantic import Field

from sejax import agents
from sejax.distill.policies import CopyConfig, copy_policy
from sejax.distill.policy_search import PolicySearchConfig, search_policies
from sejax.distill.teaching import diverged_last
from sejax.envs.base import Task
from sejax.myopia import ENOUGH, Judgement, judge, verdict_of
from sejax.ops.files import as_file_name, write_text
from sejax.ops.scores import reaches
from sejax.options import LARGEST, Count, as_text, registry, require
from sejax.options.plain import configure, plugin, to_plain
from sejax.proxies import header, zoo
from sejax.proxies.exact import make_exact
from sejax.proxies.io import Proxy
from sejax.runs import commands, fresh_agents, plots, presets
from sejax.runs.chunks import Pool
from sejax.runs.command_config import PLACES
from sejax.runs.config import MachinesConfig
from sejax.runs.fresh_agents import REAL_TRAINING, FreshAgentsConfig, World
from sejax.runs.store import Store
from sejax.training import TrainingConfig

DISCOUNTS = (0.0, 0.5, 0.9)  # beside the agents' own
# Mania et al. (2018) search the hyperparameters for each task; here all tasks share them.
ARS: dict[str, Any] = {"num_starts": 1, "num_directions": 16, "num_top": 8, "noise_std": 0.3}
ARS |= {"step_size": 0.3, "policy_error": 0.0, "num_tests": 10, "test_every": 1}
# Rows of the table.
MYOPIC, OWN, OTHERS = "the proxy, discount {:g}", "the proxy", "the proxy, other algorithms"
NULL, TASK, TUNED, NOTHING = "the null SE", "the real task", "the real task, tuned", "nothing"
SHOWN = {"return": ("test_return", 1), "training steps": ("train_steps", 0)}
Agents: TypeAlias = dict[str, agents.AgentConfig]  # by key


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckConfig(FreshAgentsConfig):
    """What `sejax.check` takes.

    Attributes:
      machines: where agents train
      agent_hparams: as_learned: agents and exploration that the proxy was learned with, if no
        agent is named; default: the agent's.
      algorithms: Other agents than those it was learned with, with default hyperparameters; null:
        all that fit the task.
      out_dir: null: runs/check-<proxy>
      null_steps: real steps, at least one generation, of a random search for a policy, and of a PPO
        that follows if the search does not solve the task
    """

    free = (*PLACES, "num_agents")

    machines: MachinesConfig = plugin("machines")
    algorithms: tuple[str, ...] | None = None
    null_steps: Count = 200_000
    num_agents: Annotated[int, Field(ge=ENOUGH, le=LARGEST)] = 20
    agent_hparams: Literal["default", "as_learned"] = "default"
    real_training: TrainingConfig = dataclasses.replace(REAL_TRAINING, max_steps=20_000)

    @property
    def default_folder(self) -> str:
        """The folder, named by the proxy."""
        return f"runs/check-{as_file_name(self.proxy.removesuffix('.safetensors'))}"


# --- the command ----------------------------------------------------------------------------------


def main(overrides: Sequence[str]) -> None:
    """Checks a proxy as the overrides say.

    Raises:
      ConfigError: for invalid overrides, or a proxy that cannot be judged.
      OSError: if a file cannot be written.
    """
    findings(CheckConfig.of_words(overrides))


help_text = functools.partial(commands.help_of, CheckConfig, __doc__)


def check(proxy: str | Path, **fields: object) -> dict[str, Any]:
    """Tells whether a learned environment is more than a policy, like `python -m sejax.check`.

    Args:
      proxy: a run directory, a file, or a shipped name.
      **fields: fields of the command, such as `num_agents=40`.

    Returns:
      What `check.json` holds: `verdict`, `judgements` by agent, `null_se`, `cost` and `worlds`.

    Raises:
      ConfigError: for an invalid field, or a proxy that cannot be judged.
    """
    words = [f"{name}={as_text(value)}" for name, value in {"proxy": proxy, **fields}.items()]
    return findings(CheckConfig.of_words(words))


def findings(config: CheckConfig) -> dict[str, Any]:
    """Trains the agents whose results are missing, and reports the findings; see `check`."""
    proxy = _judgeable(config)
    rows = _rows_on_proxy(config, proxy)
    rows_on_task = _rows_on_task(config, proxy)
    settings = config.plain() | {"task": proxy.task.origin, "discount": proxy.discount}
    settings["proxy"] = {"weights": proxy.fingerprint} | to_plain(proxy.env.config, "proxy")
    for name, row in (rows | rows_on_task).items():
        settings[name] = to_plain(row.config.agents, "agent"), to_plain(row.world.trainings)
    store = Store(config.folder, settings, field="out_dir", free=config.free)
    with store, config.machines.pool() as pool:
        store.once("check", dict)  # settings are compared, whatever `num_agents` is
        table = _trained(rows, store, pool)
        null: dict[str, Any] = {}
        if not proxy.env.has_real_dynamics and proxy.task.num_states is None:
            world, null = _null(config, proxy.task, store)
            rows_on_task = {NULL: _row_on_null(world, rows, table)} | rows_on_task
        table = pd.concat([table, _trained(rows_on_task, store, pool)], ignore_index=True)
        return _reported(proxy, null, [*config.agents], table, config.folder)


def _judgeable(config: CheckConfig) -> Proxy:
    """The proxy, if all that a check needs is there; else it raises `ConfigError`."""
    require(config.proxy != "real", "proxy", "must be a learned one; got real. Set proxy=RUN_DIR.")
    proxy = fresh_agents.loaded(config)
    task = proxy.task
    is_idle = proxy.env.has_real_dynamics and config.training_from != "proxy"
    require(not is_idle, "training_from", "must be left out for an RN. Set real_training.*.")
    jax.eval_shape(task.env.reset_env, jax.random.key(0), task.params)  # raises if it cannot run
    require(task.is_solvable, "env", f"must have a solved score; got {task.name}, which has none.")
    have_one = all(hasattr(agent, "discount") for agent in config.agents.values())
    require(have_one, "agent", "must have a discount", got=", ".join(config.agents), use="NAME")
    zoo.describe(header.read(proxy.path))  # raises if a record of its file cannot be printed
    return proxy


# --- who trains where -----------------------------------------------------------------------------


class Row(NamedTuple):
    """A row of the table: the configuration of its agents, and the world that they train in."""

    config: CheckConfig
    world: World


def _rows_on_proxy(config: CheckConfig, proxy: Proxy) -> dict[str, Row]:
    """Myopic agents, the proxy's own ones, and those of other algorithms.

    Raises:
      ConfigError: if one of them does not fit the task, or would learn nothing.
    """
    own: dict[str, Any] = config.agents
    students: dict[str, Agents] = {}
    if proxy.env.max_steps > 1:  # in one step a discount has no effect
        for discount in DISCOUNTS:
            myopic = {key: dataclasses.replace(x, discount=discount) for key, x in own.items()}
            students[MYOPIC.format(discount)] = myopic
    students[OWN] = own
    if others := _others(config, proxy.task):
        students[OTHERS] = others
    rows = {}
    for name, of_row in students.items():
        row_config = dataclasses.replace(config, agents=of_row)
        trainings = {key: fresh_agents.training_on(proxy, row_config, key) for key in of_row}
        rows[name] = Row(row_config, World(proxy.env, proxy.params, proxy.task, trainings))
    return rows


def _rows_on_task(config: CheckConfig, proxy: Proxy) -> dict[str, Row]:
    """Agents on the real task: those of the proxy, a tuned one, and one that learns nothing."""
    task = proxy.task
    first = dict([*config.agents.items()][:1])
    students = {TASK: config.agents if proxy.env.has_real_dynamics else first}
    students |= {TUNED: {"tuned": _tuned(task)}, NOTHING: first}
    rows = {}
    for name, of_row in students.items():
        training = config.real_training if name != NOTHING else _of_length(1, config.real_training)
        world = World(task.env, task.params, task, dict.fromkeys(of_row, training))
        rows[name] = Row(dataclasses.replace(config, agents=of_row), world)
    return rows


def _row_on_null(world: World, rows: dict[str, Row], table: pd.DataFrame) -> Row:
    """The proxy's own agents and the others on a null SE, for their mean steps on the proxy."""
    steps = table.groupby(["world", "agent"])["train_steps"].mean()
    students: Agents = {}
    trainings = {}
    for name in [name for name in (OWN, OTHERS) if name in rows]:
        students |= rows[name].config.agents
        for key, training in rows[name].world.trainings.items():
            trainings[key] = _of_length(ceil(steps[name, key]), training)
    config = dataclasses.replace(rows[OWN].config, agents=students)
    return Row(config, world._replace(trainings=trainings))


def _of_length(steps: int, training: TrainingConfig) -> TrainingConfig:
    """A training of so many steps, with the tests of another one."""
    return TrainingConfig(max_steps=steps, max_episodes=steps, test_episodes=training.test_episodes)


def _others(config: CheckConfig, task: Task) -> Agents:
    """Agents of algorithms that the proxy was not learned with.

    Raises:
      ConfigError: if one of them, or of the proxy's agents, does not fit the task.
    """
    learned = config.agents
    known = {*learned, *(registry.name_of("agent", agent) for agent in learned.values())}
    fitting = [x for x in agents.fitting(task) if x not in known]
    names = fitting if config.algorithms is None else config.algorithms
    wrong = [x for x in names if x in known or (":" not in x and x not in fitting)]
    rule = f"must be agents for {task.name} other than its own"
    require(not wrong, "algorithms", rule, got=", ".join(wrong), use=as_text(fitting))
    others = {x: configure("agent", {"name": x}, "algorithms") for x in names}
    for key, agent in (learned | others).items():
        field = config.group_of(key) if key in learned else "algorithms"
        agents.require_fit(agent, config.exploration, task, task.name, field)
    return others


def _tuned(task: Task) -> agents.AgentConfig:
    """An agent with the settings of `preset=best`, but one warm-up episode: SEs alone need more.

    Tabular agents have none, as by default.
    """
    name = agents.USUAL[task.actions][-1] if task.num_states is None else agents.default_for(task)
    beside = presets.sections_of(task.name, "se")["best"].get("with_agent", {}).get(name, {})
    warmup = {"warmup_episodes": int(task.num_states is None)}
    return configure("agent", beside.get("agent", {}) | {"name": name} | warmup)


def _null(config: CheckConfig, task: Task, store: Store) -> tuple[World, dict[str, Any]]:
    """A one-step SE made of a cheap policy, and where it comes from.

    A random search finds the policy. If it does not solve the task, a PPO is trained too, and the
    better policy is taken.

    Args:
      config: of the command.
      task: the real task.
      store: where the search is kept.
    """
    uses = ("search", "test", "record")
    keys = dict(zip(uses, jax.random.split(jax.random.key(config.seed), 3), strict=True))
    num_episodes = 2 * ARS["num_directions"] + 1 + ARS["num_tests"]  # of a generation
    generations = max(1, config.null_steps // (num_episodes * task.max_steps))
    fields = ARS | {"alive_bonus": (task.origin or {}).get("healthy_reward", 0.0)}
    search = PolicySearchConfig(**fields, generations=generations, until_solved=True)
    (lesson,), costs = search_policies(search, task, 1, keys, store, config.devices)
    method = "a random search"
    steps = costs["real_steps"].sum()
    if not reaches(lesson.policy_return, task.solved_reward):
        how = CopyConfig(agent_steps=config.null_steps)
        (other,), costs = copy_policy(how, task, "ppo", keys, store)
        steps += costs["real_steps"].sum()
        if other.policy_return > lesson.policy_return:
            method, lesson = "a PPO", other
    env, weights = make_exact(task, lesson.layers, lesson.states)
    about = {"policy_of": method, "return": lesson.policy_return, "real_steps": int(steps)}
    return World(env, env.params(weights), task, {}), about


def _trained(rows: dict[str, Row], store: Store, pool: Pool) -> pd.DataFrame:
    """A line for each agent. Missing results are computed, a row at a time, and stored."""
    tables = []
    for row, (config, world) in rows.items():
        names = {key: f"{as_file_name(row)}/{key}-{config.num_agents}" for key in config.agents}
        missing = [key for key, name in names.items() if store.get(name) is None]
        print(f"training on {row}: {', '.join(missing) or 'done'} ...", flush=True)
        computed = iter(pool(fresh_agents.train, [(config, world, key) for key in missing]))
        for key, name in names.items():
            columns = store.once(name, functools.partial(next, computed))
            tables.append(pd.DataFrame({"world": row, "agent": key, **columns}))
    return pd.concat(tables, ignore_index=True)


# --- what was found -------------------------------------------------------------------------------


def _reported(
    proxy: Proxy, null: dict[str, Any], learned: list[str], table: pd.DataFrame, folder: Path
) -> dict[str, Any]:
    """Prints and writes the findings."""
    task = proxy.task
    table = _scored(table, proxy)
    summary = fresh_agents.summarise(table, ["world"])
    judgements = _judgements(table, learned, proxy)
    # The dynamics of an RN are the task's.
    teaches = "its reward teaches" if proxy.env.has_real_dynamics else "its dynamics teach"
    verdict = verdict_of(judgements.values(), teaches)
    report = {"null_se": null, "cost": _cost(proxy, summary), "verdict": verdict}
    title = f"{proxy.path.stem}: return on {task.name}; % that solve it ({task.solved_reward:g})"
    printed = {name: x for name, x in report.items() if x}
    shares = table.groupby(["world", "agent"], sort=False)["solved"].mean().map("{:.0%}".format)
    shares = shares.reset_index("agent")
    solved = (shares["agent"] + " " + shares["solved"]).groupby("world").agg(", ".join)
    shown = summary.set_index(solved[summary.index], append=True)
    fresh_agents.print_table(shown, title, yaml.safe_dump(printed, sort_keys=False).strip(), SHOWN)
    report["judgements"] = {key: judgement._asdict() for key, judgement in judgements.items()}
    report["worlds"] = summary.assign(solved=solved).to_dict("index")
    write_text(folder / "check.json", json.dumps(report, indent=1) + "\n")
    plots.check(table, task.solved_reward, folder / "check.png", f"{proxy.path.stem}: {verdict}")
    return report


def _scored(table: pd.DataFrame, proxy: Proxy) -> pd.DataFrame:
    """The table with scores: returns for an SE, minus the training steps for an RN."""
    is_lost = table["nonfinite"] > 0
    returns = diverged_last(table["test_return"].mask(is_lost))
    steps = table["train_steps"].mask(is_lost, table["train_steps"].max())
    score = -steps if proxy.env.has_real_dynamics else returns
    solved = reaches(returns, proxy.task.solved_reward)
    return table.assign(test_return=returns, train_steps=steps, score=score, solved=solved)


def _judgements(table: pd.DataFrame, learned: list[str], proxy: Proxy) -> dict[str, Judgement]:
    """The myopia test of each algorithm that the proxy was learned with."""
    by_agent = table.groupby(["world", "agent"], sort=False)["score"]
    scores = {name: score.to_numpy() for name, score in by_agent}
    is_rn = proxy.env.has_real_dynamics
    top = 0.0 if is_rn else float(proxy.task.solved_reward)
    judgements = {}
    for key in learned:
        floor = scores[TASK, key] if is_rn else scores[NOTHING, learned[0]].mean()
        myopic = scores.get((MYOPIC.format(0), key), scores[OWN, key])
        judgements[key] = judge(myopic, scores[OWN, key], floor, top)
    return judgements


def _cost(proxy: Proxy, summary: pd.DataFrame) -> dict[str, Any]:
    """What learning the proxy cost, and how many agents must train on it to save its real steps.

    "never" if agents trained on the proxy do not reach the solved score. On the task the agents
    with fewer steps count, of those that reach it if any do.
    """
    learning = zoo.describe(header.read(proxy.path)).learning
    record: dict[str, Any] = vars(learning) if learning else {}  # of the file, else run.json
    with contextlib.suppress(OSError, ValueError, TypeError):
        record = record or dict(json.loads(proxy.path.with_name("run.json").read_text()))
    cost: dict[str, Any] = {x: record[x] for x in ("real_steps", "cpu_s") if record.get(x)}
    if "real_steps" in cost:
        steps, returns = summary["train_steps_mean"], summary["test_return_mean"]
        misses = ~reaches(returns, proxy.task.solved_reward)
        best = min((TASK, TUNED), key=lambda x: (misses[x], steps[x]))
        saved = steps[best] - (steps[OWN] if proxy.env.has_real_dynamics else 0)
        pays = saved > 0 and not misses[OWN]
        cost["agents_to_break_even"] = ceil(cost["real_steps"] / saved) if pays else "never"
    return cost


if __name__ == "__main__":
    commands.start(main, help_text)
