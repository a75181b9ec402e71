"""Regression with a Gaussian process on few points, in NumPy.

Source: Rasmussen and Williams, 2006, "Gaussian Processes for Machine Learning", algorithm 2.1.
"""

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

LENGTHS = (0.2, 30.0)  # bounds of a length scale, of features in [0, 1]
SIGNALS = (1e-2, 1e2)  # bounds of the variance of the function, of values with variance 1
NOISES = (1e-3, 2.0)  # bounds of the variance of the noise
STARTS = (0.5, 2.0)  # length scales from which the likelihood is climbed


def predict(x: np.ndarray, y: np.ndarray, x_new: np.ndarray) -> np.ndarray:
    """Posterior means at new points; the kernel is chosen by the marginal likelihood.

    Args:
      x: `[point, feature]`, features in about [0, 1].
      y: `[point]`, noisy values, which are not all the same.
      x_new: `[new, feature]`.

    Returns:
      `[new]`, in the unit of `y`.
    """
    mean, std = y.mean(), y.std()
    target, num_features = (y - mean) / std, x.shape[1]
    bounds = np.log([*[LENGTHS] * num_features, SIGNALS, NOISES])
    fits = [
        minimize(
            lambda theta: -log_likelihood(x, target, np.exp(theta)),
            np.log([*[start] * num_features, 1.0, 0.1]),
            bounds=bounds,
        )
        for start in STARTS
    ]
    theta = np.exp(min(fits, key=lambda fit: float(fit.fun)).x)
    return mean + std * posterior_mean(x, target, x_new, theta)


def posterior_mean(
    x: np.ndarray, y: np.ndarray, x_new: np.ndarray, theta: np.ndarray
) -> np.ndarray:
    """Posterior means `[new]` for given length scales, signal variance and noise variance."""
    factor = cho_factor(_kernel(x, x, theta) + theta[-1] * np.eye(len(x)), lower=True)
    means: np.ndarray = _kernel(x_new, x, theta) @ cho_solve(factor, y)
    return means


def log_likelihood(x: np.ndarray, y: np.ndarray, theta: np.ndarray) -> float:
    """Logarithm of the marginal likelihood, without its constant."""
    factor = cho_factor(_kernel(x, x, theta) + theta[-1] * np.eye(len(x)), lower=True)
    return float(-0.5 * y @ cho_solve(factor, y) - np.log(np.diag(factor[0])).sum())


def _kernel(x: np.ndarray, other: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Squared exponential, a length scale for each feature."""
    lengths, signal = theta[:-2], theta[-2]
    kernel: np.ndarray = signal * np.exp(-0.5 * cdist(x / lengths, other / lengths, "sqeuclidean"))
    return kernel
