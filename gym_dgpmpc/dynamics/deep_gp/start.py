"""Where training starts: a deep Gaussian process initialised from data, or carried over to grown data.

Used by `model.py` at the beginning of every fit.
"""

import math
import warnings

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.gp.deep_gp import DeepGP
from gym_dgpmpc.gp.kernels import Kernel
from gym_dgpmpc.gp.layer import Layer, conditional, factorise
from gym_dgpmpc.inference import priors

MOST_CLUSTERED = 10_000
"""The most rows to cluster: of more than this a random subset is taken, so that the cost stays the same."""


def initial_model(
    kernel: Kernel,
    data: Data,
    num_layers: int,
    num_inducing: int,
    num_chains: int,
    generator: torch.Generator,
    *,
    linear: bool = False,
) -> DeepGP:
    """Hyperparameters of C chains before the first fit, for standardised data.

    Inducing inputs by k-means of the inputs, of each chain its own, in every layer (the inner layers start near the
    identity); all else at the centres of `inference.priors`. With ``linear`` the last layer's kernel has a linear part.
    """
    size = data.x.shape[1]
    rows = _rows_to_cluster(data.x, generator)
    centres = torch.stack([cluster(rows, num_inducing, generator) for _ in range(num_chains)])
    log_lengthscale = data.x.new_full((num_chains, size), priors.log_lengthscale_centre(size))

    def layer(*, last: bool) -> Layer:
        log_variance = data.x.new_full((num_chains,), priors.log_variance_centre(last=last))
        log_slope = torch.full_like(log_lengthscale, math.log(priors.SLOPE)) if last and linear else None
        return Layer(kernel, centres.clone(), log_lengthscale.clone(), log_variance, log_slope)

    layers = tuple(layer(last=index == num_layers - 1) for index in range(num_layers))
    return DeepGP(layers, data.y.new_full((num_chains, data.y.shape[1]), math.log(priors.NOISE_VARIANCE)))


def cluster(x: Float[Tensor, "N D"], num_clusters: int, generator: torch.Generator) -> Float[Tensor, "M D"]:
    """M inducing inputs: k-means centres of the rows; where there are fewer rows, also perturbed copies of rows."""
    num_rows = x.shape[0]
    if num_rows <= num_clusters:
        extra = torch.randint(num_rows, (num_clusters - num_rows,), generator=generator, device=x.device)
        spread = 0.1 * torch.randn(len(extra), x.shape[1], generator=generator, dtype=x.dtype, device=x.device)
        return torch.cat([x, x[extra] + spread])
    from scipy.cluster.vq import kmeans2  # here, for it takes long to import

    seed = int(torch.randint(2**31, (), generator=generator, device=x.device))
    with warnings.catch_warnings():
        # An empty cluster keeps its last centre, which is as good an inducing input as any.
        warnings.filterwarnings("ignore", "One of the clusters is empty", UserWarning)
        centres, _ = kmeans2(
            x.cpu().numpy(), num_clusters, iter=10, minit="points", missing="warn", rng=np.random.default_rng(seed)
        )
    return torch.from_numpy(centres).to(x)


def _rows_to_cluster(x: Float[Tensor, "N D"], generator: torch.Generator) -> Float[Tensor, "n D"]:
    if x.shape[0] <= MOST_CLUSTERED:
        return x
    return x[torch.randperm(x.shape[0], generator=generator, device=x.device)[:MOST_CLUSTERED]]


def restandardise(
    model: DeepGP,
    whitened: Float[Tensor, "*c V"],
    old: tuple[Normaliser, Normaliser],
    new: tuple[Normaliser, Normaliser],
) -> tuple[DeepGP, Float[Tensor, "*c V"]]:
    """The same function of raw inputs, expressed in new standardised coordinates of inputs and targets.

    Inner layers live in the inputs' coordinates, so their inducing inputs and lengthscales follow the inputs' affine
    map and their (whitened, hence linear) inducing outputs its scale. The last layer's follow the targets' scale, of
    which the kernel's variance takes the geometric mean; the shift of the targets' mean is left to training. With a
    linear part, which a shift of the inputs changes, the function is the same at the inducing inputs.
    """
    stretch = old[0].std / new[0].std
    shift = (old[0].mean - new[0].mean) / new[0].std
    stretch_out = old[1].std / new[1].std
    common = stretch_out.log().mean()
    layers = [
        layer._replace(
            inducing_inputs=layer.inducing_inputs * stretch + shift,
            log_lengthscale=layer.log_lengthscale + stretch.log(),
        )
        for layer in model.layers
    ]
    layers[-1] = layers[-1]._replace(log_variance=layers[-1].log_variance + 2 * common)
    *inner, last = model.split(whitened)
    last = last * (stretch_out / common.exp())
    if layers[-1].log_slope is not None:
        values = (common.exp() * factorise(model.layers[-1])) @ last
        last = torch.linalg.solve_triangular(factorise(layers[-1]), values, upper=False)
    scaled = [v * stretch for v in inner] + [last]
    return (
        DeepGP(tuple(layers), model.log_noise + 2 * stretch_out.log()),
        torch.cat([v.flatten(-2) for v in scaled], dim=-1),
    )


def relocate(
    model: DeepGP, whitened: Float[Tensor, "C V"], data: Data, generator: torch.Generator
) -> tuple[DeepGP, Float[Tensor, "C V"]]:
    """Move every layer's inducing inputs to where its inputs are now, keeping the function they encode.

    New centres come from k-means of the inputs propagated by the layers' means; the new inducing outputs are the old
    conditional mean there.
    """
    rows = _rows_to_cluster(data.x, generator)
    layers, outputs, x = [], [], rows.expand(len(whitened), -1, -1)
    last = len(model.layers) - 1
    for index, (layer, v) in enumerate(zip(model.layers, model.split(whitened), strict=True)):
        factor = factorise(layer)
        centres = torch.stack([cluster(each, layer.inducing_inputs.shape[-2], generator) for each in x])
        moved = layer._replace(inducing_inputs=centres)
        mean, _ = conditional(layer, factor, v, centres)
        outputs.append(torch.linalg.solve_triangular(factorise(moved), mean, upper=False))
        layers.append(moved)
        if index != last:
            x = x + conditional(layer, factor, v, x)[0]
    return DeepGP(tuple(layers), model.log_noise), torch.cat([v.flatten(-2) for v in outputs], dim=-1)
