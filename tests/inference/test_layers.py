"""Compiled layers against PyTorch's, which `test_gradients.py` holds against automatic differentiation."""

import functools
import math
import warnings

import pytest
import torch

from gym_dgpmpc import compiler
from gym_dgpmpc.errors import FactorisationError
from gym_dgpmpc.gp.kernels import KERNELS, RBF
from gym_dgpmpc.gp.layer import Layer
from gym_dgpmpc.gp.linalg import cholesky
from gym_dgpmpc.inference import compiled_layers, layers
from gym_dgpmpc.inference.layers import Seen, gram, layer_gradients, layer_terms, moments, see
from tests.oracles.models import normal, seeded

SIZES = [(1, 1, 1, 1, 1), (2, 17, 6, 3, 2), (3, 64, 24, 8, 8), (2, 70, 51, 25, 17), (1, 129, 104, 6, 1)]
"""Chains, points, inducing inputs, inputs, outputs: less than a block of each, whole ones, and one beyond."""

NUDGE, AS_FAR = 8 * 2**-53, 30.0
"""Compiled code may be so many times as far from PyTorch as that moves if all it is given is rounded by so much.
Both round r^2 by |x|^2 instead of r |x|, which for the closest points here is ten times as much."""

needs_compiler = pytest.mark.skipif(
    not compiled_layers.can_take(KERNELS["rbf"], torch.zeros(1).double()), reason="no C++ compiler works here"
)


class Problem:
    """A layer of chains that differ, points, and gradients of their moments."""

    def __init__(self, kernel="matern32", sizes=SIZES[1], nudge=0.0, *, linear=False):
        chains, num_points, num_inducing, inputs, outputs = sizes
        generator, other = seeded(3), seeded(4)

        def draw(*shape):
            return normal(generator, *shape) * (1.0 + nudge * normal(other, *shape))

        log_lengthscale = math.log(math.sqrt(inputs)) + 0.2 * draw(chains, inputs)
        log_slope = draw(chains, inputs) - 0.5 if linear else None
        centres, log_variance = draw(chains, num_inducing, inputs), 0.5 * draw(chains)
        self.layer = Layer(KERNELS[kernel], centres, log_lengthscale, log_variance, log_slope)
        self.terms = layer_terms(self.layer)
        self.points, self.whitened = draw(chains, num_points, inputs), draw(chains, num_inducing, outputs)
        self.mean_bar, self.variance_bar = draw(chains, num_points, outputs), draw(chains, num_points)
        self.weights = draw(chains, outputs, num_points).abs()

    def numbers(self, *, compile):
        """Everything that a layer computes, by name; but its own slope where two points are one."""
        terms = layer_terms(self.layer, compile=compile)
        assert (terms.compiled is not None) == compile
        seen = see(terms, self.points)
        passed = moments(terms, self.whitened, seen, 0.0)
        found = layer_gradients(terms, self.whitened, passed, self.mean_bar, self.variance_bar)
        own_slope = terms.own_slope.clone()
        own_slope.diagonal(dim1=1, dim2=2).zero_()
        named = {"factor": terms.factor, "inverse": terms.inverse, "own_slope": own_slope}
        named |= {"mean": passed.mean, "variance": passed.variance, "gram": gram(terms, seen, self.weights)}
        named |= {"whitened_bar": found.whitened, "points_bar": found.points} | seen._asdict()
        return named | {
            f"{name}_bar": value for name, value in zip(self.layer.parameters(), found.parameters, strict=True)
        }


@needs_compiler
@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize(("kernel", "linear"), [*((kernel, False) for kernel in KERNELS), ("matern32", True)])
def test_compiled_layers_are_pytorchs(kernel, linear, sizes):
    problem = Problem(kernel, sizes, linear=linear)
    found, expected = problem.numbers(compile=True), problem.numbers(compile=False)
    nudged = Problem(kernel, sizes, NUDGE, linear=linear).numbers(compile=False)
    # Where a centre meets itself its own slope cancels, that of Matern-1/2 a million times larger than others.
    steepest = 1.0 + float(problem.terms.own_slope.abs().max())
    cancelling = dict.fromkeys(("inducing_inputs_bar", "log_lengthscale_bar"), steepest)
    for name, value in expected.items():
        largest, rounding = float(value.abs().max()), float((nudged[name] - value).abs().max())
        allowed = AS_FAR * rounding + 16 * 2**-53 * largest * cancelling.get(name, 1.0)
        assert allowed <= 1e-8 * largest, name
        assert float((found[name] - value).abs().max()) <= allowed, name


@needs_compiler
@pytest.mark.parametrize("size", [1, 7, 8, 33, 104])
def test_compiled_factors_are_lapacks(size):
    """Of matrices in any memory; to the rounding of a Cholesky factorisation, M eps times the matrix (Higham 2002)."""
    root = normal(seeded(), 3, 2, size, size)
    matrices = root @ root.mT
    strided = torch.nn.functional.pad(matrices, (0, 5))[..., :size]
    for given, added in ((matrices, 0.1), (strided, 0.1), (matrices.mT, 2.0)):
        factor, exists = compiled_layers.factorise(given, added)
        assert exists and factor.shape == matrices.shape
        assert not factor.triu(1).any() and (factor.diagonal(dim1=-2, dim2=-1) > 0).all()
        rounding = (size + 1) * 2**-52 * float(matrices.diagonal(dim1=-2, dim2=-1).max() + added)
        expected = matrices + added * torch.eye(size).double()
        torch.testing.assert_close(factor @ factor.mT, expected, rtol=0, atol=rounding)


@needs_compiler
@pytest.mark.parametrize("value", [-1e-3, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", [0, 6, 19])
def test_a_matrix_that_has_no_factor_is_told(place, value):
    matrices = torch.eye(20).double().repeat(4, 1, 1)
    assert compiled_layers.factorise(matrices, 0.0)[1]
    matrices[2, place, place] = value
    assert not compiled_layers.factorise(matrices, 0.0)[1]
    with pytest.raises(FactorisationError, match="jitter" if value == -1e-3 else "finite"):
        cholesky(matrices, jitter=1e-8, factorise=compiled_layers.factorise)


@needs_compiler
def test_variances_have_a_bound():
    problem = Problem()
    seen = see(problem.terms, problem.points)
    free = moments(problem.terms, problem.whitened, seen, 0.0).variance
    least = float(free.median())
    assert torch.equal(moments(problem.terms, problem.whitened, seen, least).variance, free.clamp_min(least))


@needs_compiler
@pytest.mark.parametrize("linear", [False, True])
def test_only_what_is_wanted_is_computed(linear):
    problem = Problem(linear=linear)
    seen = see(problem.terms, problem.points)
    passed = moments(problem.terms, problem.whitened, seen, 0.0)
    given = problem.terms, problem.whitened, passed, problem.mean_bar, problem.variance_bar
    everything = layer_gradients(*given)
    points = layer_gradients(*given, of_points=True, of_parameters=False)
    assert torch.equal(points.points, everything.points) and points.parameters is None
    parameters = layer_gradients(*given, of_points=False, of_parameters=True)
    assert parameters.points is None
    assert all(torch.equal(*pair) for pair in zip(parameters.parameters, everything.parameters, strict=True))
    neither = layer_gradients(*given, of_points=False, of_parameters=False)
    assert neither.points is None and neither.parameters is None
    for each in (points, parameters, neither):
        assert torch.equal(each.whitened, everything.whitened)


@needs_compiler
def test_points_may_be_shared_by_the_chains_and_in_any_layout():
    problem = Problem()
    shared = problem.points[0]
    expected = see(problem.terms, shared.expand(2, -1, -1).contiguous())
    strided = torch.stack([shared, shared], dim=-1)[..., 0]
    for points in (shared.expand(2, -1, -1), strided.expand(2, -1, -1), shared.mT.contiguous().mT.expand(2, -1, -1)):
        assert all(torch.equal(a, b) for a, b in zip(see(problem.terms, points), expected, strict=True))
    copied = Seen(*(torch.stack([tensor, tensor], dim=-1)[..., 0] for tensor in expected))
    for function in (
        lambda seen: moments(problem.terms, problem.whitened, seen, 0.0)[1:],
        lambda seen: (gram(problem.terms, seen, problem.weights),),
        lambda seen: flat(
            layer_gradients(
                problem.terms,
                problem.whitened,
                moments(problem.terms, problem.whitened, seen, 0.0),
                problem.mean_bar.mT.contiguous().mT,
                problem.variance_bar,
            )
        ),
    ):
        assert all(torch.equal(a, b) for a, b in zip(function(copied), function(expected), strict=True))


def flat(found):
    """All gradients, one after the other."""
    return [found.whitened, found.points, *found.parameters]


@needs_compiler
def test_any_number_of_threads_gives_the_same():
    problem, threads = Problem(sizes=(3, 70, 20, 3, 2)), torch.get_num_threads()
    found = []
    try:
        for count in (1, 2, 3, 5):
            torch.set_num_threads(count)
            seen = see(problem.terms, problem.points)
            passed = moments(problem.terms, problem.whitened, seen, 0.0)
            bars = problem.mean_bar, problem.variance_bar
            found.append([*seen, *flat(layer_gradients(problem.terms, problem.whitened, passed, *bars))])
    finally:
        torch.set_num_threads(threads)
    for others in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], others, strict=True))


@needs_compiler
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e200])
def test_what_is_not_finite_never_becomes_finite(kernel, value):
    """And stays with its point and chain; one that is merely far is nothing to the inducing inputs."""
    problem = Problem(kernel)
    problem.points[1, 3, 0] = value
    seen = see(problem.terms, problem.points)
    assert seen.projected[1, :, 3].isnan().all()
    others = torch.ones(2, 17, dtype=torch.bool)
    others[1, 3] = False
    assert seen.projected.mT[others].isfinite().all()
    passed = moments(problem.terms, problem.whitened, seen, 0.0)
    found = layer_gradients(problem.terms, problem.whitened, passed, problem.mean_bar, problem.variance_bar)
    assert found.points[1, 3].isnan().all()
    for tensor in (found.whitened, *found.parameters):
        assert tensor[1].isnan().all() and tensor[0].isfinite().all()
    problem.points[1, 3, 0] = 1e100
    assert (see(problem.terms, problem.points).projected[1, :, 3].abs() < 1e-100).all()


class Own(RBF):
    """A kernel of somebody else's, which the compiled code has not heard of."""

    name = "own"


@needs_compiler
def test_what_the_compiled_code_does_not_have_is_left_to_pytorch():
    """With one warning for a kernel, and none where compiled code is not wanted."""
    compiler.warn_once.cache_clear()
    generator = seeded()
    layer = Layer(Own(), normal(generator, 2, 5, 3), normal(generator, 2, 3), normal(generator, 2))
    said = []
    for compile in (False, True, True):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert layer_terms(layer, compile=compile).compiled is None
        said.append([str(warning.message) for warning in caught])
    assert said[0] == said[2] == [] and len(said[1]) == 1 and "kernel 'own'" in said[1][0]
    single = Layer(RBF(), *(tensor.float() for tensor in layer.parameters().values()))
    assert layer_terms(single).compiled is None


@needs_compiler
def test_memory_that_cannot_be_had_is_an_error(monkeypatch):
    problem = Problem()

    class Library:
        def see(self, *_):
            return 1

    monkeypatch.setattr(compiled_layers, "_library", functools.cache(Library))
    with pytest.raises(MemoryError, match="layer"):
        layers.see(problem.terms, problem.points)
