"""Adam's steps against PyTorch's own."""

import torch

from gym_dgpmpc.inference import adam
from tests.oracles.models import normal, seeded


def test_steps_are_pytorchs():
    """Also where gradients are so small that epsilon counts, and with learning rates that change."""
    generator = seeded()
    position = normal(generator, 2, 30)
    parameter = position.clone().requires_grad_()
    optimiser, state = torch.optim.Adam([parameter]), adam.init(position)
    scale = torch.logspace(-9, 3, 30, dtype=torch.float64)
    for count in range(12):
        gradient = scale * (normal(generator, 2, 30) + 0.3)
        optimiser.param_groups[0]["lr"] = rate = 0.1 * 0.8**count
        parameter.grad = gradient
        optimiser.step()
        before, held = position, [tensor.clone() for tensor in (position, *state[1:])]
        state, position = adam.step(state, position, gradient, rate)
        torch.testing.assert_close(position, parameter.detach(), rtol=1e-12, atol=1e-12)
        assert torch.equal(before, held[0]), "what a step is given stays as it is"
    assert state.num_steps == 12
