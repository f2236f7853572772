"""A mixture of models: what is held out, what weights come of it, and what its members are made with."""

import functools

import pytest
import torch

from gym_dgpmpc.dynamics.mixture import MixtureDynamics
from gym_dgpmpc.dynamics.mixture.stacking import stacking_weights
from gym_dgpmpc.types import Transitions
from tests.oracles import slider
from tests.oracles.models import seeded

MEMBERS = ("sparse-gp", "ensemble")
NETWORKS = {
    "ensemble_num_hidden_layers": 2, "ensemble_hidden_size": 32, "ensemble_weight_decay": (0, 0, 0),
    "ensemble_num_members": 2,
}  # fmt: skip
DEEP = {
    "deep_gp_num_layers": 1, "deep_gp_num_inducing": 40, "deep_gp_first_training_iterations": 200,
    "deep_gp_training_iterations": 20, "deep_gp_num_chains": 2, "deep_gp_num_samples": 10, "deep_gp_sample_spacing": 2,
}  # fmt: skip
QUICK = {
    **NETWORKS,
    **DEEP,
    "ensemble_num_epochs": 2,
    "sparse_gp_num_inducing": 20,
    "sparse_gp_max_training_iterations": 20,
}


def linear(num):
    return slider.transitions(num, 0.02)


def wave(num):
    """With a push that is a wave of the position: two inducing points know nothing of its turns."""
    observation, action, after = linear(num)
    push = torch.sin(3 * observation[:, :1])
    return Transitions(observation, action, after + torch.cat([push, -push, torch.zeros_like(push)], 1))


def first(data, num):
    return Transitions(*(field[:num] for field in data))


def mixture(members=MEMBERS, **settings):
    return MixtureDynamics(3, 1, slider.SPEC, members=members, **{**QUICK, **settings})


@functools.cache
def fitted_state(num=100):
    model = mixture()
    model.fit(linear(num), seeded())
    return model.state_dict()


def fitted(**settings):
    model = mixture(**settings)
    model.load_state_dict(fitted_state())
    return model


def test_before_any_evidence_weights_are_equal():
    metrics = mixture().fit(linear(50), seeded())
    assert metrics["sparse_gp_weight"] == metrics["ensemble_weight"] == 0.5
    assert metrics["num_held_out"] == 0


@pytest.mark.parametrize(
    ("data", "other", "settings", "better"),
    [(linear, "ensemble", {}, "sparse_gp"), (wave, "deep-gp", {"sparse_gp_num_inducing": 2}, "deep_gp")],
)
def test_the_model_that_predicts_better_gets_the_weight(data, other, settings, better):
    """A Gaussian process has a linear system from 200 transitions, and networks of two epochs have not."""
    model = mixture(("sparse-gp", other), **settings)
    model.fit(first(data(400), 200), seeded())
    metrics = model.fit(data(400), seeded(1))
    assert metrics["num_held_out"] == 40
    assert metrics[f"{better}_weight"] > 0.9


def test_every_transition_is_predicted_before_it_is_learned_from():
    """By the members as they are then: within an episode, and what is left at a training."""
    data = linear(120)
    model, before = fitted(sparse_gp_update_within_episode=True), fitted()
    held_out = Transitions(*(field[100:120:5] for field in data))
    expected = torch.stack([each.predictive(held_out, seeded()).log_density for each in before.models.values()], -1)
    model.resample(first(data, 111), seeded())
    assert model.state_dict()["num_seen"] == 111
    followed = model.models["sparse-gp"].predictive(held_out, seeded()).log_density
    model.fit(data, seeded())
    found = model.state_dict()["log_density"]
    torch.testing.assert_close(found[:3], expected[:3], rtol=1e-6, atol=1e-6)  # networks are float32
    assert not torch.allclose(followed[:3], expected[:3, 0], rtol=1e-6), "it has learned of them since"
    torch.testing.assert_close(found[3:, 0], followed[3:], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(model.state_dict()["weights"], stacking_weights(found))


def test_it_does_not_matter_how_transitions_come_to_members_that_do_not_follow():
    data, at_once, by_one = linear(120), fitted(), fitted()
    for num in range(101, 121):
        by_one.resample(first(data, num), seeded())
    for model in (at_once, by_one):
        model.fit(data, seeded())
    torch.testing.assert_close(
        at_once.state_dict()["log_density"], by_one.state_dict()["log_density"], rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize(("share", "oldest"), [(0.5, 75), (1.0, 100), (0.1, 135)])
def test_the_latest_share_of_all_transitions_decides(share, oldest):
    """Of 150 transitions those from 100 on were predicted, every fifth of them."""
    model, data = fitted(evidence_share=share), linear(150)
    model.fit(first(data, 130), seeded())
    metrics = model.fit(data, seeded())
    assert metrics["num_held_out"] == len(range(max(oldest, 100), 150, 5))


def test_a_draw_has_as_many_particles_of_each_as_its_weight_says():
    """Five standard errors of a count that is one of two whole numbers."""
    model = fitted()
    model.load_state_dict({**model.state_dict(), "weights": torch.tensor([0.3, 0.7], dtype=torch.float64)})
    counts, draws = {name: [] for name in model.models}, 400
    for name, member in model.models.items():
        member.draw = lambda count, *rest, name=name: counts[name].append(count)
    generator = seeded()
    for _ in range(draws):
        model.draw(5, 4, generator)
    for name, weight in zip(MEMBERS, (0.3, 0.7), strict=True):
        assert set(counts[name]) == {int(5 * weight), int(5 * weight) + 1}
        assert abs(sum(counts[name]) / draws - 5 * weight) < 5 * 0.5 * draws**-0.5


def test_its_predictive_density_is_the_mixture_of_the_members():
    model, data = fitted(), linear(20)
    model.load_state_dict({**model.state_dict(), "weights": torch.tensor([0.3, 0.7], dtype=torch.float64)})
    found = model.predictive(data, seeded())
    one, other = (each.predictive(data, seeded()) for each in model.models.values())
    torch.testing.assert_close(found.mean, 0.3 * one.mean + 0.7 * other.mean)
    second = 0.3 * (one.variance + one.mean**2) + 0.7 * (other.variance + other.mean**2)
    torch.testing.assert_close(found.variance, second - found.mean**2, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(found.log_density.exp(), 0.3 * one.log_density.exp() + 0.7 * other.log_density.exp())


def test_members_are_made_with_their_own_settings():
    model = MixtureDynamics(3, 1, slider.SPEC, members=("deep-gp", "sparse-gp", "ensemble"), deep_gp_num_layers=3,
                            sparse_gp_kernel="matern32", ensemble_draw="DS", dtype=torch.float64)  # fmt: skip
    deep, sparse, networks = model.models.values()
    assert (deep.num_layers, sparse.kernel.name, networks.draw_kind) == (3, "matern32", "DS")
    assert {each.dtype for each in model.models.values()} == {torch.float64}
    # Weights are of predictions with noise, and of networks that are trained as far as they can be.
    assert sparse.add_noise and (networks.epochs.num_epochs, networks.epochs.patience) == (300, 15)


@pytest.mark.parametrize(
    ("settings", "error", "value"),
    [
        ({"members": ()}, ValueError, r"\(\)"),
        ({"members": "ensemble"}, ValueError, "'ensemble'"),
        ({"members": ("ensemble", "gp")}, ValueError, "'gp'"),
        ({"members": ("ensemble", "ensemble")}, ValueError, "once"),
        ({"score_every": 0}, ValueError, "score_every.*0"),
        ({"evidence_share": 0.0}, ValueError, r"evidence_share.*0\.0"),
        ({"num_layers": 2}, TypeError, "num_layers.*deep_gp_num_layers"),
        ({"sparse_gp_draw": "MM"}, ValueError, "MM.*sparse_gp_draw"),
        ({"sparse_gp_draw": "AMM"}, ValueError, "AMM.*sparse_gp_draw"),
        ({"ensemble_draw": "MM"}, ValueError, "MM.*ensemble_draw"),
        ({"ensemble_num_epochs": 0}, ValueError, "num_epochs.*0"),
    ],
)
def test_settings_out_of_range_are_named(unchecked, settings, error, value):
    with pytest.raises(error, match=value):
        mixture(**settings)


@pytest.mark.parametrize("weights", [(0.5, 0.6), (-0.5, 1.5), (float("nan"), 0.5)])
def test_weights_in_a_state_must_be_shares(weights):
    model = fitted()
    with pytest.raises(ValueError, match=r"'weights'.*" + str(weights[1])):
        model.load_state_dict({**fitted_state(), "weights": torch.tensor(weights, dtype=torch.float64)})
    with pytest.raises(ValueError, match="'ensemble"):
        model.load_state_dict({k: v for k, v in fitted_state().items() if not k.startswith("ensemble")})
    assert float(model.state_dict()["weights"][0]) == 0.5


def test_one_member_is_that_model():
    model = mixture(("sparse-gp",))
    model.fit(linear(60), seeded())
    assert model.state_dict()["weights"].tolist() == [1.0]
    states = torch.zeros(4, 3, 3)
    moved = model.draw(4, 1, seeded())(states, torch.zeros(3, 1), 0)
    assert moved.shape == states.shape and moved.isfinite().all()
