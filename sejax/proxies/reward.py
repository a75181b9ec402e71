"""The reward network (RN): the real task with a learned reward in place of its own.

Source: paper, section "Learning Reward Networks" (table "Overview of Reward Network variants");
`docs/reference.md` 5.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PyTree
from pydantic import Field

from sejax.envs import Task, TaskSpec
from sejax.envs.environment import EnvState
from sejax.ops.networks import MLP, uniform_fan_in
from sejax.options import Activation, Count, Depth, require, require_known
from sejax.proxies.base import MAX_ABS_VALUE, ProxyConfig, ProxyEnv, ProxyParams


class Shaping(NamedTuple):
    r"""How a reward network makes a reward: a row of the paper's table of variants.

    Attributes:
      is_additive: whether the real reward r is added.
      is_potential_based: whether a step is worth :math:`\gamma \Phi(s') - \Phi(s)`, and not
        :math:`\Phi(s')`.
      weighs_info: whether, in place of a network, there is a weight for each number i' in the
        step's `info` (`Task.info_keys`).
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
    """The RN's network, and how its output makes a reward.

    Attributes:
      output_scale: Phi is this times the network's output. Some agents learn only from small
        rewards (docs/studies/rn_performance.md, MountainCarContinuous).
      augmented: the network sees the task's vector v as well
      zero_at_terminal: Phi is 0 where episodes end for the agent; see RewardEnv
    """

    default_objective: ClassVar[str] = "reward_threshold"
    has_real_dynamics: ClassVar[bool] = True

    hidden_size: Count = 64
    num_layers: Depth = 1
    activation: Activation = "prelu"
    variant: str = "additive_potential"
    output_scale: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    augmented: bool = False
    zero_at_terminal: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        require_known("proxy.variant", self.variant, VARIANTS)
        for name in ("output_scale", "augmented", "zero_at_terminal"):
            default = getattr(type(self), name)
            if getattr(self, name) != default and self.shaping.weighs_info:
                raise self._error(name, default, f"as {self.variant} has no network")

    @property
    def shaping(self) -> Shaping:
        """How the network's output makes a reward."""
        return VARIANTS[self.variant]

    @property
    def needs_discount(self) -> bool:
        return self.shaping.is_potential_based

    def require_task(self, spec: TaskSpec, task_name: str) -> None:
        """Checks that the task's steps report what this variant needs.

        Raises:
          ConfigError: if they do not.
        """
        why = f"where a step's info tells nothing of the state, as in {task_name}"
        if self.shaping.weighs_info and not spec.info_keys:
            raise self._error("variant", "additive_potential", why)
        if self.augmented and not spec.augmented_keys:
            raise self._error("augmented", False, why)

    def make(self, task: Task) -> "RewardEnv":
        """The RN of a task.

        Raises:
          ConfigError: if the task's steps do not report what this variant needs.
        """
        self.require_task(task, task.name)
        return RewardEnv(task, self)


@struct.dataclass
class RewardState(EnvState):
    env_state: Any  # of the real task
    obs: Array  # what the agent saw last
    augmentation: Float[Array, " keys"]  # v of that state; zeros before the first step


@struct.dataclass
class RewardParams(ProxyParams):
    potentials: Array | None = None  # [num_states], if `prepare` found discrete states
    discount: Array | float = 1.0  # gamma; `prepare` puts the agent's here
    limit_is_terminal: Array | bool = False  # whether episodes end for the agent at the step limit


class RewardEnv(ProxyEnv):
    r"""A task whose reward is shaped by a network :math:`\Phi`; a gymnax 1.x `Environment`.

    Dynamics, termination and observations are the real task's. With r the real reward, the agent
    gets

    ========================== =====================================
    `variant`                  reward
    ========================== =====================================
    `additive_potential`       :math:`r + \gamma \Phi(s') - \Phi(s)`
    `exclusive_potential`      :math:`\gamma \Phi(s') - \Phi(s)`
    `additive_non_potential`   :math:`r + \Phi(s')`
    `exclusive_non_potential`  :math:`\Phi(s')`
    `additive_weighted_info`   :math:`r + w^\top i'`
    `exclusive_weighted_info`  :math:`w^\top i'`
    ========================== =====================================

    where gamma is the agent's discount. A discrete state is one-hot to the network. With
    `zero_at_terminal` :math:`\Phi` is 0 where the episode ends for the agent: where it terminates,
    and at the step limit with `training.time_limit_is_terminal`. Only then does
    `additive_potential` leave the optimal policy as it is (Ng et al., 1999); the authors' code
    keeps the network's value. An agent that repeats its actions gets the sum of the rewards of all
    steps. As in the authors' code, each step is shaped with the discount of a whole decision, so
    that for this agent the potentials of the steps between do not cancel.

    :math:`\Phi` is the network's output times `output_scale`, 1 in the paper.

    `augmented` networks see the task's observation vector v as well (`Task.augmented_keys`):
    :math:`\Phi(s, v)` and :math:`\Phi(s', v')`. The authors' code has v' in both. On HalfCheetah
    the authors' v also has the two parts of the reward, beside position and velocity. The last two
    variants are baselines of the authors' code: they weigh the numbers i' in the step's `info`
    (`Task.info_keys`) and have no network.

    `info["real_reward"]` is r, of any size. A reward that is not finite, or whose learned part is
    beyond `MAX_ABS_VALUE`, becomes 0 and ends the episode. `info["nonfinite"]` says whether the
    reward was not finite.
    """

    config: RewardConfig

    def __init__(self, task: Task, config: RewardConfig):
        super().__init__(task, config)
        self._augmented_keys = task.augmented_keys if config.augmented else ()
        self._net = MLP(1, config.hidden_size, config.num_layers, config.activation)

    def init_weights(self, key: Array) -> Any:
        """Random weights: `{"potential"}` of the network, or `{"info_weights": [info_keys]}`."""
        if self.config.shaping.weighs_info:
            num_keys = len(self.task.info_keys)
            return {"info_weights": uniform_fan_in(num_keys)(key, (num_keys,))}
        num_inputs = self.task.obs_dim + len(self._augmented_keys)
        return {"potential": self._net.init(key, jnp.zeros(num_inputs))["params"]}

    def params(self, weights: PyTree, discount: Array | float = 1.0) -> RewardParams:
        return RewardParams(weights=weights, discount=discount, max_steps_in_episode=self.max_steps)

    def prepare(
        self, params: RewardParams, discount: Array | float | None, limit_is_terminal: bool = False
    ) -> RewardParams:
        """Params for the whole training of one agent, with its discount.

        If the network sees a discrete state alone, all potentials are computed at once, and each
        step looks up two of them. They hold for these weights alone: call it again for others.

        Raises:
          ConfigError: if the reward needs a discount and the agent has none.
        """
        is_known = discount is not None or not self.config.needs_discount
        fix = "Set Agent(discount=lambda hparams: ...)."
        require(is_known, "agent", f"must have a discount for {self.config.variant}", fix=fix)
        potentials = None
        sees_info = self.config.shaping.weighs_info or self._augmented_keys
        if self.task.num_states is not None and not sees_info:
            states = jnp.arange(self.task.num_states)
            potentials = self._apply(params.weights, jax.nn.one_hot(states, states.size))
        gamma = jnp.float32(1.0 if discount is None else discount)
        is_terminal = jnp.bool_(limit_is_terminal)
        return replace(params, potentials=potentials, discount=gamma, limit_is_terminal=is_terminal)

    def potential(
        self, params: RewardParams, obs: Array, augmentation: Array | tuple[()] = ()
    ) -> Float[Array, ""]:
        r""":math:`\Phi` of an observation of the task and, if augmented, of v."""
        if params.potentials is not None:
            return params.potentials[obs]
        if self.task.num_states is not None:
            obs = jax.nn.one_hot(obs, self.task.num_states)
        inputs = jnp.concatenate([obs, jnp.asarray(augmentation, jnp.float32)])
        return self._apply(params.weights, inputs)

    def _apply(self, weights: PyTree, inputs: Float[Array, "in *batch"]) -> Float[Array, "*batch"]:
        outputs: Any = self._net.apply({"params": weights["potential"]}, inputs)
        return self.config.output_scale * outputs[0]

    def reset_env(self, key: Array, params: RewardParams) -> tuple[Array, RewardState]:
        obs, env_state = self.task.env.reset_env(key, self.task.params)
        nothing = jnp.zeros(len(self._augmented_keys), jnp.float32)
        return obs, RewardState(
            env_state=env_state, obs=obs, augmentation=nothing, time=jnp.int32(0)
        )

    def step_env(
        self, key: Array, state: RewardState, action: Array, params: RewardParams
    ) -> tuple[Array, RewardState, Array, Array, dict[Any, Any]]:
        obs, env_state, real_reward, terminated, info = self.task.env.step_env(
            key, state.env_state, action, self.task.params
        )
        augmentation = _select(info, self._augmented_keys)
        next_state = RewardState(
            env_state=env_state, obs=obs, augmentation=augmentation, time=state.time + 1
        )
        if self.config.shaping.weighs_info:
            learned = params.weights["info_weights"] @ _select(info, self.task.info_keys)
        else:
            learned = self.potential(params, obs, augmentation)
            if self.config.zero_at_terminal:
                is_cut = self.is_truncated(next_state, params)
                is_end = terminated | (params.limit_is_terminal & is_cut)
                learned = jnp.where(is_end, 0.0, learned)
        if self.config.shaping.is_potential_based:
            before = self.potential(params, state.obs, state.augmentation)
            learned = params.discount * learned - before
        reward = real_reward + learned if self.config.shaping.is_additive else learned
        is_sane = jnp.isfinite(reward) & (jnp.abs(learned) < MAX_ABS_VALUE)
        discount = info.get("discount", jnp.where(terminated, 0.0, 1.0))
        info = {
            **info,
            "discount": jnp.where(is_sane, discount, 0.0),
            "real_reward": jnp.float32(real_reward),
            "nonfinite": ~jnp.isfinite(reward),
        }
        return obs, next_state, jnp.where(is_sane, reward, 0.0), terminated | ~is_sane, info

    def is_truncated(self, state: RewardState, params: RewardParams) -> Array:
        at_limit = state.time >= params.max_steps_in_episode
        return at_limit | self.task.env.is_truncated(state.env_state, self.task.params)

    def observe(self, state: RewardState) -> Array:
        return state.obs


def _select(info: Mapping[str, Array], keys: tuple[str, ...]) -> Float[Array, " keys"]:
    """The numbers under these keys."""
    return jnp.array([info[key] for key in keys], jnp.float32)
