"""The inner loop of sejax once more, in eager PyTorch: the yardstick.

What a good PyTorch programmer would write for the paper's design, one small network call after the
other: DDQN on an SE of three networks, then greedy test episodes on the real CartPole. It means
the same as `sejax.training`, and takes its hyperparameters from the same configurations, which are
all that it takes from sejax. `torch_nes.py` has the generation.

What was tried for speed, in microseconds on one thread of an AVX-512 machine at the paper's
CartPole settings; first what is used here, alone in a loop (in the whole step, where caches are
cold, everything takes about 1.3 times as long):

- loss and gradient: autograd on plain functions 310; with `nn.Sequential` 45 more;
  feature-major, by masks in the place of `gather`, or with one batched product for both networks
  at the next states: the same within 5 %;
- optimiser: `torch._fused_adam_` 4; `torch.optim.adam.adam(fused=True)` 21;
  `torch.optim.Adam(fused=True)` 39, over one flat parameter 29, plain 111, `foreach` 107;
- soft target update: `torch._foreach_lerp_` 3;
- SE step: the three networks joined in one with block-diagonal layers 10, as three modules 49;
- acting: through PyTorch 8; through NumPy on the same memory 3, lost in the noise of the step;
- storing a transition: through NumPy on the buffer's memory 1, through PyTorch 7.

Beyond eager PyTorch, for the whole step with learning, of 460 here: a backward pass written by
hand 350; `torch.compile` over loss, gradient, Adam and soft update in one 310, after 10 to 20 s.
"""

import itertools
import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from sejax.agents.dqn import DDQNConfig
from sejax.proxies.synthetic import SyntheticConfig
from sejax.training import TrainingConfig

OBS_DIM, NUM_ACTIONS, MAX_STEPS = 4, 2, 200  # CartPole-v0
HEADS = {"state": OBS_DIM, "reward": 1, "done": 1}
ABSURD = 1e6  # as in sejax.proxies.synthetic
PRELU_SLOPE = 0.25

Weights = dict[str, Any]  # nested as sejax's: {"state": {"Dense_0": {"kernel", "bias"}, ...}, ...}


# --- networks ---------------------------------------------------------------------------------


def mlp(params: list[Tensor], x: Tensor, activation: str) -> Tensor:
    """Hidden layers with an activation, then a linear head, on rows `[batch, in]` or one `[in]`.

    `params` is `[weight, bias, weight, bias, ...]`, and the slope at the end for PReLU.
    Calls the functions rather than `nn.Module`s, whose dispatch costs a quarter of the time here.
    """
    num_layers = len(params) // 2
    for i in range(num_layers - 1):
        x = F.linear(x, params[2 * i], params[2 * i + 1])
        x = F.prelu(x, params[-1]) if activation == "prelu" else ACTIVATIONS[activation](x)
    return F.linear(x, params[2 * num_layers - 2], params[2 * num_layers - 1])


ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "tanh": torch.tanh,
    "fast_tanh": torch.tanh,
    "relu": torch.relu_,  # in place, as nothing else needs what comes in
    "leaky_relu": F.leaky_relu,
}


def init_mlp(sizes: list[int], activation: str) -> list[Tensor]:
    """Parameters for `mlp`, uniform in +-1/sqrt(fan_in), for layers of these sizes."""
    params = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        for shape in ((fan_out, fan_in), (fan_out,)):
            uniform = torch.rand(shape)
            params.append((2 * uniform - 1) * fan_in**-0.5)
    return params + ([torch.full((1,), PRELU_SLOPE)] if activation == "prelu" else [])


def params_from_flax(tree: dict[str, Any]) -> list[Tensor]:
    """Parameters for `mlp` from those of an `MLP` of `sejax.ops.networks`."""
    layers = sorted((name for name in tree if name.startswith("Dense_")), key=_layer_number)
    arrays = [tree[name][leaf] for name in layers for leaf in ("kernel", "bias")]
    arrays += [np.reshape(tree["prelu_slope"], (1,))] if "prelu_slope" in tree else []
    return [torch.tensor(np.asarray(array, np.float32)) for array in arrays]


def _layer_number(name: str) -> int:
    return int(name.removeprefix("Dense_"))


# --- optimiser --------------------------------------------------------------------------------


class Trainable:
    """Parameters (copied) with Adam's moments.

    Attributes:
      params: require gradients.
      values: the same memory, without gradients.
    """

    def __init__(self, params: list[Tensor]):
        self.values = [p.detach().clone() for p in params]
        self.params = [p.detach().requires_grad_() for p in self.values]
        self._exp_avgs = [torch.zeros_like(p) for p in self.values]
        self._exp_avg_sqs = [torch.zeros_like(p) for p in self.values]
        self._num_updates = torch.zeros(())

    def descend(self, loss: Tensor, learning_rate: float) -> None:
        """One step of Adam on a loss, in place."""
        gradient = torch.autograd.grad(loss, self.params)
        with torch.no_grad():
            self._num_updates += 1
            torch._fused_adam_(
                self.values, gradient, self._exp_avgs, self._exp_avg_sqs, [],
                [self._num_updates] * len(self.values),
                lr=learning_rate, beta1=0.9, beta2=0.999, weight_decay=0.0, eps=1e-8,
                amsgrad=False, maximize=False,
            )  # fmt: skip

    def all_finite(self) -> bool:
        return all(bool(p.isfinite().all()) for p in self.values)


# --- worlds -----------------------------------------------------------------------------------


class Step(NamedTuple):
    """What a step of the SE makes."""

    obs: Tensor
    reward: float
    discount: float  # for the target
    terminated: bool
    nonfinite: bool


class SyntheticEnv:
    """The SE: its three networks run as one whose layers hold theirs side by side.

    Attributes:
      soft: whether `done` is a number between going on and an end.
    """

    def __init__(self, weights: Weights, config: SyntheticConfig):
        heads = [params_from_flax(weights[head]) for head in HEADS]
        self._params = []
        for i in range(config.num_layers + 1):
            join = torch.cat if i == 0 else lambda ws: torch.block_diag(*ws)  # same input, then own
            self._params.append(join([head[2 * i] for head in heads]).contiguous())
            self._params.append(torch.cat([head[2 * i + 1] for head in heads]))
        self._params.append(torch.full((1,), PRELU_SLOPE))
        self._activation = config.activation
        self.soft = config.done == "soft"
        self._one_hot = torch.eye(NUM_ACTIONS)

    @torch.no_grad()
    def step(self, obs: Tensor, action: int) -> Step:
        """One step from an observation with an action's index."""
        out = mlp(self._params, torch.cat([self._one_hot[action], obs]), self._activation)
        values = out.tolist()
        size = max(map(abs, values)) if all(map(math.isfinite, values)) else math.nan
        if not size < ABSURD:
            return Step(obs, 0.0, 0.0, True, math.isnan(size))
        *_, reward, done = values
        terminated = done > 0.5
        discount = 1 - done if self.soft else 1.0 - terminated
        return Step(out[:OBS_DIM], reward, discount, terminated, False)


class CartPole:
    """CartPole-v0 in NumPy, for several episodes at once. States are rows `[episode, 4]`."""

    gravity, force, step_size = 9.8, 10.0, 0.02
    pole_mass, total_mass, half_length = 0.1, 1.1, 0.5
    max_position, max_angle = 2.4, 12 * math.pi / 180

    @staticmethod
    def reset(rng: np.random.Generator, num_episodes: int) -> np.ndarray:
        return rng.uniform(-0.05, 0.05, (num_episodes, OBS_DIM)).astype(np.float32)

    @classmethod
    def step(cls, state: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Next states `[episode, 4]` and whether each has fallen `[episode]`."""
        _, velocity, angle, spin = state.T
        cos, sin = np.cos(angle), np.sin(angle)
        pole_moment = cls.pole_mass * cls.half_length
        push = np.where(action == 1, cls.force, -cls.force)
        push = (push + pole_moment * spin**2 * sin) / cls.total_mass
        spin_gain = (cls.gravity * sin - cos * push) / (
            cls.half_length * (4 / 3 - cls.pole_mass * cos**2 / cls.total_mass)
        )
        gain = push - pole_moment * spin_gain * cos / cls.total_mass
        moved = np.stack([velocity, gain, spin, spin_gain], axis=1)
        state = (state + cls.step_size * moved).astype(np.float32)
        fallen = (np.abs(state[:, 0]) > cls.max_position) | (np.abs(state[:, 2]) > cls.max_angle)
        return state, fallen


# --- replay -----------------------------------------------------------------------------------


class Batch(NamedTuple):
    """Transitions as rows. `discount` is the transition's own, before the agent's gamma."""

    obs: Tensor  # [batch, obs_dim]
    next_obs: Tensor  # [batch, obs_dim]
    action: Tensor  # [batch, 1], int64
    reward: Tensor  # [batch, 1]
    discount: Tensor  # [batch, 1]


def batch_from_sejax(transition: Any) -> Batch:
    """A batch from a feature-major `sejax.agents.buffers.Transition`, to compare updates with."""

    def rows(name: str) -> Tensor:
        array = np.asarray(getattr(transition, name), np.float32)
        return torch.tensor(np.atleast_2d(array).T.copy())

    columns = {name: rows(name) for name in Batch._fields}
    return Batch(**columns | {"action": columns["action"].long()})


class ReplayBuffer:
    """A preallocated ring of packed rows, sampled uniformly with replacement."""

    _widths = (OBS_DIM, OBS_DIM, 1, 1, 1)

    def __init__(self, capacity: int, batch_size: int):
        self._rows = torch.zeros(capacity, sum(self._widths))
        self._numpy = self._rows.numpy()  # the same memory
        self._index = torch.zeros(batch_size, dtype=torch.int64)
        self._num_stored = 0

    def store(
        self, obs: Tensor, next_obs: Tensor, action: int, reward: float, discount: float
    ) -> None:
        row = self._numpy[self._num_stored % len(self._numpy)]
        row[:OBS_DIM] = obs.numpy()
        row[OBS_DIM : 2 * OBS_DIM] = next_obs.numpy()
        row[2 * OBS_DIM :] = action, reward, discount
        self._num_stored += 1

    def sample(self) -> Batch:
        self._index.random_(0, min(self._num_stored, len(self._numpy)))
        rows = self._rows.index_select(0, self._index)
        obs, next_obs, action, reward, discount = rows.split(self._widths, dim=1)
        return Batch(obs, next_obs, action.long(), reward, discount)


# --- DDQN -------------------------------------------------------------------------------------


@dataclass
class DDQNState:
    """One agent; `ddqn_update` changes it in place."""

    online: Trainable
    target: list[Tensor]


def ddqn_state(online: list[Tensor], target: list[Tensor] | None = None) -> DDQNState:
    """A fresh agent with these parameters (copied); the target network starts as the online one."""
    return DDQNState(
        online=Trainable(online), target=[p.detach().clone() for p in target or online]
    )


def init_ddqn(config: DDQNConfig) -> DDQNState:
    """An agent with random parameters from torch's generator."""
    sizes = [OBS_DIM, *[config.hidden_size] * config.num_layers, NUM_ACTIONS]
    return ddqn_state(init_mlp(sizes, config.activation))


def ddqn_loss(state: DDQNState, batch: Batch, config: DDQNConfig) -> Tensor:
    r"""Mean squared error to :math:`r + \gamma d\, Q'(s', \arg\max_a Q(s', a))`.

    Source: van Hasselt et al. (2016), eq. 4; d is the transition's own discount, 1 - done.
    """
    activation = config.activation
    with torch.no_grad():
        best = mlp(state.online.values, batch.next_obs, activation).argmax(1, keepdim=True)
        next_value = mlp(state.target, batch.next_obs, activation).gather(1, best)
        targets = torch.addcmul(batch.reward, batch.discount, next_value, value=config.discount)
    return F.mse_loss(
        mlp(state.online.params, batch.obs, activation).gather(1, batch.action), targets
    )


def ddqn_update(state: DDQNState, batch: Batch, config: DDQNConfig) -> None:
    """One step of Adam on `ddqn_loss` and one soft update of the target network, in place."""
    state.online.descend(ddqn_loss(state, batch, config), config.learning_rate)
    torch._foreach_lerp_(state.target, state.online.values, config.tau)


@torch.no_grad()
def greedy_action(state: DDQNState, obs: Tensor, activation: str) -> int:
    """The action with the largest Q at one observation."""
    return int(mlp(state.online.values, obs, activation).argmax())


# --- inner loop -------------------------------------------------------------------------------


@dataclass(kw_only=True)
class TrainResult:
    """What came of one training: as `sejax.training.TrainResult`."""

    agent: Any
    train_steps: int
    returns: list[float]
    nonfinite: bool


def train(env: SyntheticEnv, hp: DDQNConfig, training: TrainingConfig, seed: int) -> TrainResult:
    """Trains one agent on the SE until the plateau rule fires or its steps or episodes are used up.

    Raises:
      ValueError: if the configurations ask for what is not built here.

    Source: paper, Algorithm 1, TrainAgent.
    """
    if type(hp) is not DDQNConfig or training.stop_rule not in ("plateau", "never"):
        raise ValueError("the reference is of agent=ddqn, training.stop_rule=plateau or never.")
    torch.manual_seed(seed)
    random.seed(seed)
    rng = np.random.default_rng(seed)
    max_steps = training.max_steps or training.max_episodes * MAX_STEPS
    agent = DDQNAgent(hp, max_steps)

    def reset() -> Tensor:
        return torch.from_numpy(CartPole.reset(rng, 1)[0])

    obs, total, episode_steps = reset(), 0.0, 0
    returns: list[float] = []
    for train_steps in range(1, max_steps + 1):
        action = agent.act(obs)
        step = env.step(obs, action)
        total += step.reward
        episode_steps += 1
        ended = step.terminated or episode_steps == MAX_STEPS
        agent.observe(obs, action, step, ended)
        obs = step.obs
        if ended or train_steps == max_steps:
            returns.append(total)
            if should_stop(returns, training, hp.warmup_episodes):
                break
            obs, total, episode_steps = reset(), 0.0, 0
        if step.nonfinite:
            break
    nonfinite = step.nonfinite or not agent.state.online.all_finite()
    return TrainResult(agent=agent, train_steps=train_steps, returns=returns, nonfinite=nonfinite)


class DDQNAgent:
    """Acts epsilon-greedily, and learns in each step after the warm-up."""

    def __init__(self, config: DDQNConfig, max_steps: int):
        self.state = init_ddqn(config)
        self._config = config
        self._buffer = ReplayBuffer(min(config.buffer_size, max_steps), config.batch_size)
        self._episode = 0

    def act(self, obs: Tensor) -> int:
        if random.random() < epsilon_at(self._episode, self._config):
            return random.randrange(NUM_ACTIONS)
        return greedy_action(self.state, obs, self._config.activation)

    def observe(self, obs: Tensor, action: int, step: Step, ended: bool) -> None:
        """Remembers what came of the action, and learns where it is time to."""
        self._buffer.store(obs, step.obs, action, step.reward, step.discount)
        if self._episode >= self._config.warmup_episodes:
            ddqn_update(self.state, self._buffer.sample(), self._config)
        self._episode += ended


def epsilon_at(episode: int, hp: DDQNConfig) -> float:
    """Epsilon's initial value, decayed by a factor for each episode down to its minimum.

    Differs: also where sejax falls linearly (`exploration_steps`); a random action costs less.
    """
    if episode == 0:
        return hp.epsilon_init
    return max(hp.epsilon_init * hp.epsilon_decay**episode, hp.epsilon_min)


def should_stop(returns: list[float], training: TrainingConfig, warmup_episodes: int) -> bool:
    """Whether training ends after the last of these episodes."""
    episode = len(returns) - 1
    if len(returns) >= training.max_episodes:
        return True
    may_stop = episode >= warmup_episodes + training.window
    return training.stop_rule == "plateau" and may_stop and is_plateau(returns, training)


def is_plateau(returns: list[float], training: TrainingConfig) -> bool:
    """Whether the mean return of the last d episodes is close to that of the d before.

    Source: paper, appendix "Heuristics for Agent Training and Evaluation".
    """
    newer, older = returns[-training.window :], returns[-2 * training.window : -training.window]
    older_mean = sum(older) / max(len(older), 1)
    difference = abs(sum(newer) / len(newer) - older_mean)
    return difference <= training.plateau_tolerance * (abs(older_mean) + 1e-9)


@torch.no_grad()
def play_test_episodes(
    agent: DDQNState, hp: DDQNConfig, num_episodes: int, seed: int
) -> np.ndarray:
    """Returns `[num_episodes]` of greedy episodes on the real task, all played side by side."""
    state = CartPole.reset(np.random.default_rng(seed), num_episodes)
    active = np.ones(len(state), dtype=bool)
    returns = np.zeros(len(state))
    for _ in range(MAX_STEPS):
        q_values = mlp(agent.online.values, torch.from_numpy(state), hp.activation)
        state, fallen = CartPole.step(state, q_values.argmax(1).numpy())
        returns += active  # 1 for each step, the one that falls included
        active &= ~fallen
        if not active.any():
            break
    return returns
