"""The agents by which `experiments.break_even` judges a proxy, and what learning it took."""

import dataclasses
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import Field

import sejax
from experiments.common import agents, curves
from experiments.common.agents import OUTCOMES, Condition, Group
from experiments.common.experiment import Settings, setting
from experiments.common.shards import stack
from sejax import Proxy, Task, TrainingConfig, options
from sejax.agents import AgentConfig
from sejax.options import Count, registry
from sejax.proxies.header import pretrained_files

NUM_GROUPS = 5  # of agents: the CPU seconds of a group are one value
COUNTS = (100, 20)  # agents of each sort, pilots of each kind
COUNTS_OF = {"halfcheetah": (20, 5)}
# Kinds of tuned agents: for discrete and continuous actions, and of tables.
DISCRETE, CONTINUOUS = ("ddqn", "ppo", "sac"), ("td3", "sac", "ppo")
TABLES = ("q_learning", "sarsa")
MOST_STEPS = {  # of an agent on the real task or an RN; 100,000 elsewhere
    "cliff_walking": 5_000,
    "acrobot": 50_000,
    "pendulum": 50_000,
    "mountain_car_continuous": 150_000,
    "halfcheetah": 150_000,
}
TIMED = dataclasses.replace(OUTCOMES, is_timed=True)
KEPT = ["group", "agent", "train_steps", "test_return", "nonfinite", "cpu_s"]
GRID_POINTS = 60


@dataclass(frozen=True, kw_only=True)
class BreakEven(Settings):
    """Settings of this experiment.

    Attributes:
      proxies: Proxies that ship with sejax.
      num_agents: Agents of each sort, in five groups; 100, on HalfCheetah 20.
      num_pilots: Of each kind that may be the fastest, and of learning curves; 20, on HalfCheetah
        5.
      max_steps: of an agent with real steps; by the task
      test_episodes: of each agent
      seed: first seed; pilots have the one 500 before
    """

    name = "break_even"

    proxies: tuple[str, ...] = setting(
        tuple(pretrained_files()), pretrained_files(), quick=("cliff_walking-rn",)
    )
    num_agents: Annotated[int, Field(ge=NUM_GROUPS)] | None = setting(None, quick=10)
    num_pilots: Count | None = setting(None, quick=2)
    max_steps: Count | None = setting(None, quick=3000)
    test_episodes: Count = setting(10)
    seed: options.WholeNumber = setting(1000)

    def counts(self, task: Task) -> tuple[int, int]:
        """How many agents of each sort, and how many pilots."""
        agents, pilots = COUNTS_OF.get(task.name, COUNTS)
        return self.num_agents or agents, self.num_pilots or pilots

    def limit(self, task: Task) -> int:
        """Training steps of an agent at most."""
        return self.max_steps or MOST_STEPS.get(task.name, 100_000)


def compute(settings: BreakEven) -> pd.DataFrame:
    """A row for each agent, learning curves of tuned agents, and what learning the proxies took."""
    users, drawn, costs = [], [], []
    for name in settings.proxies:
        study = Study(settings, sejax.load_proxy(name))
        users += [rows.assign(proxy=name) for rows in study.agents()]
        kind = users[-1]["kind"].iloc[0]
        drawn.append(study.curves(kind).assign(proxy=name))
        costs.append(costs_of(name))
    rows = {"agents": pd.concat(users), "curves": pd.concat(drawn), "costs": pd.DataFrame(costs)}
    return stack(rows)


def costs_of(name: str) -> dict[str, Any]:
    """What the card says of a proxy's run; None for what it leaves open."""
    card = agents.shipped(name)
    steps, cpu_s = (getattr(card.learning, x, None) for x in ("real_steps", "cpu_s"))
    costs = {"learning_steps": steps, "learning_cpu_s": cpu_s}
    return {"proxy": name, "of": card.kind, "task": card.task, **costs}


class Study:
    """The agents that a proxy is judged by.

    Attributes:
      target: return at which agents stop; for an SE known when its students have been tested.
    """

    def __init__(self, settings: BreakEven, proxy: Proxy):
        self.settings, self.proxy = settings, proxy
        self.task: Task = proxy.env.task
        self.num_agents, self.num_pilots = settings.counts(self.task)
        self.target = float(self.task.solved_reward)
        self.agent = next(iter(proxy.learned_agents().values()))
        self.kind = registry.name_of("agent", self.agent)

    def agents(self) -> Iterator[pd.DataFrame]:
        """A row for each agent; the last ones are tuned ones on the real task."""
        proxy, is_rn = self.proxy, self.proxy.env.has_real_dynamics
        if is_rn:
            more = {"exploration": proxy.learned_with("exploration")}
            training = self.until_solved(sejax.training_of(proxy).time_limit_is_terminal)
            yield self.row("student", self.kind, self.agent, training, **more)
        else:
            more = {}
            training = agents.training_as_learned(proxy, self.agent, self.settings.test_episodes)
            students = self.row("student", self.kind, self.agent, training)
            self.target = min(self.target, float(students["test_return"].mean()))
            yield students.assign(target=self.target)
            training = self.until_solved()
        yield self.row("same", self.kind, self.agent, training, **more)
        kind = yield from self.pilots()
        for role in ("tuned_student", "tuned") if is_rn else ("tuned",):
            yield self.row(
                role, kind, agents.tuned_agent(self.task.name, kind), self.until_solved()
            )

    def pilots(self) -> Generator[pd.DataFrame, None, str]:
        """Agents of each kind, one group of other seeds; returns the kind that is fastest."""
        seed = (self.settings.seed - 500) % 2**31
        settings = dataclasses.replace(self.settings, seed=seed)
        steps = {}
        for kind in kinds_for(self.task):
            agent = agents.tuned_agent(self.task.name, kind)
            condition = self.condition(f"pilot-{kind}", agent, self.until_solved(), num_groups=1)
            rows = agents.train_groups(condition, settings, self.num_pilots, TIMED)
            yield self.labelled(rows, "pilot", kind)
            steps[kind] = rows["train_steps"].mean()
        self.settings.shards.made_with |= settings.shards.made_with
        return min(steps, key=steps.__getitem__)

    def curves(self, kind: str) -> pd.DataFrame:
        """Learning curves of tuned agents on the real task, thinned."""
        training = dataclasses.replace(self.until_solved(), stop_rule="never")
        condition = self.condition("curves", agents.tuned_agent(self.task.name, kind), training, 1)
        rows = agents.train_groups(condition, self.settings, self.num_pilots, curves.CURVES)
        grid = step_grid(self.settings.limit(self.task))
        return curves.thinned(rows.drop(columns="group"), grid, self.target)

    def until_solved(self, is_terminal: bool = False) -> TrainingConfig:
        """Training that ends when the last ten tests, or all if fewer, reach the target."""
        most = self.settings.limit(self.task)
        return TrainingConfig(
            max_steps=most,
            max_episodes=most,
            stop_rule="solved",
            tests_between=1,
            test_episodes=self.settings.test_episodes,
            time_limit_is_terminal=is_terminal,
        )

    def row(
        self, role: str, kind: str, agent: AgentConfig, training: TrainingConfig, **more: Any
    ) -> pd.DataFrame:
        """Agents of one sort, in five groups."""
        condition = self.condition(role, agent, training, **more)
        each = self.num_agents // NUM_GROUPS
        return self.labelled(agents.train_groups(condition, self.settings, each, TIMED), role, kind)

    def condition(
        self,
        name: str,
        agent: AgentConfig,
        training: TrainingConfig,
        num_groups: int = NUM_GROUPS,
        **more: Any,
    ) -> Condition:
        """Students train on the proxy, others on the task; it is solved at the target."""
        proxy, stem = self.proxy, self.proxy.path.stem
        params, weights, env, origin = self.task.params, "", self.task.env, ""
        if name.endswith("student"):
            params, weights, env, origin = proxy.params, proxy.fingerprint, proxy.env, stem
        return Condition(
            name=f"{stem}-{name}",
            env=env,
            task=dataclasses.replace(self.task, solved_reward=self.target),
            groups=tuple(Group(str(i), params, weights) for i in range(num_groups)),
            agent=agent,
            training=training,
            settings={"target": self.target, "proxy": origin},
            **more,
        )

    def labelled(self, rows: pd.DataFrame, role: str, kind: str) -> pd.DataFrame:
        """What is kept of rows, and whose they are."""
        own = {"role": role, "kind": kind, "target": self.target}
        most = self.settings.limit(self.task)
        steps = rows["train_steps"].mask(rows["nonfinite"], most)  # a diverged agent solves nothing
        return rows[KEPT].assign(**own, most_steps=most, train_steps=steps)


def kinds_for(task: Task) -> tuple[str, ...]:
    """The kinds of agents of which the fastest one is taken."""
    if task.num_states is not None:
        return TABLES
    return CONTINUOUS if task.num_actions is None else DISCRETE


def step_grid(most_steps: int) -> np.ndarray:
    """Training steps at which learning curves are drawn, evenly on a logarithmic axis."""
    return np.unique(np.geomspace(most_steps / 500, most_steps, GRID_POINTS).round())
