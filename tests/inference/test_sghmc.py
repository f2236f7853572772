"""SG-HMC against a second implementation of its recursion, and against the exact law of its stationary chain."""

import math

import numpy as np
import pytest
import scipy.linalg
import torch

from gym_dgpmpc.inference import sghmc
from tests.oracles import sghmc as oracle
from tests.oracles.models import normal, seeded


@pytest.mark.parametrize("burn_in", [True, False])
@pytest.mark.parametrize("num_data", [1, 200])
def test_the_recursion_is_that_of_a_second_implementation(num_data, burn_in):
    gradients = 0.3 + normal(seeded(1), 12, 5) * torch.tensor([1e-3, 0.1, 1.0, 10.0, 1e4]).double()
    position, twin = normal(seeded(2), 5), seeded(3)
    noises = np.stack([torch.randn(5, generator=twin).double().numpy() for _ in range(12)])
    state, generator = sghmc.init(position), seeded(3)
    for gradient in gradients:
        state = sghmc.step(state, gradient, num_data, generator, step_size=0.1, decay=0.05, burn_in=burn_in)
    exact = oracle.recursion(gradients.numpy(), noises, position.numpy(), num_data, 0.1, 0.05, burn_in)
    for name, value in state._asdict().items():
        np.testing.assert_allclose(value, exact[name], rtol=1e-10, err_msg=name)


def test_a_step_leaves_its_argument_alone():
    state = sghmc.init(normal(seeded(), 3))
    before = [tensor.clone() for tensor in state]
    sghmc.step(state, torch.ones(3, dtype=torch.float64), 10, seeded())
    assert all(torch.equal(a, b) for a, b in zip(state, before, strict=True))


def test_without_further_arguments_it_is_the_sampler_of_havasi_et_al():
    """Step size 0.01 and friction 0.05, in burn-in."""
    state, gradient = sghmc.init(normal(seeded(), 3)), normal(seeded(1), 3)
    found = sghmc.step(state, gradient, 10, seeded(2))
    expected = sghmc.step(state, gradient, 10, seeded(2), step_size=0.01, decay=0.05, burn_in=True)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def test_the_preconditioner_learns_the_gradients_size():
    """For gradients of N(m, s^2) the mass is sqrt(m^2 + s^2), to the precision of the averaging window."""
    generator, scale = seeded(), torch.tensor([1e-3, 1.0, 100.0], dtype=torch.float64)
    state = sghmc.init(torch.zeros(3, dtype=torch.float64))
    for _ in range(5000):
        state = sghmc.adapt(state, scale * (0.1 + normal(generator, 3)))
    window = state.averaging.min().item()
    assert window > 20
    mass = 1.0 / state.inverse_mass()
    torch.testing.assert_close(mass, math.sqrt(1.01) * scale, rtol=4 / math.sqrt(window), atol=0)


def ensemble(hessian, inverse_mass, num_data, step_size, decay, num_chains, num_steps):
    """Positions [V, num_chains] of independent chains on the potential v' H v / 2 per datum, after ``num_steps``."""
    size = len(hessian)
    mass = (1.0 / torch.as_tensor(inverse_mass)).repeat_interleave(num_chains)
    state = sghmc.init(torch.zeros(size * num_chains, dtype=torch.float64))._replace(square=mass.square())
    generator, slope = seeded(), torch.as_tensor(hessian)
    for _ in range(num_steps):
        gradient = (slope @ state.position.view(size, num_chains)).flatten()
        state = sghmc.step(state, gradient, num_data, generator, step_size=step_size, decay=decay, burn_in=False)
    return state.position.view(size, num_chains).numpy()


def test_the_stationary_variance_of_a_unit_potential():
    """The step size of 0.5 inflates it by 1 / (1 - 0.25 / (2 (2 - 0.05))) = 1.0685, as the Lyapunov equation knows."""
    one = np.ones((1, 1))
    exact = oracle.stationary_covariance(one, np.ones(1), 1, step_size=0.5, decay=0.05)
    assert exact.item() == pytest.approx(1.0 / (1.0 - 0.25 / 3.9), rel=1e-12)
    num_chains = 100_000
    positions = ensemble(one, np.ones(1), 1, 0.5, 0.05, num_chains, 250)
    assert positions.var() == pytest.approx(exact.item(), rel=4 * math.sqrt(2 / num_chains))
    assert abs(positions.mean()) < 4 * math.sqrt(exact.item() / num_chains)


@pytest.mark.parametrize("num_data", [1, 30, 1000])
def test_the_stationary_covariance_of_coupled_coordinates(num_data):
    """The covariance is (N H)^-1 and a bias of the step size: a stale N would be a wrong temperature."""
    hessian, inverse_mass = np.array([[2.0, 0.8], [0.8, 0.7]]), np.array([0.5, 1.3])
    exact = oracle.stationary_covariance(hessian, inverse_mass, num_data, step_size=0.4, decay=0.1)
    np.testing.assert_allclose(exact, np.linalg.inv(num_data * hessian), rtol=0.1)
    num_chains = 20_000
    positions = ensemble(hessian, inverse_mass, num_data, 0.4, 0.1, num_chains, 400)
    # In coordinates where the exact covariance is the identity, the sample one errs by sqrt(2 / n) at most.
    root = np.linalg.inv(np.linalg.cholesky(exact))
    error = root @ np.cov(positions) @ root.T - np.eye(2)
    assert abs(error).max() < 4.5 * math.sqrt(2 / num_chains)


def test_the_oracles_autocovariances_decay_as_its_transition():
    hessian, inverse_mass = np.array([[2.0, 0.8], [0.8, 0.7]]), np.array([0.5, 1.3])
    lags = oracle.autocovariances(hessian, inverse_mass, 7, 0.4, 0.1, 300)
    np.testing.assert_allclose(lags[0], oracle.stationary_covariance(hessian, inverse_mass, 7, 0.4, 0.1), rtol=1e-12)
    radius = abs(scipy.linalg.eigvals(oracle.transition(hessian, inverse_mass, 0.4, 0.1))).max()
    assert radius < 1
    assert abs(lags[-1]).max() < 10 * radius**299 * abs(lags[0]).max()
