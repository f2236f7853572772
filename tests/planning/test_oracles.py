"""The oracles themselves, by routes that share nothing with how they compute."""

import numpy as np
import pytest
import torch

from tests.oracles import linear_gaussian, lqr

PROBLEM = lqr.LQR(
    A=np.array([[1.0, 0.2], [-0.1, 0.95]]),
    B=np.array([[0.0, 0.1], [0.3, 0.0]]),
    Q=np.array([[1.0, 0.1], [0.1, 0.2]]),
    R=np.diag([0.1, 0.2]),
)
START = np.array([1.5, -0.5])


def simulated_cost(actions: torch.Tensor) -> torch.Tensor:
    A, B, Q, R = map(torch.tensor, PROBLEM)
    state, cost = torch.tensor(START), torch.zeros((), dtype=torch.float64)
    for action in actions:
        state = A @ state + B @ action
        cost = cost + state @ Q @ state + action @ R @ action
    return cost


@pytest.mark.parametrize("horizon", [1, 2, 7])
def test_the_riccati_solution_is_stationary_and_its_cost_is_the_simulated_one(horizon):
    actions, cost = lqr.solve(PROBLEM, START, horizon)
    variable = torch.tensor(actions, requires_grad=True)
    simulated = simulated_cost(variable)
    (gradient,) = torch.autograd.grad(simulated, variable)
    assert simulated.item() == pytest.approx(cost, rel=1e-12)
    assert gradient.abs().max() < 1e-12  # a positive definite quadratic has one stationary point


def test_the_condensed_matrix_is_half_the_hessian():
    hessian = torch.autograd.functional.hessian(simulated_cost, torch.zeros(4, 2, dtype=torch.float64))
    np.testing.assert_allclose(lqr.condensed(PROBLEM, 4), hessian.reshape(8, 8).numpy() / 2, atol=1e-12)


def test_the_covariance_approaches_the_stationary_one():
    A, W = np.array([[0.6, 0.2], [-0.3, 0.5]]), np.array([[0.5, 0.2], [0.2, 0.4]])
    means, covariances = linear_gaussian.moments(A, np.zeros((2, 1)), W, START, np.zeros((200, 1)))
    stationary = np.linalg.solve(np.eye(4) - np.kron(A, A), W.ravel()).reshape(2, 2)
    np.testing.assert_allclose(covariances[-1], stationary, atol=1e-12)
    np.testing.assert_allclose(means[-1], 0.0, atol=1e-12)
