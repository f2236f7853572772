"""What every dynamics model and every draw must do; a new one is one more entry of FAMILIES.

The system is linear with Gaussian noise (`tests/oracles/slider.py`), so that what a rollout must give is known.
"""

import functools
from typing import NamedTuple

import numpy as np
import pytest
import torch

from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.dynamics.dropout import DropoutDynamics
from gym_dgpmpc.dynamics.ensemble.draws import PROPAGATIONS
from gym_dgpmpc.dynamics.ensemble.model import EnsembleDynamics
from gym_dgpmpc.dynamics.mixture import MixtureDynamics
from gym_dgpmpc.dynamics.mixture.model import MEMBERS
from gym_dgpmpc.dynamics.noise import NoiseSplit
from gym_dgpmpc.dynamics.sparse_gp.model import GP_DRAWS, SparseGPDynamics
from gym_dgpmpc.dynamics.true_dynamics import TrueDynamics
from gym_dgpmpc.errors import NotDifferentiableError
from gym_dgpmpc.planning.rollout import rollout
from gym_dgpmpc.settings import of_member
from gym_dgpmpc.types import DynamicsModel, Transitions, TransitionSampler
from tests.oracles import linear_gaussian, slider
from tests.oracles.models import seeded

NOISE = 0.02  # standard deviation of a step
NUM_DATA = 150
START = torch.tensor([0.3, -0.5, slider.CONSTANT])
HORIZON, CANDIDATES, PARTICLES = 4, 3, 10  # a multiple of the networks, more than the observation's numbers

DEEP = {
    "kernel": "rbf", "num_inducing": 24, "num_features": 512, "first_training_iterations": 600,
    "training_iterations": 2,
    "num_samples": 20, "sample_spacing": 2, "resample_samples": 2, "add_noise": False,
}  # fmt: skip
NETWORKS = {"num_members": 5, "num_hidden_layers": 1, "hidden_size": 8, "weight_decay": (1e-4, 1e-4)}

MIXED = {
    "deep-gp": {**DEEP, "first_training_iterations": 50},
    "sparse-gp": {"num_inducing": 30, "max_training_iterations": 50},
    "ensemble": {**NETWORKS, "num_epochs": 5},
}


class Case(NamedTuple):
    """One draw of one model: how it is made, whose training it shares, and what kind of answer it gives."""

    family: str
    make: functools.partial
    is_random: bool = True


def _cases():
    def of(family, model, settings, *arguments, **options):
        return Case(family, functools.partial(model, *arguments, **settings), **options)

    shape = (3, 1, slider.SPEC)
    cases = {}
    for draw in PROPAGATIONS:
        settings = {**NETWORKS, "draw": draw}
        cases[f"ensemble-{draw}"] = of("ensemble", EnsembleDynamics, settings, *shape, is_random=draw != "expectation")
    dropout = {"num_hidden_layers": 2, "hidden_size": 8, "num_epochs": 5}
    cases["dropout"] = of("dropout", DropoutDynamics, dropout, *shape)
    for draw in GP_DRAWS:
        cases[f"sparse-{draw}"] = of("sparse", SparseGPDynamics, {"num_inducing": 30, "draw": draw}, *shape)
    cases["exact-DS"] = of("exact", SparseGPDynamics, {"exact": True, "draw": "DS"}, *shape)
    matern = {"num_inducing": 30, "kernel": "matern52", "draw": "MM"}
    cases["sparse-matern52-MM"] = of("sparse-matern52", SparseGPDynamics, matern, *shape)
    for layers in (1, 2):
        for draw, refresh in (("pathwise", "step"), ("pathwise", "plan"), ("joint", "step"), ("marginal", "step")):
            settings = {**DEEP, "num_layers": layers, "draw": draw, "refresh": refresh}
            name = f"deep{layers}-{draw}-{refresh}"
            cases[name] = of(f"deep{layers}", DeepGPDynamics, settings, *shape)
    of_members = {of_member(name, key): value for name, own in MIXED.items() for key, value in own.items()}
    cases["mixture"] = of("mixture", MixtureDynamics, {"members": tuple(MEMBERS), **of_members}, *shape)
    cases["truth"] = Case("truth", functools.partial(lambda: TrueDynamics(slider.environment())), is_random=False)
    return cases


CASES = _cases()
FAMILIES = {case.family: name for name, case in CASES.items()}  # one case of each
LEARNERS = [name for family, name in FAMILIES.items() if family != "truth"]
OF_ONE_KIND = [name for name in LEARNERS if name != "mixture"]
"""Those whose noise is theirs: that of a mixture is its members'."""
GAUSSIAN_PROCESSES = [name for name, case in CASES.items() if case.family.startswith(("sparse", "exact", "deep"))]


@functools.cache
def trained_state(family):
    """What the family's training leaves; its draws share it."""
    model = CASES[FAMILIES[family]].make()
    model.fit(slider.transitions(NUM_DATA, NOISE), seeded())
    return model.state_dict()


def fitted(name):
    model = CASES[name].make()
    model.load_state_dict(trained_state(CASES[name].family))
    return model


def actions():
    return torch.rand(CANDIDATES, HORIZON, 1, generator=seeded(1)) * 2 - 1


def states_of(model, seed=5, num_particles=PARTICLES):
    sampler = model.draw(num_particles, HORIZON, seeded(seed))
    assert isinstance(sampler, TransitionSampler)
    return rollout(sampler, START, actions(), num_particles)


def same_states(one, other):
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert torch.equal(value, other[name]) if isinstance(value, torch.Tensor) else value == other[name], name


@pytest.fixture(params=CASES)
def name(request):
    return request.param


@pytest.fixture(params=LEARNERS)
def learner(request):
    return request.param


@pytest.fixture(params={CASES[name].family: name for name in LEARNERS}.values())
def trainer(request):
    """One learner of each family: how it draws does not change its training."""
    return request.param


def test_it_is_a_dynamics_model(name):
    model = CASES[name].make()
    assert isinstance(model, DynamicsModel)
    assert model.takes_float64, "an agent would round what float32 hides"


def test_rollouts_have_the_states_shape_and_are_finite(name):
    states = states_of(fitted(name))
    assert states.shape == (HORIZON + 1, PARTICLES, CANDIDATES, 3) and states.dtype == torch.float32
    assert states.isfinite().all()
    assert torch.equal(states[..., 2], torch.full_like(states[..., 2], slider.CONSTANT)), "a constant passes through"


def moved_by(name, action, seed=5):
    """One step of a fresh draw from states that differ between the particles."""
    states = START + 0.3 * torch.randn(PARTICLES, CANDIDATES, 3, generator=seeded(4)) * torch.tensor([1.0, 1.0, 0.0])
    return fitted(name).draw(PARTICLES, HORIZON, seeded(seed))(states, action, 0)


def test_each_particle_may_have_an_action_of_its_own(name):
    """Alike they are one action of all; otherwise each particle goes by its own, unless the draw mixes particles."""
    shared, own = actions()[:, 0], torch.rand(PARTICLES, CANDIDATES, 1, generator=seeded(2)) * 2 - 1
    together = moved_by(name, shared)
    torch.testing.assert_close(moved_by(name, shared.expand(PARTICLES, -1, -1)), together, rtol=0, atol=1e-6)
    apart = moved_by(name, own)
    assert apart.shape == together.shape and not torch.equal(apart, together)
    if "MM" not in name:
        for particle in (0, PARTICLES - 1):
            torch.testing.assert_close(apart[particle], moved_by(name, own[particle])[particle], rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.family.startswith(("sparse", "exact"))])
def test_particles_that_follow_a_linear_policy_move_by_the_closed_loop(name):
    """Mean and covariance are those of A + B F, of draws that mix particles too. The function's own uncertainty is far
    less than the noise; `MM` draws its particles anew, with standard errors that five of bound both."""
    gain, count = torch.tensor([[-1.0, -1.5, 0.0]]), 2000
    states = 0.3 * torch.randn(count, 1, 3, generator=seeded(4)) * torch.tensor([1.0, 1.0, 0.0]) + START
    after = fitted(name).draw(count, 1, seeded(5))(states, states @ gain.mT, 0)[:, 0].double()
    loop = torch.tensor(slider.A + slider.B @ gain.double().numpy())
    before = states[:, 0].double()
    known = loop @ before.mT.cov(correction=0) @ loop.mT
    variance = known.diagonal()
    if CASES[name].make().draw_kind == "MM":
        known = torch.diag(variance)
    error = (after.mean(0) - loop @ before.mean(0)).abs()
    assert (error <= 5 * (variance / count).sqrt() + NOISE).all()
    error = (after.mT.cov(correction=0) - known).abs()
    assert (error <= 5 * (2 / count) ** 0.5 * (variance.unsqueeze(0) * variance.unsqueeze(1)).sqrt() + NOISE**2).all()


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.family != "truth"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_double_precision_draw_follows_states_of_either_precision(name, dtype):
    model = CASES[name].make(dtype=torch.float64)
    model.load_state_dict(trained_state(CASES[name].family))
    sampler = model.draw(PARTICLES, HORIZON, seeded(5))
    after = sampler(START.to(dtype).expand(PARTICLES, CANDIDATES, -1), actions()[:, 0].to(dtype), 0)
    assert after.dtype == dtype and after.isfinite().all()
    states = rollout(model.draw(PARTICLES, HORIZON, seeded(5)), START.to(dtype), actions(), PARTICLES)
    assert torch.equal(states[1], after) and states.isfinite().all()


WITHOUT_GRADIENTS = ["truth"]


def weighted(states):
    """A number that every state has its part in."""
    return (states * torch.randn(states.shape, generator=seeded(8), dtype=states.dtype)).sum()


def along_actions(sampler, start, plans):
    return weighted(rollout(sampler, start, plans, PARTICLES))


def by_a_policy(sampler, start, gain):
    """Closed loop: each particle's action is decided by its state."""
    states = [start.expand(PARTICLES, CANDIDATES, 3)]
    for step in range(HORIZON):
        states.append(sampler(states[-1], states[-1] @ gain.mT, step))
    return weighted(torch.stack(states))


@pytest.mark.parametrize("name", [name for name in CASES if name not in WITHOUT_GRADIENTS])
@pytest.mark.parametrize("value_of", [along_actions, by_a_policy])
def test_gradients_are_those_of_the_values(name, value_of):
    """By the start, the actions and a policy's parameters, against differences over draws of the same random numbers.

    Networks compute in single precision, and the factor of a covariance whose entries nearly depend on each other loses
    half of its digits: such rounding a wider difference has to stay above. Its own error falls as the fourth power of
    the width.
    """
    model = CASES[name].make(dtype=torch.float64)
    model.load_state_dict(trained_state(CASES[name].family))
    chosen = actions() if value_of is along_actions else torch.tensor([[-0.4, -0.6, 0.1]])
    places = [START.double(), chosen.double()]
    directions = [torch.randn(place.shape, generator=seeded(9), dtype=torch.float64) for place in places]

    def value(shift):
        moved = [place + shift * direction for place, direction in zip(places, directions, strict=True)]
        return value_of(model.draw(PARTICLES, HORIZON, seeded(5)), *moved)

    variables = [place.clone().requires_grad_() for place in places]
    recorded = value_of(model.draw(PARTICLES, HORIZON, seeded(5)), *variables)
    found = sum(
        (gradient * direction).sum()
        for gradient, direction in zip(torch.autograd.grad(recorded, variables), directions, strict=True)
    )
    assert recorded.item() == pytest.approx(value(0.0).item(), rel=1e-12), "a recorded gradient changes no value"
    width, rounding = (2e-2, 1e-3) if CASES[name].family == "ensemble" else (3e-4, 1e-6)
    if name == "sparse-AMM":
        width, rounding = 1e-3, 1e-5
    near, far = ((value(shift) - value(-shift)) / (2 * shift) for shift in (width, 2 * width))
    known = (4 * near - far) / 3
    assert abs(found - known) <= rounding * (1 + abs(known)), (found, known, near, far)


@pytest.mark.parametrize("name", WITHOUT_GRADIENTS)
def test_what_has_no_gradients_says_so(name):
    sampler, plans = fitted(name).draw(PARTICLES, HORIZON, seeded(5)), actions().requires_grad_()
    for take in (lambda: rollout(sampler, START, plans, PARTICLES), lambda: moved_by(name, plans[:, 0])):
        with pytest.raises(NotDifferentiableError, match=rf"^{type(sampler).__name__} has no gradients.*cem"):
            take()
    with torch.no_grad():
        rollout(sampler, START, plans, PARTICLES)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.family != "truth"])
def test_a_candidate_that_is_not_finite_keeps_that_to_itself(name, value):
    sampler = fitted(name).draw(PARTICLES, HORIZON, seeded(5))
    states = START.expand(PARTICLES, CANDIDATES, -1).clone()
    states[0, 1, 0] = value
    after = sampler(states, actions()[:, 0], 0)
    assert not after[:, 1].isfinite().all()
    others = [0, 2]
    assert after[:, others].isfinite().all()
    if CASES[name].family.startswith("deep"):  # whose draws move particles one by one
        assert after[1:].isfinite().all()


def test_the_generator_decides_everything(name):
    model = fitted(name)
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    first, again, other = states_of(model, 5), states_of(model, 5), states_of(model, 6)
    assert torch.equal(first, again)
    assert torch.equal(first, other) != CASES[name].is_random
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert np.array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002


def test_a_draw_leaves_the_model_and_other_draws_alone(name):
    model = fitted(name)
    before = {
        key: value.clone() if isinstance(value, torch.Tensor) else value for key, value in model.state_dict().items()
    }
    sampler = model.draw(PARTICLES, HORIZON, seeded(5))
    states_of(model, 7)  # another draw, made and used in between
    assert torch.equal(rollout(sampler, START, actions(), PARTICLES), states_of(model, 5))
    same_states(before, model.state_dict())


def test_what_is_saved_predicts_and_learns_on_alike(name):
    model = fitted(name)
    loaded = CASES[name].make()
    loaded.load_state_dict(model.state_dict())
    assert all(isinstance(value, torch.Tensor | int | float | str) for value in model.state_dict().values())
    assert torch.equal(states_of(model), states_of(loaded))
    if name not in LEARNERS:
        return
    more = slider.transitions(NUM_DATA + 20, NOISE)
    for each in (model, loaded):
        generator = seeded(3)
        each.resample(more, generator)
        each.fit(more, generator)
    same_states(model.state_dict(), loaded.state_dict())
    assert torch.equal(states_of(model), states_of(loaded))


def test_an_empty_state_is_an_untrained_model(learner):
    model = fitted(learner)
    model.load_state_dict({})
    assert model.state_dict() == {}
    with pytest.raises(RuntimeError, match=r"draw.*fit"):
        model.draw(PARTICLES, HORIZON, seeded())
    with pytest.raises(RuntimeError, match=r"resample.*fit"):
        model.resample(slider.transitions(5, NOISE), seeded())


def test_a_state_with_a_hole_is_refused_and_changes_nothing(learner):
    model = fitted(learner)
    before = states_of(model)
    for missing in model.state_dict():
        state = dict(model.state_dict())
        del state[missing]
        of_a_member, _, entry = missing.partition(".")
        shown = rf"'{of_a_member}'.*'{entry}'" if of_a_member in MIXED else f"'{missing}'"
        with pytest.raises(ValueError, match=rf"{shown}.*None"):
            model.load_state_dict(state)
    assert torch.equal(states_of(model), before)


def test_nothing_to_learn_from_is_an_error(learner):
    with pytest.raises(ValueError, match="0 transitions"):
        CASES[learner].make().fit(slider.transitions(0, NOISE), seeded())


@pytest.mark.parametrize("learner", [FAMILIES["sparse"], FAMILIES["deep2"]])
def test_the_rounding_of_a_large_number_is_not_a_target(learner):
    """A position of 5,000 that only its last bit changes: its noise would count as much as what is to be learned."""
    observation, action, after = slider.transitions(NUM_DATA, NOISE)
    bits = torch.randint(-1, 2, (2, NUM_DATA), generator=seeded())
    observation[:, 0], after[:, 0] = 5000 + bits * 2.0**-11
    model = CASES[learner].make()
    model.fit(Transitions(observation, action, after), seeded())
    assert model.state_dict()["targets.std"][0] == 1.0
    assert model.state_dict()["targets.std"][1] < 1.0


def test_training_is_decided_by_its_generator(learner):
    def run(seed):
        torch.manual_seed(seed)  # nobody's business
        model = fitted(learner)
        metrics = model.fit(slider.transitions(40, NOISE), seeded(2))
        assert metrics and all(isinstance(value, float) and value == value for value in metrics.values())
        return model.state_dict()

    same_states(run(0), run(1))


def known_moments(candidate, noise_std):
    """Mean [H + 1, S] and covariance [H + 1, S, S] of the states under one candidate's actions."""
    W = np.diag([noise_std**2, noise_std**2, 0.0])
    return linear_gaussian.moments(slider.A, slider.B, W, START.double().numpy(), actions()[candidate].double().numpy())


def test_the_true_dynamics_are_the_linear_system():
    states = states_of(fitted("truth"), num_particles=2).numpy()
    for k in range(CANDIDATES):
        mean, _ = known_moments(k, 0.0)
        np.testing.assert_allclose(states[:, :, k], np.repeat(mean[:, None], 2, 1), atol=1e-6)


@pytest.mark.parametrize("name", GAUSSIAN_PROCESSES)
def test_a_gaussian_process_finds_the_linear_system(name):
    """None of them draws the noise, so only the function's uncertainty is left, which is less than a step's noise:
    the variance of a fit with p degrees of freedom is on average p / N of the noise's, and p is far below N here.

    Every step adds the error of one step, at most five of those standard deviations, to what the linear system makes
    of the errors before it.
    """
    num_particles = 200
    states = states_of(fitted(name), num_particles=num_particles).double().numpy()
    for k in range(CANDIDATES):
        mean, _ = known_moments(k, 0.0)
        spread = states[1, :, k].std(0)
        assert (spread[:2] < NOISE).all()
        bound = np.zeros(3)
        for t in range(1, HORIZON + 1):
            bound = np.abs(slider.A) @ bound + 5 * spread * (1 + num_particles**-0.5) + 1e-6
            error = np.abs(states[t, :, k].mean(0) - mean[t])
            assert (error <= bound).all(), (t, error, bound)


def linear_ensemble(draw, num_members=5, **options):
    """An ensemble that is exactly the linear system with its noise: swish(x) - swish(-x) = x."""
    model = EnsembleDynamics(
        3, 1, slider.SPEC, num_members=num_members, num_hidden_layers=1, hidden_size=8, weight_decay=(0, 0), draw=draw,
        **options,
    )  # fmt: skip
    model.fit(slider.transitions(4, NOISE), seeded())  # for a state of the right shapes
    state = dict(model.state_dict())
    effect = torch.tensor(np.hstack([slider.A - np.eye(3), slider.B])[:2].T, dtype=torch.float32)  # of (s, a): "4 2"
    both = torch.cat([torch.eye(4), -torch.eye(4)], 1)
    mean = torch.cat([effect, -effect])
    log_variance = torch.tensor([0.0, 0.0, 2 * np.log(NOISE), 2 * np.log(NOISE)], dtype=torch.float32)
    state |= {
        "inputs.mean": torch.zeros(4), "inputs.std": torch.ones(4),
        "layers.0.weight": both.expand(num_members, -1, -1), "layers.0.bias": torch.zeros(num_members, 1, 8),
        "layers.1.weight": torch.cat([mean, torch.zeros(8, 2)], 1).expand(num_members, -1, -1),
        "layers.1.bias": log_variance.expand(num_members, 1, -1),
        "max_logvar": torch.full((2,), 20.0), "min_logvar": torch.full((2,), -40.0),
    }  # fmt: skip
    model.load_state_dict(state)
    return model


@pytest.mark.parametrize("draw", ["TS1", "TSinf", "DS"])
def test_particles_of_a_linear_ensemble_follow_the_kalman_recursion(draw):
    """Within five standard errors: of a mean sqrt(C_ii / P), of a covariance sqrt((C_ii C_jj + C_ij^2) / P)."""
    num_particles = 5000
    states = states_of(linear_ensemble(draw), num_particles=num_particles).double().numpy()
    for k in range(CANDIDATES):
        mean, covariance = known_moments(k, NOISE)
        for t in range(1, HORIZON + 1):
            own = np.diag(covariance[t])
            error = np.abs(states[t, :, k].mean(0) - mean[t])
            assert (error <= 5 * np.sqrt(own / num_particles) + 1e-6).all()
            standard_error = np.sqrt((np.outer(own, own) + covariance[t] ** 2) / num_particles)
            assert (np.abs(np.cov(states[t, :, k].T) - covariance[t]) <= 5 * standard_error + 1e-9).all()


def test_moment_matching_forgets_correlations_and_nothing_else():
    """The recursion of the diagonal: C <- diag(A C A^T + W). Each step estimates moments and draws from them, so the
    estimates' errors add up over the steps."""
    num_particles = 5000
    states = states_of(linear_ensemble("MM"), num_particles=num_particles).double().numpy()
    for k in range(CANDIDATES):
        mean, _ = known_moments(k, NOISE)
        variance = np.zeros(3)
        for t in range(1, HORIZON + 1):
            variance = slider.A**2 @ variance + np.array([NOISE**2, NOISE**2, 0.0])
            error = np.abs(states[t, :, k].mean(0) - mean[t])
            assert (error <= 5 * np.sqrt(2 * t * variance / num_particles) + 1e-6).all()
            found = states[t, :, k].var(0)
            assert (np.abs(found - variance) <= 5 * variance * np.sqrt(2 * 2 * t / num_particles) + 1e-9).all()


def test_the_expectation_is_the_mean_and_every_particle_the_same():
    states = states_of(linear_ensemble("expectation"), num_particles=2).numpy()
    for k in range(CANDIDATES):
        mean, _ = known_moments(k, 0.0)
        np.testing.assert_allclose(states[:, :, k], np.repeat(mean[:, None], 2, 1), atol=1e-5)


def test_with_one_member_it_does_not_matter_when_it_is_chosen():
    every_step, once = (linear_ensemble(draw, num_members=1) for draw in ("TS1", "TSinf"))
    assert torch.equal(states_of(every_step, num_particles=7), states_of(once, num_particles=7))


def test_a_training_that_says_how_far_it_is_is_the_same(trainer):
    silent, told = CASES[trainer].make(), CASES[trainer].make()
    heard = []
    told.on_progress = lambda *progress: heard.append(progress)
    data = slider.transitions(NUM_DATA, NOISE)
    generators = seeded(), seeded()
    metrics = [model.fit(data, generator) for model, generator in zip((silent, told), generators, strict=True)]
    assert metrics[0] == metrics[1]
    assert torch.equal(generators[0].get_state(), generators[1].get_state())
    done, totals, losses = zip(*heard, strict=True)
    assert list(done) == sorted(done)
    assert done[-1] <= totals[-1]
    assert set(totals) == {totals[0]}
    assert np.isfinite(losses).all()


def noise_state(variance, size=2):
    """Of the fitted noise 0.6 moves the process, and observations have a half and a third of it beside."""
    return NoiseSplit(
        torch.full((size,), 0.6, dtype=torch.float64),
        variance * torch.tensor([1 / 2, 1 / 3], dtype=torch.float64),
        torch.tensor([0.05, 0.0], dtype=torch.float64),
        torch.tensor([0.4, 0.0], dtype=torch.float64),
    )


def variances_with_noise(split, process_variance, forgets_correlations):
    """Of what is observed, [H, 2], by the covariance's recursion: the start's error, then A D C D A^T + W, and R."""
    A, R = slider.A[:2, :2], split.observation_variance.numpy()
    stretch, covariance, found = 1 / (1 - split.dilution.numpy()), np.zeros((2, 2)), []
    for step in range(HORIZON):
        fed = np.diag(R * stretch) if step == 0 else covariance * np.outer(stretch, stretch)
        covariance = A @ fed @ A.T + np.diag(process_variance)
        if forgets_correlations:
            covariance = np.diag(np.diag(covariance))
        found.append(np.diag(covariance) + R)
    return np.stack(found)


@pytest.mark.parametrize("name", GAUSSIAN_PROCESSES)
def test_draws_of_a_gaussian_process_with_noise_spread_by_the_recursion(name):
    """Beside their spread without noise, to which it adds, since the system is linear: within four standard errors of
    both variances, each sqrt(2 / P) of it, and a tenth for what is not linear in the fit."""
    num_particles = 500
    silent, noisy = fitted(name), CASES[name].make(add_noise=True)
    model = getattr(silent._fitted, "factorised", silent._fitted)
    # Of a deep Gaussian process the mean over its chains, of which the particles are: each adds its own.
    noise_variance = model.model.noise_variance.reshape(-1, 2).mean(0)
    variance = noise_variance * silent.state_dict()["targets.std"] ** 2
    split = noise_state(variance)
    noisy.load_state_dict(silent.state_dict() | split.state())
    spread, alone = (states_of(each, num_particles=num_particles)[1:, :, 0].var(1) for each in (noisy, silent))
    known = variances_with_noise(split, 0.6 * variance.numpy(), "MM" in name and "AMM" not in name)
    error = 4 * (2 / num_particles) ** 0.5 * (spread + alone)[:, :2].numpy() + 0.1 * known
    assert (np.abs((spread - alone)[:, :2].numpy() - known) <= error).all()
    assert (spread[:, 2] == 0).all(), "a constant has no noise"


@pytest.mark.parametrize("name", [*(name for name in GAUSSIAN_PROCESSES if "MM" not in name), "dropout"])
def test_steps_keep_within_what_was_seen(name):
    """And one and a half times its range on either side. (`MM` draws anew from the bounded particles' moments.)"""
    model = CASES[name].make(add_noise=True)
    narrow = {
        "seen.lowest": torch.tensor([0.15, -0.175]).double(),
        "seen.highest": torch.tensor([0.25, -0.125]).double(),
    }
    model.load_state_dict(trained_state(CASES[name].family) | narrow)
    change = states_of(model).double().diff(dim=0)[..., :2]
    mean, std = (model.state_dict()[f"targets.{key}"] for key in ("mean", "std"))
    found, rounding = (change - mean) / std, 8 * 2**-24 * 2 / std  # of states of up to 2
    lowest, highest = torch.tensor([0.0, -0.25]).double(), torch.tensor([0.4, -0.05]).double()
    assert ((found > lowest - rounding) & (found < highest + rounding)).all()
    assert (found < lowest + rounding).any() and (found > highest - rounding).any()


@pytest.mark.parametrize("draw", ["TS1", "TSinf", "DS", "MM"])
def test_draws_of_an_ensemble_with_noise_spread_by_the_recursion(draw):
    """Within five standard errors, of a variance sqrt(2 / P) of it; those of `MM` add up over the steps."""
    num_particles, variance = 4000, torch.full((2,), NOISE**2, dtype=torch.float64)
    split, means_alone = noise_state(variance), linear_ensemble(draw, add_noise=False)
    noisy = linear_ensemble(draw, split_noise=True)
    noisy.load_state_dict(noisy.state_dict() | split.state())
    spread = states_of(noisy, num_particles=num_particles)[1:, :, 0].var(1)[:, :2].double().numpy()
    known = variances_with_noise(split, 0.6 * variance.numpy(), draw == "MM")
    steps = np.arange(1, HORIZON + 1)[:, None] if draw == "MM" else 1
    assert (np.abs(spread - known) <= 5 * known * np.sqrt(2 * steps * 2 / num_particles)).all()
    assert states_of(means_alone)[1:].var(1).max() < 1e-10


@pytest.mark.parametrize("learner", OF_ONE_KIND)
def test_what_was_told_apart_is_kept_and_older_states_have_none_of_it(learner):
    model = CASES[learner].make(add_noise=True, split_noise=True)
    model.load_state_dict(trained_state(CASES[learner].family))  # older: all is the process's
    assert not any(key.startswith("noise.") for key in model.state_dict())
    older = states_of(model)
    state = noise_state(torch.tensor([1e-4, 1e-4], dtype=torch.float64)).state()
    model.load_state_dict(model.state_dict() | state)
    assert torch.equal(states_of(model), older) == (not CASES[learner].is_random)
    model.resample(slider.transitions(NUM_DATA + 20, NOISE), seeded())
    same_states(state, {key: value for key, value in model.state_dict().items() if key.startswith("noise.")})
    with pytest.raises(ValueError, match=r"noise\.centre"):
        model.load_state_dict({key: value for key, value in model.state_dict().items() if key != "noise.centre"})


@pytest.mark.parametrize("trainer", OF_ONE_KIND)
def test_a_training_says_how_much_noise_of_each_kind_it_found(trainer):
    """Where it is asked to tell them apart; these transitions do not follow one another, so all is the process's."""
    data = slider.transitions(40, NOISE)
    silent, asked = CASES[trainer].make(add_noise=False), CASES[trainer].make(add_noise=True, split_noise=True)
    for model in (silent, asked):
        model.load_state_dict(trained_state(CASES[trainer].family))
    metrics, more = silent.fit(data, seeded()), asked.fit(data, seeded())
    assert more.items() >= metrics.items(), "the training is the same"
    assert set(more) - set(metrics) == {"process_noise_std", "observation_noise_std"}
    assert more["observation_noise_std"] == 0.0 and more["process_noise_std"] > 0.0
