"""The linear-quadratic regulator over a finite horizon: the exact optimum of a planning problem.

States follow x[t+1] = A x[t] + B u[t]; the cost is sum_{t<H} x[t+1]' Q x[t+1] + u[t]' R u[t]. Without noise the
optimal feedback law and the optimal open-loop sequence give the same actions.
"""

from typing import NamedTuple

import numpy as np


class LQR(NamedTuple):
    A: np.ndarray
    B: np.ndarray
    Q: np.ndarray
    R: np.ndarray


def solve(problem: LQR, initial_state: np.ndarray, horizon: int) -> tuple[np.ndarray, float]:
    """The optimal actions [H, A] and their cost.

    With V_t(x) = x' P_t x the cost to come after x[t] has been paid for, and W = Q + P_{t+1}, P_H = 0:
    K_t = (R + B'WB)^-1 B'WA and P_t = A'W (A - B K_t).
    """
    A, B, Q, R = problem
    to_go = np.zeros_like(Q)
    gains = []
    for _ in range(horizon):
        weight = Q + to_go
        gain = np.linalg.solve(R + B.T @ weight @ B, B.T @ weight @ A)
        to_go = A.T @ weight @ (A - B @ gain)
        gains.append(gain)
    state, actions = initial_state, []
    for gain in reversed(gains):
        actions.append(-gain @ state)
        state = A @ state + B @ actions[-1]
    return np.stack(actions), float(initial_state @ to_go @ initial_state)


def condensed(problem: LQR, horizon: int) -> np.ndarray:
    """The matrix G [H A, H A] of the cost of stacked actions: cost(u) = cost(u*) + e' G e with e = u - u*.

    G = F' diag(Q) F + diag(R), where block (t, s) of F is A^(t-s) B for s <= t.
    """
    A, B, Q, R = problem
    size, width = B.shape
    effect = np.zeros((horizon * size, horizon * width))
    for t in range(horizon):
        for s in range(t + 1):
            block = np.linalg.matrix_power(A, t - s) @ B
            effect[t * size : (t + 1) * size, s * width : (s + 1) * width] = block
    return effect.T @ np.kron(np.eye(horizon), Q) @ effect + np.kron(np.eye(horizon), R)
