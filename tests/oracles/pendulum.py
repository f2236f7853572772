"""A damped pendulum pushed at random, as transitions to learn from: smooth, nonlinear, cheap, with an angle."""

import numpy as np
import torch

from gym_dgpmpc.types import ObservationSpec, Transitions

SPEC = ObservationSpec(angles=(0,))


def simulate(num_steps: int, seed: int = 0) -> Transitions:
    """One trajectory from rest: angle (0 hangs down), rate; one action in [-1, 1]."""
    rng = np.random.default_rng(seed)
    state, rows = np.zeros(2), []
    for _ in range(num_steps):
        action, before = rng.uniform(-1, 1, 1), state
        for _ in range(10):
            angle, rate = state
            state = state + 0.01 * np.array([rate, 6.0 * action[0] - 5.0 * np.sin(angle) - 0.2 * rate])
        rows.append((before, action, state))
    return Transitions(*(torch.tensor(np.stack(column), dtype=torch.float32) for column in zip(*rows, strict=True)))
