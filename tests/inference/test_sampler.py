"""The chains: their gradients and where they settle, against closed forms; and when which part of them moves."""

import math

import numpy as np
import pytest
import scipy.stats
import torch

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.gp import exact
from gym_dgpmpc.gp.deep_gp import factorise_all
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.gp.layer import conditional
from gym_dgpmpc.inference import adam, sampler, sghmc
from gym_dgpmpc.inference.diagnostics import effective_sample_size
from gym_dgpmpc.inference.gradients import forward, gradients, prepare
from gym_dgpmpc.inference.sampler import LAST_LEARNING_RATE, Chains, initial_state
from gym_dgpmpc.inference.settings import InferenceSettings
from tests.oracles import sghmc as oracle
from tests.oracles.models import chains, make_model, normal, seeded

NEVER = 10**9


def one_layer(kernel="rbf", num_data=8, num_chains=1):
    """Models with fixed hyperparameters, one for each chain, and data."""
    generator = seeded(5)
    models = []
    for c in range(num_chains):
        model = make_model(1, 2, 2, 5, generator, kernel)
        models.append(model._replace(log_noise=torch.tensor([0.3, 0.6 + 0.2 * c], dtype=torch.float64).log()))
    return models, Data(normal(generator, num_data, 2), normal(generator, num_data, 2))


def two_layers(num_chains=2, num_data=9, kernel="matern32"):
    generator = seeded(5)
    models = [make_model(2, 2, 2, 5, generator, kernel) for _ in range(num_chains)]
    return models, Data(normal(generator, num_data, 2), normal(generator, num_data, 2))


def started(models, data, settings=None, num_burn_in=0, position=None):
    model = chains(*models)
    if position is None:
        position = normal(seeded(1), len(models), model.num_whitened())
    state = initial_state(model, sghmc.init(position), data.num_rows, seeded(2))
    return Chains(model, state, data, settings or InferenceSettings(), num_burn_in)


def flat_posterior(model, data):
    """Mean [V] and precision [V, V]: outputs are independent, and neighbours in the flat vector."""
    (factor,) = factorise_all(model).factors
    posterior = exact.whitened_posterior(model.layers[0], factor, model.noise_variance, *data)
    num_inducing, outputs = posterior.mean.shape
    precision = torch.zeros(num_inducing, outputs, num_inducing, outputs, dtype=torch.float64)
    for output in range(outputs):
        precision[:, output, :, output] = torch.linalg.inv(posterior.covariance[output])
    return posterior.mean.flatten(), precision.reshape(num_inducing * outputs, -1)


@pytest.fixture
def seen_gradients(monkeypatch):
    """What SG-HMC is told, of inducing outputs and of hyperparameters, by how many there are."""
    seen, original = [], sghmc.step

    def watched(state, gradient, num_data, *args, **kwargs):
        seen.append((gradient, num_data, kwargs))
        return original(state, gradient, num_data, *args, **kwargs)

    monkeypatch.setattr(sghmc, "step", watched)
    return seen


@pytest.fixture
def rates(monkeypatch):
    """The learning rates that Adam is told."""
    seen, original = [], adam.step

    def watched(state, position, gradient, learning_rate):
        seen.append(learning_rate)
        return original(state, position, gradient, learning_rate)

    monkeypatch.setattr(adam, "step", watched)
    return seen


@pytest.mark.parametrize("num_chains", [1, 2])
@pytest.mark.parametrize("kernel", KERNELS)
def test_chains_are_moved_by_the_gradient_of_the_closed_form_posterior(kernel, num_chains, seen_gradients):
    models, data = one_layer(kernel, num_chains=num_chains)
    run = started(models, data)
    before = run.state.whitened.position.clone()
    run.step(seeded())
    ((gradient, num_data, _),) = seen_gradients
    assert num_data == 8
    for c, model in enumerate(models):
        mean, precision = flat_posterior(model, data)
        torch.testing.assert_close(gradient[c], precision @ (before[c] - mean) / 8, rtol=1e-8, atol=1e-10)


def test_gradients_of_minibatches_are_unbiased():
    """The mean over all batches of one row is the full gradient exactly, of each row with its own latents."""
    models, data = two_layers()
    model = chains(*models)
    whitened, latent = normal(seeded(1), 2, model.num_whitened()), normal(seeded(2), 2, 9, 2)
    prepared = prepare(model)

    def of(rows):
        batch = data.rows(rows)
        passed = forward(prepared, model.split(whitened), batch.x.expand(2, -1, -1), [latent[:, rows]])
        found = gradients(prepared, model.split(whitened), passed, [latent[:, rows]], batch.y, of_parameters=True)
        return torch.cat([found.whitened, sampler.flatten(found.parameters)], dim=1)

    singles = torch.stack([of(torch.tensor([n])) for n in range(9)])
    torch.testing.assert_close(singles.mean(0), of(torch.arange(9)), rtol=1e-9, atol=1e-10)


def test_minibatches_are_drawn_uniformly_and_keep_rows_and_latents_together():
    models, _ = two_layers(num_data=1)
    rows = torch.arange(10, dtype=torch.float64).unsqueeze(1)
    data, generator, counts = Data(rows.expand(-1, 2), rows.expand(-1, 2) + 100.0), seeded(), torch.zeros(10)
    run = started(models, data, InferenceSettings(batch_size=4))
    for _ in range(2000):
        batch, index = run._batch(4, generator)
        assert batch.x.shape == (4, 2) and torch.equal(batch.y, batch.x + 100.0)
        assert torch.equal(batch.x[:, 0].long(), index)
        counts += torch.bincount(index, minlength=10)
    assert scipy.stats.chisquare(counts.numpy()).pvalue > 1e-4
    for size in (10, 11):
        assert run._batch(size, generator) == (data, None)
    # Only the latents of the drawn rows are moved, if any are accepted: of a hundred proposals some are.
    moved = torch.zeros(2, 10, dtype=torch.bool)
    for step in range(50):
        before, twin = run.state.latents[0].clone(), seeded(step)
        index = torch.randint(10, (4,), generator=twin)
        run.step(seeded(step))
        changed = (run.state.latents[0] != before).any(-1)
        assert not changed[:, [n for n in range(10) if n not in index]].any()
        moved |= changed
    assert moved.all()


@pytest.mark.usefixtures("unchecked")  # thousands of steps
@pytest.mark.parametrize(("kernel", "num_data"), [("rbf", 8), ("matern32", 24)])
def test_samples_follow_the_closed_form_posterior(kernel, num_data, monkeypatch):
    """Mean and covariance of v, tolerances from the chain's exact autocovariances, its step-size bias included.

    Of two chains, each against the posterior under its own hyperparameters.
    """
    monkeypatch.setattr(sampler, "MOST_TURNED", math.inf)  # so that every coordinate has the oracle's one step size
    models, data = one_layer(kernel, num_data, num_chains=2)
    settings = InferenceSettings(step_size=0.6, decay=0.4, gibbs_every=0)
    means, precisions = zip(*(flat_posterior(model, data) for model in models), strict=True)
    inverse_mass = num_data / torch.stack(precisions).diagonal(dim1=1, dim2=2)
    num_samples, spacing, burn_in = 1200, 2, 30
    run = started(models, data, settings, position=torch.stack(means))
    run.state = run.state._replace(whitened=run.state.whitened._replace(square=inverse_mass**-2))
    positions = list(sampler.sample(run, burn_in + num_samples, spacing, seeded()))
    by_chain = torch.stack(positions[burn_in:]).movedim(1, 0)
    for samples, mean, precision, mass in zip(by_chain.numpy(), means, precisions, inverse_mass.numpy(), strict=True):
        hessian = precision.numpy() / num_data
        lags = oracle.autocovariances(hessian, mass, num_data, settings.step_size, settings.decay, 600)
        # The discretisation is visible, but small beside the posterior itself.
        np.testing.assert_allclose(np.diagonal(lags[0]), np.diagonal(np.linalg.inv(precision)), rtol=0.25)
        lags = np.concatenate([np.swapaxes(lags[spacing::spacing], 1, 2), lags[::spacing]])  # both directions of time
        error = samples.mean(0) - mean.numpy()
        statistic = error @ np.linalg.solve(lags.sum(0) / num_samples, error)
        assert scipy.stats.chi2(len(mean)).sf(statistic) > 1e-4

        # Var of a product of Gaussians (Isserlis), summed over lags: the variance of each entry of the covariance.
        variance = np.einsum("kii,kjj->ij", lags, lags) + np.einsum("kij,kji->ij", lags, lags)
        deviation = (
            np.cov(samples.T)
            - oracle.stationary_covariance(hessian, mass, num_data, settings.step_size, settings.decay)
        ) / np.sqrt(variance / num_samples)
        assert abs(deviation).max() < 4.5

        # And the diagnostics see the mixing that the oracle knows.
        known = num_samples * lags[len(lags) // 2].diagonal() / lags.sum(0).diagonal()
        effective = effective_sample_size(torch.from_numpy(samples)).numpy()
        assert np.median(effective / known) == pytest.approx(1.0, abs=0.3)


def test_sampling_keeps_preconditioners_hyperparameters_and_the_spacing():
    """One layer: with latents the moves of every other step would have to fall together, too."""
    models, data = one_layer(num_chains=2)
    settings = InferenceSettings(gibbs_every=0, hyperparameters_every=1)
    every, second = started(models, data, settings), started(models, data, settings)
    one_by_one = list(sampler.sample(every, 6, 1, seeded()))
    for a, b in zip(one_by_one[1::2], sampler.sample(second, 3, 2, seeded()), strict=True):
        assert torch.equal(a, b)
    start = started(models, data, settings).state
    for name in ("square", "averaging", "gradient"):
        assert torch.equal(getattr(second.state.whitened, name), getattr(start.whitened, name))
    assert all(torch.equal(a, b) for a, b in zip(second.state.parameters, start.parameters, strict=True))


def test_the_prior_weighs_less_the_more_data_there_are(seen_gradients):
    """Where all rows are the same, only the share of the prior, v / N, changes with N."""
    models, data = one_layer()
    found = []
    for num_data in (8, 80):
        same = Data(data.x[:1].repeat(num_data, 1), data.y[:1].repeat(num_data, 1))
        run = started(models, same, InferenceSettings(batch_size=8))
        v = run.state.whitened.position.clone()
        run.step(seeded())
        gradient, seen_num_data, _ = seen_gradients.pop()
        assert seen_num_data == num_data
        found.append(gradient)
    torch.testing.assert_close(found[0] - found[1], v * (1 / 8 - 1 / 80), rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(
    ("batch_size", "bound"),
    [(200, 0.03), (1000, 0.03), (198, 0.03), (100, 2 * 0.05 * 0.1 / 0.5), (8, 2 * 0.05 * 0.1 / 0.96)],
)
def test_a_step_turns_no_coordinate_far_and_minibatches_heat_none_much(batch_size, bound):
    """Each coordinate has a step of its own, as long as asked for wherever that is short enough."""
    deviations = torch.logspace(-6, 6, 60, dtype=torch.float64).view(2, 30)  # of gradients
    state = sghmc.init(torch.zeros_like(deviations))._replace(square=deviations.square())
    sizes = sampler.step_sizes(state, 0.1, 0.05, batch_size, 200)
    turned = sizes.square() * 200 * deviations
    as_asked = 0.1**2 * 200 * deviations < bound
    assert as_asked.any() and not as_asked.all()
    torch.testing.assert_close(sizes[as_asked], torch.full_like(sizes[as_asked], 0.1), rtol=1e-12, atol=0)
    # The mass is that of the square up to the 1e-16 that keeps it from zero.
    torch.testing.assert_close(turned[~as_asked], torch.full_like(turned[~as_asked], bound), rtol=1e-6, atol=0)


@pytest.mark.parametrize("batch_size", [8, 200, 1000])
def test_inducing_outputs_and_hyperparameters_take_the_steps_that_are_short_enough(batch_size, seen_gradients):
    """By the preconditioner that the step starts from, and the rows that its gradient is made of."""
    models, data = one_layer(num_data=200)
    settings = InferenceSettings(
        batch_size=batch_size, hyperparameters="sampled", hyperparameters_every=1, step_size=0.1, decay=0.3
    )
    run, spread = started(models, data, settings), seeded(3)
    squares = [
        (8.0 * normal(spread, *state.square.shape)).exp() for state in (run.state.whitened, run.state.parameters)
    ]
    whitened, parameters = (
        run.state.whitened._replace(square=squares[0]),
        run.state.parameters._replace(square=squares[1]),
    )
    run.state = run.state._replace(whitened=whitened, parameters=parameters)
    run.step(seeded())
    asked = settings.step_size, settings.hyperparameter_step_size
    for state, size, (*_, kwargs) in zip((whitened, parameters), asked, seen_gradients, strict=True):
        expected = sampler.step_sizes(state, size, 0.3, min(batch_size, 200), 200)
        assert (expected < size).any() and (expected > 0.999 * size).any()
        torch.testing.assert_close(kwargs["step_size"], expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("hyperparameters", ["sampled", "optimised"])
def test_adam_goes_on_from_its_last_learning_rate_where_hyperparameters_are_settled(hyperparameters, rates):
    models, data = one_layer()
    settings = InferenceSettings(hyperparameters=hyperparameters, hyperparameters_every=1)
    model = chains(*models)
    state = initial_state(model, sghmc.init(normal(seeded(1), 1, model.num_whitened())), data.num_rows, seeded(2))
    run, generator = Chains(model, state, data, settings, 8, settled=True), seeded()
    for _ in range(4):
        run.step(generator)
    assert rates == pytest.approx([settings.learning_rate * LAST_LEARNING_RATE] * 4, rel=1e-12)


@pytest.mark.parametrize("hyperparameters", ["sampled", "optimised"])
def test_chains_do_not_feel_each_other(hyperparameters):
    """Another start of the second, whatever it leads to, leaves every number of the first as it is."""
    models, data = two_layers(num_data=20)
    settings = InferenceSettings(hyperparameters=hyperparameters, batch_size=8, hyperparameters_every=2, gibbs_every=5)
    ends = []
    for other in (models[1], make_model(2, 2, 2, 5, seeded(77), "matern32")):
        position = normal(seeded(1), 2, models[0].num_whitened())
        if other is not models[1]:
            position[1] = 3.0 * normal(seeded(9), models[0].num_whitened())
        run = started([models[0], other], data, settings, num_burn_in=6, position=position)
        generator = seeded(4)
        for _ in range(12):
            run.step(generator)
        ends.append(run.state)
    for first, second in zip(
        (*ends[0].whitened, *ends[0].parameters, *ends[0].latents),
        (*ends[1].whitened, *ends[1].parameters, *ends[1].latents),
        strict=True,
    ):
        assert torch.equal(first[0], second[0])
    assert not (ends[0].whitened.position[1] == ends[1].whitened.position[1]).any()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("num_chains", [1, 2])
def test_hyperparameters_see_every_position_of_the_window_alike(num_chains, monkeypatch):
    models, data = one_layer(num_chains=num_chains)
    size, num_steps = 4, 400
    settings = InferenceSettings(hyperparameters="optimised", window_size=size, hyperparameters_every=1)
    run = started(models, data, settings, num_burn_in=NEVER)
    original, seen = Chains._gradients, []

    def watched(self, position, *args, **kwargs):
        seen.append(position.clone())  # the last of a step is that of the hyperparameters
        return original(self, position, *args, **kwargs)

    monkeypatch.setattr(Chains, "_gradients", watched)
    generator, counts = seeded(), torch.zeros(size)
    for _ in range(size - 1):
        run.step(generator)
    for _ in range(num_steps):
        run.step(generator)
        counts += (run._window == seen[-1]).all(dim=(1, 2))
    assert counts.sum() == num_steps  # each was one of the window, and its rows differ
    assert scipy.stats.chisquare(counts.numpy()).pvalue > 1e-4


def test_hyperparameters_that_are_optimised_follow_the_likelihood(seen_gradients):
    """Adam's first step has the size of its learning rate, up the likelihood's gradient; no prior is added."""
    models, data = one_layer(num_chains=2)
    settings = InferenceSettings(hyperparameters="optimised", hyperparameters_every=1, gibbs_every=0)
    run = started(models, data, settings)
    before, position = run.state.parameters.position.clone(), run.state.whitened.position.clone()
    together = chains(*models)
    prepared, split = prepare(together), together.split(position)
    passed = forward(prepared, split, data.x.expand(2, -1, -1), [])
    uphill = sampler.flatten(gradients(prepared, split, passed, [], data.y, of_parameters=True).parameters)
    run.step(seeded())
    step = run.state.parameters.position - before
    # Without a burn-in the learning rate is at its end from the first step on.
    expected = settings.learning_rate * LAST_LEARNING_RATE * uphill / (uphill.abs() + 1e-8)
    torch.testing.assert_close(step, expected, rtol=1e-6, atol=1e-12)
    assert len(seen_gradients) == 1, "SG-HMC moves the inducing outputs alone"


def test_the_learning_rate_falls_geometrically_until_the_end_of_the_burn_in(rates):
    models, data = one_layer()
    run = started(models, data, InferenceSettings(hyperparameters="optimised", hyperparameters_every=1), num_burn_in=8)
    generator = seeded()
    for _ in range(10):
        run.step(generator)
    expected = [InferenceSettings().learning_rate * LAST_LEARNING_RATE ** min(done / 8, 1.0) for done in range(1, 11)]
    assert rates == pytest.approx(expected, rel=1e-12)


def test_after_the_burn_in_hyperparameters_are_sampled_under_their_prior(seen_gradients):
    """Before it Adam moves them, and the preconditioner of the inducing outputs adapts."""
    models, data = one_layer(num_chains=2)
    settings = InferenceSettings(hyperparameters="sampled", hyperparameters_every=1, gibbs_every=0)
    run, generator = started(models, data, settings, num_burn_in=3), seeded()
    num_whitened = run.state.whitened.position.shape[1]
    burning_in = []
    for _ in range(3):
        run.step(generator)
        burning_in += [kwargs["burn_in"] for *_, kwargs in seen_gradients]
        assert not run.state.parameters.momentum.any() and len(seen_gradients) == 1
        seen_gradients.clear()
    assert burning_in == [True, True, True]
    # Adam adapts the preconditioner that SG-HMC is going to use.
    assert not (run.state.parameters.square == 1.0).any()
    square = run.state.whitened.square.clone()
    for _ in range(2):
        before = run.model, run.state.whitened.position
        run.step(generator)
        (first, second), num_data = seen_gradients, data.num_rows
        seen_gradients.clear()
        assert first[0].shape[1] == num_whitened and not first[2]["burn_in"]
        assert second[1] == num_data and (second[2]["step_size"] <= settings.hyperparameter_step_size).all()
        leaves = [parameter.clone().requires_grad_() for parameter in before[0].parameters()]
        model = before[0].with_parameters(leaves)
        value = 0.0
        for c in range(2):
            one = model.with_parameters([leaf[c] for leaf in leaves])
            (v,) = one.split(before[1][c])
            mean, variance = conditional(one.layers[0], factorise_all(one).factors[0], v, data.x)
            std = (variance.unsqueeze(-1) + one.noise_variance).sqrt()
            value = value - torch.distributions.Normal(mean, std).log_prob(data.y).sum() / num_data
            centres = (one.layers[0].log_lengthscale, math.log(2) / 2), (one.layers[0].log_variance, 0.0)
            for parameter, centre in (*centres, (one.log_noise, math.log(0.05))):
                value = value - torch.distributions.Normal(centre, 3.0).log_prob(parameter).sum() / num_data
            value = (
                value - torch.distributions.Normal(0.0, 10.0).log_prob(one.layers[0].inducing_inputs).sum() / num_data
            )
        expected = sampler.flatten(list(torch.autograd.grad(value, leaves)))
        torch.testing.assert_close(second[0], expected, rtol=1e-6, atol=1e-7)
    assert run.state.parameters.momentum.all()
    assert torch.equal(run.state.whitened.square, square)


@pytest.mark.parametrize("num_chains", [1, 2])
@pytest.mark.parametrize(("every", "drawn"), [(0, []), (1, [0, 1, 2, 3, 4]), (3, [0, 3])])
def test_the_last_layer_is_drawn_as_often_as_asked(monkeypatch, every, drawn, num_chains):
    models, data = one_layer(num_chains=num_chains)
    run = started(models, data, InferenceSettings(gibbs_every=every))
    original, seen, generator = Chains.draw_last_layer, [], seeded()

    def watched(self, generator):
        seen.append(self.iteration)
        original(self, generator)

    monkeypatch.setattr(Chains, "draw_last_layer", watched)
    for _ in range(5):
        run.step(generator)
    assert seen == drawn
    # Each sample of a pool gets one, however often training draws.
    seen.clear()
    positions = list(sampler.sample(run, 4, 2, generator))
    assert len(seen) == (4 if every else 0)
    assert torch.stack(positions).shape == (4, num_chains, 10)
