"""Training as a whole: what it learns, when it stops, and how it recovers."""

import math

import pytest
import torch

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.dynamics.deep_gp.start import initial_model
from gym_dgpmpc.errors import FactorisationError, TrainingError
from gym_dgpmpc.gp.deep_gp import factorise_all, log_likelihood, propagate
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.inference import sampler, sghmc, training
from gym_dgpmpc.inference.sampler import Chains
from gym_dgpmpc.inference.settings import InferenceSettings
from gym_dgpmpc.inference.training import predictive_log_likelihood, train
from tests.oracles.models import normal, seeded

NOISE = 0.15  # standard deviation, beside a signal of about 0.7


def waves(num_data, seed):
    generator = seeded(seed)
    x = 4.0 * torch.rand(num_data, 1, generator=generator, dtype=torch.float64) - 2.0
    y = torch.cat([torch.sin(2.0 * x), torch.tanh(2.0 * x)], dim=1)
    return Data(x, y + NOISE * normal(generator, num_data, 2))


def started(data, num_layers=2, kernel="rbf", num_chains=2, num_inducing=10, seed=0):
    """Where training of chains begins."""
    model = initial_model(KERNELS[kernel], data, num_layers, num_inducing, num_chains, seeded(seed))
    return model, sghmc.init(torch.zeros(num_chains, model.num_whitened(), dtype=torch.float64))


def chains_of(data, settings, num_burn_in=0, **kind):
    """The same, to be moved step by step."""
    model, whitened = started(data, **kind)
    state = sampler.initial_state(model, whitened, data.num_rows, seeded(1))
    return Chains(model, state, data, settings, num_burn_in)


def ill_preconditioned(square):
    """Where training begins with a mass far too small for the curvature, in a preconditioner that no longer adapts.

    No step is safe then but a small one: how long a step may be is told from that mass.
    """
    model, whitened = started(waves(60, 0), kernel="matern32")
    return model, whitened._replace(
        square=torch.full_like(whitened.square, square), averaging=torch.full_like(whitened.averaging, 1e12)
    )


def mixture_log_likelihood(model, pool, data):
    """Of the mixture over samples as well as chains."""
    factorised = factorise_all(model)
    each = [
        log_likelihood(
            model, *propagate(factorised, model.split(positions), data.x.expand(2, -1, -1), seeded(9)), data.y
        )
        for positions in pool
    ]
    densities = torch.cat(each)
    return float((densities.logsumexp(0) - math.log(len(densities))).mean())


@pytest.mark.usefixtures("unchecked")  # hundreds of steps
@pytest.mark.parametrize("num_layers", [1, 2])
@pytest.mark.parametrize("hyperparameters", ["sampled", "optimised"])
def test_training_learns_the_function_and_its_noise(num_layers, hyperparameters):
    data, test = waves(150, 0), waves(400, 1)
    settings = InferenceSettings(batch_size=100, hyperparameters=hyperparameters)
    start, whitened = started(data, num_layers, "matern52", num_inducing=12)
    generator = seeded()
    trained = train(start, whitened, data, 500, generator, settings)
    sampled = training.sample_pool(trained.model, trained.state, data, 10, 5, generator, settings)

    # Knowing function and noise exactly would score -log(noise) - 1.42 for each of two targets, on average.
    best = 2 * (-math.log(NOISE) - 0.5 * math.log(2 * math.pi * math.e))
    before = mixture_log_likelihood(start, whitened.position.unsqueeze(0), test)
    after = mixture_log_likelihood(trained.model, sampled.pool, test)
    assert before < best - 2.0
    # The mean over 400 test points errs by 2^1/2 / 20; what is not known of the function costs about as much.
    assert best - 0.25 < after < best + 0.2
    # 150 residuals, some ten of them spent on the function, know their variance to 12 %; the last draws of a
    # stochastic optimiser, or of a sampler, wander around it by about as much again.
    ratio = trained.model.noise_variance / NOISE**2
    assert ((ratio > 0.5) & (ratio < 1.7)).all()


@pytest.mark.parametrize("num_chains", [1, 2])
def test_training_moves_every_hyperparameter_and_nothing_it_was_given(num_chains):
    data = waves(30, 0)
    start, whitened = started(data, num_chains=num_chains, num_inducing=5)
    before = [p.clone() for p in start.parameters()]
    trained = train(start, whitened, data, 3, seeded(), InferenceSettings(hyperparameters_every=1))
    for kept, given, moved in zip(before, start.parameters(), trained.model.parameters(), strict=True):
        assert torch.equal(kept, given)
        assert moved.isfinite().all() and not (moved == kept).any() and not moved.requires_grad
    assert not whitened.position.any()
    (latent,) = trained.state.latents
    assert latent.shape == (num_chains, 30, 1)
    assert trained.state.num_chains == num_chains


@pytest.mark.parametrize("num_data", [1, 3, 40])
def test_the_same_seed_gives_the_same_result(num_data):
    data, settings = waves(num_data, 0), InferenceSettings(batch_size=16, hyperparameters_every=1)
    results = []
    for seed in (0, 0, 1):
        start, whitened = started(data, kernel="matern12", num_inducing=5, seed=seed)
        results.append(train(start, whitened, data, 4, seeded(seed), settings))
    first, again, other = results
    assert first.negative_log_likelihood == again.negative_log_likelihood

    def tensors(trained):
        state = trained.state
        return [*state.whitened, *state.parameters, *state.latents, *trained.model.parameters()]

    assert all(torch.equal(a, b) for a, b in zip(tensors(first), tensors(again), strict=True))
    assert not torch.equal(first.state.whitened.position, other.state.whitened.position)


def test_the_window_holds_the_latest_positions_and_no_others():
    """A window that is not yet full is used as far as it goes; one of a single position is the chain's own."""
    data = waves(20, 0)
    start, whitened = started(data, 1, num_inducing=5)

    def lengthscale(window_size):
        settings = InferenceSettings(
            step_size=0.1, window_size=window_size, hyperparameters="optimised", hyperparameters_every=1
        )
        return train(start, whitened, data, 6, seeded(), settings).model.layers[0].log_lengthscale

    assert torch.equal(lengthscale(6), lengthscale(600))
    assert not torch.equal(lengthscale(6), lengthscale(1))


@pytest.mark.parametrize("hyperparameters", ["sampled", "optimised"])
@pytest.mark.parametrize("num_burn_in", [0, 100])
def test_hyperparameters_move_as_often_as_asked(hyperparameters, num_burn_in):
    settings = InferenceSettings(hyperparameters_every=3, hyperparameters=hyperparameters)
    run = chains_of(waves(30, 0), settings, num_burn_in)
    generator, moved = seeded(), []
    for _ in range(7):
        before = [p.clone() for p in run.model.parameters()]
        run.step(generator)
        moved.append(any(not torch.equal(a, b) for a, b in zip(before, run.model.parameters(), strict=True)))
    assert moved == [False, False, True, False, False, True, False]


@pytest.mark.parametrize("hyperparameters", ["sampled", "optimised"])
@pytest.mark.parametrize("num_burn_in", [0, 5])
def test_a_snapshot_is_everything_that_a_step_moves(hyperparameters, num_burn_in):
    settings = InferenceSettings(window_size=4, hyperparameters=hyperparameters, hyperparameters_every=1)
    run = chains_of(waves(30, 0), settings, num_burn_in, kernel="matern52")
    for _ in range(3):
        run.step(seeded())
    kept = run.snapshot()
    ends = []
    for _ in range(2):  # a snapshot survives being restored
        for seed in range(3):
            run.step(seeded(seed))
        state = run.state
        latents = [latent.clone() for latent in state.latents]
        ends.append([*run.model.parameters(), *state.whitened, *state.parameters, *latents, run._window.clone()])
        run.restore(kept)
        # Restoring brings the chains to rest; for the comparison they move as they did.
        run.state = run.state._replace(whitened=kept.state.whitened, parameters=kept.state.parameters)
        assert run.iteration == 3 and run.settings == settings and torch.equal(run.value, kept.value)
        assert all(torch.equal(a, b) for a, b in zip(run.state.latents, kept.state.latents, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(*ends, strict=True))
    before = run._step_sizes(run.state.whitened, settings.step_size, 8)
    run.restore(kept, scale=0.5)
    assert not run.state.whitened.momentum.any() and not run.state.parameters.momentum.any()
    # The bounds too, or where they are the smaller ones a rollback would change nothing.
    assert torch.equal(run._step_sizes(run.state.whitened, settings.step_size, 8), 0.5 * before)


def test_adam_takes_the_smaller_steps_after_a_rollback():
    settings = InferenceSettings(hyperparameters="optimised", hyperparameters_every=1)
    run = chains_of(waves(30, 0), settings)
    kept = run.snapshot()
    run.restore(kept, scale=0.25)
    before = run.state.parameters.position.clone()
    run.step(seeded())
    # Its first step has the size of the learning rate, here at its end, wherever there is a gradient.
    step = (run.state.parameters.position - before).abs().max().item()
    assert step == pytest.approx(0.25 * settings.learning_rate / 6, rel=1e-4)


@pytest.mark.usefixtures("unchecked")  # hundreds of steps
@pytest.mark.parametrize("step_size", [0.25, 0.5])
def test_a_run_that_diverges_goes_back_and_takes_smaller_steps(step_size):
    """With such a mass they explode at once; what comes out is a usable model all the same.

    How far such a chain has got after 60 steps is chance, and another processor's rounding throws the dice anew; only
    what the criterion of divergence leaves is certain.
    """
    data = waves(60, 0)
    settings = InferenceSettings(step_size=step_size, look_every=20, gibbs_every=0)
    start = chains_of(data, settings, kernel="matern32").evaluate(seeded())
    trained = train(*ill_preconditioned(1e-4), data, 60, seeded(), settings)
    assert 1 <= trained.num_rollbacks <= training.MAX_ROLLBACKS
    assert trained.scale == 0.5**trained.num_rollbacks
    assert trained.num_iterations == 60
    assert trained.negative_log_likelihood < start + training.EXPLODED
    assert all(p.isfinite().all() for p in trained.model.parameters())
    assert training.is_plausible(trained.state.whitened.position)


@pytest.mark.usefixtures("unchecked")  # hundreds of steps
def test_a_run_that_cannot_be_saved_says_so():
    data = waves(60, 0)
    with pytest.raises(TrainingError, match=r"\b6 times.*\b31\.25\b.*\b60 transitions"):
        train(*ill_preconditioned(1e-8), data, 100, seeded(), InferenceSettings(step_size=1e3, gibbs_every=0))


def test_a_covariance_that_cannot_be_factorised_is_gone_back_from(monkeypatch):
    step, count = Chains.step, 0

    def stumbling(self, generator):
        nonlocal count
        count += 1
        if count == 25:
            raise FactorisationError("this one could not")
        step(self, generator)

    monkeypatch.setattr(Chains, "step", stumbling)
    data = waves(20, 0)
    trained = train(*started(data), data, 40, seeded(), InferenceSettings(look_every=10))
    assert (trained.num_rollbacks, trained.num_iterations) == (1, 40)
    assert count == 45, "only the steps since the last look are repeated"


def test_without_trouble_looking_changes_nothing():
    data = waves(30, 0)
    ends = [
        train(*started(data), data, 30, seeded(), InferenceSettings(look_every=look)).state.whitened.position
        for look in (1, 7, 100)
    ]
    assert torch.equal(ends[0], ends[1]) and torch.equal(ends[0], ends[2])


@pytest.mark.usefixtures("unchecked")  # hundreds of steps
def test_training_stops_when_held_out_data_say_that_it_is_enough():
    data = waves(200, 0)
    settings = InferenceSettings(step_size=0.03, learning_rate=0.03, patience=3, look_every=25)
    trained = train(*started(data, 1, "matern52"), data, 3000, seeded(), settings)
    assert 75 < trained.num_iterations < 1500
    assert trained.num_iterations % 25 == 0
    # It stopped late enough: as good as knowing function and noise, up to what 200 observations leave unknown.
    sampled = training.sample_pool(trained.model, trained.state, data, 10, 5, seeded(), settings, trained.scale)
    best = 2 * (-math.log(NOISE) - 0.5 * math.log(2 * math.pi * math.e))
    found = mixture_log_likelihood(trained.model, sampled.pool, waves(400, 1))
    assert best - 0.25 < found < best + 0.2
    # Without patience, or with too little data to judge by, it goes on to the end.
    for rows, patience in ((200, None), (50, 1)):
        few = Data(data.x[:rows], data.y[:rows])
        settings = InferenceSettings(patience=patience, look_every=5, step_size=0.03)
        assert train(*started(few, 1), few, 30, seeded(), settings).num_iterations == 30


@pytest.mark.parametrize("num_layers", [2, 3])
def test_latents_of_the_rows_that_were_trained_on_come_back_in_the_datas_order(num_layers, monkeypatch):
    """Those of the rows held out are drawn, and sampling goes on with all of them."""
    data, settings, kept = waves(120, 0), InferenceSettings(patience=5, look_every=4), []
    initial = sampler.initial_state

    def watched(*args):
        kept.append(initial(*args))
        return kept[-1]

    monkeypatch.setattr(sampler, "initial_state", watched)
    trained = train(*started(data, num_layers), data, 8, seeded(3), settings)
    order = torch.randperm(120, generator=seeded(3))
    held_out, rows = order[:12], order[12:]
    assert training._split_off_held_out(data, seeded(3))[0].x.equal(data.x[rows])
    # Chains move the latents that they are given in place.
    for latent, of_rows in zip(trained.state.latents, kept[0].latents, strict=True):
        assert latent.shape == (2, 120, 1) and of_rows.shape == (2, 108, 1)
        assert torch.equal(latent[:, rows], of_rows)
        drawn = latent[:, held_out].flatten()
        assert len(drawn.unique()) == 24
        # Standard normal: five standard errors of a standard deviation.
        assert abs(drawn.std().item() - 1.0) < 5 / math.sqrt(2 * 24)
    before = [latent.clone() for latent in trained.state.latents]
    sampled = training.sample_pool(trained.model, trained.state, data, 3, 4, seeded(), settings, trained.scale)
    assert sampled.pool.shape == (3, 2, trained.model.num_whitened())
    for old, new in zip(before, sampled.state.latents, strict=True):
        changed = (old != new).any(-1).any(0)
        assert new.shape == old.shape and changed[rows].any() and changed[held_out].any()


def test_held_out_rows_are_not_trained_on():
    rows = torch.arange(120, dtype=torch.float64).unsqueeze(1)
    kept, held, which = training._split_off_held_out(Data(rows, rows + 1000), seeded())
    assert held.num_rows == 12 and kept.num_rows == 108
    assert torch.equal(kept.x[:, 0].long(), which)
    assert sorted(torch.cat([kept.x, held.x]).flatten().tolist()) == list(range(120))
    assert torch.equal(held.y, held.x + 1000) and torch.equal(kept.y, kept.x + 1000)
    # Not always the same ones, and never more than it takes.
    assert not torch.equal(training._split_off_held_out(Data(rows, rows), seeded(1))[1].x, held.x)
    for num_rows, num_held in ((100, 10), (2559, 255), (10_000, 256)):
        many = torch.zeros(num_rows, 1, dtype=torch.float64)
        assert training._split_off_held_out(Data(many, many), seeded())[1].num_rows == num_held
    few = Data(rows[:99], rows[:99])
    assert training._split_off_held_out(few, seeded()) == (few, None, None)


@pytest.mark.usefixtures("unchecked")  # hundreds of steps
@pytest.mark.parametrize(("num_layers", "gibbs_every"), [(1, 0), (2, 0), (2, 20)])
def test_sampling_that_diverges_begins_anew_with_smaller_steps(num_layers, gibbs_every):
    data = waves(40, 0)
    model, whitened = started(data, num_layers)
    # A mass far too small for the curvature: unstable until the step has been halved a few times. Of one chain: it
    # takes the others along.
    square = whitened.square.clone()
    square[1] = 1e-4
    state = sampler.initial_state(model, whitened._replace(square=square), 40, seeded(1))
    latents = [latent.clone() for latent in state.latents]
    settings = InferenceSettings(gibbs_every=gibbs_every, step_size=1.0)
    told = []
    sampled = training.sample_pool(model, state, data, 5, 20, seeded(), settings, on_sample=told.append)
    assert sampled.pool.shape == (5, 2, model.num_whitened()) and training.is_plausible(sampled.pool)
    assert torch.equal(sampled.pool[-1], sampled.state.whitened.position)
    assert sampled.scale in [0.5**halvings for halvings in range(1, training.MAX_ROLLBACKS + 1)]
    assert all(torch.equal(a, b) for a, b in zip(latents, state.latents, strict=True)), "each attempt begins anew"
    assert told[-5:] == list(range(1, 6))
    with pytest.raises(
        TrainingError, match=r"sampling the posterior diverged 6 times, the last time with the step size 31\.25\b"
    ):
        # The bound of a coordinate's steps follows its mass, so that a wild step size alone would not diverge.
        massless = state._replace(whitened=state.whitened._replace(square=torch.full_like(square, 1e-14)))
        wild = InferenceSettings(gibbs_every=gibbs_every, step_size=1e3)
        training.sample_pool(model, massless, data, 5, 20, seeded(), wild)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e9])
def test_what_is_absurd_is_not_plausible(value):
    positions = torch.zeros(3, 4)
    assert training.is_plausible(positions)
    positions[1, 2] = value
    assert not training.is_plausible(positions)


def test_where_a_run_counts_as_diverged():
    """Whitened outputs of 1e4, or a negative log likelihood 1e3 above the lowest; up to there it may recover.

    Of any chain.
    """
    positions = torch.zeros(2, 3)
    for largest, plausible in ((9999.5, True), (1e4, False), (-1e4, False)):
        positions[1, 1] = largest
        assert training.is_plausible(positions) is plausible
    run = chains_of(waves(20, 0), InferenceSettings())
    for value, trouble in ((-4.0, None), (1000.0, None), (1000.5, "1000.5"), (math.nan, "nan")):
        run.value = torch.tensor([-5.0, value], dtype=torch.float64)
        said = training._advance(run, 0, seeded(), best=0.0)
        assert said is None if trouble is None else trouble in said


def test_hyperparameters_that_are_absurd_are_gone_back_from():
    run = chains_of(waves(20, 0), InferenceSettings())
    run.model.log_noise[1, 0] = 20.0
    assert "hyperparameter" in training._advance(run, 0, seeded(), best=0.0)


def test_the_likelihood_of_a_mixture_is_the_mean_of_its_parts():
    """log of the mean density over chains, then the mean over the data; one layer propagates without chance."""
    data = waves(15, 0)
    model, _ = started(data, 1, num_chains=3)
    model = model.with_parameters([p + 0.2 * normal(seeded(3), *p.shape) for p in model.parameters()])
    factorised, positions = factorise_all(model), normal(seeded(1), 3, model.num_whitened())
    each = []
    for c, v in enumerate(positions):
        one = model.with_parameters([parameter[c] for parameter in model.parameters()])
        each.append(log_likelihood(one, *propagate(factorise_all(one), one.split(v), data.x, seeded()), data.y).exp())
    expected = torch.stack(each).mean(0).log().mean()
    found = predictive_log_likelihood(factorised, positions, data, seeded())
    assert found == pytest.approx(float(expected), rel=1e-12)
