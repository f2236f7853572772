"""The network with dropout: its functions' moments in closed form, its training against a second implementation."""

import math

import numpy as np
import pytest
import torch

from gym_dgpmpc.dynamics.dropout import DropoutDynamics
from gym_dgpmpc.dynamics.dropout.model import NUM_FUNCTIONS
from gym_dgpmpc.dynamics.dropout.network import DropoutNetwork, draw_kept, initial_network
from gym_dgpmpc.dynamics.noise import NoiseSplit
from gym_dgpmpc.types import Transitions
from tests.oracles import pendulum
from tests.oracles.models import seeded

SMALL = {"num_hidden_layers": 2, "hidden_size": 7, "num_epochs": 3}


def small(**settings):
    return DropoutDynamics(2, 1, pendulum.SPEC, **(SMALL | settings))


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def steep(num_hidden_layers, rate, **settings):
    """A trained model whose weights are six times what they begin with, so that its functions differ."""
    model = small(num_hidden_layers=num_hidden_layers, dropout=rate, **settings)
    model.fit(pendulum.simulate(30), seeded())
    state = model.state_dict()
    model.load_state_dict(state | {name: 6 * value for name, value in state.items() if name.startswith("layers.")})
    return model


def test_a_function_keeps_its_masks_for_the_whole_plan():
    """At the same state and action it predicts the same at every step; each particle has a function of its own."""
    sampler = steep(2, 0.3, add_noise=False).draw(6, 5, seeded(1))
    observation, action = torch.tensor([0.4, -0.2]).expand(6, 2, -1), torch.tensor([[0.5], [0.5]])
    first = sampler(observation, action, 0)
    for step in range(1, 5):
        assert torch.equal(sampler(observation, action, step), first)
    assert torch.equal(first[:, 0], first[:, 1]), "all candidates meet the same function"
    assert len(torch.unique(first[:, 0], dim=0)) == 6


def test_noise_is_a_particles_own_and_the_same_for_all_candidates():
    sampler = steep(2, 0.0).draw(3, 2, seeded(1))
    after = [sampler(torch.zeros(3, 2, 2), torch.zeros(2, 1), step) for step in range(2)]
    assert torch.equal(after[0][:, 0], after[0][:, 1])
    assert len(torch.unique(torch.stack(after)[:, :, 0].flatten(0, 1), dim=0)) == 6


def test_moments_over_masks_are_those_of_independent_coins():
    """With one hidden layer f = b + sum_j z_j a_j, a_j = w_j s(h_j), has mean b + q sum a, variance q (1 - q) sum a^2,
    and a fourth cumulant, which the standard error of a variance needs, of q (1 - q) (1 - 6 q (1 - q)) sum a^4."""
    rate, count = 0.3, 20_000
    model = steep(1, rate, add_noise=False)
    state = {name: value.double().numpy() for name, value in model.state_dict().items() if torch.is_tensor(value)}
    data = pendulum.simulate(40, seed=3)
    observation, action = data.observation[-1:], data.action[-1:]
    raw = model.encoder.inputs(observation.double(), action.double()).numpy()[0]
    x = (raw - state["inputs.mean"]) / state["inputs.std"]
    hidden = sigmoid(x @ state["layers.0.weight"] + state["layers.0.bias"])
    parts = hidden[:, None] * state["layers.1.weight"] * state["targets.std"]
    q, coin = 1 - rate, rate * (1 - rate)
    mean = state["targets.mean"] + state["targets.std"] * state["layers.1.bias"] + q * parts.sum(0)
    variance = coin * (parts**2).sum(0)
    fourth = coin * (1 - 6 * coin) * (parts**4).sum(0)
    unbounded = {name: torch.full((2,), value).double() for name, value in (("lowest", -99.0), ("highest", 99.0))}
    model.load_state_dict(model.state_dict() | {f"seen.{name}": value for name, value in unbounded.items()})
    drawn = model.draw(count, 1, seeded(2))(observation.expand(count, 1, -1), action, 0) - observation
    change = drawn[:, 0].double().numpy()
    assert (np.abs(change.mean(0) - mean) <= 5 * np.sqrt(variance / count) + 1e-6).all()
    error = np.sqrt((2 * variance**2 + fourth) / count)
    assert (np.abs(change.var(0) - variance) <= 5 * error + 1e-6 * variance).all()

    # And the predictive density is of some of these functions, with the noise.
    found = model.predictive(Transitions(observation, action, observation), seeded(3))
    noise = np.exp(state["log_noise"]) * state["targets.std"] ** 2
    assert (np.abs(found.mean[0].numpy() - mean) <= 5 * np.sqrt(variance / NUM_FUNCTIONS)).all()
    error = np.sqrt((2 * variance**2 + fourth) / NUM_FUNCTIONS) + variance / NUM_FUNCTIONS
    assert (np.abs(found.variance[0].numpy() - noise - variance) <= 5 * error).all()


def test_training_is_adam_on_the_variational_bound():
    """A second implementation in double precision: N times the mean misfit and the divergence from the prior, q l^2 / 2
    |W|^2 and l^2 / 2 |b|^2, over N; Adam by its formulas, the noise ten times as fast; two trainings."""
    sizes, length, rate = (20, 30), 1.7, 0.3
    model = small(batch_size=8, learning_rate=1e-2, prior_lengthscale=length, dropout=rate)
    generator, repeated = seeded(7), seeded(7)
    first_network = initial_network(model.sizes, math.log(0.1), repeated, torch.device("cpu"))
    parameters = {name: value.double() for name, value in first_network.parameters().items()}
    step, first, second = 0, {}, {}
    for num_rows in sizes:
        data = pendulum.simulate(num_rows)
        model.fit(data, generator)
        raw = model.encoder.inputs(data.observation.double(), data.action.double())
        change = model.encoder.targets(data.observation.double(), data.next_observation.double())
        x, y = ((part - part.mean(0)) / part.std(0, correction=0) for part in (raw, change))
        for _ in range(SMALL["num_epochs"]):
            order = torch.rand(1, num_rows, generator=repeated).argsort(1)[0]
            for batch in order.split(8):
                masks = draw_kept(first_network, rate, repeated, len(batch))
                leaves = {name: value.clone().requires_grad_() for name, value in parameters.items()}
                h = torch.sigmoid(x[batch] @ leaves["layers.0.weight"] + leaves["layers.0.bias"]) * masks[0].double()
                h = torch.sigmoid(h @ leaves["layers.1.weight"] + leaves["layers.1.bias"]) * masks[1].double()
                mean = h @ leaves["layers.2.weight"] + leaves["layers.2.bias"]
                noise = torch.distributions.Normal(mean, (0.5 * leaves["log_noise"]).exp())
                value = -noise.log_prob(y[batch]).sum() / len(batch)
                for i in range(3):
                    kept = 1.0 if i == 0 else 1 - rate
                    squares = kept * leaves[f"layers.{i}.weight"].square().sum()
                    value = value + length**2 / (2 * num_rows) * (squares + leaves[f"layers.{i}.bias"].square().sum())
                gradients = dict(zip(leaves, torch.autograd.grad(value, list(leaves.values())), strict=True))
                step += 1
                for name, g in gradients.items():
                    first[name] = 0.9 * first.get(name, 0.0) + 0.1 * g
                    second[name] = 0.999 * second.get(name, 0.0) + 0.001 * g**2
                    m, v = first[name] / (1 - 0.9**step), second[name] / (1 - 0.999**step)
                    speed = 1e-1 if name == "log_noise" else 1e-2
                    parameters[name] = parameters[name] - speed * m / (v.sqrt() + 1e-8)
        torch.rand(NUM_FUNCTIONS, 1, 14, generator=repeated)  # the functions that the report is of
    for name, value in parameters.items():
        # Single precision, where Adam divides by the gradient's own size: 1e-2 of a step.
        atol = 1e-3 if name == "log_noise" else 1e-4
        torch.testing.assert_close(model.state_dict()[name].double(), value, rtol=0, atol=atol)


def test_it_learns_the_pendulum():
    model = small(hidden_size=32, num_epochs=400, learning_rate=5e-3)
    before = small().fit(pendulum.simulate(200), seeded())["rmse"]
    assert model.fit(pendulum.simulate(200), seeded())["rmse"] < 0.25 * before
    test = pendulum.simulate(100, seed=1)
    expected = model.predictive(test, seeded())
    change = (test.next_observation - test.observation).double()
    assert float((expected.mean - change).square().mean().sqrt()) < 0.25 * float(change.square().mean().sqrt())


def test_training_stops_where_held_out_data_are_likeliest():
    """And goes back there, over as many epochs, of one step each, as it was patient."""
    model = small(num_epochs=200, patience=3, learning_rate=0.3)
    metrics = model.fit(pendulum.simulate(100), seeded())
    assert metrics["iterations"] < 200
    assert model.state_dict()["adam.num_updates"] == metrics["iterations"] - 3


def test_noise_that_is_given_is_not_learned():
    model = small(model_noise_std=0.2)
    model.fit(pendulum.simulate(30), seeded())
    assert model.fit(pendulum.simulate(40), seeded())["noise_std"] == pytest.approx(0.2, rel=1e-6)


def test_without_dropout_there_is_one_function():
    states = steep(2, 0.0, add_noise=False).draw(4, 1, seeded(1))(torch.ones(4, 3, 2), torch.zeros(3, 1), 0)
    assert torch.equal(states, states[:1, :1].expand_as(states))


def test_what_does_not_vary_leaves_finite_noise():
    network = DropoutNetwork((), (), torch.tensor([-1e4, 0.0]))
    assert network.noise_variance.min() > 1e-7


def test_observation_noise_does_not_add_up():
    """A network of zeros moves by the mean change whatever it is fed, so what is observed varies by the start's error
    and by the present one's, R each, at every step; within five standard errors."""
    count, R = 5000, torch.tensor([0.04, 0.09]).double()
    model, nothing = steep(2, 0.3, split_noise=True), torch.zeros(2).double()
    state = {name: value * 0 if name.startswith("layers.") else value for name, value in model.state_dict().items()}
    model.load_state_dict(state | NoiseSplit(nothing, R, nothing, nothing).state())
    sampler, states = model.draw(count, 3, seeded(1)), torch.zeros(count, 1, 2)
    for step in range(3):
        states = sampler(states, torch.zeros(1, 1), step)
        found, known = states[:, 0].double(), (step + 1) * state["targets.mean"]
        assert ((found.mean(0) - known).abs() <= 5 * (2 * R / count).sqrt()).all()
        assert ((found.var(0) - 2 * R).abs() <= 5 * 2 * R * (2 / count) ** 0.5).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_hidden_layers": 0}, "num_hidden_layers .* 0$"),
        ({"hidden_size": 0}, "hidden_size .* 0$"),
        ({"dropout": 1.0}, r"dropout must lie in \[0, 1\), got 1\.0$"),
        ({"prior_lengthscale": -1.0}, r"prior_lengthscale .* -1\.0$"),
        ({"model_noise_std": 0.0}, r"model_noise_std .* 0\.0$"),
        ({"learning_rate": 0.0}, r"learning_rate .* 0\.0$"),
        ({"batch_size": 0}, "batch_size .* 0$"),
        ({"num_epochs": 0}, "num_epochs .* 0$"),
        ({"patience": 0}, "patience .* 0$"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_settings_out_of_range_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        small(**settings)
