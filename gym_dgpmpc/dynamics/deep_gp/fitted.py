"""What a fit of the deep Gaussian process leaves behind, and its entries in a state that is saved.

`model.py` makes it by training, draws from it, and moves it on as data grow.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.dynamics.bounds import SeenTargets, take_seen
from gym_dgpmpc.dynamics.noise import NoiseSplit, take_noise_split
from gym_dgpmpc.dynamics.state import normalisers_state, take_normaliser, take_tensor, take_tensors
from gym_dgpmpc.gp.deep_gp import DeepGP, Factorised, factorise_all
from gym_dgpmpc.gp.kernels import Kernel
from gym_dgpmpc.gp.layer import Layer, parameter_shapes
from gym_dgpmpc.inference import sghmc
from gym_dgpmpc.inference.diagnostics import effective_sample_size, rank_normalised_r_hat
from gym_dgpmpc.types import Scales, StateDict


class Fitted(NamedTuple):
    """C chains: their hyperparameters, where they are, and samples that they left."""

    factorised: Factorised  # of C chains; a saved state holds only its model
    normalisers: tuple[Normaliser, Normaliser]
    chain: sghmc.SGHMCState  # "C V"
    latents: list[Tensor]  # "C N D" of each inner layer, float32
    pool: Tensor  # "n C V", a ring of n samples of each chain
    oldest: int  # the row of the pool that the next sample replaces
    seen: SeenTargets
    noise: NoiseSplit | None = None  # None: not told apart

    def state_dict(self) -> StateDict:
        """As entries of a state; see `take_fitted`."""
        model = self.factorised.model
        # The pool is the one tensor that changes in place, which must not change a state taken before.
        state: StateDict = {"pool": self.pool.clone(), "oldest": self.oldest, "log_noise": model.log_noise}
        for index, layer in enumerate(model.layers):
            state |= {f"layers.{index}.{name}": value for name, value in layer.parameters().items()}
        state |= {f"latents.{index}": latent for index, latent in enumerate(self.latents)}
        state |= normalisers_state(*self.normalisers) | self.seen.state()
        state |= {} if self.noise is None else self.noise.state()
        return state | {f"chain.{name}": value for name, value in self.chain._asdict().items()}

    def diagnostics(self) -> dict[str, float]:
        """Mixing of the kept samples (medians over coordinates), and the fitted noise and kernel scales."""
        model, by_chain = self.factorised.model, self.pool.unbind(1)
        sizes = torch.stack([effective_sample_size(samples) for samples in by_chain])
        metrics = {
            "effective_sample_size": float(sizes.sum(0).median()),
            "gradient_norm": float(self.chain.gradient.norm(dim=-1).mean()),
            "noise_std": float(model.noise_variance.sqrt().mean()),
        }
        if len(self.pool) >= 4:
            metrics["r_hat"] = float(torch.stack([rank_normalised_r_hat(samples) for samples in by_chain]).median())
        for index, layer in enumerate(model.layers):
            metrics[f"layer_{index + 1}_kernel_std"] = float(layer.variance.sqrt().mean())
        return metrics

    def scales(self) -> Scales:
        """Lengthscales of each layer and noise, of every chain."""
        model = self.factorised.model
        return Scales([layer.lengthscale for layer in model.layers], model.noise_variance.sqrt())


class FittedSizes(NamedTuple):
    """The sizes that settings and encoding give a `Fitted`."""

    num_chains: int
    num_layers: int
    num_inducing: int
    num_samples: int
    num_inputs: int
    num_targets: int
    linear: bool


def take_fitted(state: StateDict, kernel: Kernel, sizes: FittedSizes, device: torch.device) -> Fitted:
    """What `Fitted.state_dict` made entries of.

    Raises:
        ValueError: an entry is missing or is not of these sizes.
    """
    chains, size, num_targets = sizes.num_chains, sizes.num_inputs, sizes.num_targets
    whitened = sizes.num_inducing * (size * (sizes.num_layers - 1) + num_targets)

    def take(name: str, *shape: int) -> Tensor:
        return take_tensor(state, name, shape, device)

    def take_layer(index: int) -> Layer:
        linear = sizes.linear and index == sizes.num_layers - 1
        shapes = parameter_shapes(sizes.num_inducing, size, linear=linear)
        of_chains = {name: (chains, *shape) for name, shape in shapes.items()}
        return Layer(kernel, **take_tensors(state, of_chains, device, prefix=f"layers.{index}."))

    layers = (take_layer(index) for index in range(sizes.num_layers))
    model = DeepGP(tuple(layers), take("log_noise", chains, num_targets))
    normalisers = (
        take_normaliser(state, "inputs", size, device),
        take_normaliser(state, "targets", num_targets, device),
    )
    chain = sghmc.SGHMCState(*(take(f"chain.{name}", chains, whitened) for name in sghmc.SGHMCState._fields))
    pool, oldest = take("pool", sizes.num_samples, chains, whitened), state.get("oldest")
    if not isinstance(oldest, int) or not 0 <= oldest < sizes.num_samples:
        raise ValueError(f"dynamics state 'oldest': expected one of 0 to {sizes.num_samples - 1}, received {oldest!r}")
    latents = [_take_latent(state, f"latents.{index}", chains, size, device) for index in range(sizes.num_layers - 1)]
    seen, noise = take_seen(state, num_targets, device), take_noise_split(state, num_targets, device)
    return Fitted(factorise_all(model), normalisers, chain, latents, pool, oldest, seen, noise)


def _take_latent(
    state: StateDict, name: str, num_chains: int, size: int, device: torch.device
) -> Float[Tensor, "C N D"]:
    """The latents of an inner layer, for however many rows there were."""
    value = state.get(name)
    rows = value.shape[1] if isinstance(value, Tensor) and value.ndim == 3 else 0
    return take_tensor(state, name, (num_chains, rows, size), device, torch.float32)
