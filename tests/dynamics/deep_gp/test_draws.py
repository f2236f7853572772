"""The draws of a trained model against the law that they are drawn from.

One layer: the closed-form conditional Gaussian. Two layers: samples of the numpy oracle, which conditions the dense
joint Gaussian of each layer. Draws are the particles here: half of them are of one chain, half of another, with
hyperparameters, inducing inputs and a whitened sample of its own, so that a particle that used another's would show.
Every particle has random features of its own, so that over particles the covariance is exact, for any number of them.
"""

import numpy as np
import pytest
import scipy.stats
import torch

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.dynamics.deep_gp.draws import ConditionalSampler, PathwiseSampler, Posterior
from gym_dgpmpc.gp.deep_gp import Factorised, factorise_all
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.gp.layer import conditional
from gym_dgpmpc.types import ObservationSpec
from tests.oracles import gaussian_process
from tests.oracles.models import chains, dense, make_model, normal, seeded

NUM_POINTS = 4
NUM_INDUCING = 6
ENCODER = Encoder(2, 1)
INPUTS = Normaliser(torch.tensor([0.3, -0.2, 0.1]).double(), torch.tensor([0.8, 1.5, 2.0]).double())
TARGETS = Normaliser(torch.tensor([0.5, -1.0]).double(), torch.tensor([0.2, 3.0]).double())
COORDINATES = Coordinates(ENCODER, INPUTS, TARGETS, torch.float64)

both_depths = pytest.mark.parametrize("num_layers", [1, 2])
every_kernel = pytest.mark.parametrize("kernel", KERNELS)


class World:
    """Two small models, a sample of the inducing outputs of each, and the points at which functions are looked at."""

    def __init__(self, kernel, num_layers, *, linear=False):
        generator = seeded(7)
        self.kernel, self.num_layers = kernel, num_layers
        sizes = num_layers, 3, 2, NUM_INDUCING
        self.models = [make_model(*sizes, generator, kernel, linear=linear) for _ in range(2)]
        self.factorised = factorise_all(chains(*self.models))
        flat = normal(generator, 2, self.models[0].num_whitened())
        self.whitened = self.factorised.model.split(flat)
        self.observation, self.action = normal(generator, NUM_POINTS, 2), normal(generator, NUM_POINTS, 1)
        # Two points close to each other, as candidates of a plan are.
        self.observation[1] = self.observation[0] + 0.2
        self.action[1] = self.action[0] - 0.1

    def posterior(self, particles_per_sample):
        chain = torch.arange(2).repeat_interleave(particles_per_sample)
        model, factors = self.factorised
        factorised = Factorised(model.at(chain), [factor[chain] for factor in factors])
        return Posterior(factorised, [v[chain] for v in self.whitened])

    def values(self, sampler, particles_per_sample, step=0, points=slice(None)):
        """f [2, particles, points, T] in standardised targets, through the sampler's raw units."""
        observation = self.observation[points].expand(2 * particles_per_sample, -1, -1).clone()
        after = sampler(observation, self.action[points], step)
        target = TARGETS(after - observation)
        return target.unflatten(0, (2, particles_per_sample)).numpy()

    def standardised_points(self):
        return INPUTS(torch.cat([self.observation, self.action], dim=1)).numpy()

    def exact_moments(self, sample, joint=True):
        """Mean [n T] and covariance [n T, n T] for one layer."""
        layer, v = dense(self.models[sample].layers[0]), self.whitened[0][sample].numpy()
        mean, covariance = gaussian_process.conditional(self.kernel, layer, v, self.standardised_points())
        covariance = covariance if joint else np.diag(np.diagonal(covariance))
        return mean.ravel(), np.kron(covariance, np.eye(2))

    def exact_samples(self, sample, num_samples, joint=True):
        """Samples [num_samples, n T] of the oracle, for any number of layers."""
        layers, rng = [dense(layer) for layer in self.models[sample].layers], np.random.default_rng(sample)
        whitened, points = [v[sample].numpy() for v in self.whitened], self.standardised_points()
        groups = [points] if joint else np.split(points, NUM_POINTS)
        drawn = [gaussian_process.sample(self.kernel, layers, whitened, x, num_samples, rng) for x in groups]
        return np.concatenate(drawn, axis=1).reshape(num_samples, -1)


def check_law(world, drawn, *, joint):
    """Means and covariances of ``drawn`` [2, draws, n, T], each to 5 standard errors (and a jitter of 1e-6)."""
    for sample, values in enumerate(drawn):
        draws = len(values)
        values = values.reshape(draws, -1)
        centred = values - values.mean(0)
        products = centred[:, :, None] * centred[:, None, :]
        found, error = products.mean(0), products.std(0) / np.sqrt(draws)
        mean_error = values.std(0) / np.sqrt(draws)
        if world.num_layers == 1:
            mean, covariance = world.exact_moments(sample, joint)
        else:  # against as many samples of the oracle: the errors of both add up
            oracle = world.exact_samples(sample, draws, joint)
            mean, covariance = oracle.mean(0), np.cov(oracle.T)
            error, mean_error = np.sqrt(2) * error, np.sqrt(2) * mean_error
        assert (abs(values.mean(0) - mean) < 5 * mean_error + 1e-4).all()
        assert (abs(found - covariance) < 5 * error + 1e-5).all()


@both_depths
@every_kernel
@pytest.mark.parametrize("joint", [True, False])
def test_values_drawn_from_the_conditional_have_its_moments(kernel, num_layers, joint):
    world = World(kernel, num_layers)
    sampler = ConditionalSampler(world.posterior(3000), COORDINATES, seeded(), joint=joint)
    first, second = (world.values(sampler, 3000, step) for step in range(2))
    check_law(world, first, joint=joint)
    check_law(world, second, joint=joint)
    check_uncorrelated(first, second)


def check_uncorrelated(first, second):
    """Each entry of a correlation matrix of independent draws errs by draws^-1/2."""
    for a, b in zip(first, second, strict=True):
        draws, size = len(a), a[0].size
        correlation = np.corrcoef(a.reshape(draws, size).T, b.reshape(draws, size).T)[:size, size:]
        assert abs(correlation).max() < 5 / np.sqrt(draws)


def pathwise(world, refresh, horizon=1, particles=2400, num_features=256):
    """One plan's draw.

    Given its features a function of the first layer is Gaussian, over all features a scale mixture of Gaussians with
    the exact covariance, of a kurtosis that exceeds a Gaussian's by some 1 / F. What that does to a second layer's
    moments is a share of the same order, a tenth of their standard errors.
    """
    posterior = world.posterior(particles)
    return PathwiseSampler(posterior, COORDINATES, horizon, num_features, refresh, torch.float64, seeded())


@pytest.mark.usefixtures("unchecked")  # thousands of particles, one after the other
@both_depths
@every_kernel
def test_functions_drawn_for_a_step_have_the_law_of_joint_values(kernel, num_layers):
    world = World(kernel, num_layers)
    sampler = pathwise(world, "step", horizon=2)
    first, second = (world.values(sampler, 2400, step) for step in (0, 1))
    check_law(world, first, joint=True)
    check_law(world, second, joint=True)
    check_uncorrelated(first, second)


@pytest.mark.usefixtures("unchecked")  # thousands of particles, one after the other
@both_depths
@every_kernel
def test_functions_drawn_for_a_plan_are_joint_over_time(kernel, num_layers):
    """Two points visited at step 0 and two at step 3 covary as four points visited at once."""
    world = World(kernel, num_layers)
    sampler = pathwise(world, "plan")
    early = world.values(sampler, 2400, 0, points=[0, 2])
    late = world.values(sampler, 2400, 3, points=[1, 3])
    drawn = np.stack([early[:, :, 0], late[:, :, 0], early[:, :, 1], late[:, :, 1]], axis=2)
    check_law(world, drawn, joint=True)


@pytest.mark.usefixtures("unchecked")
@both_depths
@pytest.mark.parametrize("draw", ["joint", "step", "plan"])
def test_a_linear_part_is_drawn_too(num_layers, draw):
    world = World("matern32", num_layers, linear=True)
    if draw == "joint":
        sampler = ConditionalSampler(world.posterior(2400), COORDINATES, seeded(), joint=True)
    else:
        sampler = pathwise(world, draw)
    check_law(world, world.values(sampler, 2400), joint=True)


@pytest.mark.usefixtures("unchecked")
@every_kernel
@pytest.mark.parametrize("refresh", ["step", "plan"])
def test_the_particles_of_one_plan_spread_as_the_conditional_says(kernel, refresh):
    """Near the inducing inputs, where the data are, and elsewhere; every particle of the same chain and sample.

    Features shared by the particles would err by F^-1/2 of the prior's variance, in one direction for all of them:
    far too wide or too narrow a spread where the conditional is much narrower than the prior.
    """
    generator, num_particles, num_features = seeded(1), 400, 128
    model = make_model(1, 3, 2, 40, generator, kernel)
    (layer,), factorised = model.layers, factorise_all(model)
    (factor,), v = factorised.factors, normal(generator, 40, 2)
    near = layer.inducing_inputs[:20] + 0.3 * normal(generator, 20, 3)
    x = torch.cat([near, 1.5 * normal(generator, 20, 3)])
    particles = Factorised(chains(*[model] * num_particles), [factor.expand(num_particles, -1, -1)])
    posterior = Posterior(particles, [v.expand(num_particles, -1, -1)])
    sampler = PathwiseSampler(posterior, COORDINATES, 1, num_features, refresh, torch.float64, generator)
    raw = INPUTS.inverse(x)
    observation = raw[:, :2].expand(num_particles, -1, -1).clone()
    drawn = TARGETS(sampler(observation, raw[:, 2:], 0) - observation)
    _, variance = conditional(layer, factor, v, x)
    ratio = drawn.var(0) / variance.unsqueeze(-1)
    for part in (ratio[:20], ratio[20:]):
        assert 0.9 < part.sqrt().median() < 1.1
    # The mean of n squares of normals, whose variance is over features s, of the mean s^2: its own variance is
    # (2 + 3 var(s) / s^4) / n. A pair of features at a point has the variance s^2 on average and at most about
    # sigma^2, so var(s) / s^4 is at most 2 sigma^2 / (F s^2): a chi-square of so many degrees of freedom less.
    excess = 2 * float(layer.variance) / (num_features * variance.unsqueeze(-1))
    degrees = num_particles * 2 / (2 + 3 * excess)
    alpha = 1e-4 / ratio.numel()
    lower, upper = (torch.from_numpy(scipy.stats.chi2(degrees).ppf(q)) / degrees for q in (alpha / 2, 1 - alpha / 2))
    assert ((ratio > lower) & (ratio < upper)).all()


@both_depths
@every_kernel
def test_a_function_drawn_for_a_plan_is_one_function(kernel, num_layers):
    world = World(kernel, num_layers)
    sampler = PathwiseSampler(world.posterior(2), COORDINATES, 4, 64, "plan", torch.float64, seeded())
    at_once = world.values(sampler, 2, 0)
    assert np.array_equal(world.values(sampler, 2, 3), at_once)
    one_by_one = np.concatenate([world.values(sampler, 2, k, points=[k]) for k in range(NUM_POINTS)], axis=2)
    # Sums in another order: rounding of the terms of the sum, k(x, Z) alpha, which cancel.
    np.testing.assert_allclose(one_by_one, at_once, atol=1e-8)
    assert abs(at_once[0, 0] - at_once[0, 1]).min() > 1e-6, "particles with the same sample have other functions"


@every_kernel
@pytest.mark.parametrize("refresh", ["step", "plan"])
def test_functions_pass_through_the_inducing_outputs(kernel, refresh):
    """Wherever the model is certain, every draw agrees with it, whatever its features: at the inducing inputs."""
    world = World(kernel, 1)
    sampler = PathwiseSampler(world.posterior(3), COORDINATES, 2, 64, refresh, torch.float64, seeded())
    for chain, model in enumerate(world.models):
        raw = INPUTS.inverse(model.layers[0].inducing_inputs)
        observation = raw[:, :2].expand(6, -1, -1).clone()
        target = TARGETS(sampler(observation, raw[:, 2:], 1) - observation)[3 * chain : 3 * chain + 3]
        u = world.factorised.factors[0][chain] @ world.whitened[0][chain]
        # The jitter leaves a standard deviation of sqrt(1e-6) sigma to each inducing output, and to its draw as much.
        assert (target - u).abs().max() < 6 * np.sqrt(2e-6 * float(model.layers[0].variance))


@both_depths
@every_kernel
def test_candidates_in_one_place_move_alike(kernel, num_layers):
    world = World(kernel, num_layers)
    world.observation[1], world.action[1] = world.observation[0], world.action[0]
    pair = []
    for sampler in (
        ConditionalSampler(world.posterior(50), COORDINATES, seeded(), joint=True),
        PathwiseSampler(world.posterior(50), COORDINATES, 1, 64, "step", torch.float64, seeded()),
    ):
        values = world.values(sampler, 50)
        pair.append(abs(values[:, :, 0] - values[:, :, 1]).max())
    # A jitter of 1e-6 keeps values that are drawn jointly apart by 1e-3; Matern-1/2 makes sqrt(1e-3) of it inside.
    assert pair[0] < (0.02 if num_layers == 1 or kernel != "matern12" else 0.3)
    assert pair[1] < 1e-8


@pytest.mark.parametrize("draw", ["joint", "marginal", "step", "plan"])
def test_the_generator_decides_the_draw_and_the_argument_is_left_alone(draw):
    world, results = World("matern32", 2), []
    for seed in (0, 0, 1):
        if draw in ("joint", "marginal"):
            sampler = ConditionalSampler(world.posterior(3), COORDINATES, seeded(seed), joint=draw == "joint")
        else:
            sampler = PathwiseSampler(world.posterior(3), COORDINATES, 2, 32, draw, torch.float64, seeded(seed))
        observation = world.observation.expand(6, -1, -1).clone()
        after = [sampler(observation, world.action, step) for step in range(2)]
        assert torch.equal(observation, world.observation.expand(6, -1, -1))
        results.append(torch.stack(after))
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])
    same = torch.equal(results[0][0], results[0][1])
    assert same == (draw == "plan"), "only one function per plan repeats itself"


def test_rollouts_may_change_their_number_of_candidates():
    """The buffers of an earlier rollout must not show in a later one of another size."""
    world = World("matern52", 2)
    sampler = PathwiseSampler(world.posterior(2), COORDINATES, 4, 32, "plan", torch.float64, seeded())
    before = world.values(sampler, 2)
    few = world.values(sampler, 2, points=[2])
    again = world.values(sampler, 2)
    assert np.array_equal(before, again)
    np.testing.assert_allclose(few[:, :, 0], before[:, :, 2], atol=1e-8)


@pytest.mark.parametrize(
    "spec",
    [
        ObservationSpec(),
        ObservationSpec(angles=(1,)),
        ObservationSpec(absolute=(0,), not_inputs=(0,)),
        ObservationSpec(constant=(2,)),
        ObservationSpec(angles=(1,), absolute=(0, 2), not_inputs=(0,), constant=(2,)),
    ],
)
def test_coordinates_are_encoder_and_normaliser_in_one(spec):
    encoder, generator = Encoder(3, 2, spec), seeded()
    inputs, targets = (
        Normaliser(normal(generator, size), 0.5 + normal(generator, size).square())
        for size in (encoder.input_size, encoder.target_size)
    )
    coordinates = Coordinates(encoder, inputs, targets, torch.float64)
    observation, action = normal(generator, 4, 5, 3), normal(generator, 5, 2)
    encoded = coordinates.encode(observation, action)
    expected = inputs(encoder.inputs(observation, action.expand(4, -1, -1)))
    torch.testing.assert_close(encoded, expected, rtol=1e-12, atol=1e-12)
    target = 0.1 * normal(generator, 4, 5, encoder.target_size)  # less than half a turn, of which there is one way back
    after = coordinates.decode(observation, target)
    expected = targets.inverse(target)
    torch.testing.assert_close(encoder.targets(observation, after), expected, rtol=1e-12, atol=1e-12)
    assert torch.equal(after[..., list(spec.constant)], observation[..., list(spec.constant)])
