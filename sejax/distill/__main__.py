"""Make an SE of a policy; of several candidates, keep the SE that teaches best.

  python -m sejax.distill env=pendulum policy=ppo:model.zip    a model of Stable-Baselines3
  python -m sejax.distill env=cartpole policy=my_module:act    a function of observations
  python -m sejax.distill env=cartpole policy=ppo              an agent of sejax, which is trained
  python -m sejax.distill env=halfcheetah 'agents=[td3,sac,ppo]' search.generations=200

A small network copies the policy and becomes the reward of a one-step SE. Without `policy`,
augmented random search finds linear policies. The best policy of each part of the search becomes
an SE, students train on each SE, and the SE that teaches best is kept. Writes proxy.safetensors,
card.md, students.csv and search.csv into run_dir. The same command resumes where it stopped.
"""

import functools
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import pandas as pd

from sejax import agents, envs
from sejax.distill.policies import CopyConfig, copy_policy
from sejax.distill.policy_search import PolicySearchConfig, search_policies
from sejax.distill.teaching import diverged_last, grades, students
from sejax.ops.files import as_file_name, write_text
from sejax.options import Count, registry, require
from sejax.options.plain import configure, defaults_of, flatten, from_plain, merge, plugin
from sejax.proxies import header, zoo
from sejax.proxies.exact import make_exact, require_vectors
from sejax.proxies.io import save
from sejax.proxies.synthetic import SyntheticConfig
from sejax.runs import commands
from sejax.runs.command_config import PLACES, CommandConfig
from sejax.runs.config import LearnConfig
from sejax.runs.store import Store
from sejax.runs.words import Tree, agent_names
from sejax.training import TrainingConfig

# How many steps students train by default, by kind of actions.
STEPS = {"continuous": 10_000, "discrete": 2000}
BEGUN = "distill"  # the entry that says whose folder it is
CHOOSE, TEST = "choose", "test"  # what students are for


@dataclass(frozen=True, kw_only=True)
class DistillConfig(CommandConfig):
    """Task, students and their trainings, and how policies become SEs.

    Attributes:
      env: the task to solve
      preset: settings of agents and trainings
      training: training of the students
      run_dir: null: runs/distill-<env>[-<policy>]-s<seed>
      policy: ppo:FILE.zip, a model of Stable-Baselines3; module:function; or an agent of sejax,
        such as ppo. null: a linear policy is searched.
      copy: how a given policy is copied
      search: how a linear policy is searched
      independent_starts: Whether the numbers of an initial state are independent; else they have
        the visited states' covariance.
      num_snapshots: Policies that become SEs: the search is cut into this many equal parts (at
        most one for each test), and each part gives its best tested policy.
      num_students: Students of each agent on each SE; their returns choose one of the SEs.
      num_tested: Further students of each agent, on the chosen SE.
    """

    free = PLACES

    env: registry.Makes[envs.Task] = plugin("env")
    preset: str = "distilled"
    run_dir: str | None = None
    policy: str | None = None
    copy: CopyConfig = CopyConfig()
    search: PolicySearchConfig = PolicySearchConfig()
    independent_starts: bool = False
    num_snapshots: Count = 6
    num_students: Count = 4
    num_tested: Count = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        require_vectors(envs.spec_of(self.env), registry.name_of("env", self.env))
        self.require_agents(self.env, SyntheticConfig())  # as of a one-step SE

    @classmethod
    def default_layers(cls, typed: Tree) -> dict[str, Tree]:
        """The settings of a run with this preset that are fields here, and those of the task.

        One-step SEs have trainings and students of their own. Searches leave out the task's reward
        for being healthy.
        """
        known = defaults_of(cls)
        typed = {"preset": cls.preset} | {name: x for name, x in typed.items() if name in known}
        env = configure("env", registry.DEFAULTS["env"] | typed.get("env", {}))
        actions = envs.spec_of(env).actions
        if not agent_names(typed["agents"]):
            students = {name: {"name": name} for name in agents.USUAL[actions]}
            typed = merge(typed, {"agents": students})
        # An episode of a one-step SE has one step.
        limit = {"max_steps": flatten(typed).get("training.max_steps")}
        steps = from_plain(TrainingConfig, limit, "training").max_steps or STEPS[actions]
        lengths = {"max_steps": steps, "max_episodes": steps}
        search = {"alive_bonus": getattr(env, "healthy_reward", 0.0)}
        of_run = LearnConfig.default_layers(typed)
        below = {layer: {k: tree[k] for k in known if k in tree} for layer, tree in of_run.items()}
        return below | {"distill": {"training": lengths, "search": search}}

    @property
    def default_folder(self) -> str:
        """The folder, named by task, given policy and seed."""
        algorithm, _, path = (self.policy or "").rpartition(":")
        task_name = registry.name_of("env", self.env)
        parts = ["distill", task_name, algorithm, Path(path).stem, f"s{self.seed}"]
        return f"runs/{as_file_name('-'.join(filter(None, parts)))}"


def main(overrides: Sequence[str]) -> None:
    """Distils as the overrides say.

    Raises:
      ConfigError: for invalid overrides, or a folder of another command.
      OSError: if a file cannot be written.
    """
    distill(DistillConfig.of_words(overrides), shlex.join(overrides))


help_text = functools.partial(commands.help_of, DistillConfig, __doc__)


# --- what the command does ------------------------------------------------------------------------


def distill(config: DistillConfig, words: str = "") -> Path:
    """Finds policies, makes SEs of them, and writes the SE that teaches best.

    Args:
      config: the configuration; finished parts that its folder holds are not repeated.
      words: the command's overrides, for the card.

    Returns:
      The SE's file.

    Raises:
      ConfigError: for a folder of another command, or an invalid policy.
      OSError: if a file cannot be written.
    """
    with Store(config.folder, config.plain(), free=config.free) as store:
        if store.get(BEGUN) is None:  # it raises for other settings
            others = [name for name in ("proxy", "checkpoint") if store.file(name).exists()]
            rule = f"must hold no {' or '.join(others)} of another command"
            require(not others, "run_dir", rule, got=store.folder, use="FOLDER")
        return _distilled(config, store, words)


def _distilled(config: DistillConfig, store: Store, words: str) -> Path:
    folder = store.folder
    task = envs.make_from(config.env)
    # The last key also tests policies. The unused key "nothing" keeps the numbers of old runs.
    uses = ("search", "nothing", "record", CHOOSE, TEST)
    keys = dict(zip(uses, jax.random.split(jax.random.key(config.seed), len(uses)), strict=True))
    if config.policy is None:
        store.put(BEGUN)
        lessons, costs = search_policies(
            config.search, task, config.num_snapshots, keys, store, config.devices
        )
        write_text(folder / "search.csv", costs.to_csv(index=False))
    else:
        lessons, costs = copy_policy(config.copy, task, config.policy, keys, store)
        store.put(BEGUN)  # now that the policy is known to be one
    ses = [make_exact(task, x.layers, x.states, config.independent_starts) for x in lessons]
    best = 0
    rows = pd.DataFrame()
    if len(lessons) > 1:
        student_keys = jax.random.split(keys[CHOOSE], config.num_students)
        rows = students(ses, lessons, config, student_keys, store).assign(use=CHOOSE)
        marks = grades(rows)
        print(f"mean and worst student, by the policy's generation:\n{marks.to_string()}")
        best = [lesson.generation for lesson in lessons].index(int(marks.idxmax()))
    se, lesson = ses[best], lessons[best]
    student_keys = jax.random.split(keys[TEST], config.num_tested)
    tested = students([se], [lesson], config, student_keys, store)
    rows = pd.concat([rows, tested.assign(use=TEST)])
    write_text(folder / "students.csv", rows.to_csv(index=False))
    spent = pd.concat([costs, rows])[["real_steps", "cpu_s"]].sum()
    learning = {
        "command": f"python -m sejax.distill {words}".rstrip(),
        "generations": int(costs["generation"].max()) if config.policy is None else 0,
        "real_steps": int(spent["real_steps"]),
        "agents": len(rows),
        "train_steps": int(rows["train_steps"].sum()),
        "cpu_s": round(float(spent["cpu_s"]), 1),
    }
    record: dict[str, Any] = {"generation": lesson.generation, "seed": config.seed}
    record |= {"learning": learning, "policy_return": lesson.policy_return}
    path = folder / "proxy.safetensors"
    settings = config.plain()
    learned_with = {name: settings[name] for name in ("agents", "exploration", "training", "seed")}
    save(path, *se, learned_with, **record, evaluations=evaluations_of(tested))
    write_text(folder / "card.md", zoo.describe(header.read(path), str(folder)).card + "\n")
    print(f"{path} holds the SE of generation {lesson.generation}.")
    return path


def evaluations_of(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """The results of fresh students of each agent, in the form that the SE's file keeps."""
    rows = rows.assign(test_return=diverged_last(rows["test_return"]))
    of_agents = rows.groupby("agent", sort=False).agg(
        num_agents=("train_steps", "size"),
        return_mean=("test_return", "mean"),
        return_std=("test_return", "std"),
        train_steps=("train_steps", "mean"),
    )
    fixed = {"hparams": "as_learned", "world": "proxy"}  # one student has no deviation
    return [fixed | row for row in of_agents.fillna(0.0).reset_index().to_dict("records")]


if __name__ == "__main__":
    commands.start(main, help_text)
