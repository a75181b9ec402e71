r"""One-step SEs with a known best policy; their weights are computed, not fitted.

The reward of a one-step SE says which action is best in a state, so that it can be built from a
policy. For continuous actions the reward is minus the distance to the policy's action. For discrete
actions, each action that the policy likes better than the chosen one costs; a network of ReLUs
computes this without approximation:

.. math:: r(s, a) = -\sum_i |a_i - \mathrm{clip}(u_i(s))| \qquad
   r(s, a) = -\sum_j \mathrm{clip}((u_j(s) - u_a(s)) / m, 0, 1)

Episodes begin in a Gaussian with the mean and covariance of states that the policy visited.

Such an SE is its policy in disguise: no agent was trained to learn it, and its cost is the cost of
the policy (`sejax.distill`).

Source: ours; one-step SEs with learned initial states are those of Liesen et al. (2024).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from sejax.envs import Task, TaskSpec
from sejax.options import require
from sejax.proxies.base import ProxyEnv
from sejax.proxies.synthetic import START_HIDDEN_SIZE, SyntheticConfig, Vector

Layer = tuple[np.ndarray, np.ndarray]  # kernel [out, in] and bias [out] of an affine map

# Noise beyond this many standard deviations is cut off by the ReLUs of the initial states.
_MOST_NOISE = 12.0


def make_exact(
    task: Task, layers: Sequence[Layer], states: np.ndarray, independent_starts: bool = False
) -> tuple[ProxyEnv, dict[str, Any]]:
    """A one-step SE whose best policy is a given one.

    Args:
      task: the real task, whose observations are vectors.
      layers: the policy, affine maps `([out, in], [out])` of the observation with ReLUs between
        them. Continuous actions are its output `[action_dim]`, clipped to the task's bounds; the
        best discrete action is the one with the largest output `[num_actions]`.
      states: observations that the policy visited, `[state, obs_dim]`, in the task's units.
      independent_starts: whether the numbers of an initial state are independent; else they have
        the covariance of the visited states.

    Returns:
      The SE, and its weights; `sejax.save` writes them.

    Raises:
      ConfigError: for a task with discrete observations, or layers that do not fit it.

    Example:
      >>> import sejax
      >>> task = sejax.envs.make("pendulum")
      >>> layers = [(np.array([[0.0, -8.0, -2.0]]), np.zeros(1))]
      >>> env, weights = make_exact(task, layers, np.random.default_rng(0).normal(size=(99, 3)))
      >>> _, reward, _ = env.predict(weights, np.array([1.0, 0.1, 0.0]), np.array([-0.8]))
      >>> abs(float(reward)) < 1e-6
      True
    """
    states = np.asarray(states, float)
    layers = [(np.asarray(kernel, float), np.asarray(bias, float)) for kernel, bias in layers]
    require_vectors(task, task.name)
    is_fit = states.shape == (len(states), task.obs_dim) and np.isfinite(states).all()
    rule = f"must be two or more rows of {task.obs_dim} finite numbers"
    require(is_fit and len(states) > 1, "states", rule, got=states.shape)
    shapes = [kernel.shape for kernel, _ in layers]
    sizes = [task.obs_dim, *(len(bias) for _, bias in layers)]
    is_chain = layers and shapes == [*zip(sizes[1:], sizes[:-1], strict=True)]
    rule = f"must be layers from {task.obs_dim} numbers to {task.action_dim}; got {shapes}."
    require(is_chain and sizes[-1] == task.action_dim, "policy", rule)
    is_discrete = task.num_actions is not None
    reward = _preference(layers, states) if is_discrete else _as_network(layers, task.max_action)
    config = SyntheticConfig(
        hidden_size=max(len(bias) for _, bias in reward[:-1]),
        num_layers=len(reward) - 1,
        start_hidden_size=max(START_HIDDEN_SIZE, task.obs_dim),
        activation="relu",
        reward_form="network" if is_discrete else "distance",
    )
    weights = {
        "reward": _as_weights(reward, config.hidden_size),
        "start": _as_weights(gaussian(states, independent_starts), config.start_hidden_size),
    }
    return config.make(task), weights


def require_vectors(spec: TaskSpec, task_name: str) -> None:
    """Checks that a task's observations are vectors.

    Raises:
      ConfigError: if they are not.
    """
    require(spec.states == "vector", "env", "must observe vectors", got=task_name, use="cartpole")


def _as_network(layers: Sequence[Layer], bound: float) -> list[Layer]:
    """The policy in units of the bound, with at least one hidden layer: x = relu(x) - relu(-x)."""
    *hidden, (kernel, bias) = layers
    if not hidden:
        unit = np.eye(len(kernel))
        hidden = [(np.concatenate([kernel, -kernel]), np.zeros(2 * len(kernel)))]
        kernel = np.concatenate([unit, -unit], axis=1)
    return [*hidden, (kernel / bound, bias / bound)]


def _preference(layers: Sequence[Layer], states: np.ndarray) -> list[Layer]:
    """Layers for minus the cost of a one-hot action: the sum over all actions that are better.

    An action that is better by the margin m, or more, costs 1. Only a tenth of the differences in
    the given states are smaller than m, so that nearly every better action costs the same.
    """
    outputs = forward(layers, states)
    size = outputs.shape[1]
    better, chosen = np.nonzero(~np.eye(size, dtype=bool))  # [pair], both
    differences = np.abs(outputs[:, better] - outputs[:, chosen])
    margin = max(float(np.quantile(differences, 0.1)), 1e-6 * float(np.abs(outputs).max()), 1e-9)
    # The network's input is the one-hot action, then the observation. Each layer keeps the action.
    *hidden, (kernel, bias) = (
        (block_diag(np.eye(size), kernel), np.concatenate([np.zeros(size), bias]))
        for kernel, bias in layers
    )
    output = kernel[size:] / margin
    shift = bias[size:] / margin
    difference = output[better] - output[chosen]
    shift = shift[better] - shift[chosen]
    # relu(x) - relu(x - 1) is clip(x, 0, 1).
    kernel = np.concatenate([kernel[:size], difference, difference])
    clipped = kernel, np.concatenate([bias[:size], shift, shift - 1])
    # relu(clip - 1 + a) is clip for the chosen action (a = 1), and 0 for others (a = 0).
    pairs = np.eye(len(better))
    costs = np.concatenate([np.eye(size)[chosen], pairs, -pairs], axis=1), -np.ones(len(better))
    return [*hidden, clipped, costs, (np.full((1, len(better)), -1.0), np.zeros(1))]


def gaussian(states: np.ndarray, independent: bool = False) -> list[Layer]:
    """Layers that turn standard normal noise n into a move: n + move has the states' moments.

    These are the mean and the covariance; with `independent` the covariances are 0. relu(n + c) - c
    is n, except for noise below -c.
    """
    size = states.shape[1]
    spread = np.cov(states, rowvar=False).reshape(size, size)
    if independent:
        spread = np.diag(np.diag(spread))
    # Far below rounding of each number; one that does not vary gets a deviation of 1e-6.
    root = np.linalg.cholesky(spread + 1e-10 * np.diag(np.maximum(np.diag(spread), 1e-2)))
    kernel = root - np.eye(size)
    shift = np.full(size, _MOST_NOISE)
    return [(np.eye(size), shift), (kernel, states.mean(axis=0) - kernel @ shift)]


def _as_weights(layers: Sequence[Layer], hidden_size: int) -> dict[str, Any]:
    """Weights of a network with equally wide hidden layers; zeros fill up narrower layers."""
    weights = {}
    width = layers[0][0].shape[1]
    for i, (kernel, bias) in enumerate(layers):
        missing = hidden_size - len(bias) if i < len(layers) - 1 else 0
        columns = (0, width - kernel.shape[1])
        weights[f"Dense_{i}"] = {
            "kernel": np.pad(kernel, ((0, missing), columns)).astype(np.float32),
            "bias": np.pad(bias, (0, missing)).astype(np.float32),
        }
        width = hidden_size
    return weights


def forward(layers: Sequence[Layer], inputs: Vector) -> Vector:
    """The policy's outputs `[state, action_dim]` for states `[state, obs_dim]`, before clipping.

    Arrays are of NumPy or JAX.
    """
    *hidden, (kernel, bias) = layers
    for inner, shift in hidden:
        inputs = inputs @ inner.T + shift
        inputs = inputs * (inputs > 0)
    return inputs @ kernel.T + bias
