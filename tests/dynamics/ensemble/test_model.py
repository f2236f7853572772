"""The ensemble against plain numpy, its training against a second implementation, its draws at known networks."""

import math
import re

import numpy as np
import pytest
import torch

from gym_dgpmpc.dynamics.ensemble import network as ensemble_network
from gym_dgpmpc.dynamics.ensemble.draws import PROPAGATIONS
from gym_dgpmpc.dynamics.ensemble.model import EnsembleDynamics
from gym_dgpmpc.dynamics.ensemble.network import (
    MAX_LOGVAR,
    MIN_LOGVAR,
    Ensemble,
    half_precision,
    initial_ensemble,
    loss,
    predict,
)
from gym_dgpmpc.dynamics.networks import layer_sizes
from tests.oracles import pendulum
from tests.oracles.models import seeded

SMALL = {"num_members": 3, "num_hidden_layers": 2, "hidden_size": 7, "weight_decay": (1e-3, 2e-3, 5e-3)}


def small(**settings):
    return EnsembleDynamics(2, 1, pendulum.SPEC, **(SMALL | settings))


def network(num_members=3, generator=None):
    return initial_ensemble(num_members, layer_sizes(4, 2, 7, 4), generator or seeded(), torch.device("cpu"))


def by_hand(parameters, member, x):
    """Mean and log variance of one member at the rows of x, in numpy."""
    parts = {name: value.detach().double().numpy() for name, value in parameters.items()}
    for i in range(3):
        x = x @ parts[f"layers.{i}.weight"][member] + parts[f"layers.{i}.bias"][member]
        x = x / (1 + np.exp(-x)) if i < 2 else x
    mean, logvar = x[:, :2], x[:, 2:]
    logvar = parts["max_logvar"] - np.log1p(np.exp(parts["max_logvar"] - logvar))
    return mean, parts["min_logvar"] + np.log1p(np.exp(logvar - parts["min_logvar"]))


def test_predictions_and_loss_are_those_of_each_network_by_itself():
    ensemble = network()
    x, y = torch.randn(3, 9, 4, generator=seeded(1)), torch.randn(3, 9, 2, generator=seeded(2))
    found = predict(ensemble, x)
    expected = 0.01 * 2 * (MAX_LOGVAR - MIN_LOGVAR)
    for member in range(3):
        mean, logvar = by_hand(ensemble.parameters(), member, x[member].double().numpy())
        np.testing.assert_allclose(found.mean[member], mean, atol=1e-5)
        np.testing.assert_allclose(found.logvar[member], logvar, atol=1e-5)
        expected += ((y[member].numpy() - mean) ** 2 * np.exp(-logvar) + logvar).mean()
    assert float(loss(ensemble, x, y)) == pytest.approx(expected, rel=1e-5)


def test_points_beyond_the_cache_are_taken_in_parts(monkeypatch):
    ensemble, x = network(), torch.randn(3, 25, 4, generator=seeded(1))
    monkeypatch.setattr(ensemble_network, "ROWS_AT_ONCE", 10)
    with torch.no_grad():
        parts = predict(ensemble, x.clone())
    for one, other in zip(parts, predict(ensemble, x), strict=True):
        torch.testing.assert_close(one, other.detach(), rtol=1e-5, atol=1e-6)


def test_weights_start_truncated_and_biases_at_zero():
    """A normal cut off at two standard deviations has 0.8796 of them left."""
    ensemble = initial_ensemble(5, layer_sizes(100, 1, 200, 8), seeded(), torch.device("cpu"))
    (first, _), std = ensemble.weights, 0.5 * 100**-0.5
    assert first.shape == (5, 100, 200)
    assert float(first.abs().max()) <= 2 * std
    # The standard error of a standard deviation from n draws is below std / sqrt(2 n).
    assert float(first.std()) == pytest.approx(0.8796 * std, abs=5 * std / math.sqrt(2 * first.numel()))
    assert all(float(bias.abs().max()) == 0.0 for bias in ensemble.biases)
    assert not torch.equal(first[0], first[1])
    # Where PETS's published code lets the bounds start.
    assert set(ensemble.max_logvar.tolist()) == {0.5} and set(ensemble.min_logvar.tolist()) == {-10.0}


def test_training_is_adam_on_bootstraps_with_decayed_weights():
    """A second implementation, in double precision: the whole loss with its decay, Adam by its formulas, two trainings
    of which the second goes on with weights and moments, fresh bootstraps each time."""
    sizes = ((20, 1), (30, 2))
    model, generator = small(num_epochs=2, batch_size=8, learning_rate=1e-2), seeded(7)
    for num_steps, _ in sizes:
        model.fit(pendulum.simulate(num_steps), generator)

    generator = seeded(7)
    parameters = None
    step, first, second = 0, {}, {}
    for num_steps, _ in sizes:
        data = pendulum.simulate(num_steps)
        raw = model.encoder.inputs(data.observation.double(), data.action.double())
        x = (raw - raw.mean(0)) / raw.std(0, correction=0)
        y = model.encoder.targets(data.observation.double(), data.next_observation.double())
        if parameters is None:
            start = initial_ensemble(3, model.sizes, generator, torch.device("cpu"))
            parameters = {name: value.double() for name, value in start.parameters().items()}
        rows = torch.randint(num_steps, (3, num_steps), generator=generator)
        for _ in range(2):
            rows_now = rows.gather(1, torch.rand(rows.shape, generator=generator).argsort(1))
            for begin in range(0, num_steps, 8):
                batch = rows_now[:, begin : begin + 8]
                leaves = {name: value.clone().requires_grad_() for name, value in parameters.items()}
                value = loss(Ensemble.from_parameters(leaves), x[batch], y[batch])
                for i, decay in enumerate(SMALL["weight_decay"]):
                    value = value + decay / 2 * leaves[f"layers.{i}.weight"].square().sum()
                gradients = dict(zip(leaves, torch.autograd.grad(value, list(leaves.values())), strict=True))
                step += 1
                for name, g in gradients.items():
                    first[name] = 0.9 * first.get(name, 0.0) + 0.1 * g
                    second[name] = 0.999 * second.get(name, 0.0) + 0.001 * g**2
                    m, v = first[name] / (1 - 0.9**step), second[name] / (1 - 0.999**step)
                    parameters[name] = parameters[name] - 1e-2 * m / (v.sqrt() + 1e-8)
    for name, value in parameters.items():
        # Single precision, where Adam divides by the gradient's own size: 1e-2 of a step of 1e-2.
        torch.testing.assert_close(model.state_dict()[name].double(), value, rtol=0, atol=1e-4)


def test_it_learns_the_pendulum_and_its_own_uncertainty():
    model = EnsembleDynamics(
        2, 1, pendulum.SPEC, num_hidden_layers=2, hidden_size=32, weight_decay=(1e-5,) * 3, num_epochs=100
    )
    before = small().fit(pendulum.simulate(200), seeded())["rmse"]
    metrics = model.fit(pendulum.simulate(200), seeded())
    assert metrics["rmse"] < 0.2 * before
    test = pendulum.simulate(100, seed=1)
    model.draw_kind = "expectation"
    predicted = model.draw(1, 1, seeded())(test.observation.unsqueeze(0), test.action, 0)[0]
    still = (test.next_observation - test.observation).square().mean().sqrt()
    assert float((predicted - test.next_observation).square().mean().sqrt()) < 0.2 * float(still)


def constant(draw, means=(0.0, 1.0, 2.0), stds=(1e-3, 1e-3, 1e-3)):
    """Three networks that predict the same change everywhere, each its own."""
    model = small(draw=draw)
    model.fit(pendulum.simulate(5), seeded())
    state = {
        name: torch.zeros_like(value) if name.startswith("layers") else value
        for name, value in model.state_dict().items()
    }
    state["layers.2.bias"] = torch.tensor(
        [[[mean, -mean, 2 * math.log(std), 2 * math.log(std)]] for mean, std in zip(means, stds, strict=True)]
    )
    state |= {"max_logvar": torch.full((2,), 30.0), "min_logvar": torch.full((2,), -50.0)}
    model.load_state_dict(state)
    return model


def changes(model, num_particles, candidates=40, steps=3):
    """Which network moved each particle at each step, [steps, P, K], from the change of the first number."""
    sampler = model.draw(num_particles, steps, seeded(3))
    states, moved = torch.zeros(num_particles, candidates, 2), []
    for step in range(steps):
        after = sampler(states, torch.zeros(candidates, 1), step)
        torch.testing.assert_close(
            after - states, (after - states)[..., :1] * torch.tensor([1.0, -1.0]), rtol=0, atol=0.02
        )
        moved.append((after - states)[..., 0].round().long())
        states = after
    return torch.stack(moved)


def test_tsinf_keeps_a_network_for_the_whole_plan():
    owner = torch.arange(6).div(2, rounding_mode="floor").view(1, 6, 1)
    assert torch.equal(changes(constant("TSinf"), 6), owner.expand(3, 6, 40))


def test_ts1_shuffles_the_networks_over_a_candidates_particles_at_each_step():
    moved = changes(constant("TS1"), 6)
    assert torch.equal(moved.sort(1).values, torch.tensor([0, 0, 1, 1, 2, 2]).view(1, 6, 1).expand(3, 6, 40))
    assert len(torch.unique(moved.movedim(1, -1).reshape(-1, 6), dim=0)) > 40, "of 90 orders, in 120 draws"
    # Each particle meets each network a third of the time: 120 draws have the standard error sqrt(2/9 / 120).
    share = torch.stack([(moved == b).float().mean((0, 2)) for b in range(3)])
    assert float((share - 1 / 3).abs().max()) < 5 * math.sqrt(2 / 9 / 120)


def test_ds_draws_from_the_mixtures_mean_and_total_variance():
    """Variance: the mean of the networks' plus that of their means; five standard errors of P K draws."""
    means, stds = (0.0, 1.0, 2.0), (0.5, 1.0, 1.5)
    sampler = constant("DS", means, stds).draw(100, 1, seeded(3))
    change = sampler(torch.zeros(100, 400, 2), torch.zeros(400, 1), 0)[..., 0].double().numpy().ravel()
    variance = np.mean(np.square(stds)) + np.var(means)
    assert change.mean() == pytest.approx(np.mean(means), abs=5 * math.sqrt(variance / change.size))
    assert change.var() == pytest.approx(variance, abs=5 * variance * math.sqrt(2 / change.size))


@pytest.mark.parametrize("draw", ["TS1", "TSinf"])
@pytest.mark.parametrize("num_particles", [1, 2, 4])
def test_particles_that_are_left_over_are_of_networks_at_random(draw, num_particles):
    """Of three networks each has P // 3 particles or one more: in 150 draws P / 3, with the standard error of a binary
    number, whose variance is at most 1/4."""
    model, generator, draws = constant(draw), seeded(3), 150
    counts = torch.zeros(draws, 3)
    for count in counts:
        moved = model.draw(num_particles, 1, generator)(torch.zeros(num_particles, 7, 2), torch.zeros(7, 1), 0)
        network = moved[..., 0].round().long().sort(0).values
        assert (network == network[:, :1]).all(), "the same ones for all candidates"
        count += torch.bincount(network[:, 0], minlength=3)
    assert set(counts.unique().tolist()) == {num_particles // 3, num_particles // 3 + 1}
    assert (counts.sum(1) == num_particles).all()
    assert ((counts.mean(0) - num_particles / 3).abs() < 5 * 0.5 * draws**-0.5).all()


@pytest.mark.parametrize("draw", PROPAGATIONS)
def test_any_number_of_particles_will_do(draw):
    assert constant(draw).draw(4, 1, seeded())(torch.zeros(4, 2, 2), torch.zeros(2, 1), 0).shape == (4, 2, 2)


def test_half_precision_is_off_by_its_rounding():
    """bfloat16 rounds to 8 bits, 2^-9 relative, in each of the inputs, weights and results of the middle layer."""
    ensemble = initial_ensemble(3, layer_sizes(4, 3, 200, 4), seeded(), torch.device("cpu"))
    x = torch.randn(3, 50, 4, generator=seeded(1))
    with torch.no_grad():
        exact, rounded = predict(ensemble, x.clone()), predict(half_precision(ensemble), x.clone())
    assert rounded.mean.dtype == torch.float32
    error = (exact.mean - rounded.mean).abs().mean() / exact.mean.std()
    assert 0 < float(error) < 6 * 2**-9


def test_half_precision_is_for_planning_alone():
    full, half = small(), small(half_precision=True)
    for model in (full, half):
        model.fit(pendulum.simulate(30), seeded())
    for name, value in full.state_dict().items():
        assert np.array_equal(value, half.state_dict()[name]), name
    states = [m.draw(3, 1, seeded(1))(torch.zeros(3, 2, 2), torch.ones(2, 1), 0) for m in (full, half)]
    assert not torch.equal(*states)
    torch.testing.assert_close(*states, rtol=0, atol=0.05)


@pytest.mark.parametrize("num_updates", [0, 1.5, None, "many"])
def test_a_damaged_count_is_named(num_updates):
    model = small()
    model.fit(pendulum.simulate(5), seeded())
    with pytest.raises(ValueError, match=rf"'adam\.num_updates'.* {re.escape(repr(num_updates))}$"):
        model.load_state_dict(model.state_dict() | {"adam.num_updates": num_updates})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_members": 0}, "num_members .* 0$"),
        ({"num_hidden_layers": 0}, "num_hidden_layers .* 0$"),
        ({"hidden_size": 0}, "hidden_size .* 0$"),
        ({"batch_size": 0}, "batch_size .* 0$"),
        ({"num_epochs": 0}, "num_epochs .* 0$"),
        ({"weight_decay": (1e-3, 1e-3)}, r"weight_decay .*\b2\b.*\(0\.001, 0\.001\)$"),
        ({"weight_decay": (1e-3, 1e-3, -1.0)}, r"weight_decay .*-1\.0\)$"),
        ({"learning_rate": 0.0}, r"learning_rate .* 0\.0$"),
        ({"draw": "TS2"}, "draw 'TS2'.*TS1, TSinf, DS, MM, expectation"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_settings_out_of_range_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        small(**settings)
