r"""One-step SEs whose best policy is known: written down, with nothing fitted.

The reward of a one-step SE says which action is best in a state, so that it can be built from a
policy. Where actions are continuous, the reward is minus the distance to the policy's action, or
its square (`proxy.reward_form`); where they are discrete, each action that the policy likes better
costs, in a network of ReLUs that is no approximation:

.. math:: r(s, a) = -c \sum_i |a_i - \mathrm{clip}(u_i(s))| \qquad
   r(s, a) = -c \sum_j \mathrm{clip}((u_j(s) - u_a(s)) / m, 0, 1)

Episodes begin in a Gaussian with the mean and covariance of states that the policy visited.

Such an SE is its policy in disguise: no agent was trained to learn it, and what it costs is what
the policy cost (`sejax.distillation`).

Source: ours; one-step SEs with learned initial states are those of Liesen et al. (2024).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sejax.envs.base import Task
from sejax.options import positive, require
from sejax.proxies.base import ProxyEnv
from sejax.proxies.synthetic import START_HIDDEN_SIZE, SyntheticConfig

Layer = tuple[np.ndarray, np.ndarray]  # kernel [out, in] and bias [out] of an affine map

# Noise beyond this many standard deviations is cut off by the ReLUs of the initial states.
_MOST_NOISE = 12.0


def make_exact(
    task: Task,
    layers: Sequence[Layer],
    states: np.ndarray,
    *,
    form: str = "distance",
    slope: float = 1.0,
    widen: float = 1.0,
    independent_starts: bool = False,
) -> tuple[ProxyEnv, dict[str, Any]]:
    """A one-step SE whose best policy is a given one.

    Args:
      task: the real task, whose observations are vectors.
      layers: the policy, affine maps of the observation with ReLUs between them. Continuous actions
        are its output `[action_dim]`, clipped to the task's bounds; of discrete ones the one with
        the largest output `[num_actions]` is best.
      states: observations that the policy visited, `[state, obs_dim]`, in the task's units.
      form: of the reward where actions are continuous, `distance` or `quadratic`.
      slope: c, what a unit of it costs, or an action that is not the best.
      widen: deviation of the initial states, in units of the visited ones'.
      independent_starts: whether their numbers are independent; else they have the covariance of
        the visited states.

    Returns:
      The SE, and its weights; `sejax.save` writes them.

    Raises:
      ConfigError: for a task with discrete observations, layers that do not fit it, or numbers that
        are not finite.

    Example:
      >>> import sejax
      >>> task = sejax.envs.make("pendulum")
      >>> layers = [(np.array([[0.0, -8.0, -2.0]]), np.zeros(1))]
      >>> env, weights = make_exact(task, layers, np.random.default_rng(0).normal(size=(99, 3)))
      >>> reward = env.bandit_reward(weights, np.array([1.0, 0.1, 0.0]), np.array([-0.8]))
      >>> abs(float(reward)) < 1e-6
      True
    """
    task_states = np.asarray(states, float)
    layers = [(np.asarray(kernel, float), np.asarray(bias, float)) for kernel, bias in layers]
    _require_fit(task, layers, task_states)
    positive("a reward must tell actions apart")("slope", slope, 1.0)
    positive("it is a scale")("widen", widen, 1.0)
    known: dict[str, Any] = {}
    if task.num_actions is None:
        reward = _as_network(layers, task.max_action)
        known = {"reward_form": form, "reward_slope": slope}
    else:
        reward = _preference(layers, task_states, slope)
    config = SyntheticConfig(
        hidden_size=max(len(bias) for _, bias in reward[:-1]),
        num_layers=len(reward) - 1,
        start_hidden_size=max(START_HIDDEN_SIZE, task.obs_dim),
        activation="relu",
        **known,
    )
    weights = {
        "reward": as_weights(reward, config.hidden_size),
        "start": as_weights(
            gaussian(task_states, widen, independent_starts), config.start_hidden_size
        ),
    }
    return config.make(task), weights


def _require_fit(task: Task, layers: Sequence[Layer], states: np.ndarray) -> None:
    require(
        task.num_states is None,
        "env",
        f"must have vectors as observations; got {task.name}. Set env=cartpole.",
    )
    require(
        states.ndim == 2 and states.shape[1] == task.obs_dim and len(states) > 1,
        "states",
        f"must be several of {task.obs_dim} numbers each; got the shape {list(states.shape)}. Set "
        "observations that the policy visited.",
    )
    sizes = [task.obs_dim, *(len(bias) for _, bias in layers)]
    shapes = [tuple(kernel.shape) for kernel, _ in layers]
    fitting = list(zip(sizes[1:], sizes[:-1], strict=True))
    require(
        shapes == fitting and sizes[-1] == task.action_dim and len(layers) > 0,
        "policy",
        f"must map {task.obs_dim} numbers to {task.action_dim}, each layer what the one before it "
        f"gives; got kernels of the shapes {shapes}. Set layers=[(kernel, bias)].",
    )
    numbers = [states, *(x for layer in layers for x in layer)]
    require(
        all(np.isfinite(x).all() for x in numbers),
        "policy",
        "must have finite numbers, in its states too; got others. Set another policy.",
    )


def _as_network(layers: Sequence[Layer], bound: float) -> list[Layer]:
    """The policy in units of the bound, with a hidden layer at least: x is relu(x) - relu(-x)."""
    *hidden, (kernel, bias) = layers
    if not hidden:
        size = len(kernel)
        hidden = [(np.concatenate([kernel, -kernel]), np.zeros(2 * size))]
        kernel = np.concatenate([np.eye(size), -np.eye(size)], axis=1)
    return [*hidden, (kernel / bound, bias / bound)]


def _preference(layers: Sequence[Layer], states: np.ndarray, slope: float) -> list[Layer]:
    """Minus what an action, one-hot, costs for each that the policy likes better.

    An action that is better by the margin m, or more, costs 1; a tenth of such differences in
    the given states are smaller than m, so that nearly every wrong action costs as much.
    """
    size = len(layers[-1][1])
    outputs = evaluate(layers, states)
    better, chosen = (np.array(x) for x in zip(*_pairs(size), strict=True))
    differences = np.abs(outputs[:, better] - outputs[:, chosen])
    margin = max(float(np.quantile(differences, 0.1)), 1e-6 * float(np.abs(outputs).max()), 1e-9)
    *hidden, (kernel, bias) = _with_action(layers, size)
    action, output, own = kernel[:size], kernel[size:] / margin, bias[size:] / margin
    apart, shift = output[better] - output[chosen], own[better] - own[chosen]
    # relu(x) - relu(x - 1) is clip(x, 0, 1).
    clipped = (
        np.concatenate([action, apart, apart]),
        np.concatenate([bias[:size], shift, shift - 1]),
    )
    # relu(clip - 1 + a) is clip for the action that was chosen, and 0 for others.
    pairs = np.eye(len(better))
    costs = np.concatenate([np.eye(size)[chosen], pairs, -pairs], axis=1), -np.ones(len(better))
    return [*hidden, clipped, costs, (np.full((1, len(better)), -slope), np.zeros(1))]


def _pairs(size: int) -> list[tuple[int, int]]:
    return [(j, k) for j in range(size) for k in range(size) if j != k]


def _with_action(layers: Sequence[Layer], size: int) -> list[Layer]:
    """The policy's layers, which hand on the action `[size]`, one-hot, beside.

    The network's input is the action before the observation, and so are the outputs of each layer.
    """
    found = []
    for kernel, bias in layers:
        beside = np.zeros((size, kernel.shape[1])), np.zeros((len(bias), size))
        wide = np.block([[np.eye(size), beside[0]], [beside[1], kernel]])
        found.append((wide, np.concatenate([np.zeros(size), bias])))
    return found


def gaussian(states: np.ndarray, widen: float = 1.0, independent: bool = False) -> list[Layer]:
    """Layers that turn standard normal noise n into a move, so that n and it have the moments.

    The mean and covariance of n + move are those of the states, the deviations times `widen`.
    relu(n + c) - c is n but for noise below -c. Numbers that are `independent` have no covariance.
    """
    mean, size = states.mean(axis=0), states.shape[1]
    spread = widen**2 * np.cov(states, rowvar=False).reshape(size, size)
    if independent:
        spread = np.diag(np.diag(spread))
    # A number that does not vary keeps a deviation that is far below rounding.
    root = np.linalg.cholesky(spread + 1e-10 * np.eye(size) * max(1.0, np.abs(spread).max()))
    kernel = root - np.eye(size)
    shift = np.full(size, _MOST_NOISE)
    return [(np.eye(size), shift), (kernel, mean - kernel @ shift)]


def as_weights(layers: Sequence[Layer], hidden_size: int) -> dict[str, Any]:
    """Weights of a network with equally wide hidden layers, which zeros fill up."""
    *hidden, last = layers
    size_in, found = hidden[0][0].shape[1], {}
    for i, (kernel, bias) in enumerate([*hidden, last]):
        rows = hidden_size if i < len(hidden) else len(bias)
        columns = size_in if i == 0 else hidden_size
        wide = np.zeros((rows, columns), np.float32)
        wide[: kernel.shape[0], : kernel.shape[1]] = kernel
        found[f"Dense_{i}"] = {
            "kernel": wide,
            "bias": np.pad(bias, (0, rows - len(bias))).astype(np.float32),
        }
    return found


def evaluate(layers: Sequence[Layer], states: np.ndarray) -> np.ndarray:
    """The policy's outputs in states `[state, obs_dim]`, before clipping; `[state, action_dim]`."""
    *hidden, last = layers
    values = states
    for kernel, bias in hidden:
        values = np.maximum(values @ kernel.T + bias, 0.0)
    return np.asarray(values @ last[0].T + last[1])
