"""The dynamics model as the agent uses it: fit, resample, draw, save and load, at tiny sizes."""

import re

import pytest
import torch

from gym_dgpmpc.dynamics.deep_gp import start as deep_gp_start
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.errors import TrainingError
from gym_dgpmpc.inference.mcem import InferenceSettings
from gym_dgpmpc.planning.rollout import rollout
from gym_dgpmpc.types import DynamicsModel, ObservationSpec, Transitions
from tests.oracles import pendulum
from tests.oracles.models import seeded

TINY = {
    "num_inducing": 8, "num_features": 16, "first_training_iterations": 3, "training_iterations": 2, "num_samples": 4,
    "sample_spacing": 1, "resample_steps": 2,
}  # fmt: skip


def tiny(**settings):
    return DeepGPDynamics(2, 1, pendulum.SPEC, **(TINY | settings))


def fitted(num_steps=30, **settings):
    model = tiny(**settings)
    model.fit(pendulum.simulate(num_steps), seeded())
    return model


def predictions(model, seed=5, num_particles=3, horizon=4):
    sampler = model.draw(num_particles, horizon, seeded(seed))
    actions = torch.rand(6, horizon, 1, generator=seeded(1), dtype=model.dtype) * 2 - 1
    return rollout(sampler, torch.tensor([0.1, 0.2], dtype=model.dtype), actions, num_particles)


def test_it_is_a_dynamics_model():
    assert isinstance(tiny(), DynamicsModel)


@pytest.mark.parametrize("num_layers", [1, 2, 3])
@pytest.mark.parametrize("draw", ["pathwise", "joint", "marginal"])
def test_fit_draw_and_roll_out(draw, num_layers):
    model = tiny(draw=draw, num_layers=num_layers)
    metrics = model.fit(pendulum.simulate(30), seeded())
    assert {"negative_log_joint", "effective_sample_size", "gradient_norm", "noise_std", "r_hat"} <= set(metrics)
    assert all(isinstance(value, float) and value == value for value in metrics.values())
    states = predictions(model)
    assert states.shape == (5, 3, 6, 2) and states.dtype == torch.float32 and states.isfinite().all()
    assert len(torch.unique(states[1, :, 0, 1])) == 3, "particles are different worlds"


@pytest.mark.parametrize("draw", ["pathwise", "joint"])
def test_the_same_seed_gives_the_same_run(draw):
    def run(seed):
        model, generator = tiny(draw=draw), seeded(seed)
        model.fit(pendulum.simulate(20), generator)
        model.fit(pendulum.simulate(30), generator)
        model.resample(pendulum.simulate(31), generator)
        return predictions(model)

    assert torch.equal(run(0), run(0))
    assert not torch.equal(run(0), run(1))


@pytest.mark.parametrize("num_steps", [1, 2, 5])
def test_fewer_transitions_than_inducing_inputs_are_enough(num_steps):
    model = fitted(num_steps)
    assert predictions(model).isfinite().all()
    model.resample(pendulum.simulate(num_steps + 1), seeded())
    model.fit(pendulum.simulate(num_steps + 4), seeded())
    assert predictions(model).isfinite().all()


def test_a_pool_of_one_sample_is_enough():
    model = fitted(num_samples=1)
    assert predictions(model).isfinite().all()
    model.resample(pendulum.simulate(31), seeded())
    assert predictions(model).isfinite().all()


def test_dimensions_that_never_vary_stay_where_they_are():
    data = pendulum.simulate(30)
    still = torch.full((30, 1), 7.25)
    data = Transitions(
        torch.cat([data.observation, still], 1), data.action, torch.cat([data.next_observation, still], 1)
    )
    for spec in (pendulum.SPEC, ObservationSpec(angles=(0,), constant=(2,))):
        model = DeepGPDynamics(3, 1, spec, **TINY)
        model.fit(data, seeded())
        after = model.draw(3, 1, seeded())(data.observation.expand(3, -1, -1).clone(), data.action, 0)
        assert after.isfinite().all()
        # Unmodelled it is passed through; modelled, its targets are zeros that are not scaled up to anything.
        error = (after[..., 2] - 7.25).abs()
        assert error.max() < (1e-6 if spec.constant else 5.0)


def test_no_transitions_are_an_error():
    with pytest.raises(ValueError, match="0 transitions"):
        tiny().fit(Transitions(torch.zeros(0, 2), torch.zeros(0, 1), torch.zeros(0, 2)), seeded())


@pytest.mark.parametrize("verb", ["draw", "resample"])
def test_an_unfitted_model_says_so(verb):
    with pytest.raises(RuntimeError, match=f"{verb}.*fit"):
        if verb == "draw":
            tiny().draw(1, 1, seeded())
        else:
            tiny().resample(pendulum.simulate(3), seeded())


@pytest.mark.parametrize("gibbs_every", [20, 0])
def test_resampling_replaces_the_oldest_rows_of_the_pool_and_nothing_else(gibbs_every):
    num = 3 if gibbs_every else 1  # SG-HMC alone gives one position
    model, generator = fitted(num_samples=4, resample_samples=3, gibbs_every=gibbs_every), seeded(3)
    before = {name: torch.as_tensor(value).clone() for name, value in model.state_dict().items()}
    pool, oldest = before["pool"], 0
    for count in range(1, 6):  # around the ring of four and further
        model.resample(pendulum.simulate(30 + count), generator)
        state = model.state_dict()
        changed = (state["pool"] != pool).any(dim=1).nonzero().flatten().tolist()
        assert changed == sorted((oldest + i) % 4 for i in range(num))
        newest = (oldest + num - 1) % 4
        oldest = (oldest + num) % 4
        assert state["oldest"] == oldest
        assert torch.equal(state["pool"][newest], state["chain.position"])
        pool = state["pool"].clone()
        moved = {name for name, value in before.items() if not torch.equal(torch.as_tensor(state[name]), value)}
        assert moved - {"oldest"} == {"pool", "chain.position", "chain.momentum"}


def test_resampling_may_be_turned_off():
    model = fitted(resample_steps=0)
    before = model.state_dict()["pool"].clone()
    assert model.resample(pendulum.simulate(31), seeded()) == {}
    assert torch.equal(model.state_dict()["pool"], before)


def test_a_state_that_was_taken_does_not_change_with_the_model():
    """A checkpoint may be written while the agent goes on."""
    model = fitted()
    state = model.state_dict()
    before = {name: torch.as_tensor(value).clone() for name, value in state.items()}
    model.resample(pendulum.simulate(31), seeded())
    assert all(torch.equal(torch.as_tensor(state[name]), value) for name, value in before.items())


def test_particles_are_distinct_samples_while_the_pool_lasts():
    model = fitted(num_layers=1, num_inducing=4, num_features=1, refresh="plan")
    pool = torch.arange(4.0, dtype=torch.float64).unsqueeze(1).expand(4, 8)
    model.load_state_dict(model.state_dict() | {"pool": 100.0 * (1.0 + pool)})
    sampler = model.draw(6, 1, seeded())
    # Samples a hundred standard deviations apart tell which particle holds which.
    state = model.state_dict()
    raw = state["layers.0.inducing_inputs"] * state["inputs.std"] + state["inputs.mean"]
    angle, rate, action = torch.atan2(raw[:, 1], raw[:, 2]), raw[:, 0], raw[:, 3:]
    observation = torch.stack([angle, rate], 1).float()
    change = sampler(observation.expand(6, -1, -1).clone(), action.float(), 0)[:, :, 1] - observation[:, 1]
    held = change.abs().mean(1)
    order = held.argsort()
    assert torch.allclose(held[:2], held[4:], rtol=0.1), "the fifth particle begins the pool again"
    assert sorted(order[order < 4].tolist()) == [0, 1, 2, 3]
    steps = held[:4].sort().values
    assert torch.allclose(steps / steps[0], torch.tensor([1.0, 2.0, 3.0, 4.0]), rtol=0.1)


@pytest.mark.parametrize("draw", ["pathwise", "joint", "marginal"])
def test_a_loaded_model_draws_what_the_saved_one_does(draw):
    model, other = fitted(draw=draw), tiny(draw=draw)
    model.resample(pendulum.simulate(31), seeded())
    state = {
        name: value.clone() if isinstance(value, torch.Tensor) else value for name, value in model.state_dict().items()
    }
    assert all(isinstance(value, torch.Tensor | int | float | str) for value in state.values())
    other.load_state_dict(state)
    assert torch.equal(predictions(model), predictions(other))
    for each in (model, other):  # and goes on the same way
        generator = seeded(8)
        each.resample(pendulum.simulate(32), generator)
        each.fit(pendulum.simulate(35), generator)
    assert torch.equal(predictions(model), predictions(other))


def test_an_unfitted_model_saves_and_loads_too():
    model = fitted()
    assert tiny().state_dict() == {}
    model.load_state_dict({})
    with pytest.raises(RuntimeError, match=r"draw.*fit"):
        model.draw(1, 1, seeded())


@pytest.mark.parametrize(
    ("settings", "name", "expected", "received"),
    [
        ({"num_inducing": 9}, "layers.0.inducing_inputs", (9, 4), (8, 4)),
        ({"num_layers": 3}, "layers.2.inducing_inputs", (8, 4), None),
        ({"num_samples": 5}, "pool", (5, 48), (4, 48)),
    ],
)
def test_the_state_of_another_model_is_refused(settings, name, expected, received):
    """And what was learned before stays."""
    model = fitted(**settings)
    before = predictions(model)
    with pytest.raises(ValueError, match=rf"'{name}'.*{re.escape(str(expected))}.*{re.escape(str(received))}"):
        model.load_state_dict(fitted().state_dict())
    assert torch.equal(predictions(model), before)


@pytest.mark.parametrize("name", ["pool", "oldest", "log_noise", "inputs.std", "chain.square", "layers.1.log_variance"])
@pytest.mark.parametrize("value", [None, "text", torch.zeros(3, 3)])
def test_a_missing_or_damaged_entry_is_named(name, value):
    state = dict(fitted().state_dict())
    state[name] = value
    if value is None:
        del state[name]
    with pytest.raises(ValueError, match=f"'{name}'"):
        tiny().load_state_dict(state)


@pytest.mark.parametrize("oldest", [-1, 4])
def test_a_position_outside_the_ring_is_refused(oldest):
    with pytest.raises(ValueError, match=rf"'oldest'.*\b3\b.* {oldest}$"):
        tiny().load_state_dict(fitted().state_dict() | {"oldest": oldest})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_layers": 0}, "num_layers .* 0$"),
        ({"num_inducing": 0}, "num_inducing .* 0$"),
        ({"num_features": -1}, "num_features .* -1$"),
        ({"first_training_iterations": 0}, "first_training_iterations .* 0$"),
        ({"training_iterations": 0}, "training_iterations .* 0$"),
        ({"num_samples": 0}, "num_samples .* 0$"),
        ({"sample_spacing": 0}, "sample_spacing .* 0$"),
        ({"resample_samples": 0}, "resample_samples .* 0$"),
        ({"resample_samples": -3}, "resample_samples .* -3$"),
        ({"resample_steps": -1}, "resample_steps .* -1$"),
        ({"batch_size": 0}, "batch_size .* 0$"),
        ({"patience": 0}, "patience .* 0$"),
        ({"step_size": 0.0}, r"step_size .* 0\.0$"),
        ({"learning_rate": float("nan")}, "learning_rate .* nan$"),
        ({"decay": 1.5}, r"decay .* 1\.5$"),
        ({"gibbs_every": -1}, "gibbs_every .* -1$"),
        ({"draw": "thompson"}, "draw 'thompson'.*pathwise, joint, marginal"),
        ({"refresh": "never"}, "refresh 'never'.*step, plan"),
        ({"kernel": "cubic"}, "kernel 'cubic'.*rbf"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_settings_out_of_range_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        DeepGPDynamics(2, 1, pendulum.SPEC, **settings)


def test_settings_of_inference_are_settings_of_the_model():
    given = {"step_size": 0.03, "decay": 0.1, "window_size": 7, "patience": 3, "look_every": 11}
    assert tiny(**given).inference == InferenceSettings(**given)
    assert tiny().inference == InferenceSettings()
    with pytest.raises(TypeError, match="'stepsize'"):
        tiny(stepsize=0.03)


def test_a_training_that_diverges_leaves_the_model_as_it_was():
    model = fitted()
    before = predictions(model)
    model.inference = InferenceSettings(step_size=1e4, gibbs_every=0)
    with pytest.raises(TrainingError):
        model.training_iterations = 50
        model.fit(pendulum.simulate(40), seeded())
    assert torch.equal(predictions(model), before)


@pytest.mark.parametrize("gibbs_every", [20, 0])
def test_a_resampling_that_diverges_is_dropped(gibbs_every):
    model = fitted(gibbs_every=gibbs_every, resample_steps=50)
    before, step_size = predictions(model), model._fitted.step_size
    model._fitted = model._fitted._replace(step_size=1e4)
    assert model.resample(pendulum.simulate(31), seeded()) == {"resamplings_dropped": 1.0}
    assert torch.equal(predictions(model), before)
    model._fitted = model._fitted._replace(step_size=step_size)
    assert model.resample(pendulum.simulate(31), seeded()) == {"resamplings_dropped": 0.0}
    assert not torch.equal(predictions(model), before)


def test_resampling_takes_the_steps_that_training_had_to_make_smaller():
    """Those asked for diverge each time, and the pool would stay as it is for a whole episode."""
    settings = {"step_size": 8.0, "first_training_iterations": 300, "resample_steps": 10}
    model = tiny(**settings)
    metrics = model.fit(pendulum.simulate(40), seeded())
    assert metrics["rollbacks"] >= 1
    assert model.state_dict()["step_size"] <= 8.0 / 2 ** metrics["rollbacks"]
    loaded = tiny(**settings)
    loaded.load_state_dict(model.state_dict())
    for each in (model, loaded):
        generator = seeded(3)
        dropped = [each.resample(pendulum.simulate(41 + i), generator)["resamplings_dropped"] for i in range(10)]
        assert sum(dropped) < 5
    assert torch.equal(predictions(loaded), predictions(model))


def test_a_state_without_a_step_size_has_the_one_asked_for():
    """So do the states of earlier versions, and those of trainings that had no need of another."""
    settings = {"step_size": 0.01}
    state = fitted(**settings).state_dict()
    assert "step_size" not in state
    model = tiny(**settings)
    model.load_state_dict(state)
    assert model._fitted.step_size == 0.01
    for value in (0.0, float("nan"), "text"):
        with pytest.raises(ValueError, match=rf"'step_size'.* {value!r}$"):
            model.load_state_dict(state | {"step_size": value})


def test_resampling_encodes_the_rows_it_needs_and_no_others():
    """Its cost does not grow with the data: of 10,000 transitions it looks at a few minibatches."""
    model, seen = fitted(batch_size=16, gibbs_rows=32), []
    encode = model._encode
    model._encode = lambda data: seen.append(len(data.action)) or encode(data)
    many = Transitions(*(field.repeat(400, 1)[:10_000] for field in pendulum.simulate(30)))
    model.resample(many, seeded())
    assert seen == [16, 16, 32]


def test_clustering_looks_at_a_bounded_number_of_rows(monkeypatch):
    monkeypatch.setattr(deep_gp_start, "MOST_CLUSTERED", 25)
    sizes, cluster = [], deep_gp_start.cluster
    monkeypatch.setattr(deep_gp_start, "cluster", lambda x, *rest: sizes.append(len(x)) or cluster(x, *rest))
    model = fitted(40)
    model.fit(pendulum.simulate(60), seeded())
    assert sizes == [25, 25, 25]
