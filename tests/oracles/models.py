"""Small hand-made deep Gaussian processes, in torch and as the numpy oracle sees them."""

import torch
from torch import Tensor

from gym_dgpmpc.gp.deep_gp import DeepGP
from gym_dgpmpc.gp.kernels import find_kernel
from gym_dgpmpc.gp.layer import Layer
from tests.oracles.gaussian_process import DenseLayer


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def make_model(
    num_layers: int,
    input_size: int,
    num_targets: int,
    num_inducing: int,
    generator: torch.Generator,
    kernel: str = "rbf",
    *,
    linear: bool = False,
) -> DeepGP:
    """Random inducing inputs, unequal lengthscales and variances; an inner layer that bends its input noticeably.

    With ``linear`` the last layer's kernel has a linear part, of slopes that are unequal too.
    """

    def layer(variance: float, *, linear: bool = False) -> Layer:
        lengthscale = 0.8 + torch.rand(input_size, generator=generator, dtype=torch.float64)
        inducing_inputs = 1.5 * normal(generator, num_inducing, input_size)
        log_variance = torch.tensor(variance, dtype=torch.float64).log()
        log_slope = 0.5 * normal(generator, input_size) - 0.5 if linear else None
        return Layer(find_kernel(kernel), inducing_inputs, lengthscale.log(), log_variance, log_slope)

    inner = [layer(0.15) for _ in range(num_layers - 1)]
    noise = 0.1 + 0.2 * torch.rand(num_targets, generator=generator, dtype=torch.float64)
    return DeepGP((*inner, layer(1.7, linear=linear)), noise.log())


def dense(layer: Layer) -> DenseLayer:
    slope = 0.0 if layer.log_slope is None else layer.log_slope.exp().numpy()
    return DenseLayer(layer.inducing_inputs.numpy(), layer.lengthscale.numpy(), float(layer.variance), slope)


def chains(*models: DeepGP) -> DeepGP:
    """The models side by side, as those of as many chains."""
    stacked = [torch.stack(tensors) for tensors in zip(*(model.parameters() for model in models), strict=True)]
    return models[0].with_parameters(stacked)
