"""Adam and L-BFGS within a box, many rows at once, against the dense formula, exact optima and each row alone."""

import math

import pytest
import torch

from gym_dgpmpc.planning.ascent import AdamAscent, LBFGSAscent, uphill
from tests.oracles.models import normal, seeded

SIZE = 6


def hill(seed):
    """A concave quadratic -(x - c)^T G (x - c) / 2 with its top c within the box."""
    generator = seeded(seed)
    root = normal(generator, SIZE, SIZE)
    matrix = root @ root.mT + 0.5 * torch.eye(SIZE, dtype=torch.float64)
    return matrix, 0.2 + 0.6 * torch.rand(SIZE, generator=generator, dtype=torch.float64)


def climbed(ascent, matrices, tops, num_steps):
    """The values and the places that were evaluated."""
    seen = []
    for _ in range(num_steps):
        away = ascent.position - tops
        gradient = -torch.einsum("kij,kj->ki", matrices, away)
        seen.append((0.5 * (gradient * away).sum(-1), ascent.position))
        ascent = ascent.step(seen[-1][0], gradient)
    values, places = zip(*seen, strict=True)
    return torch.stack(values), torch.stack(places)


def several(count):
    matrices, tops = zip(*map(hill, range(count)), strict=True)
    return torch.stack(matrices), torch.stack(tops)


@pytest.mark.parametrize("kind", [AdamAscent, LBFGSAscent])
def test_rows_do_not_meet(kind):
    matrices, tops = several(4)
    start = torch.rand(4, SIZE, generator=seeded(9), dtype=torch.float64)
    together, _ = climbed(kind.init(start, 0.1, 12), matrices, tops, 12)
    for row in range(4):
        own = slice(row, row + 1)
        alone, _ = climbed(kind.init(start[own], 0.1, 12), matrices[own], tops[own], 12)
        torch.testing.assert_close(together[:, own], alone, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", [AdamAscent, LBFGSAscent])
def test_the_first_step_is_as_long_as_was_said_and_none_leaves_the_box(kind):
    matrices, tops = several(4)
    start = torch.rand(4, SIZE, generator=seeded(9), dtype=torch.float64)
    _, places = climbed(kind.init(start, 0.05, 30), matrices, tops + 2.0, 30)
    first = (places[1] - places[0]).abs().amax(-1)
    torch.testing.assert_close(first, torch.full_like(first, 0.05))
    assert places.min() >= 0.0 and places.max() <= 1.0


def test_the_direction_is_the_dense_formulas():
    """H <- (I - rho s y^T) H (I - rho y s^T) + rho s s^T from gamma I, with gamma = s.y / y.y of the newest pair."""
    generator, (matrix, _) = seeded(3), hill(3)
    steps = normal(generator, 4, 1, SIZE)
    changes = steps @ matrix
    steps[1] = 0.0  # a trial that was not taken
    changes[1] = 0.0
    changes[2] = -changes[2]  # curved the wrong way
    gradient, free = normal(generator, 1, SIZE), torch.tensor([[True] * (SIZE - 2) + [False] * 2])
    found = uphill(gradient, steps, changes, free, 0.1)[0]

    kept = SIZE - 2
    newest = steps[3, 0, :kept], changes[3, 0, :kept]
    inverse = torch.eye(kept, dtype=torch.float64) * (newest[0] @ newest[1]) / (newest[1] @ newest[1])
    for s, y in ((steps[0, 0, :kept], changes[0, 0, :kept]), newest):
        rho, eye = 1.0 / (s @ y), torch.eye(kept, dtype=torch.float64)
        left = eye - rho * torch.outer(s, y)
        inverse = left @ inverse @ left.mT + rho * torch.outer(s, s)
    torch.testing.assert_close(found[:kept], inverse @ gradient[0, :kept], rtol=1e-12, atol=1e-12)
    assert not found[kept:].any()


def test_without_curvature_the_direction_is_the_gradients():
    gradient = torch.tensor([[3.0, -1.0, 0.0], [0.0, 0.0, 0.0]])
    none = torch.zeros(0, 2, 3)
    found = uphill(gradient, none, none, torch.ones(2, 3, dtype=torch.bool), 0.2)
    torch.testing.assert_close(found, torch.tensor([[0.2, -0.2 / 3, 0.0], [0.0, 0.0, 0.0]]))


def test_lbfgs_finds_the_top_of_a_quadratic():
    """To the rounding of its value: near the top that is the square of the distance, times the largest curvature."""
    matrices, tops = several(5)
    start = torch.rand(5, SIZE, generator=seeded(9), dtype=torch.float64)
    values, _ = climbed(LBFGSAscent.init(start, 0.1, 50), matrices, tops, 50)
    assert (values.amax(0) > -1e-12).all()


@pytest.mark.parametrize("kind", [AdamAscent, LBFGSAscent])
def test_a_corner_is_reached_exactly_and_left_again(kind):
    slopes = torch.tensor([[1.0, -2.0, 0.5]], dtype=torch.float64)
    ascent = kind.init(torch.full((1, 3), 0.5, dtype=torch.float64), 0.2, 20)
    for _ in range(10):
        ascent = ascent.step((slopes * ascent.position).sum(-1), slopes)
    assert torch.equal(ascent.position, torch.tensor([[1.0, 0.0, 1.0]], dtype=torch.float64))
    for _ in range(10):
        away = ascent.position - 0.4
        ascent = ascent.step(-away.square().sum(-1) + 10.0, -2.0 * away)
    assert ((ascent.position > 0.0) & (ascent.position < 1.0)).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["value", "gradient"])
@pytest.mark.parametrize("kind", [AdamAscent, LBFGSAscent])
def test_from_a_place_that_is_not_finite_a_row_goes_back(kind, where, bad):
    """The other row does not notice."""
    start = torch.full((2, 1), 0.5, dtype=torch.float64)
    ascent, known = (kind.init(start[:rows], 0.25, 8) for rows in (2, 1))
    for _ in range(8):
        value, gradient = ascent.position[:, 0].clone(), torch.ones_like(ascent.position)
        beyond = bool(ascent.position[1, 0] > 0.6)
        if beyond:
            (value if where == "value" else gradient)[1] = bad
        before = ascent.position
        ascent = ascent.step(value, gradient)
        known = known.step(known.position[:, 0], torch.ones_like(known.position))
        assert torch.equal(ascent.position[:1], known.position)
        assert ascent.position.isfinite().all()
        assert not beyond or ascent.position[1, 0] < before[1, 0] or ascent.position[1, 0] <= 0.75
    assert ascent.position[0, 0] == 1.0
    assert (ascent.best if kind is AdamAscent else ascent.place)[1, 0] <= 0.6
