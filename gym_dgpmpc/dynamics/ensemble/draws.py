"""Draws of a trained ensemble: the ways of Chua et al. (2018) to move P particles through B networks.

    TS1          each particle through a network drawn anew at each step, a candidate's particles shared out evenly;
    TSinf        each particle through one network, its own for the whole plan;
    DS           each by its own draw from the Gaussian with the ensemble's mean and total variance;
    MM           as DS, then a candidate's particles are replaced by draws from their mean and variance;
    expectation  along the ensemble's mean.

The last three need only a Gaussian at each point: `CollapsedEnsemble` gives it, `gaussian_draws.py` draws from it.
"""

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.autograd import grad_if_asked
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.dynamics.ensemble.network import Ensemble, predict
from gym_dgpmpc.dynamics.gaussian_draws import Gaussian, normals_like

Propagation = Literal["TS1", "TSinf", "DS", "MM", "expectation"]
PROPAGATIONS: tuple[Propagation, ...] = get_args(Propagation)


class EnsembleSampler:
    """The draws `TSinf` and `TS1`: every particle by one network's mean and variance, fresh noise at each step.

    Particle p belongs to network p // (P / B); networks may be copies of each other. With ``shuffle`` the particles of
    each candidate are permuted before a step and put back after it. Of the variance that a network predicts,
    ``noise_share`` is drawn.
    """

    def __init__(
        self,
        network: Ensemble,
        coordinates: Coordinates,
        generator: torch.Generator,
        *,
        shuffle: bool,
        noise_share: Float[Tensor, "T"],
    ):
        self._network, self._coordinates, self._generator, self._shuffle = network, coordinates, generator, shuffle
        self._noise_scale = noise_share.sqrt()

    @grad_if_asked
    def __call__(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "*p K A"], step: int
    ) -> Float[Tensor, "P K S"]:
        x = self._coordinates.encode(observation, action)
        if self._shuffle:
            chance = torch.rand(x.shape[:2], generator=self._generator, dtype=x.dtype, device=x.device)
            order = chance.argsort(0).unsqueeze(-1)
            x = x.gather(0, order.expand_as(x))
        mean, logvar = predict(self._network, x.reshape(len(self._network.weights[0]), -1, x.shape[-1]))
        std = torch.exp(0.5 * logvar) * self._noise_scale
        target = mean + std * normals_like(mean, self._generator)
        target = target.view(*x.shape[:2], -1)
        if self._shuffle:
            target = torch.empty_like(target).scatter_(0, order.expand_as(target), target)
        return self._coordinates.decode(observation, target)


class CollapsedEnsemble:
    """The ensemble as one Gaussian: E_b[mean_b] and noise_share E_b[variance_b] + Var_b[mean_b].

    Without a share it is the mean alone.
    """

    def __init__(self, network: Ensemble, noise_share: Float[Tensor, "T"] | None):
        self._network, self._noise_share = network, noise_share

    def __call__(self, x: Float[Tensor, "P K D"]) -> Gaussian:
        num_members = len(self._network.weights[0])
        mean, logvar = predict(self._network, x.flatten(0, 1).expand(num_members, -1, -1))
        shape = x.shape[:2]
        if self._noise_share is None:
            return Gaussian(mean.mean(0).unflatten(0, shape), None)
        variance = logvar.exp().mean(0) * self._noise_share + mean.var(0, correction=0)
        return Gaussian(mean.mean(0).unflatten(0, shape), variance.unflatten(0, shape))
