"""Regression with a Gaussian process on few points, by scikit-learn."""

import warnings

import numpy as np


def predict(x: np.ndarray, y: np.ndarray, x_new: np.ndarray) -> np.ndarray:
    """Posterior means at new points; the kernel is chosen by the marginal likelihood.

    Args:
      x: `[point, feature]`, features in about [0, 1].
      y: `[point]`, noisy values, which are not all the same.
      x_new: `[new, feature]`.

    Returns:
      `[new]`, in the unit of `y`.

    Raises:
      ImportError: without scikit-learn.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
    from threadpoolctl import threadpool_limits  # which scikit-learn needs

    kernel = ConstantKernel() * Matern(np.ones(x.shape[1]), nu=2.5) + WhiteKernel()
    model = GaussianProcessRegressor(
        kernel, normalize_y=True, n_restarts_optimizer=3, random_state=0
    )
    # Threads of BLAS wait for each other longer than so few points take, beside other work.
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore", ConvergenceWarning)  # a length that says: of no effect
        means: np.ndarray = model.fit(x, y).predict(x_new)
    return means
