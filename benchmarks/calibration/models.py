"""The models of the benchmark, each as a function of a task's sizes and spec; see `MODELS`."""

from collections.abc import Callable
from functools import partial
from typing import Any

from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.dynamics.ensemble.model import EnsembleDynamics
from gym_dgpmpc.dynamics.sparse_gp.model import SparseGPDynamics

Make = Callable[..., DeepGPDynamics | EnsembleDynamics | SparseGPDynamics]

_REACHER_NETWORKS = {
    "num_hidden_layers": 4,
    "hidden_size": 200,
    "weight_decay": (2.5e-4, 5e-4, 5e-4, 5e-4, 7.5e-4),
    "learning_rate": 7.5e-4,
}
_HALF_CHEETAH_NETWORKS = {
    "num_hidden_layers": 4,
    "hidden_size": 200,
    "weight_decay": (2.5e-5, 5e-5, 7.5e-5, 7.5e-5, 1e-4),
    "learning_rate": 1e-3,
}

NETWORKS: dict[str, dict[str, Any]] = {"reacher": _REACHER_NETWORKS, "cheetah": _HALF_CHEETAH_NETWORKS}
"""Where the published settings of the ensemble differ from its defaults."""

MODELS: dict[str, Make] = {
    "DGP L=1": partial(DeepGPDynamics, num_layers=1),
    "DGP L=2": partial(DeepGPDynamics, num_layers=2),
    "DGP L=3": partial(DeepGPDynamics, num_layers=3),
    "PETS, 5 epochs": partial(EnsembleDynamics),
    "PETS, held-out optimum": partial(EnsembleDynamics, num_epochs=300, patience=15),
    "sparse GP": partial(SparseGPDynamics),
    "sparse GP with noise": partial(SparseGPDynamics, add_noise=True),
    "exact GP": partial(SparseGPDynamics, exact=True),
}
