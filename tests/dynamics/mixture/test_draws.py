"""Particles of a mixture: how many are whose, and that each moves as in its member's own draw."""

import torch

from gym_dgpmpc.dynamics.deep_gp import DeepGPDynamics
from gym_dgpmpc.dynamics.ensemble import EnsembleDynamics
from gym_dgpmpc.dynamics.mixture.draws import MixtureSampler, Share, share_out
from gym_dgpmpc.planning.rollout import rollout
from gym_dgpmpc.types import TrajectorySampler
from tests.oracles import slider
from tests.oracles.models import seeded

WEIGHTS = torch.tensor([0.05, 0.33, 0.0, 0.62], dtype=torch.float64)


def test_expected_counts_are_the_weights_share():
    """A count is one of two whole numbers, so that its variance is at most 1/4: five standard errors of the mean."""
    generator, draws = seeded(), 4000
    for num_particles in (1, 5, 20):
        counts = torch.tensor([share_out(num_particles, WEIGHTS, generator) for _ in range(draws)])
        assert (counts.sum(1) == num_particles).all() and (counts[:, 2] == 0).all()
        assert ((counts - num_particles * WEIGHTS).abs() < 1).all()
        assert ((counts.double().mean(0) - num_particles * WEIGHTS).abs() < 5 * 0.5 * draws**-0.5).all()


def test_counts_that_are_whole_numbers_are_met_exactly():
    weights = torch.full((5,), 0.2, dtype=torch.float64)  # whose sum is not 1 in floating point
    assert all(share_out(10, weights, seeded(seed)) == [2] * 5 for seed in range(50))


class Plus:
    """A step that adds the action and a number of its own."""

    def __init__(self, number):
        self.number = number

    def __call__(self, observation, action, step):
        return observation + action + self.number * (step + 1)


def test_actions_are_those_of_all_particles_or_each_ones_own():
    sampler = MixtureSampler([Share(Plus(1.0), 2), Share(Plus(10.0), 3)])
    states, actions = torch.randn(5, 4, 2, generator=seeded()), torch.randn(5, 4, 2, generator=seeded(1))
    added = torch.tensor([1.0, 1.0, 10.0, 10.0, 10.0]).view(5, 1, 1)
    assert torch.equal(sampler(states, actions[0], 0), states + actions[0] + added)
    assert torch.equal(sampler(states, actions, 0), states + actions + added)
    plans = torch.randn(4, 3, 2, generator=seeded(2))
    found = sampler.trajectories(states[0, 0], plans)
    for step in range(3):
        assert torch.equal(found[step + 1], found[step] + plans[:, step] + added * (step + 1))


def test_trajectories_are_the_members_own_bit_for_bit():
    """Of one that offers them as a whole, in compiled code, and of one that is asked step by step, with its noise."""
    deep = DeepGPDynamics(
        3, 1, slider.SPEC, num_inducing=12, num_features=32, first_training_iterations=20, num_samples=5,
        sample_spacing=1,
    )  # fmt: skip
    networks = EnsembleDynamics(3, 1, slider.SPEC, num_hidden_layers=1, hidden_size=8, weight_decay=(0, 0))
    data, start = slider.transitions(60, 0.02), torch.tensor([0.3, -0.5, slider.CONSTANT])
    plans = torch.rand(6, 4, 1, generator=seeded()) * 2 - 1
    for model in (deep, networks):
        model.fit(data, seeded())

    def shares():
        return [Share(deep.draw(3, 4, seeded(1)), 3), Share(networks.draw(2, 4, seeded(2)), 2)]

    sampler, alone = MixtureSampler(shares()), shares()
    assert isinstance(sampler, TrajectorySampler)
    own = torch.cat([rollout(*each[:1], start, plans, each.num_particles) for each in alone], 1)
    assert torch.equal(rollout(sampler, start, plans, 5), own)
    # Step by step it is the same, up to the rounding of compiled code.
    stepped, states = MixtureSampler(shares()), start.expand(5, 6, -1)
    for step, after in enumerate(own[1:]):
        states = stepped(states, plans[:, step], step)
        torch.testing.assert_close(states, after, rtol=0, atol=1e-5)
        assert torch.equal(states[3:], after[3:])
