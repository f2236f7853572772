"""The optimiser of the collapsed bound on small problems."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import OptimizeResult

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.dynamics.deep_gp.start import initial_model
from gym_dgpmpc.gp.deep_gp import DeepGP
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.gp.sgpr import collapsed_bound
from gym_dgpmpc.inference.lbfgs import LENGTHSCALES, NOISE_VARIANCES, maximise_bound
from tests.oracles.models import normal, seeded


def problem(num_data=120, noise=0.2):
    generator = seeded(3)
    x = 4 * torch.rand(num_data, 2, generator=generator, dtype=torch.float64) - 2
    clean = torch.stack([torch.sin(2 * x[:, 0]), 0.7 * x[:, 0]], 1)
    return Data(x, clean + noise * normal(generator, num_data, 2)), seeded(4)


def start_from(data, num_inducing, generator, kernel="rbf"):
    """Where a chain of one layer begins, without the chains' axis, which L-BFGS does not have."""
    model = initial_model(KERNELS[kernel], data, 1, num_inducing, 1, generator)
    return model.with_parameters([parameter[0] for parameter in model.parameters()])


def test_it_climbs_to_a_stationary_point_and_finds_the_noise():
    """The maximum-likelihood variance of Gaussian noise has the standard error s sqrt(2 / N); degrees of freedom of
    the fit, some 15 of 120 for the first output, lower it further."""
    data, generator = problem()
    start = start_from(data, 15, generator)
    found = maximise_bound(start, data, 300)
    before = collapsed_bound(start.layers[0], start.noise_variance, *data) / data.y.numel()
    assert found.bound > float(before)
    parameters = [tensor.clone().requires_grad_() for tensor in found.model.parameters()]
    model = found.model.with_parameters(parameters)
    value = collapsed_bound(model.layers[0], model.noise_variance, *data) / data.y.numel()
    assert abs(float(value.detach()) - found.bound) < 1e-12
    gradients = torch.cat([g.flatten() for g in torch.autograd.grad(value, parameters)])
    # The second input changes nothing, so its lengthscale climbs towards infinity, where the slope vanishes too.
    assert float(gradients.abs().max()) < 1e-3
    lengthscale = found.model.layers[0].lengthscale
    assert lengthscale[1] > 10 * lengthscale[0]
    error = (found.model.noise_variance / 0.2**2 - 1).abs()
    assert bool((error < 5 * math.sqrt(2 / 120) + 15 / 120).all())


def test_frozen_inducing_inputs_stay():
    data, generator = problem()
    start = start_from(data, 15, generator, "matern32")
    found = maximise_bound(start, data, 20, free_inducing_inputs=False)
    assert torch.equal(found.model.layers[0].inducing_inputs, start.layers[0].inducing_inputs)
    free = maximise_bound(start, data, 20)
    assert not torch.equal(free.model.layers[0].inducing_inputs, start.layers[0].inducing_inputs)


def test_hyperparameters_stay_within_bounds():
    """Data without noise would take the noise to zero."""
    data, generator = problem(num_data=40, noise=0.0)
    found = maximise_bound(start_from(data, 40, generator), data, 200)
    assert bool((found.model.log_noise >= math.log(NOISE_VARIANCES[0]) - 1e-9).all())
    assert bool((found.model.layers[0].lengthscale <= LENGTHSCALES[1] * (1 + 1e-9)).all())


def test_it_starts_within_bounds_and_says_how_many_iterations_it_made():
    data, generator = problem(num_data=30)
    start = start_from(data, 10, generator)
    start = start._replace(log_noise=torch.full_like(start.log_noise, -100.0))
    found = maximise_bound(start, data, 1)
    assert math.isfinite(found.bound) and found.num_iterations == 1


@pytest.mark.parametrize(("variance", "kept"), [(1e-30, 1e-4), (1e30, 1e4)])
def test_a_start_beyond_the_limits_is_moved_to_them(monkeypatch, variance, kept):
    """Beyond them covariances cannot be factorised. An optimiser that stays where it starts shows the start."""

    def stay(function, start, bounds, **settings):
        low, high = np.array(bounds).T
        assert ((low <= start) & (start <= high)).all()
        return OptimizeResult(x=start, fun=function(start)[0], nfev=1)

    monkeypatch.setattr("scipy.optimize.minimize", stay)
    data, generator = problem(num_data=30)
    start = start_from(data, 10, generator)
    layer = start.layers[0]._replace(
        log_lengthscale=torch.tensor([1e-30, 1e30]).double().log(), log_variance=torch.tensor(variance).double().log()
    )
    found = maximise_bound(DeepGP((layer,), torch.tensor([1e-30, 1e30]).double().log()), data, 1)
    (moved,) = found.model.layers
    assert moved.lengthscale.tolist() == pytest.approx([0.01, 1e3], rel=1e-12)
    assert float(moved.variance) == pytest.approx(kept, rel=1e-12)
    assert found.model.log_noise.exp().tolist() == pytest.approx([1e-6, 10.0], rel=1e-12)
    assert torch.equal(moved.inducing_inputs, layer.inducing_inputs)
