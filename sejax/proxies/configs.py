"""Configurations of the proxies, and what else of them needs no JAX.

They lie apart from the environments that they make, because importing this module imports neither
JAX nor gymnax: `sejax.gym` runs proxies in NumPy alone, and the commands refuse bad settings before
they load JAX.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple, TypeVar

import numpy as np

from sejax.envs.base import Task
from sejax.envs.spec import Box, TaskSpec
from sejax.options import (
    ACTIVATIONS,
    MOST_LAYERS,
    as_text,
    counts,
    one_of,
    option,
    positive,
    require,
    shortened,
)
from sejax.proxies import MAX_ABS_VALUE, ProxyConfig

if TYPE_CHECKING:
    from jax import Array

    from sejax.proxies.base import ProxyEnv

DONE_MODES = ("soft", "threshold", "bernoulli", "sigmoid")
INITIAL_STATES = ("real", "learned", "noise")
STATE_UNITS = ("raw", "bounds")
REWARD_FORMS = ("network", "distance", "quadratic")
START_HIDDEN_SIZE = 32  # units of the network that makes initial states

Vector = TypeVar("Vector", np.ndarray, "Array")


class Units(NamedTuple):
    """Units in which an SE's networks see and make states.

    Attributes:
      middle: `[obs_dim]` float32, the state that is 0 for the networks.
      one: `[obs_dim]` float32, the difference that is 1 for them.
    """

    middle: np.ndarray
    one: np.ndarray

    def encode(self, vector: Vector) -> Vector:
        """States `[*batch, obs_dim]` in these units; of NumPy or JAX."""
        return (vector - self.middle) / self.one

    def decode(self, vector: Vector) -> Vector:
        """Inverse of `encode`."""
        return vector * self.one + self.middle


@dataclass(frozen=True, kw_only=True)
class SyntheticConfig(ProxyConfig):
    """The SE's networks, where its episodes begin, and how they end.

    The default is the contextual bandit of Liesen et al. (2024): everything about it is seen by any
    agent. The paper's SE is `initial_state=real horizon=null done=soft`.
    """

    hidden_size: int = option(128, counts("a layer needs a unit"))
    num_layers: int = option(1, counts("there is a hidden layer", most=MOST_LAYERS))
    activation: str = option("leaky_relu", one_of(ACTIVATIONS))
    done: str = option(
        "threshold",
        one_of(DONE_MODES),
        help=(
            "How the done output d ends an episode. soft: at d > 0.5, but targets bootstrap with "
            "1 - d (the authors'); threshold: at d > 0.5; bernoulli: with probability clip(d, 0, "
            "1); sigmoid: with probability sigmoid(d). Agents see all ends but the first."
        ),
    )
    min_steps: int = option(
        1,
        counts("an episode has steps"),
        help=(
            "First step of an episode that d may end it at; before it, targets bootstrap with 1. "
            "An SE of episodes of a step or two is a bandit, whatever its networks could do."
        ),
    )
    initial_state: str = option(
        "learned",
        one_of(INITIAL_STATES),
        help=(
            "real: the task's initial states; learned: standard normal noise plus a network's "
            "output for it; noise: noise alone, in the units of `state_units`."
        ),
    )
    state_units: str = option(
        "raw",
        one_of(STATE_UNITS),
        help=(
            "Units in which the networks see and make states. raw: the task's own; bounds: 0 is "
            "the middle of a bounded observation and 1 is half of the way to its bound. A car's "
            "velocity lies in [-0.07, 0.07], where noise of 1 would be no measure."
        ),
    )
    horizon: int | None = option(
        1,
        counts("an episode has steps"),
        help=(
            "Steps of an episode; null: the task's limit. 1: a contextual bandit, which has "
            "neither a next-state nor a done network."
        ),
    )
    reward_form: str = option(
        "network",
        one_of(REWARD_FORMS),
        help=(
            "What the reward network of a bandit makes. network: the reward of an action; "
            "distance, quadratic: the best of continuous actions, in units of their bound, from "
            "which the reward is minus the sum of the distances, or of their squares, so that the"
            " best policy is known."
        ),
    )
    reward_slope: float = option(
        1.0, positive("a reward must tell actions apart"), help="Reward lost for each unit of it."
    )
    start_hidden_size: int = option(START_HIDDEN_SIZE, counts("a layer needs a unit"))
    horizon_is_terminal: bool = option(
        True,
        help=(
            "Whether the horizon terminates an episode, so that nothing is bootstrapped there, or"
            " truncates it, as the task's limit does."
        ),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.min_steps <= (self.horizon or self.min_steps),
            "proxy.min_steps",
            f"must be at most the horizon; got {self.min_steps} with a horizon of {self.horizon}. "
            f"Set proxy.min_steps={self.horizon}, or proxy.horizon=null.",
        )
        require(
            self.horizon != 1 or self.horizon_is_terminal,
            "proxy.horizon_is_terminal",
            "must be true with proxy.horizon=1, which has no next state; got false. Set "
            "proxy.horizon_is_terminal=true.",
        )
        require(
            self.is_bandit or self.reward_form == "network",
            "proxy.reward_form",
            f"must be network where episodes have several steps; got {self.reward_form}. Set "
            "proxy.reward_form=network, or proxy.horizon=1.",
        )
        require(
            self.reward_form != "network" or self.reward_slope == 1,
            "proxy.reward_slope",
            f"must be 1 with proxy.reward_form=network; got {self.reward_slope:g}. Set "
            "proxy.reward_form=distance.",
        )

    @property
    def is_bandit(self) -> bool:
        """Whether an episode is one step: a contextual bandit."""
        return self.horizon == 1

    @property
    def ends_at_horizon(self) -> bool:
        """Whether the step limit terminates an episode in place of truncating it."""
        return self.horizon is not None and self.horizon_is_terminal

    @property
    def needs_task(self) -> bool:
        return self.initial_state == "real"

    @property
    def sees_bounds(self) -> bool:
        return self.state_units == "bounds"

    def require_task(self, spec: TaskSpec, task_name: str) -> None:
        """Checks that the reward's form is one for the task's actions.

        Raises:
          ConfigError: if it is not.
        """
        require(
            self.reward_form == "network" or spec.num_actions is None,
            "proxy.reward_form",
            f"must be network for discrete actions, as of {shortened(task_name)}; got "
            f"{self.reward_form}. Set proxy.reward_form=network.",
        )

    @property
    def reaches_step_limit(self) -> bool:
        return self.is_bandit or (self.done == "soft" and self.horizon is None)

    def max_steps(self, task_max_steps: int) -> int:
        return task_max_steps if self.horizon is None else self.horizon

    def networks(self, obs_dim: int, action_dim: int) -> dict[str, list[int]]:
        """Number of inputs and of each layer's units, by network.

        Example:
          >>> SyntheticConfig(hidden_size=8).networks(obs_dim=4, action_dim=2)
          {'reward': [6, 8, 1], 'start': [4, 32, 4]}
        """
        outputs = {"state": obs_dim, "reward": 1, "done": 1}
        heads = ("reward",) if self.is_bandit else tuple(outputs)
        hidden = [self.hidden_size] * self.num_layers
        networks = {head: [action_dim + obs_dim, *hidden, outputs[head]] for head in heads}
        if self.reward_form != "network":
            networks["reward"] = [obs_dim, *hidden, action_dim]
        if self.initial_state == "learned":
            networks["start"] = [obs_dim, self.start_hidden_size, obs_dim]
        return networks

    def units(self, space: Box) -> Units | None:
        """Units of states in a box; None for the task's own.

        An entry without bounds keeps its own unit; some spaces write "none" as a huge number.

        Example:
          >>> space = Box(low=(-1.5, -np.inf), high=(0.5, np.inf))
          >>> SyntheticConfig(state_units="bounds").units(space)
          Units(middle=array([-0.5,  0. ], dtype=float32), one=array([0.5, 1. ], dtype=float32))
        """
        if self.state_units == "raw":
            return None
        low, high = (np.asarray(x, np.float32) for x in (space.low, space.high))
        bounded = (np.abs(low) < MAX_ABS_VALUE) & (np.abs(high) < MAX_ABS_VALUE)
        low, high = np.where(bounded, low, -2), np.where(bounded, high, 2)
        return Units(
            middle=((low + high) / 2).astype(np.float32), one=((high - low) / 4).astype(np.float32)
        )

    def make(self, task: Task) -> "ProxyEnv":
        """The SE of a task.

        Raises:
          ConfigError: for a form of the reward that is not one for the task's actions.
        """
        self.require_task(task, task.name)
        from sejax.proxies.synthetic import BanditEnv, SyntheticEnv  # imports JAX

        return (BanditEnv if self.is_bandit else SyntheticEnv)(task, self)


class Shaping(NamedTuple):
    r"""How a reward network makes a reward: a row of the paper's table of variants.

    Attributes:
      is_additive: whether the real reward r is added.
      is_potential_based: whether a step is worth :math:`\gamma \Phi(s') - \Phi(s)`, and not
        :math:`\Phi(s')`.
      weighs_info: whether there is no network, but a weight for each number i' in the step's `info`
        (`Task.info_keys`).
    """

    is_additive: bool
    is_potential_based: bool = False
    weighs_info: bool = False


# Source: paper, table "Overview of Reward Network variants".
VARIANTS = {
    "additive_potential": Shaping(is_additive=True, is_potential_based=True),
    "exclusive_potential": Shaping(is_additive=False, is_potential_based=True),
    "additive_non_potential": Shaping(is_additive=True),
    "exclusive_non_potential": Shaping(is_additive=False),
    "additive_weighted_info": Shaping(is_additive=True, weighs_info=True),
    "exclusive_weighted_info": Shaping(is_additive=False, weighs_info=True),
}


@dataclass(frozen=True, kw_only=True)
class RewardConfig(ProxyConfig):
    """The RN's network, and how its output makes a reward."""

    default_objective: ClassVar[str] = "reward_threshold"
    has_real_dynamics: ClassVar[bool] = True

    hidden_size: int = option(64, counts("a layer needs a unit"))
    num_layers: int = option(1, counts("there is a hidden layer", most=MOST_LAYERS))
    activation: str = option("prelu", one_of(ACTIVATIONS))
    variant: str = option("additive_potential", one_of(VARIANTS))
    output_scale: float = option(
        1.0,
        positive("a reward of 0 teaches nothing", 1e6),
        help=(
            "Phi is this times the network's output. Some agents learn only from small rewards "
            "(docs/results.md, MountainCarContinuous)."
        ),
    )
    augmented: bool = option(False, help="the network sees the task's vector v as well")
    zero_at_terminal: bool = option(
        False, help="Phi is 0 where episodes end for the agent; see RewardEnv"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        defaults = {"output_scale": 1.0, "augmented": False, "zero_at_terminal": False}
        for name, default in defaults.items():
            value = getattr(self, name)
            require(
                value == default or not self.shaping.weighs_info,
                f"proxy.{name}",
                f"must be {as_text(default)}, as {self.variant} has no network; got "
                f"{shortened(value)}. Set proxy.{name}={as_text(default)}.",
            )

    @property
    def shaping(self) -> Shaping:
        """How the network's output makes a reward."""
        return VARIANTS[self.variant]

    @property
    def needs_discount(self) -> bool:
        return self.shaping.is_potential_based

    def require_task(self, spec: TaskSpec, task_name: str) -> None:
        """Checks that the steps of the task tell what this variant needs.

        Raises:
          ConfigError: if they do not.
        """
        fields = (
            ("variant", self.shaping.weighs_info, spec.info_keys, "additive_potential"),
            ("augmented", self.augmented, spec.augmented_keys, "false"),
        )
        for name, is_needed, is_there, fix in fields:
            value = getattr(self, name)
            require(
                is_there or not is_needed,
                f"proxy.{name}",
                f"must do without a step's info in {shortened(task_name)}, which tells nothing of "
                f"the state; got {value}. Set proxy.{name}={fix}.",
            )

    def make(self, task: Task) -> "ProxyEnv":
        """The RN of a task.

        Raises:
          ConfigError: if the task does not tell what this variant needs.
        """
        from sejax.proxies.reward import RewardEnv  # imports JAX

        self.require_task(task, task.name)
        return RewardEnv(task, self)
