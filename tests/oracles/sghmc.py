"""SG-HMC written a second time, coordinate by coordinate, and its exact stationary law on a quadratic potential."""

import math

import numpy as np
import scipy.linalg


def recursion(
    gradients: np.ndarray,
    noises: np.ndarray,
    position: np.ndarray,
    num_data: int,
    step_size: float,
    decay: float,
    burn_in: bool,
) -> dict[str, np.ndarray]:
    """Follow given gradients and standard normal noises [steps, V] from rest; returns the final statistics."""
    final = {name: [] for name in ("position", "momentum", "averaging", "gradient", "square")}
    for coordinate, start in enumerate(position):
        v, p, xi, g, g2 = float(start), 0.0, 1.0, 1.0, 1.0
        for gradient, noise in zip(gradients[:, coordinate], noises[:, coordinate], strict=True):
            if burn_in:
                r = 1 / (xi + 1)
                xi, g, g2 = (
                    1 + xi * (1 - g * g / (g2 + 1e-16)),
                    (1 - r) * g + r * gradient,
                    (1 - r) * g2 + r * gradient**2,
                )
            inverse_mass = 1 / (math.sqrt(g2 + 1e-16) + 1e-16)
            noise_variance = max(2 * (step_size / math.sqrt(num_data)) ** 2 * decay * inverse_mass, 1e-16)
            p = p - step_size**2 * inverse_mass * gradient - decay * p + math.sqrt(noise_variance) * noise
            v += p
        for name, value in zip(final, (v, p, xi, g, g2), strict=True):
            final[name].append(value)
    return {name: np.array(values) for name, values in final.items()}


def transition(hessian: np.ndarray, inverse_mass: np.ndarray, step_size: float, decay: float) -> np.ndarray:
    """The matrix [2V, 2V] that takes (v, p) to the next (v, p), for the gradient ``hessian @ v``."""
    identity = np.eye(len(hessian))
    pull = step_size**2 * inverse_mass[:, None] * hessian
    return np.block([[identity - pull, (1 - decay) * identity], [-pull, (1 - decay) * identity]])


def stationary_covariance(
    hessian: np.ndarray, inverse_mass: np.ndarray, num_data: int, step_size: float, decay: float
) -> np.ndarray:
    """Covariance [V, V] of the positions on the potential v' H v / 2 *per datum*, step-size bias included.

    The chain is x <- A x + noise with the same noise in v as in p, so its covariance S solves S = A S A' + Q.
    As the step size goes to zero it becomes (N H)^-1.
    """
    A = transition(hessian, inverse_mass, step_size, decay)
    Q = np.kron(np.ones((2, 2)), np.diag(2 * step_size**2 / num_data * decay * inverse_mass))
    return scipy.linalg.solve_discrete_lyapunov(A, Q)[: len(hessian), : len(hessian)]


def autocovariances(
    hessian: np.ndarray, inverse_mass: np.ndarray, num_data: int, step_size: float, decay: float, num_lags: int
) -> np.ndarray:
    """E[v_(t+k) v_t'] for k = 0 .. num_lags - 1 [num_lags, V, V], of the stationary chain around its mean."""
    A = transition(hessian, inverse_mass, step_size, decay)
    Q = np.kron(np.ones((2, 2)), np.diag(2 * step_size**2 / num_data * decay * inverse_mass))
    covariance, size, lags = scipy.linalg.solve_discrete_lyapunov(A, Q), len(hessian), []
    for _ in range(num_lags):
        lags.append(covariance[:size, :size])
        covariance = A @ covariance
    return np.stack(lags)
