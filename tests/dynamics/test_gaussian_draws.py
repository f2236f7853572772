"""Drawing from a Gaussian at each point, and matching moments, against the formulas."""

import torch

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.dynamics.gaussian_draws import Gaussian, GaussianSampler, match_moments
from tests.oracles.models import seeded


def test_matching_takes_the_populations_moments_of_each_candidate():
    """Two particles at 0 and 2 have the mean 1 and the variance 1; with the sample's variance it would be 2."""
    states = torch.tensor([[[0.0, 5.0], [10.0, -1.0]], [[2.0, 5.0], [16.0, 1.0]]])
    noise = torch.randn(2, 2, 2, generator=seeded())
    expected = torch.tensor([[1.0, 5.0], [13.0, 0.0]]) + torch.tensor([[1.0, 0.0], [3.0, 1.0]]) * noise
    torch.testing.assert_close(match_moments(states, seeded()), expected)


def coordinates():
    def normaliser(size, mean, std):
        return Normaliser(torch.full((size,), mean).double(), torch.full((size,), std).double())

    return Coordinates(Encoder(2, 1), normaliser(3, 1.0, 2.0), normaliser(2, 0.5, 3.0), torch.float32)


def test_draws_are_in_raw_units_and_from_the_inputs_own_gaussian():
    observation, action = torch.randn(4, 3, 2, generator=seeded(1)), torch.randn(3, 1, generator=seeded(2))
    seen = []

    def predict(x):
        seen.append(x)
        return Gaussian(0.1 * x[..., :2].double(), torch.full((4, 3, 2), 0.25).double())

    after = GaussianSampler(predict, coordinates(), seeded(3))(observation, action, 0)
    inputs = (torch.cat([observation, action.expand(4, -1, -1)], -1) - 1.0) / 2.0
    torch.testing.assert_close(seen[0], inputs)
    noise = torch.randn(4, 3, 2, generator=seeded(3), dtype=torch.float64)
    target = (0.1 * inputs[..., :2].double() + 0.5 * noise).float()
    torch.testing.assert_close(after, observation + 3.0 * target + 0.5)
    assert after.dtype == torch.float32


def test_without_a_variance_nothing_is_drawn():
    generator = seeded(3)
    before = generator.get_state()
    sampler = GaussianSampler(lambda x: Gaussian(x[..., :2], None), coordinates(), generator)
    sampler(torch.zeros(4, 3, 2), torch.zeros(3, 1), 0)
    assert torch.equal(generator.get_state(), before)
