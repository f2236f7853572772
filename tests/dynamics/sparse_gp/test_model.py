"""The sparse Gaussian process as a dynamics model: what the contract of all models does not say."""

import pytest
import torch

from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.dynamics.sparse_gp.model import SparseGPDynamics
from gym_dgpmpc.gp import exact
from gym_dgpmpc.types import ObservationSpec, Transitions
from tests.oracles import pendulum
from tests.oracles.models import normal, seeded


def fitted(num_steps=60, data=None, **settings):
    model = SparseGPDynamics(2, 1, pendulum.SPEC, **({"num_inducing": 20, "max_training_iterations": 40} | settings))
    model.fit(pendulum.simulate(num_steps) if data is None else data, seeded())
    return model


def noisy(num_steps, std=0.2):
    data = pendulum.simulate(num_steps)
    return data._replace(next_observation=data.next_observation + std * normal(seeded(9), num_steps, 2).float())


def one_step(model, data, num_particles=2000, seed=1):
    sampler = model.draw(num_particles, 1, seeded(seed))
    return sampler(data.observation.expand(num_particles, -1, -1), data.action, 0).double()


def test_it_predicts_the_pendulum():
    model, test = fitted(150, max_training_iterations=100), pendulum.simulate(60, seed=1)
    error = (one_step(model, test, 50).mean(0) - test.next_observation).square().mean(0).sqrt()
    still = (test.next_observation - test.observation).square().mean(0).sqrt()
    assert bool((error < 0.1 * still).all())


@pytest.mark.parametrize("add_noise", [False, True])
def test_draws_have_the_moments_of_the_exact_regression(add_noise):
    """At the hyperparameters that the model found, within five standard errors of P draws; the jitter is a millionth
    of the kernel's variance and here less than a thousandth of the noise, which a hundredth of a deviation allows for.
    """
    data, test = noisy(60), pendulum.simulate(8, seed=1)
    model = fitted(data=data, exact=True, add_noise=add_noise)
    state, encoder = model.state_dict(), model.encoder
    raw = [encoder.inputs(each.observation.double(), each.action.double()) for each in (data, test)]
    target = encoder.targets(data.observation.double(), data.next_observation.double())
    inputs, targets = Normaliser.fit(raw[0]), Normaliser.fit(target)
    (layer,), noise = model._fitted.model.layers, model._fitted.model.noise_variance
    assert torch.equal(state["inducing_inputs"], inputs(raw[0]))
    assert 1e-6 * layer.variance < 1e-3 * noise.min()
    known = exact.regression(layer, noise, inputs(raw[0]), targets(target), inputs(raw[1]))
    mean = targets.inverse(known.mean) + test.observation
    variance = known.covariance.diagonal(dim1=-2, dim2=-1).mT.clamp_min(0.0) + (noise if add_noise else 0.0)
    std = variance.sqrt() * targets.std
    count = 2000
    drawn = one_step(model, test, count)
    slack = 1e-2 * std
    assert bool(((drawn.mean(0) - mean).abs() <= 5 * std / count**0.5 + slack).all())
    assert bool(((drawn.std(0) - std).abs() <= 5 * std / (2 * count) ** 0.5 + slack).all())


def test_matched_particles_have_a_candidates_moments():
    ds, mm = fitted(draw="DS"), fitted(draw="MM")
    test = pendulum.simulate(8, seed=1)
    first, second = one_step(ds, test), one_step(mm, test)
    std = first.std(0)
    # Both are estimates from 2000 draws, and the second draws again from such an estimate.
    assert bool(((first.mean(0) - second.mean(0)).abs() <= 5 * std * (3 / 2000) ** 0.5).all())
    assert bool(((second.std(0) - std).abs() <= 5 * std * (3 / 4000) ** 0.5).all())


@pytest.mark.parametrize("num_steps", [1, 2, 7])
def test_with_few_transitions_each_is_an_inducing_point(num_steps):
    model = fitted(num_steps)
    assert model.state_dict()["inducing_inputs"].shape == (num_steps, 4)
    test = pendulum.simulate(5, seed=1)
    assert one_step(model, test, 3).isfinite().all()
    loaded = SparseGPDynamics(2, 1, pendulum.SPEC, num_inducing=20)
    loaded.load_state_dict(model.state_dict())
    assert torch.equal(one_step(loaded, test, 3), one_step(model, test, 3))
    model.fit(pendulum.simulate(40), seeded())
    assert model.state_dict()["inducing_inputs"].shape == (20, 4)


def test_inducing_inputs_start_from_different_rows_of_the_data():
    data = pendulum.simulate(60)
    model = SparseGPDynamics(2, 1, pendulum.SPEC, num_inducing=20, max_training_iterations=1)
    model.fit(data, seeded())
    raw = model.encoder.inputs(data.observation.double(), data.action.double())
    rows = Normaliser.fit(raw)(raw)
    nearest = torch.cdist(model.state_dict()["inducing_inputs"], rows).min(1)
    assert len(nearest.indices.unique()) == 20
    assert float(nearest.values.max()) < 0.5, "one step of the optimiser away"


def test_the_exact_model_takes_every_transition():
    assert fitted(33, exact=True).state_dict()["inducing_inputs"].shape == (33, 4)


def test_within_an_episode_the_data_count_if_asked():
    """At the new transition itself the prediction moves towards what was seen, hyperparameters as they were."""
    data = pendulum.simulate(40)
    odd = Transitions(torch.tensor([[2.5, 4.0]]), torch.tensor([[0.5]]), torch.tensor([[4.0, 1.0]]))
    grown = Transitions(
        *(torch.cat(pair) for pair in zip(data, Transitions(*(p.repeat(30, 1) for p in odd)), strict=True))
    )
    for update in (False, True):
        model = fitted(40, update_within_episode=update)
        before, hyperparameters = one_step(model, odd).mean(0), model.state_dict()
        model.resample(grown, seeded())
        distances = [float((each - odd.next_observation).norm()) for each in (before, one_step(model, odd).mean(0))]
        assert (distances[1] < 0.9 * distances[0]) == update
        assert torch.equal(model.state_dict()["seen.highest"], hyperparameters["seen.highest"]) != update
        for name in ("inducing_inputs", "log_lengthscale", "log_variance", "log_noise", "inputs.mean", "targets.std"):
            assert torch.equal(model.state_dict()[name], hyperparameters[name])


def test_the_exact_model_within_an_episode_is_exact_too():
    """Where no transition was when it was trained, it predicts what the same hyperparameters give with all of them."""
    grown = noisy(60, 0.02)
    model = fitted(data=Transitions(*(field[:30] for field in grown)), exact=True, update_within_episode=True)
    normalisers = model._fitted.normalisers
    model.resample(grown, seeded())
    layer, noise = model._fitted.model.layers[0], model._fitted.model.noise_variance
    x, y = (normalise(raw) for normalise, raw in zip(normalisers, model._encode(grown), strict=True))
    assert torch.equal(layer.inducing_inputs, x)
    known = exact.regression(layer, noise, x, y, x)
    mean = normalisers[1].inverse(known.mean) + grown.observation
    std = known.covariance.diagonal(dim1=-2, dim2=-1).mT.clamp_min(0.0).sqrt() * normalisers[1].std
    count = 2000
    error = (one_step(model, grown, count).mean(0) - mean).abs()
    assert bool((error <= 5 * std / count**0.5 + 1e-2 * std).all())
    other = SparseGPDynamics(2, 1, pendulum.SPEC, exact=True, update_within_episode=True)
    other.load_state_dict(model.state_dict())
    assert torch.equal(one_step(other, grown, 3), one_step(model, grown, 3))


def test_later_trainings_start_from_the_last_one():
    """One iteration from a converged model loses nothing; one from the beginning is far behind."""
    data = pendulum.simulate(80)
    first = SparseGPDynamics(2, 1, pendulum.SPEC, exact=True, max_training_iterations=100)
    converged = first.fit(data, seeded())["bound"]
    first.max_training_iterations = 1
    again = first.fit(data, seeded())["bound"]
    fresh = SparseGPDynamics(2, 1, pendulum.SPEC, exact=True, max_training_iterations=1).fit(data, seeded())["bound"]
    assert again >= converged - 1e-6 > fresh + 0.1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_inducing": 0}, "num_inducing .* 0$"),
        ({"max_training_iterations": 0}, "max_training_iterations .* 0$"),
        ({"draw": "TS1"}, "draw 'TS1'.*DS, MM, AMM"),
        ({"kernel": "cubic"}, "kernel 'cubic'"),
        ({"kernel": "matern32", "draw": "AMM"}, "AMM .*'rbf'.*'matern32'"),
        (
            {"observation_spec": ObservationSpec(body_frame=((0, 1, 2),)), "draw": "AMM"},
            r"AMM .*body_frame=\(\(0, 1, 2\),\)",
        ),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_settings_out_of_range_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        SparseGPDynamics(2, 1, **settings)


def test_the_state_of_a_larger_model_is_refused():
    with pytest.raises(ValueError, match=r"'inducing_inputs'.*\(10, 4\).*\(20, 4\)"):
        SparseGPDynamics(2, 1, pendulum.SPEC, num_inducing=10).load_state_dict(fitted().state_dict())
