"""The one Cholesky factorisation: what it reproduces, its ladder of jitters, its errors, its gradient."""

import pytest
import torch

from gym_dgpmpc.errors import FactorisationError
from gym_dgpmpc.gp.linalg import JITTER, cholesky
from tests.oracles.models import normal, seeded

ONE = torch.tensor(1.0, dtype=torch.float64)


def positive_definite(generator, *shape):
    root = normal(generator, *shape, shape[-1] + 2)
    return root @ root.mT


@pytest.mark.parametrize("shape", [(1,), (6,), (3, 6), (2, 3, 6)])
def test_the_factor_reproduces_the_matrix_and_its_jitter(shape):
    covariance, scale = positive_definite(seeded(), *shape), torch.tensor(2.5, dtype=torch.float64)
    factor = cholesky(covariance, scale)
    expected = covariance + JITTER * scale * torch.eye(shape[-1], dtype=torch.float64)
    torch.testing.assert_close(factor @ factor.mT, expected, rtol=1e-13, atol=1e-13)
    assert torch.equal(factor, factor.tril())


@pytest.mark.parametrize(
    ("smallest_eigenvalue", "rung"), [(0.0, 1), (-5e-6, 10), (-5e-5, 100), (-5e-4, 1e3), (-5e-3, 1e4)]
)
def test_the_first_jitter_that_suffices_is_taken(smallest_eigenvalue, rung):
    direction = torch.linalg.qr(normal(seeded(), 4, 4))[0]
    covariance = direction @ torch.diag(torch.tensor([3.0, 2.0, 1.0, smallest_eigenvalue]).double()) @ direction.mT
    factor = cholesky(covariance, ONE)
    expected = covariance + rung * JITTER * torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close(factor @ factor.mT, expected, rtol=0, atol=1e-9)


def test_one_bad_matrix_of_a_batch_is_enough_for_the_next_jitter():
    covariance = torch.stack([torch.eye(2), torch.diag(torch.tensor([1.0, -5e-6]))]).double()
    factor = cholesky(covariance, ONE)
    assert (factor @ factor.mT)[0, 0, 0].item() == pytest.approx(1 + 10 * JITTER, abs=1e-12)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("position", [(0, 0), (3, 3), (2, 0), (3, 2)])
def test_a_value_that_is_not_finite_is_an_error(value, position):
    covariance = positive_definite(seeded(), 4)
    covariance[position] = covariance[position[::-1]] = value
    with pytest.raises(FactorisationError, match=r"\(4, 4\).*not finite"):
        cholesky(covariance, ONE)


def test_an_indefinite_matrix_is_an_error_that_names_the_largest_jitter():
    with pytest.raises(FactorisationError, match=r"\(2, 2\).*\b0\.01\b"):
        cholesky(torch.diag(torch.tensor([1.0, -0.1], dtype=torch.float64)), ONE)


def test_the_gradient_is_that_of_finite_differences():
    root, scale = normal(seeded(), 4, 6).requires_grad_(), ONE.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda a, s: cholesky(a @ a.mT, s, jitter=0.1), (root, scale))
