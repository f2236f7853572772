"""The exact draw of the last layer against the closed-form posterior, and what it does to chains."""

import pytest
import torch

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.errors import FactorisationError
from gym_dgpmpc.gp.deep_gp import DeepGP, factorise_all
from gym_dgpmpc.gp.exact import whitened_posterior
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.gp.layer import Layer, conditional, project
from gym_dgpmpc.inference import sghmc
from gym_dgpmpc.inference.gradients import forward, prepare
from gym_dgpmpc.inference.last_layer import last_layer_evidence
from gym_dgpmpc.inference.sampler import Chains, initial_state, step_sizes
from gym_dgpmpc.inference.settings import InferenceSettings
from tests.oracles.models import chains, normal, seeded

M, D, T, N = 7, 2, 3, 30


@pytest.fixture
def generator():
    return seeded()


def deep_gp(num_layers, generator, kernel="matern32"):
    """The model of one chain."""

    def layer(log_variance):
        centres = torch.randn(M, D, generator=generator, dtype=torch.float64)
        return Layer(KERNELS[kernel], centres, torch.tensor([0.1, -0.2]).double(), torch.tensor(log_variance).double())

    layers = tuple(layer(-3.0) for _ in range(num_layers - 1))
    log_noise = torch.tensor([-2.0, -3.0, -1.0]).double() + 0.3 * normal(generator, T)
    return DeepGP((*layers, layer(0.3)), log_noise)


def toy(generator):
    x = torch.randn(N, D, generator=generator, dtype=torch.float64)
    return Data(x, torch.stack([x[:, 0].sin(), x[:, 1].cos(), x.sum(-1)], dim=1))


def posterior(model, whitened, data, latents=(), weight=1.0):
    """That of every chain, of models side by side."""
    prepared = prepare(model)
    passed = forward(prepared, model.split(whitened), data.x.expand(len(whitened), -1, -1), latents)
    return last_layer_evidence(prepared, passed[-1], data.y, weight).posterior()


def started(model, data, generator, **settings):
    """Chains at random positions, in motion."""
    whitened = sghmc.init(normal(generator, len(model.log_noise), model.num_whitened()))
    whitened = whitened._replace(momentum=torch.ones_like(whitened.position))
    state = initial_state(model, whitened, data.num_rows, generator)
    return Chains(model, state, data, InferenceSettings(**settings), 0)


@pytest.mark.parametrize("num_chains", [1, 2])
@pytest.mark.parametrize("kernel", ["rbf", "matern12"])
def test_one_layer_is_the_closed_form(kernel, num_chains, generator):
    models, data = [deep_gp(1, generator, kernel) for _ in range(num_chains)], toy(generator)
    # What the last layer is given its own place does not matter: it is integrated out.
    found = posterior(chains(*models), normal(generator, num_chains, M * T), data)
    covariance = torch.cholesky_inverse(found.precision_factor)
    for c, model in enumerate(models):
        exact = whitened_posterior(model.layers[0], *factorise_all(model).factors, model.noise_variance, *data)
        torch.testing.assert_close(found.mean[c].mT, exact.mean, rtol=0, atol=1e-10)
        torch.testing.assert_close(covariance[c], exact.covariance, rtol=0, atol=1e-10)


def test_samples_have_the_posterior_moments(generator):
    model = chains(*(deep_gp(1, generator) for _ in range(2)))
    found = posterior(model, torch.zeros(2, M * T).double(), toy(generator))
    num = 40_000
    samples = found.sample(num, generator)
    assert samples.shape == (num, 2, M, T)
    covariance = torch.cholesky_inverse(found.precision_factor)
    std = covariance.diagonal(dim1=-2, dim2=-1).sqrt()  # "C T M"
    # Five standard errors: of a mean std / sqrt(n), of a covariance at most sqrt(2 / n) std_i std_j.
    assert ((samples.mean(0).mT - found.mean).abs() <= 5 * std / num**0.5).all()
    for c in range(2):
        for t in range(T):
            error = samples[:, c, :, t].mT.cov() - covariance[c, t]
            assert (error.abs() <= 5 * (2 / num) ** 0.5 * std[c, t].outer(std[c, t])).all()
    # Chains draw noise of their own: a correlation of independent draws errs by num^-1/2.
    across = torch.stack([samples[:, 0, 0, 0], samples[:, 1, 0, 0]]).corrcoef()[0, 1]
    assert across.abs() < 5 / num**0.5


def test_weight_counts_a_datum_as_often(generator):
    model, data = chains(deep_gp(1, generator)), toy(generator)
    start = torch.zeros(1, M * T).double()
    weighted = posterior(model, start, data, weight=2.0)
    twice = posterior(model, start, Data(data.x.repeat(2, 1), data.y.repeat(2, 1)))
    torch.testing.assert_close(weighted.mean, twice.mean)
    torch.testing.assert_close(weighted.precision_factor, twice.precision_factor)


def test_a_precision_that_rounding_spoils_is_an_error(generator):
    """Never a posterior under a prior that is stronger than the model's."""
    model, data = chains(deep_gp(1, generator, "rbf")), toy(generator)
    with pytest.raises(FactorisationError):
        posterior(model, torch.zeros(1, M * T).double(), Data(data.x[:2], data.y[:2]), weight=1e19)


@pytest.mark.parametrize("field", ["x", "y"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_data_that_are_not_finite_are_an_error(field, value, generator):
    """Of one target of one chain's datum, too; never a posterior of which a part is not finite."""
    model, data = chains(*(deep_gp(1, generator) for _ in range(2))), toy(generator)
    getattr(data, field)[3, 1] = value
    with pytest.raises(FactorisationError, match="finite"):
        posterior(model, torch.zeros(2, M * T).double(), data)


@pytest.mark.parametrize("num_chains", [1, 2])
def test_gibbs_step_moves_the_last_layer_alone(num_chains, generator):
    model, data = chains(*(deep_gp(2, generator) for _ in range(num_chains))), toy(generator)
    run = started(model, data, generator)
    before = run.snapshot().state
    run.draw_last_layer(generator)
    inner, after = model.num_inner(), run.state
    assert inner == M * D
    assert torch.equal(after.whitened.position[:, :inner], before.whitened.position[:, :inner])
    assert not (after.whitened.position[:, inner:] == before.whitened.position[:, inner:]).any()
    assert (after.whitened.momentum[:, :inner] == 1).all()
    assert not (after.whitened.momentum[:, inner:] == 1).any()
    assert torch.equal(after.whitened.square, before.whitened.square)
    assert all(torch.equal(a, b) for a, b in zip(after.latents, before.latents, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(after.parameters, before.parameters, strict=True))


@pytest.mark.parametrize(("batch_size", "step_size"), [(10, 0.05), (N, 0.1)])
def test_a_gibbs_step_draws_the_momentum_of_the_last_layer_from_its_own_law(batch_size, step_size, generator):
    """N(0, eps^2 M^-1 / N), where SG-HMC leaves it, with the mass and the step size of each coordinate."""
    model, data, num_draws = chains(*(deep_gp(2, generator) for _ in range(2))), toy(generator), 400
    run = started(model, data, generator, batch_size=batch_size, step_size=step_size)
    square = (8.0 * torch.rand(run.state.whitened.square.shape, generator=generator, dtype=torch.float64) - 6.0).exp()
    run.state = run.state._replace(whitened=run.state.whitened._replace(square=square))
    size = step_sizes(run.state.whitened, step_size, run.settings.decay, batch_size, N)
    assert (size > 0.999 * step_size).any() and (size < 0.5 * step_size).any()
    inner, drawn = model.num_inner(), []
    for _ in range(num_draws):
        run.draw_last_layer(generator)
        drawn.append(run.state.whitened.momentum[:, inner:])
    std = size * square**-0.25 / N**0.5
    standard = torch.stack(drawn) / std[:, inner:]
    # Five standard errors, of the mean and the variance of a coordinate, and of those of all of them together, whose
    # draws are independent.
    for error, count in ((standard.mean(0), num_draws), (standard.mean(), standard.numel())):
        assert (error.abs() <= 5 / count**0.5).all()
    for ratio, count in ((standard.var(0), num_draws), (standard.var(), standard.numel())):
        assert ((ratio - 1).abs() <= 5 * (2 / count) ** 0.5).all()


def test_last_layer_is_laid_out_as_the_model_reads_it(generator):
    """A draw explains the data: through the model its mean prediction beats the prior's by far."""
    model, data = chains(*(deep_gp(2, generator) for _ in range(2))), toy(generator)
    run = started(model, data, generator)
    run.state = run.state._replace(whitened=sghmc.init(torch.zeros_like(run.state.whitened.position)))
    before = run.evaluate(generator)
    run.draw_last_layer(generator)
    assert run.evaluate(generator) < before - 1.0


def test_repeated_draws_share_the_inner_layers(generator):
    model, data = chains(*(deep_gp(2, generator) for _ in range(2))), toy(generator)
    run = started(model, data, generator)
    start = run.state.whitened.position.clone()
    positions = run.last_layer_draws(4, generator)
    assert positions.shape == (4, 2, model.num_whitened())
    inner = model.num_inner()
    assert torch.equal(positions[..., :inner], start[:, :inner].expand(4, -1, -1))
    assert positions[..., inner:].std(0).min() > 0
    assert torch.equal(run.state.whitened.position, start)


def test_draws_from_some_rows_count_for_all_data(generator):
    """Where all rows are the same, any n of them with the weight N / n say what the N say."""
    one, (x, y) = deep_gp(1, generator), toy(generator)
    num_data, num_rows, num_samples = 64, 4, 20_000
    data = Data(x[:1].repeat(num_data, 1), y[:1].repeat(num_data, 1))
    (factor,) = factorise_all(one).factors
    exact = whitened_posterior(one.layers[0], factor, one.noise_variance, *data)
    run = started(chains(one), data, generator, gibbs_rows=num_rows)
    positions = run.last_layer_draws(num_samples, generator)[:, 0]
    # What the data determine: the function's value at the only input, a . v for each target.
    layer = one.layers[0]
    a = (layer.variance.sqrt() * project(layer, factor, x[:1])).squeeze()
    values = torch.einsum("m,nmt->nt", a, positions.unflatten(1, (M, T)))
    variance = torch.einsum("m,tmk,k->t", a, exact.covariance, a)
    # Five standard errors, of a mean and of a variance. Without the weight the variance is more than ten times this.
    assert ((values.mean(0) - a @ exact.mean).abs() <= 5 * (variance / num_samples).sqrt()).all()
    assert ((values.var(0) / variance - 1).abs() <= 5 * (2 / num_samples) ** 0.5).all()


def test_the_last_layer_is_fed_what_the_inner_layers_give(generator):
    """Given the latents, its inputs are known, so that its posterior is closed too."""
    models, data = [deep_gp(2, generator) for _ in range(2)], toy(generator)
    together = chains(*models)
    whitened, latent = 2.0 * normal(generator, 2, together.num_whitened()), normal(generator, 2, N, D)
    found = posterior(together, whitened, data, [latent])
    for c, model in enumerate(models):
        inner, last = model.layers
        factors = factorise_all(model).factors
        mean, variance = conditional(inner, factors[0], model.split(whitened[c])[0], data.x)
        hidden = data.x + mean + variance.sqrt().unsqueeze(-1) * latent[c]
        exact = whitened_posterior(last, factors[1], model.noise_variance, hidden, data.y)
        # Rounding of 1e-16 times the condition number of K_zz, at most M / jitter, and that of the precision.
        torch.testing.assert_close(found.mean[c].mT, exact.mean, rtol=0, atol=1e-6)
        covariance = torch.cholesky_inverse(found.precision_factor[c])
        torch.testing.assert_close(covariance, exact.covariance, rtol=0, atol=1e-6)
        for others in (data.x, data.x + mean, hidden + 0.1):  # nothing else would do
            unfed = whitened_posterior(last, factors[1], model.noise_variance, others, data.y)
            assert (unfed.mean - exact.mean).abs().max() > 1e-3
