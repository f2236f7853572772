"""The exact law of a linear system driven by Gaussian noise: x[t+1] = A x[t] + B u[t] + w, w ~ N(0, W)."""

import numpy as np


def moments(
    A: np.ndarray, B: np.ndarray, W: np.ndarray, initial_state: np.ndarray, actions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Means [H + 1, S] and covariances [H + 1, S, S] of the states under ``actions`` [H, A] (Kalman's prediction)."""
    means, covariances = [initial_state], [np.zeros_like(W)]
    for action in actions:
        means.append(A @ means[-1] + B @ action)
        covariances.append(A @ covariances[-1] @ A.T + W)
    return np.stack(means), np.stack(covariances)


def expected_quadratic(mean: np.ndarray, covariance: np.ndarray, Q: np.ndarray) -> float:
    """E[x' Q x] = m' Q m + tr(Q C)."""
    return float(mean @ Q @ mean + np.trace(Q @ covariance))
