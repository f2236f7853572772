"""Where training starts: inducing inputs, and a model carried over to other coordinates or other inducing inputs."""

import math
import warnings

import pytest
import torch

from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.dynamics.deep_gp.start import cluster, initial_model, relocate, restandardise
from gym_dgpmpc.gp.deep_gp import factorise_all, log_likelihood, propagate
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.gp.layer import conditional
from tests.oracles.models import chains, make_model, normal, seeded


def mean_function(model, whitened, x):
    """The composition of the layers' means, of one chain or of several."""
    for layer, factor, v in zip(model.layers, factorise_all(model).factors, model.split(whitened), strict=True):
        mean = conditional(layer, factor, v, x)[0]
        x = mean if layer is model.layers[-1] else x + mean
    return x


@pytest.mark.parametrize("num_layers", [1, 2, 3])
@pytest.mark.parametrize("kernel", KERNELS)
def test_restandardising_keeps_the_function_of_raw_inputs(kernel, num_layers):
    """Up to the shift of the targets' mean, which is left to training."""
    generator = seeded(1)
    model = make_model(num_layers, 3, 2, 6, generator, kernel)
    whitened, raw = normal(generator, model.num_whitened()), normal(generator, 10, 3)

    def normalisers(seed):
        twin = seeded(seed)
        return tuple(Normaliser(normal(twin, n), 0.5 + normal(twin, n).square()) for n in (3, 2))

    old, new = normalisers(2), normalisers(3)
    moved, moved_whitened = restandardise(model, whitened, old, new)
    before = mean_function(model, whitened, old[0](raw)) * old[1].std
    after = mean_function(moved, moved_whitened, new[0](raw)) * new[1].std
    torch.testing.assert_close(after, before, rtol=1e-7, atol=1e-7)
    # The noise, too, is the same in raw units, and its floor is not.
    noise = model.log_noise.exp() * old[1].std.square()
    torch.testing.assert_close(moved.log_noise.exp() * new[1].std.square(), noise)


def test_with_a_linear_part_restandardising_keeps_the_inducing_outputs():
    generator = seeded(1)
    model = make_model(1, 3, 2, 6, generator, linear=True)
    whitened = normal(generator, model.num_whitened())

    def normalisers(seed):
        twin = seeded(seed)
        return tuple(Normaliser(normal(twin, n), 0.5 + normal(twin, n).square()) for n in (3, 2))

    old, new = normalisers(2), normalisers(3)
    moved, moved_whitened = restandardise(model, whitened, old, new)
    outputs = [
        factorise_all(each).factors[0] @ each.split(v)[0] * targets.std
        for each, v, (_, targets) in ((model, whitened, old), (moved, moved_whitened, new))
    ]
    torch.testing.assert_close(outputs[1], outputs[0], rtol=1e-9, atol=1e-9)
    raw = old[0].inverse(model.layers[0].inducing_inputs)
    torch.testing.assert_close(new[0].inverse(moved.layers[0].inducing_inputs), raw, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("linear", [False, True])
def test_restandardising_to_the_same_coordinates_changes_nothing(linear):
    generator = seeded(1)
    model = make_model(2, 3, 2, 6, generator, linear=linear)
    whitened = normal(generator, model.num_whitened())
    same = (
        Normaliser(normal(generator, 3), torch.ones(3).double()),
        Normaliser(normal(generator, 2), torch.ones(2).double()),
    )
    moved, moved_whitened = restandardise(model, whitened, same, same)
    torch.testing.assert_close(moved_whitened, whitened)
    for a, b in zip(moved.parameters(), model.parameters(), strict=True):
        torch.testing.assert_close(a, b)


def test_a_common_stretch_of_the_targets_keeps_the_whole_predictive_law():
    """With one stretch for all targets the kernel's variance can take all of it: p(y | v) in raw units is unchanged."""
    generator = seeded(1)
    model = make_model(1, 3, 2, 6, generator)
    whitened, x, raw_y = normal(generator, model.num_whitened()), normal(generator, 5, 3), normal(generator, 5, 2)
    inputs, zero = Normaliser(torch.zeros(3).double(), torch.ones(3).double()), torch.zeros(2).double()
    old, new = ((inputs, Normaliser(zero, torch.full((2,), std).double())) for std in (1.0, 0.3))
    moved, moved_whitened = restandardise(model, whitened, old, new)
    densities = []
    for each, v, scale in ((model, whitened, 1.0), (moved, moved_whitened, 0.3)):
        mean, variance = propagate(factorise_all(each), each.split(v), x, generator)
        densities.append(log_likelihood(each, mean, variance, raw_y / scale) - 2 * math.log(scale))
    torch.testing.assert_close(densities[1], densities[0], rtol=1e-4, atol=1e-4)  # the noise floor does not scale


@pytest.mark.parametrize("num_layers", [1, 2])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("num_chains", [1, 2])
def test_relocating_to_the_data_keeps_the_mean_function_there(kernel, num_layers, num_chains):
    """With no more rows than inducing inputs every row is one of them, in every layer: nothing but jitter is lost."""
    generator = seeded(1)
    model = chains(*(make_model(num_layers, 2, 2, 15, generator, kernel) for _ in range(num_chains)))
    whitened = 0.5 * normal(generator, num_chains, model.num_whitened())
    data = Data(normal(generator, 12, 2), normal(generator, 12, 2))
    moved, moved_whitened = relocate(model, whitened, data, generator)
    x = data.x.expand(num_chains, -1, -1)
    before, after = (mean_function(m, v, x) for m, v in ((model, whitened), (moved, moved_whitened)))
    for one, other in zip(after, before, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=5e-3 * other.std().item())
    assert torch.equal(moved.layers[0].inducing_inputs[:, :12], x)
    assert moved.log_noise is model.log_noise
    for old, new in zip(model.layers, moved.layers, strict=True):
        assert new.log_variance is old.log_variance and new.log_lengthscale is old.log_lengthscale


@pytest.mark.parametrize("num_layers", [1, 2])
def test_relocating_among_more_data_than_inducing_inputs_keeps_a_smooth_function(num_layers):
    generator = seeded(1)
    model = chains(*(make_model(num_layers, 2, 1, 40, generator) for _ in range(2)))
    whitened = 0.5 * normal(generator, 2, model.num_whitened())
    data = Data(normal(generator, 300, 2), normal(generator, 300, 1))
    moved, moved_whitened = relocate(model, whitened, data, generator)
    x = data.x.expand(2, -1, -1)
    before, after = (mean_function(m, v, x) for m, v in ((model, whitened), (moved, moved_whitened)))
    error = (after - before).square().mean((1, 2)).sqrt()
    assert (error < 0.1 * before.std(dim=(1, 2))).all()
    # Each chain's centres are its own: those of its own layers' inputs, and of another clustering.
    assert not torch.equal(*moved.layers[0].inducing_inputs)


@pytest.mark.parametrize("num_rows", [1, 4, 7])
def test_few_rows_are_all_inducing_inputs(num_rows):
    x = normal(seeded(), num_rows, 3)
    centres = cluster(x, 7, seeded(1))
    assert centres.shape == (7, 3)
    assert torch.equal(centres[:num_rows], x)
    assert len(torch.unique(centres, dim=0)) == 7, "perturbed copies, not copies"
    assert torch.cdist(centres, x).amin(1).max() < 0.1 * 5 * math.sqrt(3)


def test_many_rows_are_clustered():
    """Three tight groups, three centres: each is its group's mean (k-means can also settle elsewhere: not here)."""
    middle = torch.tensor([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]]).double()
    x = (middle.unsqueeze(1) + 0.1 * normal(seeded(), 3, 50, 2)).flatten(0, 1)
    centres = cluster(x, 3, seeded(2))
    order = torch.cdist(middle, centres).argmin(1)
    torch.testing.assert_close(centres[order], x.view(3, 50, 2).mean(1), rtol=0, atol=1e-12)
    assert torch.equal(cluster(x, 3, seeded(2)), centres)


@pytest.mark.parametrize("num_rows", [3, 7, 50])
def test_rows_that_are_all_the_same_are_quietly_clustered_and_factorised(num_rows):
    x = torch.full((num_rows, 2), 0.5, dtype=torch.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # what the user's console would show
        centres = cluster(x, 7, seeded())
    assert centres.shape == (7, 2) and centres.isfinite().all()
    model = make_model(1, 2, 1, 7, seeded())
    model = model._replace(layers=(model.layers[0]._replace(inducing_inputs=centres),))
    assert factorise_all(model).factors[0].isfinite().all()


def test_restandardising_chains_is_restandardising_each():
    generator = seeded(1)
    models = [make_model(2, 3, 2, 6, generator) for _ in range(2)]
    whitened = normal(generator, 2, models[0].num_whitened())
    old, new = (
        tuple(Normaliser(normal(generator, n), 0.5 + normal(generator, n).square()) for n in (3, 2)) for _ in range(2)
    )
    together, moved = restandardise(chains(*models), whitened, old, new)
    for c, model in enumerate(models):
        alone, alone_moved = restandardise(model, whitened[c], old, new)
        torch.testing.assert_close(moved[c], alone_moved, rtol=1e-12, atol=1e-12)
        for a, b in zip(together.parameters(), alone.parameters(), strict=True):
            torch.testing.assert_close(a[c], b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("num_chains", [1, 3])
@pytest.mark.parametrize("num_layers", [1, 3])
def test_the_initial_model_has_the_published_settings(num_layers, num_chains):
    data = Data(normal(seeded(), 30, 4), normal(seeded(1), 30, 2))
    model = initial_model(KERNELS["matern32"], data, num_layers, 10, num_chains, seeded(2))
    for index, layer in enumerate(model.layers):
        variance = 1.0 if index == num_layers - 1 else 0.01
        torch.testing.assert_close(layer.variance, torch.full((num_chains,), variance, dtype=torch.float64))
        assert layer.kernel is KERNELS["matern32"]
        assert layer.inducing_inputs.shape == (num_chains, 10, 4)
        torch.testing.assert_close(layer.lengthscale, torch.full((num_chains, 4), 2.0, dtype=torch.float64))
        centres = layer.inducing_inputs
        assert torch.equal(centres, model.layers[0].inducing_inputs)
        assert not any(torch.equal(centres[0], other) for other in centres[1:]), "each chain has its own centres"
    assert len({layer.inducing_inputs.data_ptr() for layer in model.layers}) == num_layers, "each its own"
    assert model.noise_variance.shape == (num_chains, 2)
    torch.testing.assert_close(model.log_noise.exp(), torch.full((num_chains, 2), 0.05, dtype=torch.float64))
