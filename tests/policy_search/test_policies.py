"""Policies of few parameters: moments against Monte Carlo, bounds, and what they are fed."""

import numpy as np
import pytest
import torch

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.policy_search.policies import ROOM, Fed, LinearPolicy, RBFPolicy
from gym_dgpmpc.types import ObservationSpec
from tests.oracles.models import normal, seeded

DRAWS = 200_000
ANGLES = ObservationSpec(angles=(1,), not_inputs=(2,))


def fed(spec=None, size=3):
    encoder = Encoder(size, 0, spec)
    return Fed(encoder, torch.linspace(-0.2, 0.3, encoder.input_size), torch.linspace(0.8, 1.3, encoder.input_size))


def linear(spec=None, scale=0.7, squash="sine"):
    policy, generator = LinearPolicy(fed(spec), 2, squash).double(), seeded(3)
    with torch.no_grad():
        policy.weight.copy_(scale * normal(generator, *policy.weight.shape))
        policy.bias.copy_(scale * normal(generator, *policy.bias.shape))
    return policy


def rbf(spec=None, squash="sine", num_centres=7):
    return RBFPolicy(fed(spec), 2, squash, num_centres, seeded(1)).double()


def belief(size=3, spread=0.5):
    generator = seeded(2)
    root = spread * normal(generator, size, size)
    return normal(generator, 1, size), (root @ root.mT).unsqueeze(0)


def drawn(mean, covariance):
    root = torch.linalg.cholesky(covariance[0])
    return mean[0] + normal(seeded(4), DRAWS, mean.shape[1]) @ root.mT


def assert_moments(found, states, values):
    """Within five standard errors of the averages of as many draws, each element with its own."""
    for expected, samples in (
        (found.mean[0], values),
        (found.covariance[0], outer(values - found.mean, values - found.mean)),
        (found.cross[0], outer(states - states.mean(0), values - found.mean)),
    ):
        error = samples.std(0) / DRAWS**0.5
        assert ((samples.mean(0) - expected).abs() <= 5 * error + 1e-12).all()
        assert (error > 0).all()  # what is compared does vary


def outer(a, b):
    return a.unsqueeze(-1) * b.unsqueeze(-2)


@torch.no_grad()
def test_the_squashed_actions_of_gaussian_states_have_these_moments():
    """A linear policy without angles is Gaussian before it is squashed, so that nothing is approximate."""
    policy, (mean, covariance) = linear(), belief()
    states = drawn(mean, covariance)
    assert_moments(policy.moments(mean, covariance), states, policy(states))


@torch.no_grad()
def test_radial_basis_functions_of_gaussian_features_have_these_moments():
    policy, (mean, covariance) = rbf(), belief()
    features, found = drawn(mean, covariance), policy.unsquashed_moments(mean, covariance)
    assert_moments(found._replace(cross=covariance @ found.cross), features, policy.unsquashed(features))


@torch.no_grad()
def test_angles_are_encoded_exactly():
    """Weights of 1e-4 leave the squashing linear up to 1e-8 of its slope, 3/2, so the moments are the encoding's."""
    policy, (mean, covariance) = linear(ANGLES, scale=1e-4), belief()
    states = drawn(mean, covariance)
    found = policy.moments(mean, covariance)
    assert_moments(found, states, policy(states))
    assert not torch.allclose(found.cross, torch.zeros_like(found.cross), atol=1e-6)


@torch.no_grad()
def test_a_known_state_has_a_known_action():
    """Up to the rounding of the second moments, sums of 49 products."""
    for policy in (linear(ANGLES), rbf(ANGLES)):
        state = belief()[0]
        found = policy.moments(state, torch.zeros(1, 3, 3, dtype=torch.float64))
        torch.testing.assert_close(found.mean, policy(state))
        assert found.covariance.abs().max() < 1e-13 and not found.cross.any()


@pytest.mark.parametrize("squash", ["tanh", "sine"])
def test_actions_stay_within_their_bounds_and_come_near_them(squash):
    actions = linear(scale=30.0, squash=squash)(10 * normal(seeded(0), 500, 3))
    assert actions.abs().max() <= 1.0 + 1e-15 and actions.abs().max() > 0.9


def test_moments_of_the_other_squashing_are_refused():
    with pytest.raises(ValueError, match="'tanh' are not known: take \"sine\""):
        rbf(squash="tanh").moments(*belief())


def test_it_is_fed_what_the_model_is_in_wider_units():
    store = TransitionStore(3, 1)
    observation = torch.tensor([[1.0, 0.3, 5.0], [3.0, 0.3, 6.0]])
    for before, after in zip(observation, observation.flip(0), strict=True):
        store.append(before.numpy(), np.zeros(1, np.float32), after.numpy(), reward=0.0)
    found = Fed.of(store, ANGLES, size=4)
    assert (found.encoder.plain, found.encoder.angles, found.encoder.observation_size) == ([0], [1], 4)
    torch.testing.assert_close(found.mean, torch.tensor([2.0, 0.0, 0.0]))
    torch.testing.assert_close(found.std, torch.tensor([ROOM, 1.0, 1.0]))
