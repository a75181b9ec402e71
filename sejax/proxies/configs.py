"""Configurations of the proxies. Importing this imports no gymnax, which takes seconds."""

from dataclasses import dataclass
from typing import Any, ClassVar

from sejax.errors import require
from sejax.networks import ACTIVATIONS
from sejax.options import MOST_LAYERS, Options, counts, one_of, option

DONE_MODES = ("soft", "threshold")
VARIANTS = (
    "additive_potential", "exclusive_potential", "additive_non_potential",
    "exclusive_non_potential", "additive_weighted_info", "exclusive_weighted_info",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SyntheticConfig(Options):
    """The SE's three networks, and how their done output is used."""

    group: ClassVar[str] = "proxy"

    hidden_size: int = option(128, counts("a layer needs a unit"))
    num_layers: int = option(1, counts("there is a hidden layer", most=MOST_LAYERS))
    activation: str = option("leaky_relu", one_of(ACTIVATIONS))
    # soft: bootstrap with 1 - d (authors); threshold: with 1 - [d > 0.5]
    done: str = option("soft", one_of(DONE_MODES))

    @property
    def may_never_end(self) -> bool:
        """Whether most of what it may become never ends an episode."""
        return self.done == "soft"

    def make(self, task: Any) -> Any:
        """The SE of a task."""
        from sejax.proxies.synthetic import SyntheticEnv

        return SyntheticEnv(task, self)


@dataclass(frozen=True, kw_only=True)
class RewardConfig(Options):
    """The RN's network, and how its output makes a reward."""

    group: ClassVar[str] = "proxy"
    default_objective: ClassVar[str] = "reward_threshold"  # of `python -m sejax.run proxy=rn`

    hidden_size: int = option(128, counts("a layer needs a unit"))
    num_layers: int = option(1, counts("there is a hidden layer", most=MOST_LAYERS))
    activation: str = option("prelu", one_of(ACTIVATIONS))
    variant: str = option("additive_potential", one_of(VARIANTS))
    augmented: bool = False  # the network sees the task's observation vector v as well
    zero_at_terminal: bool = False  # Phi is 0 where episodes end for the agent; see RewardEnv

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("augmented", "zero_at_terminal"):
            require(not (self.weighs_info and getattr(self, name)), f"proxy.{name}",
                    "be false with weighted info", f"{self.variant} has no network",
                    "true", f"proxy.{name}=false")  # fmt: skip

    def require_task(self, facts: Any, task_name: str) -> None:
        """Checks that the task tells what this variant needs.

        Raises:
          ConfigError: if it does not.
        """
        fields = (("variant", self.weighs_info, "additive_potential"),
                  ("augmented", self.augmented, "false"))  # fmt: skip
        for name, needs_info, fix in fields:
            value = getattr(self, name)
            require(facts.has_info or not needs_info, f"proxy.{name}", f"do without {value} in "
                    f"{task_name}", "its steps tell nothing beside the observation", value,
                    f"proxy.{name}={fix}")  # fmt: skip

    def make(self, task: Any) -> Any:
        """The RN of a task.

        Raises:
          ConfigError: if the task does not tell what this variant needs.
        """
        from sejax.proxies.reward import RewardEnv

        self.require_task(task.facts, task.name)
        return RewardEnv(task, self)

    @property
    def weighs_info(self) -> bool:
        return self.variant.endswith("weighted_info")

    @property
    def is_additive(self) -> bool:
        return self.variant.startswith("additive")

    @property
    def is_potential_based(self) -> bool:
        return self.variant in ("additive_potential", "exclusive_potential")
