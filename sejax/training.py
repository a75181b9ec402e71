"""How long an agent trains, and how it is tested.

Source: paper, appendix "Heuristics for Agent Training and Evaluation"; `docs/reference.md` 3.
"""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

from sejax.errors import require
from sejax.options import Options, counts, not_negative, one_of, option

STOP_RULES = ("plateau", "solved", "never")
SOLVED_BY = ("test", "train")


@dataclass(frozen=True, kw_only=True)
class TrainingConfig(Options):
    """How long an agent trains, and how it is tested."""

    group: ClassVar[str] = "training"

    max_episodes: int = option(1000, counts("it counts episodes"))  # n_e: of a training at most
    # The stop rule waits for so many training steps.
    min_steps: int = option(0, counts("it counts steps", least=0))
    # Training ends after so many steps, whatever the rule says.
    max_steps: int | None = option(None, counts("an agent must train"))
    stop_rule: str = option("plateau", one_of(STOP_RULES))  # plateau (SEs), solved (real tasks)
    # d: episodes in each of the two means that the plateau rule compares
    window: int = option(10, counts("it counts episodes"))
    # C_diff: relative change between them that counts as flat
    plateau_tolerance: float = option(0.01, not_negative("it bounds a relative change"))
    # Whose last d returns must reach the solved reward.
    solved_by: str = option("test", one_of(SOLVED_BY))
    # n_te: greedy episodes on the real task after training
    test_episodes: int = option(10, counts("it counts episodes"))
    # Greedy episodes on the real task after each training episode; the solved rule by tests has at
    # least one.
    tests_between: int = option(0, counts("it counts episodes", least=0))
    time_limit_is_terminal: bool = True  # a real episode cut by the limit does not bootstrap

    @property
    def is_fixed_length(self) -> bool:
        """Whether all agents train for as many steps, but for those that run out of episodes."""
        return self.stop_rule == "never" and self.max_steps is not None

    @property
    def stops_by_tests(self) -> bool:
        """Whether tests between training episodes say that the task is solved."""
        return self.stop_rule == "solved" and self.solved_by == "test"

    @property
    def num_tests_between(self) -> int:
        """Test episodes after each training episode."""
        return max(self.tests_between, int(self.stops_by_tests))


def budget_for(
    training: TrainingConfig, agent: Any, learned_with: Iterable[Any], max_episode_steps: int,
    task_max_steps: int,
) -> TrainingConfig:  # fmt: skip
    """How long an agent trains on a proxy that was learned with others.

    A step budget grows by the steps for which this agent waits longer with learning than any of
    those: ten long initial episodes, or a rollout of PPO, could use it up. Episodes, which may have
    one step, grow in number with it. No more steps are asked for than there were episodes for.

    Args:
      training: that the proxy was learned with.
      agent: configuration of the agent that is to train.
      learned_with: of those that the proxy was learned with, as far as they are known.
      max_episode_steps: that the proxy's episodes may take.
      task_max_steps: that the real task's may take.
    """
    max_steps = training.max_steps
    if max_steps is None:
        return training
    if training.is_fixed_length:  # as long as the episodes allowed, in files of older versions
        max_steps = min(max_steps, training.max_episodes * max_episode_steps)
    waits, *waited = (steps_before_learning(each, max_episode_steps, task_max_steps)
                      for each in (agent, *learned_with))  # fmt: skip
    longer = max(0, waits - max(waited, default=0))
    return dataclasses.replace(training, max_steps=max_steps + longer,
                               max_episodes=training.max_episodes + longer)  # fmt: skip


def require_reachable(name: str, training: TrainingConfig, max_episode_steps: int) -> None:
    """Checks that a training of fixed length does not run out of episodes before.

    Args:
      name: of the group of fields.
      training: the limits.
      max_episode_steps: that an episode may take.

    Raises:
      ConfigError: if even the longest episodes are too few.
    """
    if not training.is_fixed_length:
        return
    assert training.max_steps is not None
    episodes = -(-training.max_steps // max_episode_steps)
    require(training.max_episodes >= episodes, f"{name}.max_episodes", f"be at least {episodes}",
            f"{name}.max_steps={training.max_steps} takes as many episodes of at most "
            f"{max_episode_steps} steps", training.max_episodes,
            f"{name}.max_episodes={episodes}")  # fmt: skip


def steps_before_learning(agent: Any, max_episode_steps: int, task_max_steps: int) -> int:
    """Training steps before an agent first learns, as its configuration says; 0 if it does not."""
    steps = getattr(agent, "steps_before_learning", None)
    return 0 if steps is None else steps(max_episode_steps, task_max_steps)
