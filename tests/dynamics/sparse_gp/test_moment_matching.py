"""Propagating a Gaussian: its encoding, one step of it, and the particles that stand for it."""

import numpy as np
import pytest
import torch

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.dynamics.noise import ObservationNoise
from gym_dgpmpc.dynamics.sparse_gp.model import SparseGPDynamics
from gym_dgpmpc.dynamics.sparse_gp.moment_matching import encoded_moments, orthonormal_frame, root_of
from gym_dgpmpc.errors import NotDifferentiableError
from gym_dgpmpc.types import ObservationSpec, Transitions
from tests.oracles.models import normal, seeded


def gaussian(size, count=3, seed=1, scale=0.5):
    generator = seeded(seed)
    root = scale * normal(generator, count, size, size)
    return normal(generator, count, size), root @ root.mT


def with_action(mean, covariance, action):
    """Moments of the state and a known action."""
    return torch.cat([mean, action], -1), torch.nn.functional.pad(covariance, (0, action.shape[-1]) * 2)


def follow(gain):
    """The matrix from a state to it and the action of a linear policy."""
    return torch.cat([torch.eye(gain.shape[1], dtype=gain.dtype), gain])


def weighted_nodes(mean, covariance, order=24):
    """Gauss and Hermite's nodes [n, S] and weights [n] of a Gaussian."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(order)
    size = len(mean)
    grid = torch.tensor(np.stack(np.meshgrid(*[nodes] * size, indexing="ij"), -1).reshape(-1, size))
    weight = torch.tensor(np.prod(np.stack(np.meshgrid(*[weights / weights.sum()] * size, indexing="ij"), -1), -1))
    return mean + grid @ torch.linalg.cholesky(covariance).mT, weight.flatten()


def test_the_encodings_moments_are_exact():
    """Two angles, one plain number, one that is not fed, and an action that goes by all of them, against quadrature."""
    encoder = Encoder(4, 1, ObservationSpec(angles=(2, 0), not_inputs=(3,)))
    mean, covariance = gaussian(4)
    gain = normal(seeded(2), 1, 4)
    found = encoded_moments(encoder, mean @ follow(gain).mT, follow(gain) @ covariance @ follow(gain).mT)
    for k in range(3):
        states, weight = weighted_nodes(mean[k], covariance[k])
        x = encoder.inputs(states, states @ gain.mT)
        expected = weight @ x
        torch.testing.assert_close(found.mean[k], expected, rtol=0, atol=1e-9)
        centred = weight.unsqueeze(-1) * (x - expected)
        torch.testing.assert_close(found.covariance[k], centred.mT @ (x - expected), rtol=0, atol=1e-9)
        torch.testing.assert_close(found.cross[k], (states - mean[k]).mT @ centred, rtol=0, atol=1e-9)


def test_without_angles_the_encoding_is_a_choice_of_rows():
    encoder = Encoder(3, 1, ObservationSpec(not_inputs=(1,)))
    mean, covariance = gaussian(3)
    found = encoded_moments(encoder, *with_action(mean, covariance, torch.zeros(3, 1, dtype=torch.float64)))
    assert torch.equal(found.mean[:, :2], mean[:, [0, 2]])
    assert torch.equal(found.covariance[:, :2, :2], covariance[:, [0, 2]][:, :, [0, 2]])
    assert float(found.covariance[:, 2].abs().max()) == 0.0


SPEC = ObservationSpec(absolute=(1,), not_inputs=(2,), constant=(3,))


def trained(draw="AMM", **settings):
    """A model of four numbers: a change, an absolute value, one that is not fed, and one that never changes.

    The transitions are noisy: without noise the weights are large and of both signs, and their sums mere rounding.
    """
    generator = seeded(3)
    before, action = normal(generator, 80, 4), normal(generator, 80, 1)
    before[:, 3] = 0.3
    after = before.clone()
    after[:, 0] += torch.sin(before[:, 1]) + 0.5 * action[:, 0]
    after[:, 1] = torch.cos(before[:, 0]) * 0.8
    after[:, 2] += 0.2 * before[:, 0] * before[:, 1]
    after[:, :3] += 0.05 * normal(generator, 80, 3)
    model = SparseGPDynamics(4, 1, SPEC, num_inducing=25, max_training_iterations=60, draw=draw, **settings)
    model.fit(Transitions(before.float(), action.float(), after.float()), seeded())
    return model


@pytest.mark.parametrize("add_noise", [False, True])
def test_a_step_has_the_moments_of_many_draws(add_noise):
    """Each of 100,000 states moves by its own draw; means and covariances agree within five standard errors."""
    sampler = trained(add_noise=add_noise).draw(5, 1, seeded())
    mean, covariance = gaussian(4, scale=0.3)
    covariance[:, 3], covariance[:, :, 3] = 0.0, 0.0
    mean[:, 3] = 0.3
    action = normal(seeded(2), 3, 1)
    found_mean, found_covariance = sampler.propagate(*with_action(mean, covariance, action))
    count = 100_000
    one_by_one = trained(draw="DS", add_noise=add_noise, dtype=torch.float64).draw(1, 1, seeded(8))
    for k in range(3):
        root = torch.linalg.cholesky(covariance[k, :3, :3])
        states = mean[k].expand(count, -1).clone()
        states[:, :3] += normal(seeded(9), count, 3) @ root.mT
        after = one_by_one(states.unsqueeze(0), action[k].expand(count, -1), 0)[0]
        error = (found_mean[k] - after.mean(0)).abs()
        assert bool((error <= 5 * after.std(0) / count**0.5 + 1e-12).all())
        centred = after - found_mean[k]
        products = centred.unsqueeze(-1) * centred.unsqueeze(-2)
        error = (found_covariance[k] - products.mean(0)).abs()
        assert bool((error <= 5 * products.std(0) / count**0.5 + 1e-12).all())


def test_the_particles_carry_the_gaussian_from_step_to_step():
    """After three steps they have the moments that three steps of the recursion give, up to rounding.

    Second moments are sums of the weights' products, so each step rounds them by eps (sum |weights|)^2 at most. Both
    chains do so, and moments of order one carry it on as it is.
    """
    model = trained()
    sampler = model.draw(7, 3, seeded(4))
    start, actions = torch.tensor([0.2, -0.4, 0.1, 0.3]), normal(seeded(5), 3, 2, 1)
    mean, covariance = start.double().expand(2, -1), torch.zeros(2, 4, 4, dtype=torch.float64)
    states = start.double().expand(7, 2, -1)
    for step, action in enumerate(actions):
        mean, covariance = sampler.propagate(*with_action(mean, covariance, action))
        states = sampler(states, action, step)
    sums = sampler._predictor.weights.abs().sum(0) * sampler._targets.std
    rounding = 3 * torch.finfo(torch.float64).eps * float(sums.max()) ** 2
    assert rounding < 1e-4 * float(covariance[:, :3, :3].diagonal(dim1=-2, dim2=-1).min())  # else nothing is tested
    torch.testing.assert_close(states.mean(0), mean, rtol=0, atol=rounding)
    deviation = (states - states.mean(0)).transpose(0, 1)
    torch.testing.assert_close(deviation.mT @ deviation / 7, covariance, rtol=0, atol=rounding)


def test_an_action_that_goes_by_what_is_observed_varies_with_the_state_only():
    """With a = F o and o = x + e, Cov[x, a] = Cov[x] F^T, since e is independent of x."""
    gain, blur = normal(seeded(2), 1, 4), ObservationNoise(*(torch.full((4,), x).double() for x in (0.2, 0.1, 0.4)))
    mean, state = gaussian(4)
    observed = follow(gain) @ (state + 0.2**2 * torch.eye(4)) @ follow(gain).mT
    sampler = trained().draw(5, 1, seeded())
    fed_mean, fed = sampler._fed(blur, mean @ follow(gain).mT, observed, is_start=False)
    torch.testing.assert_close(fed_mean, torch.cat([blur.fed(mean), mean @ gain.mT], -1))
    torch.testing.assert_close(fed[:, :4, :4], 1.1**2 * state)
    torch.testing.assert_close(fed[:, :4, 4:], 1.1 * state @ gain.mT)
    torch.testing.assert_close(fed[:, 4:], torch.cat([fed[:, :4, 4:].mT, observed[:, 4:, 4:]], -1))


@pytest.mark.parametrize(("num_particles", "size"), [(5, 4), (19, 18), (20, 3)])
def test_frames_have_mean_zero_and_unit_covariance(num_particles, size):
    frame = orthonormal_frame(num_particles, size, seeded())
    torch.testing.assert_close(frame.mean(0), torch.zeros(size, dtype=torch.float64), rtol=0, atol=1e-12)
    identity = torch.eye(size, dtype=torch.float64)
    torch.testing.assert_close(frame.mT @ frame / num_particles, identity, rtol=0, atol=1e-12)
    assert not torch.equal(frame, orthonormal_frame(num_particles, size, seeded(1)))


def test_too_few_particles_are_an_error():
    with pytest.raises(ValueError, match=r"AMM .*\b5 particles.*\b4$"):
        trained().draw(4, 1, seeded())


def test_roots_keep_small_variances_and_what_does_not_vary():
    """Standard deviations of 1e-6 and 1e3 side by side, one of zero, and two numbers that are the same one."""
    std = torch.tensor([1e-6, 0.0, 1e3, 2.0], dtype=torch.float64)
    correlation = torch.eye(4, dtype=torch.float64)
    correlation[0, 2] = correlation[2, 0] = 0.9
    several = torch.stack([correlation, torch.ones_like(correlation)]) * std.unsqueeze(-1) * std
    root = root_of(several)
    found = (root @ root.mT - several) / std.clamp_min(1e-9).unsqueeze(-1) / std.clamp_min(1e-9)
    assert found.abs().max() < 1e-11 and not root[:, 1].any() and not root.triu(1).any()


def test_a_root_has_a_derivative_where_something_does_not_vary():
    """Of l = std along the diagonal: d(std) / d(variance) = 1 / (2 std), and nothing at a variance of zero."""
    variance = torch.tensor([4.0, 0.0, 9.0], dtype=torch.float64, requires_grad=True)
    root_of(torch.diag_embed(variance.unsqueeze(0))).sum().backward()
    torch.testing.assert_close(variance.grad, torch.tensor([0.25, 0.0, 1 / 6], dtype=torch.float64), rtol=1e-9, atol=0)


def test_gradients_through_a_blur_are_refused():
    sampler = trained().draw(10, 1, seeded())
    sampler._blur = ObservationNoise(*(torch.full((4,), 0.1, dtype=torch.float64) for _ in range(3)))
    with pytest.raises(NotDifferentiableError, match=r"MomentMatchingSampler has no gradients.*split_noise"):
        sampler(torch.zeros(10, 2, 4), torch.zeros(2, 1, requires_grad=True), 0)
