"""Gradients of pathwise draws against differences of their values, and of rollouts against those of their steps."""

import math

import pytest
import torch

from gym_dgpmpc.dynamics.bounds import SeenTargets
from gym_dgpmpc.dynamics.deep_gp.model import compiled_rollout
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.planning.rollout import rollout, rollout_objective
from tests.dynamics.deep_gp.test_compiled_rollout import HORIZON, PARTICLES, SPECS, Draw
from tests.oracles.models import normal, seeded

CANDIDATES = 4

pytestmark = pytest.mark.skipif(not compiled_rollout.is_available(), reason="no C++ compiler works here")


def gradients(value_of, *places):
    """The value, and its gradients by copies of these tensors."""
    variables = [place.clone().requires_grad_() for place in places]
    value = value_of(*variables)
    return value.detach(), torch.autograd.grad(value, variables)


def along(value_of, places, directions, width):
    """The derivative along a direction, by central differences extrapolated to width zero: their error falls as the
    fourth power of the width, their rounding grows as its inverse."""

    def value(shift):
        return value_of(*(place + shift * direction for place, direction in zip(places, directions, strict=True)))

    with torch.no_grad():
        near, far = ((value(shift) - value(-shift)) / (2 * shift) for shift in (width, 2 * width))
    return (4 * near - far) / 3


def check_step(sampler, step):
    generator = seeded(1)
    places = [normal(generator, PARTICLES, CANDIDATES, size) for size in (3, 2)]
    directions = [normal(generator, *place.shape) for place in places]
    weight = normal(generator, PARTICLES, CANDIDATES, 3)

    def value_of(states, actions):
        return (sampler(states, actions, step) * weight).sum()

    _, found = gradients(value_of, *places)
    assert all(gradient.dtype == torch.float64 for gradient in found)
    slope = sum((gradient * direction).sum() for gradient, direction in zip(found, directions, strict=True))
    known = along(value_of, places, directions, 1e-4)
    assert abs(slope - known) <= 1e-7 * (1 + abs(known)), (slope, known)


@pytest.mark.parametrize("spec", SPECS)
@pytest.mark.parametrize("num_layers", [1, 2])
@pytest.mark.parametrize("refresh", ["step", "plan"])
@pytest.mark.parametrize("with_noise", [False, True])
def test_a_steps_gradient_is_that_of_its_value(spec, num_layers, refresh, with_noise):
    """For every encoding, with a linear part; the first step and later ones differ where observations have noise."""
    draw = Draw("matern52", num_layers, spec, refresh, with_noise=with_noise, linear=True)
    for step in (0, 2):
        check_step(draw.double, step)


@pytest.mark.parametrize("kernel", [name for name in KERNELS if name != "matern12"])
def test_the_gradient_is_right_for_every_kernel_with_a_slope(kernel):
    check_step(Draw(kernel, 2).double, 1)


def test_no_gradient_passes_a_bound():
    """Where a step is bounded it moves no further, so the state's own part is left."""
    seen = SeenTargets(*(torch.full((3,), bound, dtype=torch.float64) for bound in (-0.1, 0.1)))
    draw = Draw("matern52", 2, seen=seen)
    check_step(draw.double, 0)
    states, actions = normal(seeded(1), PARTICLES, CANDIDATES, 3), normal(seeded(2), PARTICLES, CANDIDATES, 2)
    with torch.no_grad():
        moved = draw.double(states, actions, 0)
    lowest, highest = draw.double.coordinates.lowest, draw.double.coordinates.highest
    change = (moved - states - draw.double.coordinates.shift) / draw.double.coordinates.spread
    bounded = ((change - lowest).abs() < 1e-9) | ((change - highest).abs() < 1e-9)
    assert bounded.any() and not bounded.all()
    _, (by_state, by_action) = gradients(lambda s, a: draw.double(s, a, 0)[bounded].sum(), states, actions)
    torch.testing.assert_close(by_state, bounded.double())
    assert not by_action.any()


def whole(sampler, weight):
    return lambda start, actions: (rollout(sampler, start, actions, PARTICLES) * weight).sum()


def by_steps(sampler, weight):
    def value_of(start, actions):
        states = [start.expand(PARTICLES, len(actions), -1)]
        for step, action in enumerate(actions.unbind(1)):
            states.append(sampler(states[-1], action, step))
        return (torch.stack(states) * weight).sum()

    return value_of


@pytest.mark.parametrize("spec", SPECS)
@pytest.mark.parametrize("num_layers", [1, 3])
@pytest.mark.parametrize("refresh", ["step", "plan"])
@pytest.mark.parametrize("with_noise", [False, True])
def test_a_rollouts_gradient_is_that_of_its_steps(spec, num_layers, refresh, with_noise):
    """Which PyTorch chains; in double precision they differ by rounding, however chaotic the functions are."""
    draw = Draw("matern32", num_layers, spec, refresh, with_noise=with_noise)
    places = draw.observation.double(), draw.actions(CANDIDATES).double()
    weight = normal(seeded(1), HORIZON + 1, PARTICLES, CANDIDATES, 3)
    _, found = gradients(whole(draw.double, weight), *places)
    _, known = gradients(by_steps(draw.double, weight), *places)
    for one, other in zip(found, known, strict=True):
        assert (one - other).abs().max() <= 1e-9 * other.abs().max()


def test_a_rollouts_gradient_is_that_of_its_value():
    """Of smooth functions over three steps, where differences are exact enough to tell."""
    draw = Draw("rbf", 2, SPECS[3], with_noise=True)
    places = draw.observation.double(), draw.actions(CANDIDATES)[:, :3].double()
    directions = [normal(seeded(2), *place.shape) for place in places]
    value_of = whole(draw.double, normal(seeded(1), 4, PARTICLES, CANDIDATES, 3))
    _, found = gradients(value_of, *places)
    slope = sum((gradient * direction).sum() for gradient, direction in zip(found, directions, strict=True))
    known = along(value_of, places, directions, 1e-5)
    assert abs(slope - known) <= 1e-6 * (1 + abs(known))


@pytest.mark.parametrize(("dtype", "offset"), [(torch.float32, 0.0), (torch.float64, 0.0), (torch.float64, 1e4)])
def test_compiled_code_gives_the_values_and_pytorch_their_gradient(dtype, offset):
    """The gradient of single precision is that of double precision at the same states, up to its rounding."""
    draw = Draw("matern52", 2, offset=offset, with_noise=True)
    start = (draw.observation.double() + torch.tensor([offset, 0.0, offset])).to(dtype)
    actions, weight = draw.actions(CANDIDATES)[:, :2], normal(seeded(1), 3, PARTICLES, CANDIDATES, 3)
    recorded, (by_start, by_actions) = gradients(whole(draw.compiled, weight), start, actions)
    assert torch.equal(recorded, whole(draw.compiled, weight)(start, actions)), "the compiled code's in either case"
    assert by_start.dtype == dtype and by_actions.dtype == torch.float32
    _, known = gradients(whole(draw.double, weight), start.double(), actions.double())
    for found, exact in zip((by_start, by_actions), known, strict=True):
        assert (found - exact).abs().max() <= 1e-4 * exact.abs().max()


def test_a_candidate_that_is_not_finite_keeps_that_to_itself():
    draw, bad = Draw("matern32", 2), 1
    actions = draw.actions(CANDIDATES)
    actions[bad, 1, 0] = math.nan
    weight = torch.ones(HORIZON + 1, PARTICLES, CANDIDATES, 3)
    _, (_, by_actions) = gradients(whole(draw.compiled, weight), draw.observation, actions)
    others = [k for k in range(CANDIDATES) if k != bad]
    assert by_actions[others].isfinite().all() and not by_actions[bad].isfinite().all()
    _, (_, alone) = gradients(whole(draw.compiled, weight[:, :, others]), draw.observation, actions[others])
    torch.testing.assert_close(by_actions[others], alone, rtol=1e-4, atol=1e-4 * float(alone.abs().max()))


def test_actions_alone_decide_whether_a_score_has_a_gradient():
    draw = Draw("matern32", 2)
    objective = rollout_objective(draw.compiled, lambda s, a, after: -after.norm(dim=-1), draw.observation, PARTICLES)
    actions = draw.actions(CANDIDATES)
    scores = objective(actions)
    assert not scores.requires_grad
    recorded = objective(actions.clone().requires_grad_())
    assert recorded.requires_grad and torch.equal(recorded, scores)
    with torch.no_grad():
        assert not objective(actions.clone().requires_grad_()).requires_grad
