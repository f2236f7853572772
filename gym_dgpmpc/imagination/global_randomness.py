"""Stable-Baselines3 draws from the process's own random states; here they are lent to it and put back."""

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


@contextmanager
def lent_randomness() -> Iterator[None]:
    """Give back the random states of Python, NumPy and PyTorch as they were, whatever happens to them inside."""
    python, numpy, own = random.getstate(), np.random.get_state(), torch.get_rng_state()  # noqa: NPY002
    of_devices = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)  # noqa: NPY002
        torch.set_rng_state(own)
        if of_devices:
            torch.cuda.set_rng_state_all(of_devices)
