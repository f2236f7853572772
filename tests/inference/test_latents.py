"""Latents: how they move against quadrature, what comes out of a move, and those of new rows."""

import math

import numpy as np
import pytest
import torch

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.gp.deep_gp import factorise_all
from gym_dgpmpc.gp.layer import conditional
from gym_dgpmpc.inference.gradients import forward, prepare
from gym_dgpmpc.inference.latents import move_latents, with_latents
from tests.oracles.models import chains, make_model, normal, seeded


def uncertain(model):
    """With an inner layer that leaves much to its latents, of which the data then say something."""
    inner, last = model.layers
    inner = inner._replace(log_variance=torch.zeros_like(inner.log_variance), log_lengthscale=inner.log_lengthscale - 2)
    return model._replace(layers=(inner, last), log_noise=torch.full_like(model.log_noise, math.log(0.02)))


def test_a_datums_latents_settle_in_their_conditional_law():
    """Against quadrature over the one latent of a datum; 3000 rows that are the same are as many independent chains.

    Two chains of them, under hyperparameters and inducing outputs of their own.
    """
    generator = seeded(3)
    models = [uncertain(make_model(2, 1, 1, 6, generator, "matern32")) for _ in range(2)]
    together, num = chains(*models), 3000
    whitened = 1.5 * normal(generator, 2, together.num_whitened())
    x, y = torch.tensor([[0.4]], dtype=torch.float64), torch.tensor([[0.8]], dtype=torch.float64)
    prepared, data = prepare(together), Data(x.repeat(num, 1), y.repeat(num, 1))
    latents = [normal(generator, 2, num, 1)]
    for _ in range(100):
        _, latents = move_latents(prepared, together.split(whitened), data, latents, generator)
    nodes, weights = (torch.from_numpy(part) for part in np.polynomial.hermite_e.hermegauss(200))
    for c, model in enumerate(models):
        factors, split = factorise_all(model).factors, model.split(whitened[c])
        mean, variance = conditional(model.layers[0], factors[0], split[0], x)
        hidden = x + mean + variance.sqrt().unsqueeze(-1) * nodes.unsqueeze(1)
        last_mean, last_variance = conditional(model.layers[1], factors[1], split[1], hidden)
        std = (last_variance + model.noise_variance).sqrt()
        law = weights * torch.distributions.Normal(last_mean.squeeze(1), std).log_prob(y.squeeze(1)).exp()
        law = law / law.sum()
        first = float(law @ nodes)
        second, fourth = (float(law @ (nodes - first) ** power) for power in (2, 4))
        assert abs(first) > 0.2 or abs(second - 1.0) > 0.2, "the datum says something of its latent"
        found = latents[0][c, :, 0]
        assert found.mean().item() == pytest.approx(first, abs=5 * math.sqrt(second / num))
        assert found.var().item() == pytest.approx(second, abs=5 * math.sqrt((fourth - second**2) / num))


def test_moved_points_are_those_of_the_moved_latents():
    generator = seeded(4)
    model = chains(*(uncertain(make_model(2, 2, 2, 5, generator, "matern32")) for _ in range(2)))
    prepared, data = prepare(model), Data(normal(generator, 9, 2), normal(generator, 9, 2))
    whitened = model.split(normal(generator, 2, model.num_whitened()))
    before = [normal(generator, 2, 9, 2)]
    passed, after = move_latents(prepared, whitened, data, before, generator)
    accepted = (after[0] != before[0]).any(-1)
    assert accepted.any() and not accepted.all()
    for one, other in zip(passed, forward(prepared, whitened, data.x.expand(2, -1, -1), after), strict=True):
        for a, b in zip((*one.seen, one.mean, one.variance), (*other.seen, other.mean, other.variance), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-10)


def test_latents_of_new_rows_are_drawn_and_the_others_stay():
    latents = [normal(seeded(1), 2, 3, 4), normal(seeded(2), 2, 3, 4)]
    grown = with_latents(latents, 5000, seeded())
    for old, new in zip(latents, grown, strict=True):
        assert new.shape == (2, 5000, 4) and torch.equal(new[:, :3], old)
        assert new.std().item() == pytest.approx(1.0, abs=5 / math.sqrt(2 * 40_000))
    assert abs(float(torch.stack([grown[0].flatten(), grown[1].flatten()]).corrcoef()[0, 1])) < 5 / math.sqrt(40_000)
    assert all(torch.equal(a, b) for a, b in zip(with_latents(latents, 3, seeded()), latents, strict=True))
