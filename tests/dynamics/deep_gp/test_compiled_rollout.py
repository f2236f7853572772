"""Compiled rollouts against the same functions evaluated step by step with PyTorch, in single and double precision."""

import math
import os
import platform
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from gym_dgpmpc import compiler
from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.dynamics.bounds import SeenTargets
from gym_dgpmpc.dynamics.coordinates import Coordinates
from gym_dgpmpc.dynamics.deep_gp.draws import CompiledPathwiseSampler, PathwiseSampler, Posterior
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics, compiled_rollout
from gym_dgpmpc.dynamics.noise import ObservationNoise
from gym_dgpmpc.gp.deep_gp import factorise_all
from gym_dgpmpc.gp.kernels import KERNELS, RBF
from gym_dgpmpc.planning.rollout import rollout
from gym_dgpmpc.types import ObservationSpec, Transitions
from tests.oracles.models import chains, make_model, normal, seeded

HORIZON, PARTICLES = 6, 3
SPECS = [
    ObservationSpec(),
    ObservationSpec(angles=(1,)),
    ObservationSpec(angles=(1,), absolute=(0, 2), not_inputs=(0,), constant=(2,)),
    ObservationSpec(angles=(1,), body_frame=((1, 2, 0),)),
    ObservationSpec(absolute=(0, 2), not_inputs=(0, 1, 2), body_frame=((1, 0, 2),)),
    ObservationSpec(constant=(0, 1), body_frame=((2, 0, 1),)),
]

pytestmark = pytest.mark.skipif(not compiled_rollout.is_available(), reason="no C++ compiler works here")


class Draw:
    """The same functions, drawn from the same generator, as compiled code and as PyTorch in two precisions.

    Each particle is of a chain of its own, with hyperparameters and inducing inputs that no other has.
    """

    def __init__(
        self,
        kernel,
        num_layers,
        spec=SPECS[1],
        refresh="step",
        num_inducing=13,
        num_features=22,
        offset=0.0,
        with_noise=False,
        seen=None,
        linear=False,
    ):
        generator = seeded(3)
        encoder = Encoder(3, 2, spec)
        # Small steps: the rounding of one step is not to be amplified much by the next ones.
        inputs, targets = (
            Normaliser(0.1 * normal(generator, size), 0.8 + 0.1 * normal(generator, size).square())
            for size in (encoder.input_size, encoder.target_size)
        )
        inputs.mean[: len(encoder.plain)] += (torch.zeros(3).double() + offset)[encoder.plain]
        targets.mean.add_(((torch.zeros(3).double() + offset) * (1.0 - encoder.carried))[encoder.predicted])
        sizes = num_layers, encoder.input_size, encoder.target_size, num_inducing
        model = chains(*(make_model(*sizes, generator, linear=linear) for _ in range(PARTICLES)))
        names = kernel if isinstance(kernel, tuple) else (kernel,) * num_layers
        layers = zip(model.layers, names, strict=True)
        model = model._replace(layers=tuple(layer._replace(kernel=KERNELS[name]) for layer, name in layers))
        whitened = model.split(normal(generator, PARTICLES, model.num_whitened()))
        posterior = Posterior(factorise_all(model), whitened)

        noise = None
        if with_noise:
            predicted, centre = torch.zeros(3).double(), normal(generator, 3) + offset
            predicted[encoder.predicted] = 1.0
            blur = ObservationNoise(0.3 * predicted, 0.1 * predicted, centre)
            noise = 0.1 + 0.1 * torch.rand(PARTICLES, encoder.target_size, generator=generator).double(), blur

        def sampler(dtype):
            coordinates = Coordinates(encoder, inputs, targets, dtype, seen)
            return PathwiseSampler(posterior, coordinates, HORIZON, num_features, refresh, dtype, seeded(), noise)

        single = Coordinates(encoder, inputs, targets, torch.float32, seen)
        self.compiled = CompiledPathwiseSampler(posterior, single, HORIZON, num_features, refresh, seeded(), noise)
        self.single, self.double = sampler(torch.float32), sampler(torch.float64)
        self.observation = normal(generator, 3).float()
        self.generator = generator

    def actions(self, num_candidates):
        return normal(self.generator, num_candidates, HORIZON, 2).float()


def errors(draw, actions):
    """Largest error of a compiled step and of one by PyTorch in single precision, against double precision.

    All from the same states, those that the compiled steps reached: how chaotic the functions are plays no part, and
    where states have grown, so has the rounding of both.
    """
    found = draw.compiled.trajectories(draw.observation, actions)
    assert found.shape == (HORIZON + 1, PARTICLES, len(actions), 3)
    assert torch.equal(found[0], draw.observation.expand_as(found[0]))
    exact = torch.stack([draw.double(found[t].double(), actions[:, t].double(), t) for t in range(HORIZON)])
    by_torch = torch.stack([draw.single(found[t].clone(), actions[:, t], t) for t in range(HORIZON)])
    return (found[1:] - exact).abs().max(), (by_torch - exact).abs().max()


@pytest.mark.parametrize("num_layers", [1, 3])
@pytest.mark.parametrize("refresh", ["step", "plan"])
def test_a_linear_part_is_as_exact(num_layers, refresh):
    draw = Draw("matern32", num_layers, refresh=refresh, linear=True)
    compiled, by_torch = errors(draw, draw.actions(40))
    assert compiled < max(10 * by_torch, 1e-5)
    assert all((layer.linear_out is not None) == (layer is draw.single.layers[-1]) for layer in draw.single.layers)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("num_layers", [1, 3])
@pytest.mark.parametrize("spec", SPECS)
@pytest.mark.parametrize("refresh", ["step", "plan"])
def test_is_as_exact_as_pytorch_in_single_precision(kernel, num_layers, spec, refresh):
    draw = Draw(kernel, num_layers, spec, refresh)
    compiled, by_torch = errors(draw, draw.actions(40))
    # Rounding differs, its size does not: the state's magnitude times that of the weights, in units of 6e-8.
    assert compiled < max(10 * by_torch, 1e-5)


@pytest.mark.parametrize("spec", SPECS)
@pytest.mark.parametrize("refresh", ["step", "plan"])
def test_is_as_exact_with_noise(spec, refresh):
    draw = Draw("matern32", 2, spec, refresh, with_noise=True)
    actions = draw.actions(40)
    compiled, by_torch = errors(draw, actions)
    assert compiled < max(10 * by_torch, 1e-5)
    constant = list(spec.constant)
    states = draw.compiled.trajectories(draw.observation, actions)
    assert torch.equal(states[..., constant], draw.observation[constant].expand(*states.shape[:3], -1))
    # The same luck for all candidates, and not that of the other particles.
    alike = draw.compiled.trajectories(draw.observation, actions[:1].expand(3, -1, -1))
    assert torch.equal(alike[:, :, 0], alike[:, :, 2])
    silent = Draw("matern32", 2, spec, refresh).compiled.trajectories(draw.observation, actions)
    others = [i for i in range(3) if i not in constant]
    assert ((states - silent)[1:, ..., others].abs().amax((0, 2)) > 1e-3).all()


def test_steps_keep_within_their_bounds_as_by_pytorch():
    """Of one target they are so narrow that each step meets them, of the others wide: of these nothing changes."""
    free, actions = Draw("matern32", 2, SPECS[0], with_noise=True), Draw("matern32", 2).actions(40)
    wide = torch.full((3,), 50.0, dtype=torch.float64)
    narrow = SeenTargets(torch.tensor([-50.0, 0.01, -50.0]).double(), torch.tensor([50.0, 0.02, 50.0]).double())
    untouched = Draw("matern32", 2, SPECS[0], with_noise=True, seen=SeenTargets(-wide, wide))
    states = free.compiled.trajectories(free.observation, actions)
    assert torch.equal(untouched.compiled.trajectories(free.observation, actions), states)
    bounded = Draw("matern32", 2, SPECS[0], with_noise=True, seen=narrow)
    compiled, by_torch = errors(bounded, actions)
    assert compiled < max(10 * by_torch, 1e-5)
    # The first step alone begins from the same states.
    found = bounded.compiled.trajectories(bounded.observation, actions)
    assert torch.equal(found[1, ..., [0, 2]], states[1, ..., [0, 2]])
    assert (found[1, ..., 1] - states[1, ..., 1]).abs().max() > 1e-3
    actions[1, 2] = math.nan
    spoilt = bounded.compiled.trajectories(bounded.observation, actions)
    assert spoilt[3:, :, 1].isnan().all(), "a bound is no way back from NaN"
    others = [0, *range(2, 40)]
    assert torch.equal(spoilt[:, :, others], found[:, :, others])


@pytest.mark.parametrize("kernel", KERNELS)
def test_far_from_the_inducing_inputs_and_on_them(kernel):
    """Vanishing kernels, many turns of the features and angles, and distances of exactly zero."""
    draw = Draw(kernel, 1, ObservationSpec())
    scale = draw.single.layers[0].inverse_lengthscale
    centre = (draw.single.layers[0].centres[..., 0] / scale)[1]  # some multiple of a particle's first inducing input
    for observation in (torch.full((3,), 40.0), torch.zeros(3), centre[:3]):
        draw.observation = observation
        compiled, by_torch = errors(draw, draw.actions(5))
        # cos of a phase phi errs by the rounding of phi.
        assert compiled < max(10 * by_torch, 1e-6 * observation.abs().max(), 1e-5)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="these are flags for other processors")
@pytest.mark.parametrize("without", ["-mno-avx512f", "-mno-avx512f -mno-avx2 -mno-fma"])
def test_processors_with_shorter_vectors_are_as_exact(without, monkeypatch, tmp_path):
    monkeypatch.setenv("CXX", " ".join([*compiler.find_compiler(), without]))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    remembered = compiler.load, compiled_rollout._library
    try:
        for each in remembered:
            each.cache_clear()
        for kernel in KERNELS:
            draw = Draw(kernel, 2)
            actions = draw.actions(37)
            compiled, by_torch = errors(draw, actions)
            assert compiled < max(10 * by_torch, 1e-5)
            alone = torch.cat([draw.compiled.trajectories(draw.observation, a[None]) for a in actions], dim=2)
            assert torch.equal(draw.compiled.trajectories(draw.observation, actions), alone)
    finally:
        for each in remembered:
            each.cache_clear()


@pytest.mark.parametrize(("num_inducing", "num_features"), [(16, 32), (16, 22), (13, 32), (1, 2)])
def test_inducing_inputs_and_features_may_fill_their_blocks_or_not(num_inducing, num_features):
    """Blocks are of 4 inducing inputs and 2 frequencies: what is padded computes nothing, nothing beyond it is read."""
    draw = Draw("matern32", 2, num_inducing=num_inducing, num_features=num_features)
    compiled, by_torch = errors(draw, draw.actions(7))
    assert compiled < max(10 * by_torch, 1e-5)


@pytest.mark.parametrize("num_inducing", [13, 16])
def test_every_particle_has_a_model_of_its_own(num_inducing):
    """With other hyperparameters and inducing inputs of one particle the others roll out as before, bit by bit."""
    draw = Draw("matern32", 2, num_inducing=num_inducing)
    actions = draw.actions(5)
    before = draw.compiled.trajectories(draw.observation, actions)
    for name in ("inverse_lengthscale", "centres", "offsets", "frequencies"):
        layers = []
        for layer in draw.compiled.layers:
            changed = getattr(layer, name).clone()
            changed[1] *= 1.1
            layers.append(layer._replace(**{name: changed}))
        after = compiled_rollout.CompiledRollout(layers, draw.compiled.coordinates)(draw.observation, actions)
        assert torch.equal(after[:, [0, 2]], before[:, [0, 2]])
        assert (after[1:, 1] - before[1:, 1]).abs().amax() > 1e-4, name


def test_every_layer_may_have_a_kernel_of_its_own():
    kernels = ("matern12", "rbf", "matern72")
    draw = Draw(kernels, 3)
    compiled, by_torch = errors(draw, draw.actions(40))
    assert compiled < max(10 * by_torch, 1e-5)
    swapped = Draw(kernels[::-1], 3)
    actions = draw.actions(3)
    first, second = (each.compiled.trajectories(draw.observation, actions)[1] for each in (draw, swapped))
    assert (first - second).abs().max() > 0.01, "the order of the kernels plays no part"


class Own(RBF):
    """A kernel of somebody else's, which the compiled code has not heard of."""

    name = "own"


def test_a_kernel_that_the_compiled_code_does_not_have_is_left_to_pytorch(monkeypatch, unchecked):
    """With one warning from training and one from plans; none where none is wanted. The plans are the same."""
    monkeypatch.setitem(KERNELS, "own", Own())
    compiler.warn_once.cache_clear()
    observation = normal(seeded(), 10, 3).float()
    worlds = []
    for kernel, compile in (("own", True), ("rbf", False), ("own", False), ("own", True)):
        model = DeepGPDynamics(
            3,
            2,
            kernel=kernel,
            num_inducing=5,
            first_training_iterations=2,
            num_samples=2,
            num_chains=2,
            compile=compile,
        )
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model.fit(Transitions(observation, observation[:, :2], observation), seeded())
            worlds.append(model.draw(2, 3, seeded()))
        said = [str(warning.message) for warning in caught]
        assert len(said) == 2 * (len(worlds) == 1) and all("kernel 'own'" in text for text in said)
        assert not isinstance(worlds[-1], CompiledPathwiseSampler)
    states = [world(observation.expand(2, -1, -1).clone(), observation[:, :2], 0) for world in worlds]
    assert all(torch.equal(states[0], other) for other in states[1:])


def test_a_compiled_world_of_an_unknown_kernel_is_an_error(monkeypatch, unchecked):
    monkeypatch.setitem(KERNELS, "own", Own())
    with pytest.raises(RuntimeError, match="kernel 'own'"):
        Draw("own", 1)


def test_large_angles_keep_their_digits():
    draw = Draw("rbf", 1, SPECS[1])
    draw.observation = torch.tensor([0.1, 1000.0, 0.2])
    compiled, _ = errors(draw, draw.actions(5))
    assert compiled < 1000 * 2e-7 * 5  # an angle of 1000 is itself rounded to 3e-5


@pytest.mark.parametrize("num_candidates", [1, 33, 64, 65, 140])
def test_any_number_of_candidates_and_threads(num_candidates):
    draw = Draw("matern32", 2)
    actions = draw.actions(num_candidates)
    threads = torch.get_num_threads()
    try:
        found = []
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            found.append(draw.compiled.trajectories(draw.observation, actions))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])
    alone = torch.cat([draw.compiled.trajectories(draw.observation, a[None]) for a in actions], dim=2)
    assert torch.equal(found[0], alone), "a candidate's trajectory depends on its neighbours"


FORKED = """
import multiprocessing, torch
from tests.dynamics.deep_gp.test_compiled_rollout import Draw
torch.set_num_threads(2)
draw = Draw("rbf", 1)
actions = draw.actions(100)
expected = draw.compiled.trajectories(draw.observation, actions)
def same(_): return torch.equal(draw.compiled.trajectories(draw.observation, actions), expected)
with multiprocessing.get_context("fork").Pool(1) as pool:
    print(pool.map_async(same, [0]).get(timeout=20))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_child_has_threads_of_its_own():
    """The parent's are not in it, and it would wait for them for ever."""
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", FORKED], cwd=root, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout == "[True]\n", done.stderr


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e30])
def test_what_is_not_finite_never_becomes_finite(kernel, value):
    draw = Draw(kernel, 2, ObservationSpec())
    actions = draw.actions(4)
    actions[2, 3, 0] = value
    states = draw.compiled.trajectories(draw.observation, actions)
    assert states[:4, :, 2].isfinite().all()
    if abs(value) != 1e30:  # an action that is only large has a cosine like any other
        assert states[4:, :, 2].isnan().all()
    others = [0, 1, 3]
    assert states[:, :, others].isfinite().all()


def test_the_argument_may_be_a_view_of_another_precision():
    draw = Draw("matern52", 1)
    actions = draw.actions(8)
    expected = draw.compiled.trajectories(draw.observation, actions)
    strided = torch.stack([actions, actions], dim=-1).double()[..., 0]
    assert torch.equal(draw.compiled.trajectories(draw.observation, strided), expected)


@pytest.mark.parametrize("spec", SPECS[:3])
@pytest.mark.parametrize("with_noise", [False, True])
def test_float64_states_far_from_zero_are_as_exact_as_near_it(spec, with_noise):
    offset = torch.tensor([1e6, 2 * math.pi * 1e6, 5e5], dtype=torch.float64)
    draw = Draw("matern32", 2, spec, offset=offset, with_noise=with_noise)
    observation, actions = draw.observation.double() + offset, draw.actions(20)
    for sampler in (draw.compiled, draw.single):
        found = rollout(sampler, observation, actions, PARTICLES)
        assert found.dtype == torch.float64 and torch.equal(found[0], observation.expand_as(found[0]))
        stepped = torch.stack([draw.double(found[t], actions[:, t].double(), t) for t in range(HORIZON)])
        assert (found[1:] - stepped).abs().max() < 1e-5  # as near zero; float32 rounds 1e6 by 0.03


@pytest.mark.parametrize(
    ("observation_size", "action_size", "horizon", "message"),
    [
        (2, 2, HORIZON, r"observation .*\(3,\).*\(2,\)"),
        (3, 1, HORIZON, rf"actions .*\b2\].*\(4, {HORIZON}, 1\)"),
        (3, 2, HORIZON + 1, rf"actions .*\b{HORIZON}\b.*\b{HORIZON + 1}\b"),
    ],
)
def test_sizes_that_are_not_the_draws_are_refused(observation_size, action_size, horizon, message):
    """The compiled code would read beyond its arrays."""
    sampler = Draw("rbf", 1).compiled
    with pytest.raises(ValueError, match=message):
        sampler.trajectories(torch.zeros(observation_size), torch.zeros(4, horizon, action_size))


def test_functions_for_a_whole_plan_serve_one_of_any_length():
    sampler = Draw("rbf", 1, refresh="plan").compiled
    assert sampler.trajectories(torch.zeros(3), torch.zeros(4, 2 * HORIZON, 2)).isfinite().all()


def test_noise_is_drawn_for_so_many_steps():
    sampler = Draw("rbf", 1, refresh="plan", with_noise=True).compiled
    with pytest.raises(ValueError, match=rf"actions .*\b{HORIZON}\b.*\b{HORIZON + 1}\b"):
        sampler.trajectories(torch.zeros(3), torch.zeros(4, HORIZON + 1, 2))


@pytest.mark.parametrize("refresh", ["step", "plan"])
@pytest.mark.parametrize("add_noise", [False, True])
def test_the_model_draws_compiled_worlds_and_plans_alike_without(refresh, add_noise):
    generator = seeded()
    observation, action = normal(generator, 60, 3).float(), normal(generator, 60, 2).float()
    data = Transitions(observation, action, observation + 0.1 * observation.flip(1).tanh())
    results = []
    for compile in (True, False):
        model = DeepGPDynamics(
            3,
            2,
            num_inducing=20,
            num_features=32,
            first_training_iterations=20,
            num_samples=4,
            num_chains=2,
            refresh=refresh,
            add_noise=add_noise,
            compile=compile,
        )
        model.fit(data, seeded(1))
        world = model.draw(PARTICLES, HORIZON, seeded(2))
        assert isinstance(world, CompiledPathwiseSampler) == compile
        results.append(rollout(world, observation[0], normal(seeded(4), 50, HORIZON, 2).float(), PARTICLES))
    torch.testing.assert_close(results[0], results[1], rtol=1e-3, atol=1e-3)


def test_double_precision_is_rolled_out_by_pytorch():
    model = DeepGPDynamics(
        3, 2, num_inducing=5, first_training_iterations=2, num_samples=2, num_chains=1, dtype=torch.float64
    )
    observation = normal(seeded(), 10, 3).float()
    model.fit(Transitions(observation, observation[:, :2], observation), seeded())
    assert not isinstance(model.draw(2, 3, seeded()), CompiledPathwiseSampler)
