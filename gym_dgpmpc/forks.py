"""Models and plans in forked processes: a child computes on one thread, and so does not wait for threads of its parent.

PyTorch's pool of threads (OpenMP) does not survive a fork: the child takes it for there, and waits for ever for threads
that only the parent has. With one thread there is no pool to wait for; PyTorch's own `DataLoader` does the same in its
workers. Called by whatever computes with PyTorch: `dynamics/learner.py` and `planning/controller.py`.
"""

import os
from functools import cache

import torch


@cache
def compute_on_one_thread_in_children() -> None:
    """Let every process that is forked from this one, from now on, begin with one thread of PyTorch's."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_use_one_thread)


def _use_one_thread() -> None:
    if torch.get_num_threads() > 1:
        torch.set_num_threads(1)
