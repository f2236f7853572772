"""Moving-window MCEM: its gradients and its chain against the closed-form posterior."""

import numpy as np
import pytest
import scipy.stats
import torch

from gym_dgpmpc.data.standardised import Data, minibatch
from gym_dgpmpc.gp import exact
from gym_dgpmpc.gp.deep_gp import factorise_all
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.inference import mcem, sghmc
from gym_dgpmpc.inference.diagnostics import effective_sample_size
from gym_dgpmpc.inference.mcem import InferenceSettings
from tests.oracles import sghmc as oracle
from tests.oracles.models import make_model, normal, seeded


def one_layer(kernel="rbf", num_data=8):
    """A model with fixed hyperparameters, data, and the exact posterior of v in the layout of the flat vector."""
    generator = seeded(5)
    model = make_model(1, 2, 2, 5, generator, kernel)
    model = model._replace(log_noise=torch.tensor([0.3, 0.6], dtype=torch.float64).log())
    data = Data(normal(generator, num_data, 2), normal(generator, num_data, 2))
    return model, data


def flat_posterior(model, data):
    """Mean [V] and precision [V, V]: outputs are independent, and neighbours in the flat vector."""
    (factor,) = factorise_all(model).factors
    posterior = exact.whitened_posterior(model.layers[0], factor, model.noise_variance, *data)
    num_inducing, outputs = posterior.mean.shape
    precision = torch.zeros(num_inducing, outputs, num_inducing, outputs, dtype=torch.float64)
    for output in range(outputs):
        precision[:, output, :, output] = torch.linalg.inv(posterior.covariance[output])
    return posterior.mean.flatten(), precision.reshape(num_inducing * outputs, -1)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_gradient_is_that_of_the_closed_form_posterior(kernel):
    model, data = one_layer(kernel)
    mean, precision = flat_posterior(model, data)
    v = normal(seeded(1), len(mean)).requires_grad_()
    value = mcem.negative_log_joint(factorise_all(model), v, data, 8, seeded())
    (gradient,) = torch.autograd.grad(value, v)
    torch.testing.assert_close(gradient, precision @ (v.detach() - mean) / 8, rtol=1e-8, atol=1e-10)


def test_gradients_of_minibatches_are_unbiased():
    """Without hidden noise (one layer) the mean over all batches of one row is the full gradient exactly."""
    model, data = one_layer("matern32")
    factorised, v = factorise_all(model), normal(seeded(1), model.num_whitened()).requires_grad_()

    def gradient(batch):
        value = mcem.negative_log_joint(factorised, v, batch, len(data.x), seeded())
        return torch.autograd.grad(value, v)[0]

    singles = [gradient(Data(x, y)) for x, y in zip(data.x.split(1), data.y.split(1), strict=True)]
    torch.testing.assert_close(torch.stack(singles).mean(0), gradient(data), rtol=1e-10, atol=1e-12)


def test_minibatches_are_drawn_uniformly_and_keep_rows_together():
    rows = torch.arange(10, dtype=torch.float64).unsqueeze(1)
    data, generator, counts = Data(rows, rows + 100.0), seeded(), torch.zeros(10)
    for _ in range(2000):
        batch = minibatch(data, 4, generator)
        assert batch.x.shape == (4, 1) and torch.equal(batch.y, batch.x + 100.0)
        counts += torch.bincount(batch.x.long().flatten(), minlength=10)
    assert scipy.stats.chisquare(counts.numpy()).pvalue > 1e-4
    assert minibatch(data, 10, generator) is data and minibatch(data, 11, generator) is data


@pytest.mark.parametrize(("kernel", "num_data"), [("rbf", 8), ("matern32", 24)])
def test_samples_follow_the_closed_form_posterior(kernel, num_data):
    """Mean and covariance of v, tolerances from the chain's exact autocovariances, its step-size bias included."""
    model, data = one_layer(kernel, num_data)
    mean, precision = flat_posterior(model, data)
    hessian = precision.numpy() / num_data
    inverse_mass = 1.0 / np.diagonal(hessian).copy()
    settings = InferenceSettings(step_size=0.6, decay=0.4, gibbs_every=0)
    lags = oracle.autocovariances(hessian, inverse_mass, num_data, settings.step_size, settings.decay, 600)
    # The discretisation is visible, but small beside the posterior itself.
    np.testing.assert_allclose(np.diagonal(lags[0]), np.diagonal(np.linalg.inv(precision)), rtol=0.25)

    num_samples, spacing, burn_in = 1200, 2, 30
    start = sghmc.init(mean)._replace(square=torch.from_numpy(inverse_mass) ** -2)
    chains = list(mcem.sample(factorise_all(model), start, data, burn_in + num_samples, spacing, seeded(), settings))
    samples = torch.stack([chain.position for chain in chains[burn_in:]]).numpy()
    lags = np.concatenate([np.swapaxes(lags[spacing::spacing], 1, 2), lags[::spacing]])  # both directions of time
    error = samples.mean(0) - mean.numpy()
    statistic = error @ np.linalg.solve(lags.sum(0) / num_samples, error)
    assert scipy.stats.chi2(len(mean)).sf(statistic) > 1e-4

    # Var of a product of Gaussians (Isserlis), summed over lags: the variance of each entry of the sample covariance.
    variance = np.einsum("kii,kjj->ij", lags, lags) + np.einsum("kij,kji->ij", lags, lags)
    deviation = (
        np.cov(samples.T)
        - oracle.stationary_covariance(hessian, inverse_mass, num_data, settings.step_size, settings.decay)
    ) / np.sqrt(variance / num_samples)
    assert abs(deviation).max() < 4.5

    # And the diagnostics see the mixing that the oracle knows.
    known = num_samples * lags[len(lags) // 2].diagonal() / lags.sum(0).diagonal()
    effective = effective_sample_size(torch.from_numpy(samples)).numpy()
    assert np.median(effective / known) == pytest.approx(1.0, abs=0.3)


def test_sampling_keeps_the_preconditioner_and_the_spacing():
    model, data = one_layer()
    start = sghmc.init(torch.zeros(model.num_whitened(), dtype=torch.float64))
    every = list(mcem.sample(factorise_all(model), start, data, 6, 1, seeded(), InferenceSettings(gibbs_every=0)))
    second = list(mcem.sample(factorise_all(model), start, data, 3, 2, seeded(), InferenceSettings(gibbs_every=0)))
    for a, b in zip(every[1::2], second, strict=True):
        assert torch.equal(a.position, b.position)
        assert torch.equal(b.square, start.square) and torch.equal(b.averaging, start.averaging)


def test_the_prior_weighs_less_the_more_data_there_are():
    """With a batch that repeats the same rows only |v|^2 / (2 N) changes with N."""
    model, data = one_layer()
    factorised, v = factorise_all(model), normal(seeded(1), model.num_whitened())
    values = [mcem.negative_log_joint(factorised, v, data, n, seeded()).item() for n in (8, 80)]
    assert values[0] - values[1] == pytest.approx(0.5 * v.square().sum().item() * (1 / 8 - 1 / 80), rel=1e-10)


def test_hyperparameters_see_every_position_of_the_window_alike(monkeypatch):
    model, data = one_layer()
    size, num_steps = 4, 400
    run = mcem.MCEM(
        model, sghmc.init(normal(seeded(1), model.num_whitened())), data, InferenceSettings(window_size=size)
    )
    original, seen = mcem.negative_log_joint, []

    def watched(factorised, whitened, batch, num_data, generator):
        if not whitened.requires_grad:  # the M-step; the gradient of the E-step is the position's
            seen.append(whitened.clone())
        return original(factorised, whitened, batch, num_data, generator)

    monkeypatch.setattr(mcem, "negative_log_joint", watched)
    generator, counts = seeded(), torch.zeros(size)
    for _ in range(size - 1):
        run.step(generator)
    seen.clear()
    for _ in range(num_steps):
        run.step(generator)
        counts += (run.window == seen.pop()).all(dim=1)
    assert counts.sum() == num_steps  # each was one of the window, and its rows differ
    assert scipy.stats.chisquare(counts.numpy()).pvalue > 1e-4


@pytest.mark.parametrize(("every", "drawn"), [(0, []), (1, [0, 1, 2, 3, 4]), (3, [0, 3])])
def test_the_last_layer_is_drawn_as_often_as_asked(monkeypatch, every, drawn):
    model, data = one_layer()
    settings = InferenceSettings(gibbs_every=every)
    run = mcem.MCEM(model, sghmc.init(normal(seeded(1), model.num_whitened())), data, settings)
    original, seen, generator = mcem.gibbs_step, [], seeded()

    def watched(*args):
        seen.append(run.iteration)
        return original(*args)

    monkeypatch.setattr(mcem, "gibbs_step", watched)
    for _ in range(5):
        run.step(generator)
    assert seen == drawn
    # Each sample of a pool gets one, however often training draws.
    seen.clear()
    list(mcem.sample(factorise_all(model), run.chain, data, 4, 2, generator, settings))
    assert len(seen) == (4 if every else 0)


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("decay", (0.0, 1.0), (-1e-9, 1.0 + 1e-9)),
        ("step_size", (1e-300, 10.0), (0.0, -1.0, float("inf"), float("nan"))),
        ("learning_rate", (1e-300, 10.0), (0.0, -1.0, float("inf"), float("nan"))),
        ("gibbs_every", (0, 1), (-1,)),
        ("patience", (None, 1), (0,)),
        ("window_size", (1,), (0,)),
    ],
)
def test_settings_have_ranges_of_which_the_ends_are_told(name, good, bad):
    for value in good:
        assert getattr(InferenceSettings(**{name: value}), name) == value
    for value in bad:
        with pytest.raises(ValueError, match=rf"{name} .*{value}"):
            InferenceSettings(**{name: value})
