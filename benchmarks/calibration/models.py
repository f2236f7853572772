"""The models of the benchmark, each as a function of a task's sizes and spec; see `MODELS`."""

from collections.abc import Callable
from functools import partial

from benchmarks.methods import OPTIMUM
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.dynamics.ensemble.model import EnsembleDynamics
from gym_dgpmpc.dynamics.mixture.model import MixtureDynamics
from gym_dgpmpc.dynamics.sparse_gp.model import SparseGPDynamics

Make = Callable[..., DeepGPDynamics | EnsembleDynamics | SparseGPDynamics | MixtureDynamics]

MODELS: dict[str, Make] = {
    "DGP L=1": partial(DeepGPDynamics, num_layers=1),
    "DGP L=2": partial(DeepGPDynamics, num_layers=2),
    "DGP L=3": partial(DeepGPDynamics, num_layers=3),
    "PETS, 5 epochs": partial(EnsembleDynamics),
    "PETS, held-out optimum": partial(EnsembleDynamics, **OPTIMUM),
    "sparse GP": partial(SparseGPDynamics),
    "sparse GP with noise": partial(SparseGPDynamics, add_noise=True),
    "exact GP": partial(SparseGPDynamics, exact=True),
    "DGP L=2 and PETS": partial(MixtureDynamics),
}
