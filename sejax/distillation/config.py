"""The configuration of `python -m sejax.distill`: its own fields, and those of its students."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from sejax import envs
from sejax.distillation.policy_copy import CopyConfig
from sejax.distillation.policy_search import SearchConfig
from sejax.ops.files import as_file_name
from sejax.options import Options, counts, one_of, option, positive, require
from sejax.options.plain import from_plain, merge
from sejax.runs import config as configuration
from sejax.runs.config import LearnConfig

# Students of a task's kind of actions where none are named, and how long they train.
STUDENTS = {"continuous": "[td3,sac]", "discrete": "[ddqn,ppo]"}
# Of the fields of sejax.run; the others would have no effect.
TAKEN = (
    "env",
    "agent",
    "agents",
    "exploration",
    "training",
    "preset",
    "seed",
    "devices",
    "run_dir",
)
STEPS = {"continuous": 10_000, "discrete": 2_000}


@dataclass(frozen=True, kw_only=True)
class DistillConfig(Options):
    """The fields of `python -m sejax.distill`; all others are those of `sejax.run`."""

    group: ClassVar[str] = ""

    policy: str | None = option(
        None,
        help=(
            "null: one is searched. ppo:FILE.zip, of Stable-Baselines3; FILE.npz with kernel_0, "
            "bias_0 and so on; or module:function."
        ),
    )
    copy: CopyConfig = option(CopyConfig(), help="Of a policy that is not of the exact form.")
    search: SearchConfig = option(SearchConfig(), help="Of a linear policy.")
    reward_form: str = option(
        "distance",
        one_of(("distance", "quadratic")),
        help=(
            "Of the SE's reward where actions are continuous: minus the distance to the policy's,"
            " or its square."
        ),
    )
    slope: float = option(
        1.0, positive("a reward must tell actions apart"), help="of the SE's reward"
    )
    widen: float = option(
        1.0,
        positive("it is a scale"),
        help="Deviation of the SE's initial states, in units of those that the policy visits.",
    )
    independent_starts: bool = option(
        False,
        help=(
            "Whether the numbers of an initial state are independent; else they have the visited "
            "states' covariance."
        ),
    )
    num_snapshots: int = option(
        6,
        counts("something must be taught"),
        help=(
            "Policies that are taught: the best tested one of each of so many equal parts of the "
            "search."
        ),
    )
    num_students: int = option(
        4,
        counts("an SE is chosen by what it teaches"),
        help="Students of each kind on the SE of each policy, which choose one of them.",
    )
    num_tested: int = option(
        10, counts("a card says what an SE teaches"), help="Others of each kind, on the chosen SE."
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        tested = -(-self.search.generations // self.search.test_every)
        require(
            self.policy is not None or self.num_snapshots <= tested,
            "num_snapshots",
            f"must be at most {tested}, as many policies as the search tests; got "
            f"{self.num_snapshots}. Set search.test_every=1.",
        )

    @property
    def of_ses(self) -> dict[str, Any]:
        """Options of `sejax.proxies.exact.make_exact`."""
        return {
            "form": self.reward_form,
            "slope": self.slope,
            "widen": self.widen,
            "independent_starts": self.independent_starts,
        }


def read(overrides: Sequence[str]) -> tuple[DistillConfig, LearnConfig]:
    """The command's fields, and a configuration of task, students and trainings.

    Raises:
      ConfigError: for overrides that cannot be.
    """
    names = {field.name for field in dataclasses.fields(DistillConfig)}
    values: dict[str, object] = {}
    rest = []
    for override in overrides:
        name, _, text = override.partition("=")
        first, _, last = name.partition(".")
        if first in names:
            values = merge(values, {first: {last: text}} if last else {first: text})
        else:
            rest.append(override)
    given = {override.partition("=")[0] for override in rest}
    for name in sorted(given):
        known = name.partition(".")[0] in TAKEN
        fix = "Set search.generations=N." if name == "generations" else "Leave it out."
        require(known, name, f"must be left out of sejax.distill, where it has no effect. {fix}")
    task = [x for x in rest if x.partition("=")[0].partition(".")[0] == "env"]
    spec = envs.spec_of(configuration.config(task).env)
    defaults = {"preset": "distilled"}
    if not given & {"agent", "agents"}:
        defaults["agents"] = STUDENTS[spec.actions]
    if "training.max_steps" in given:  # of one step each
        text = next(x for x in rest if x.startswith("training.max_steps=")).partition("=")[2]
        defaults["training.max_episodes"] = text
    elif "training.max_episodes" not in given:
        defaults |= dict.fromkeys(
            ("training.max_steps", "training.max_episodes"), str(STEPS[spec.actions])
        )
    words = [f"{name}={text}" for name, text in defaults.items() if name not in given]
    config = configuration.config([*words, *rest])
    require(
        config.training.is_fixed_length,
        "training.stop_rule",
        f"must be never, with training.max_steps; got {config.training.stop_rule}. Set "
        "training.stop_rule=never.",
    )
    own = from_plain(DistillConfig, values, "")  # after the task, whose faults come first
    require(
        spec.actions == "continuous" or own.reward_form == "distance",
        "reward_form",
        f"must be left out where actions are discrete; got {own.reward_form}. Leave it out.",
    )
    if own.search.alive_bonus is None:
        bonus = getattr(config.env, "healthy_reward", 0.0)
        search = dataclasses.replace(own.search, alive_bonus=bonus)
        own = dataclasses.replace(own, search=search)
    return own, config


def folder_of(own: DistillConfig, config: LearnConfig) -> Path:
    """The command's folder: `run_dir`, or one named by task, given policy and seed."""
    algorithm, _, path = (own.policy or "").rpartition(":")
    given = (
        f"-{algorithm}-{Path(path).stem}" if algorithm else f"-{Path(path).stem}" if path else ""
    )
    name = as_file_name(f"distill-{config.name('env')}{given}-s{config.seed}")
    return Path(config.run_dir or f"runs/{name}")
