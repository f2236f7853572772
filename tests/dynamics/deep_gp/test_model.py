"""The dynamics model as the agent uses it: fit, resample, draw, save and load, at tiny sizes."""

import math
import re

import pytest
import torch

from gym_dgpmpc.dynamics.bounds import SeenTargets
from gym_dgpmpc.dynamics.deep_gp import start as deep_gp_start
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.errors import TrainingError
from gym_dgpmpc.inference.following import BLOCK
from gym_dgpmpc.inference.settings import InferenceSettings
from gym_dgpmpc.planning.rollout import rollout
from gym_dgpmpc.types import DynamicsModel, ObservationSpec, Transitions
from tests.oracles import pendulum
from tests.oracles.models import seeded

TINY = {
    "num_inducing": 8, "num_features": 16, "first_training_iterations": 3, "training_iterations": 2, "num_chains": 2,
    "num_samples": 8, "sample_spacing": 1, "resample_samples": 2,
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
    assert {"negative_log_likelihood", "effective_sample_size", "gradient_norm", "noise_std", "r_hat"} <= set(metrics)
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


@pytest.mark.parametrize("num_layers", [1, 2])
def test_with_a_linear_part_a_line_is_known_far_from_all_data(num_layers):
    """Four times as far as the data go; without it the model has nothing to say there but its prior."""
    observation = torch.rand(60, 1, generator=seeded(), dtype=torch.float64) * 2 - 1
    action = torch.rand(60, 1, generator=seeded(1), dtype=torch.float64) * 2 - 1
    data = Transitions(observation, action, observation + 0.3 * observation - 0.2 * action)
    far = torch.tensor([[4.0], [-4.0]]).double()
    tested = Transitions(far, torch.zeros_like(far), 1.3 * far)
    changes, spreads = [], []
    for linear in (True, False):
        sizes = {"num_layers": num_layers, "num_inducing": 20, "first_training_iterations": 150}
        model = DeepGPDynamics(1, 1, **(TINY | sizes), linear=linear)
        model.fit(data, seeded(2))
        found = model.predictive(tested, seeded(3))
        changes.append(found.mean.squeeze(-1) / 1.2 * far.sign().squeeze(-1))
        spreads.append(found.variance.sqrt().squeeze(-1) / 1.2)
    assert ((changes[0] - 1.0).abs() < 3 * spreads[0]).all() and changes[0].min() > 0.5
    assert changes[1].max() < 0.5


@pytest.mark.parametrize("num_layers", [1, 2])
def test_a_linear_part_goes_through_fits_files_and_episodes(num_layers):
    model = fitted(linear=True, num_layers=num_layers)
    generator = seeded(4)
    model.fit(pendulum.simulate(40), generator)
    model.resample(pendulum.simulate(41), generator)
    other = tiny(linear=True, num_layers=num_layers)
    other.load_state_dict(model.state_dict())
    assert torch.equal(predictions(other), predictions(model))
    slopes = [name for name in model.state_dict() if name.endswith("log_slope")]
    assert slopes == [f"layers.{num_layers - 1}.log_slope"]


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


@pytest.mark.parametrize("num_chains", [1, 3])
@pytest.mark.parametrize("gibbs_every", [20, 0])
@pytest.mark.parametrize(("asked", "replaced"), [(3, 3), (9, 4)])
def test_resampling_replaces_the_oldest_rows_of_the_pool_and_nothing_else(asked, replaced, gibbs_every, num_chains):
    """Of every chain, all of them at most, however the chains were trained."""
    settings = {"num_chains": num_chains, "num_samples": 4 * num_chains, "resample_samples": asked}
    model, generator = fitted(**settings, gibbs_every=gibbs_every), seeded(3)
    before = {name: torch.as_tensor(value).clone() for name, value in model.state_dict().items()}
    inner, oldest = 4 * 8, 0
    for count in range(1, 6):  # around the ring of four and further, past 32 rows
        assert model.resample(pendulum.simulate(30 + count), generator) == {"resamplings_dropped": 0.0}
        state = model.state_dict()
        rows = sorted((oldest + index) % 4 for index in range(replaced))
        changed = (state["pool"] != before["pool"]).any(dim=2)
        assert changed.nonzero().tolist() == [[row, chain] for row in rows for chain in range(num_chains)]
        newest, oldest = (oldest + replaced - 1) % 4, (oldest + replaced) % 4
        assert state["oldest"] == oldest
        assert torch.equal(state["pool"][newest], state["chain.position"])
        moved = {name for name, value in before.items() if not torch.equal(torch.as_tensor(state[name]), value)}
        assert moved - {"oldest", "seen.lowest", "seen.highest"} == {"pool", "chain.position", "latents.0"}
        # Of the inner layers every new sample has what the chain has.
        position = before["chain.position"][:, :inner]
        assert torch.equal(state["chain.position"][:, :inner], position)
        assert torch.equal(state["pool"][rows][..., :inner], position.expand(replaced, -1, -1))
        latents = state["latents.0"]
        assert latents.shape == (num_chains, 30 + count, 4) and latents.dtype == torch.float32
        before = {name: torch.as_tensor(value).clone() for name, value in state.items()}


@pytest.mark.parametrize(("num_samples", "num_chains", "kept"), [(4, 2, 2), (5, 2, 3), (1, 3, 1), (7, 1, 7)])
def test_the_pool_has_as_many_samples_of_each_chain(num_samples, num_chains, kept):
    model = fitted(num_samples=num_samples, num_chains=num_chains)
    state = model.state_dict()
    assert state["pool"].shape == (kept, num_chains, 48)
    assert state["layers.0.log_variance"].shape == (num_chains,)
    assert torch.equal(state["pool"][-1], state["chain.position"])


def test_particles_are_spread_over_the_chains_and_then_over_their_samples():
    """Of 3 chains with 4 samples each: any 3 are of 3 chains, any 12 are all samples, and it begins anew."""
    model = fitted(num_chains=3, num_samples=12)
    firsts = set()
    for seed in range(30):
        chain, row = model._pick(30, seeded(seed))
        assert chain.dtype == row.dtype == torch.int64 and len(chain) == len(row) == 30
        for start in range(0, 30, 3):
            assert sorted(chain[start : start + 3].tolist()) == [0, 1, 2]
        pairs = list(zip(chain.tolist(), row.tolist(), strict=True))
        assert len(set(pairs[:12])) == len(set(pairs[12:24])) == 12
        for count in (1, 2, 7):
            few = model._pick(count, seeded(seed))
            assert len(few[0]) == len(few[1]) == count and len(set(few[0].tolist())) == min(count, 3)
        firsts |= set(pairs[:3])
    assert len(firsts) == 12, "none is preferred"


def test_resampling_may_be_turned_off():
    model, generator = fitted(resample_samples=0), seeded()
    before = {name: torch.as_tensor(value).clone() for name, value in model.state_dict().items()}
    assert model.resample(pendulum.simulate(31), generator) == {}
    after = model.state_dict()
    assert set(after) == set(before)
    assert all(torch.equal(torch.as_tensor(after[name]), value) for name, value in before.items())
    assert torch.equal(generator.get_state(), seeded().get_state()), "nothing was drawn"


def test_a_state_that_was_taken_does_not_change_with_the_model():
    """A checkpoint may be written while the agent goes on."""
    model = fitted()
    state = model.state_dict()
    before = {name: torch.as_tensor(value).clone() for name, value in state.items()}
    model.resample(pendulum.simulate(31), seeded())
    assert all(torch.equal(torch.as_tensor(state[name]), value) for name, value in before.items())


def test_particles_are_distinct_samples_while_the_pool_lasts():
    model = fitted(num_layers=1, num_inducing=4, num_features=2, refresh="plan")
    # 4 rows of 2 chains: the samples are 100, 200, ... in the first one, 500, 600, ... in the second.
    pool = 100.0 * (1.0 + torch.arange(8.0, dtype=torch.float64).view(2, 4).mT.unsqueeze(-1).expand(4, 2, 8))
    # One set of hyperparameters: the size of a sample shows as it is.
    state = model.state_dict()
    alike = {
        name: value[:1].expand_as(value)
        for name, value in state.items()
        if name.startswith("layers.") or name == "log_noise"
    }
    model.load_state_dict(state | alike | SeenTargets.unbounded(2, model.device).state() | {"pool": pool})
    sampler = model.draw(10, 1, seeded())
    # Samples a hundred standard deviations apart tell which particle holds which.
    raw = alike["layers.0.inducing_inputs"][0] * state["inputs.std"] + state["inputs.mean"]
    angle, rate, action = torch.atan2(raw[:, 1], raw[:, 2]), raw[:, 0], raw[:, 3:]
    observation = torch.stack([angle, rate], 1).float()
    change = sampler(observation.expand(10, -1, -1).clone(), action.float(), 0)[:, :, 1] - observation[:, 1]
    held = change.abs().mean(1)
    steps = held[:8].sort().values
    assert torch.allclose(steps / steps[0], torch.arange(1.0, 9.0), rtol=0.1)
    assert all(min(abs(first / again - 1) for first in held[:8]) < 0.1 for again in held[8:]), "the pool begins again"
    low = held < 4.5 * steps[0]
    assert (low[::2] != low[1::2]).all(), "neighbours are of different chains"


def test_each_particle_has_the_hyperparameters_of_its_chain():
    """A chain with a vanishing kernel predicts no change, whatever its samples are."""
    model = fitted(num_layers=1, add_noise=False)
    state = model.state_dict()
    flat = torch.stack([state["layers.0.log_variance"][0], torch.tensor(-40.0, dtype=torch.float64)])
    centred = {"targets.mean": torch.zeros_like(state["targets.mean"])}
    model.load_state_dict(state | centred | {"layers.0.log_variance": flat})
    for draw in ("pathwise", "joint", "marginal"):
        model.draw_kind = draw
        chain, _ = model._pick(6, seeded(5))
        change = predictions(model, num_particles=6, horizon=1)[1] - predictions(model, num_particles=6, horizon=1)[0]
        still = change.abs().amax((1, 2)) < 1e-5
        assert torch.equal(still, chain == 1)


@pytest.mark.parametrize("num_layers", [1, 2, 3])
@pytest.mark.parametrize("loaded_at", [31, 32, 33, 64])
def test_one_loaded_within_an_episode_goes_on_bit_by_bit(loaded_at, num_layers):
    """Wherever the rows stand to the blocks that are summed once and for all; and through the next fit."""
    model, other = fitted(num_layers=num_layers), tiny(num_layers=num_layers)
    generator = seeded(4)
    for num_rows in range(31, loaded_at + 1):
        model.resample(pendulum.simulate(num_rows), generator)
    state = {name: torch.as_tensor(value).clone() for name, value in model.state_dict().items()}
    other.load_state_dict(state | {"oldest": int(state["oldest"])})
    again = torch.Generator()
    again.set_state(generator.get_state())
    for num_rows in range(loaded_at + 1, loaded_at + 4):
        for each, chance in ((model, generator), (other, again)):
            assert each.resample(pendulum.simulate(num_rows), chance) == {"resamplings_dropped": 0.0}
        assert torch.equal(predictions(model, num_particles=8), predictions(other, num_particles=8))
    states = model.state_dict(), other.state_dict()
    assert all(torch.equal(*(torch.as_tensor(each[name]) for each in states)) for name in states[0])
    model.fit(pendulum.simulate(loaded_at + 4), generator)
    other.fit(pendulum.simulate(loaded_at + 4), again)
    assert torch.equal(predictions(model), predictions(other))


@pytest.mark.parametrize("renew", ["fit", "load_state_dict"])
def test_what_was_followed_before_is_forgotten_with_a_new_posterior(renew):
    """Sums under the hyperparameters of the fit before would say nothing of the present ones."""
    model, fresh = fitted(), tiny()
    for num_rows in (31, 40):  # so that a block is summed
        model.resample(pendulum.simulate(num_rows), seeded(num_rows))
    if renew == "fit":
        model.fit(pendulum.simulate(45), seeded(7))
    else:
        model.load_state_dict(fitted(44).state_dict())
    fresh.load_state_dict(model.state_dict())
    for each in (model, fresh):
        each.resample(pendulum.simulate(46), seeded(8))
    assert torch.equal(predictions(model), predictions(fresh))


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
        ({"num_inducing": 9}, "layers.0.inducing_inputs", (2, 9, 4), (2, 8, 4)),
        ({"num_layers": 3}, "layers.2.inducing_inputs", (2, 8, 4), None),
        ({"linear": True}, "layers.1.log_slope", (2, 4), None),
        ({"num_samples": 10}, "pool", (5, 2, 48), (4, 2, 48)),
        ({"num_chains": 4}, "layers.0.inducing_inputs", (4, 8, 4), (2, 8, 4)),
    ],
)
def test_the_state_of_another_model_is_refused(settings, name, expected, received):
    """And what was learned before stays."""
    model = fitted(**settings)
    before = predictions(model)
    with pytest.raises(ValueError, match=rf"'{name}'.*{re.escape(str(expected))}.*{re.escape(str(received))}"):
        model.load_state_dict(fitted().state_dict())
    assert torch.equal(predictions(model), before)


@pytest.mark.parametrize(
    "name", ["pool", "oldest", "log_noise", "inputs.std", "chain.square", "layers.1.log_variance", "latents.0"]
)
@pytest.mark.parametrize("value", [None, "text", torch.zeros(3, 3)])
def test_a_missing_or_damaged_entry_is_named(name, value):
    state = dict(fitted().state_dict())
    state[name] = value
    if value is None:
        del state[name]
    with pytest.raises(ValueError, match=f"'{name}'"):
        tiny().load_state_dict(state)


def test_a_state_without_latents_of_its_rows_has_them_drawn():
    """As those of earlier versions are: latents of no rows."""
    model = fitted()
    state = model.state_dict()
    model.load_state_dict(state | {"latents.0": state["latents.0"][:, :0]})
    assert torch.equal(predictions(model), predictions(fitted()))
    model.resample(pendulum.simulate(31), seeded())
    assert model.state_dict()["latents.0"].shape == (2, 31, 4)


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
        ({"num_features": 7}, "num_features .* 7$"),
        ({"num_chains": 0}, "num_chains .* 0$"),
        ({"first_training_iterations": 0}, "first_training_iterations .* 0$"),
        ({"training_iterations": 0}, "training_iterations .* 0$"),
        ({"num_samples": 0}, "num_samples .* 0$"),
        ({"sample_spacing": 0}, "sample_spacing .* 0$"),
        ({"resample_samples": -1}, "resample_samples .* -1$"),
        ({"batch_size": 0}, "batch_size .* 0$"),
        ({"patience": 0}, "patience .* 0$"),
        ({"step_size": 0.0}, r"step_size .* 0\.0$"),
        ({"learning_rate": float("nan")}, "learning_rate .* nan$"),
        ({"decay": 1.5}, r"decay .* 1\.5$"),
        ({"gibbs_every": -1}, "gibbs_every .* -1$"),
        ({"hyperparameter_step_size": 0.0}, r"hyperparameter_step_size .* 0\.0$"),
        ({"hyperparameters": "fixed"}, "hyperparameters 'fixed'.*sampled, optimised"),
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
    given |= {"hyperparameters": "optimised", "hyperparameter_step_size": 0.01}
    assert tiny(**given).inference == InferenceSettings(**given)
    assert tiny().inference == InferenceSettings()
    with pytest.raises(TypeError, match="'stepsize'"):
        tiny(stepsize=0.03)


def test_a_training_that_diverges_leaves_the_model_as_it_was():
    """With a mass far too small for the curvature, in a preconditioner that no longer adapts."""
    model = fitted(gibbs_every=0, step_size=1e3, training_iterations=50)
    state = model.state_dict()
    wrong = {"chain.square": 1e-12, "chain.averaging": 1e12}
    model.load_state_dict(state | {name: torch.full_like(state[name], value) for name, value in wrong.items()})
    before = predictions(model)
    with pytest.raises(TrainingError):
        model.fit(pendulum.simulate(40), seeded())
    assert torch.equal(predictions(model), before)


@pytest.mark.parametrize("field", ["observation", "next_observation"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_resampling_that_cannot_be_computed_is_dropped(field, value):
    """And the samples stay; the next one is that of a model that never met the data."""
    model, unspoilt = fitted(), fitted()
    before = {name: torch.as_tensor(value).clone() for name, value in model.state_dict().items()}
    bad = pendulum.simulate(35)
    getattr(bad, field)[33, 1] = value
    assert model.resample(bad, seeded()) == {"resamplings_dropped": 1.0}
    after = model.state_dict()
    assert all(torch.equal(torch.as_tensor(after[name]), value) for name, value in before.items())
    for each in (model, unspoilt):
        assert each.resample(pendulum.simulate(36), seeded(1)) == {"resamplings_dropped": 0.0}
    assert torch.equal(predictions(model, num_particles=8), predictions(unspoilt, num_particles=8))
    assert not torch.equal(model.state_dict()["pool"], before["pool"])


def test_a_step_size_that_an_earlier_version_kept_is_of_no_account():
    """Each training has its own; nothing between two of them takes a step."""
    model, state = tiny(), fitted().state_dict()
    model.load_state_dict(state | {"step_size": 0.01})
    assert model.state_dict().keys() == state.keys()
    assert torch.equal(predictions(model), predictions(fitted()))


@pytest.mark.parametrize("num_layers", [1, 2])
def test_resampling_encodes_the_rows_it_needs_and_no_others(num_layers):
    """Its cost does not grow with the data: after the first time it looks at the newest block alone."""
    model, generator, seen = fitted(num_layers=num_layers), seeded(), []
    encode = model._encode
    many = Transitions(*(field.repeat(400, 1)[:10_000] for field in pendulum.simulate(30)))
    model.resample(many, generator)
    model._encode = lambda data: seen.append(len(data.action)) or encode(data)
    for count in range(1, 40):
        data = Transitions(*(torch.cat([field, field[:count]]) for field in many))
        seen.clear()
        model.resample(data, generator)
        # For the moves of the latents and for the sums; those of a block that has become whole, and of the rest.
        assert sum(seen) <= 2 * BLOCK


def seen_by(model, data):
    """The least and the greatest standardised targets of the data."""
    _, y = model._encode(data)
    return model._fitted.normalisers[1](y).aminmax(dim=0)


@pytest.mark.parametrize("num_layers", [1, 2])
def test_steps_are_bounded_by_all_that_was_seen(num_layers):
    """By the fit, and by what came since: many rows at once, a row at a time, and none."""
    model, generator = fitted(20, num_layers=num_layers), seeded()
    for num_steps in (20, 21, 2 * BLOCK, 2 * BLOCK, 3 * BLOCK + 1, 3 * BLOCK + 2):
        data = pendulum.simulate(num_steps)
        if num_steps > 20:
            model.resample(data, generator)
        assert all(torch.equal(*pair) for pair in zip(model._fitted.seen, seen_by(model, data), strict=True))
    model.fit(pendulum.simulate(30), generator)
    expected = seen_by(model, pendulum.simulate(30))
    assert all(torch.equal(*pair) for pair in zip(model._fitted.seen, expected, strict=True))


@pytest.mark.parametrize("draw", ["pathwise", "joint", "marginal"])
@pytest.mark.parametrize("compile", [True, False])
def test_particles_far_from_all_data_do_not_run_away(draw, compile):
    """Where the prior is ten thousand times as wide as the data, noise included."""
    model = fitted(draw=draw, compile=compile)
    state = model.state_dict()
    wide = {name: state[name] + 2 * math.log(1e4) for name in ("layers.1.log_variance", "log_noise")}
    model.load_state_dict(state | wide)
    targets, (lowest, highest) = model._fitted.normalisers[1], model._fitted.seen.bounds()
    start, actions = torch.tensor([40.0, 50.0]), torch.rand(6, 4, 1, generator=seeded(1)) * 2 - 1
    states = rollout(model.draw(3, 4, seeded(5)), start, actions, 3).double()
    change = targets(states[1:] - states[:-1])
    rounding = 8 * 2**-24 * states.abs().amax() / targets.std
    assert ((change > lowest - rounding) & (change < highest + rounding)).all()
    assert (change - lowest).abs().amin() < rounding.max() and (change - highest).abs().amin() < rounding.max()
    # As files of earlier versions are: without bounds, since what was seen is not in them.
    model.load_state_dict({name: value for name, value in model.state_dict().items() if not name.startswith("seen")})
    unbounded = rollout(model.draw(3, 4, seeded(5)), start, actions, 3).double()
    assert targets(unbounded[1] - unbounded[0]).abs().max() > 1e3


def test_clustering_looks_at_a_bounded_number_of_rows(monkeypatch):
    monkeypatch.setattr(deep_gp_start, "MOST_CLUSTERED", 25)
    sizes, cluster = [], deep_gp_start.cluster
    monkeypatch.setattr(deep_gp_start, "cluster", lambda x, *rest: sizes.append(len(x)) or cluster(x, *rest))
    model = fitted(40)
    model.fit(pendulum.simulate(60), seeded())
    # Of both chains at the start, and then in both layers.
    assert sizes == [25] * 6
