"""Configurations of the proxies. Importing this imports neither JAX nor gymnax."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from sejax.errors import require
from sejax.options import ACTIVATIONS, MOST_LAYERS, Options, counts, one_of, option, positive

if TYPE_CHECKING:
    from sejax.proxies.base import ProxyEnv

DONE_MODES = ("soft", "threshold", "bernoulli", "sigmoid")
INITIAL_STATES = ("real", "learned", "noise")
STATE_UNITS = ("raw", "bounds")
VARIANTS = (
    "additive_potential",
    "exclusive_potential",
    "additive_non_potential",
    "exclusive_non_potential",
    "additive_weighted_info",
    "exclusive_weighted_info",
)


@dataclass(frozen=True, kw_only=True)
class SyntheticConfig(Options):
    """The SE's networks, where its episodes begin, and how they end.

    The paper's SE is `initial_state=real horizon=null done=soft`; the contextual bandit of Liesen
    et al. (2024) is `initial_state=learned horizon=1`.
    """

    group: ClassVar[str] = "proxy"

    hidden_size: int = option(128, counts("a layer needs a unit"))
    num_layers: int = option(1, counts("there is a hidden layer", most=MOST_LAYERS))
    activation: str = option("leaky_relu", one_of(ACTIVATIONS))
    # How the done output d ends an episode. soft: at d > 0.5, but targets bootstrap with 1 - d
    # (the authors'); threshold: at d > 0.5; bernoulli: with probability clip(d, 0, 1); sigmoid:
    # with probability sigmoid(d). All but the first are ends that every agent sees.
    done: str = option("soft", one_of(DONE_MODES))
    # real: the task's initial states; learned: standard normal noise, moved by a network; noise:
    # that alone, in the units of `state_units`, where nothing would tell the network what to learn.
    initial_state: str = option("real", one_of(INITIAL_STATES))
    # Units in which the networks see and make states. raw: the task's own; bounds: half the way
    # from the middle of its observation space to the bounds, where it has such, is 1. A car's
    # velocity lies in [-0.07, 0.07]: noise of 1, or a weight, is no measure for it.
    state_units: str = option("raw", one_of(STATE_UNITS))
    # Steps of an episode; null: the task's limit. 1: a contextual bandit, which has neither a
    # next-state nor a done network.
    horizon: int | None = option(None, counts("an episode has steps"))
    # Whether the horizon terminates an episode, so that nothing is bootstrapped there, or cuts it,
    # as the task's limit does.
    horizon_is_terminal: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.horizon != 1 or self.horizon_is_terminal,
            "proxy.horizon_is_terminal",
            "be true with proxy.horizon=1",
            "there is no next state to bootstrap with",
            "false",
            "proxy.horizon_is_terminal=true",
        )

    @property
    def lasts_to_the_limit(self) -> bool:
        """Whether the episodes of most of what it may become take all steps that they may."""
        return self.horizon == 1 or (self.done == "soft" and self.horizon is None)

    @property
    def needs_task(self) -> bool:
        """Whether its task must run where it is used; what agents see of it is in a file."""
        return self.initial_state == "real"

    def max_steps(self, task_max_steps: int) -> int:
        """Steps of an episode at most."""
        return task_max_steps if self.horizon is None else self.horizon

    def make(self, task: Any) -> "ProxyEnv":
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
    # Phi is this times the network's output. Some agents learn only from small rewards
    # (docs/results.md, MountainCarContinuous).
    output_scale: float = option(1.0, positive("a reward of 0 teaches nothing", 1e6))
    augmented: bool = False  # the network sees the task's observation vector v as well
    zero_at_terminal: bool = False  # Phi is 0 where episodes end for the agent; see RewardEnv

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("augmented", "zero_at_terminal"):
            require(
                not (self.weighs_info and getattr(self, name)),
                f"proxy.{name}",
                "be false with weighted info",
                f"{self.variant} has no network",
                "true",
                f"proxy.{name}=false",
            )
        require(
            self.output_scale == 1 or not self.weighs_info,
            "proxy.output_scale",
            "be 1 with weighted info",
            f"{self.variant} has no network",
            self.output_scale,
            "proxy.output_scale=1",
        )

    def require_task(self, spec: Any, task_name: str) -> None:
        """Checks that the task tells what this variant needs.

        Raises:
          ConfigError: if it does not.
        """
        fields = (
            ("variant", self.weighs_info, spec.info_keys, "additive_potential"),
            ("augmented", self.augmented, spec.augmented_keys, "false"),
        )
        for name, is_needed, is_there, fix in fields:
            value = getattr(self, name)
            require(
                is_there or not is_needed,
                f"proxy.{name}",
                f"do without {value} in {task_name}",
                "its steps tell nothing of the state beside the observation",
                value,
                f"proxy.{name}={fix}",
            )

    def make(self, task: Any) -> "ProxyEnv":
        """The RN of a task.

        Raises:
          ConfigError: if the task does not tell what this variant needs.
        """
        from sejax.proxies.reward import RewardEnv

        self.require_task(task, task.name)
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
