"""What is measured, each function one worker process: rows of plain values, one for each figure."""

import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch

from benchmarks.rows import Row
from benchmarks.speed import floor, peers
from benchmarks.speed.cases import (
    BATCH_SIZE,
    BY_STEP,
    DRAWS,
    NUM_CANDIDATES,
    NUM_PARTICLES,
    Case,
    deep_gp,
    peak_memory_mb,
    plan_call,
    planner,
    random_actions,
    reward,
    seeded,
    step_call,
    timed,
    transitions,
)
from benchmarks.speed.inductor import compiled_step
from gym_dgpmpc.data.normaliser import Normaliser
from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.dynamics.deep_gp.start import initial_model
from gym_dgpmpc.inference import sghmc
from gym_dgpmpc.inference.sampler import Chains, initial_state
from gym_dgpmpc.inference.training import BURN_IN
from gym_dgpmpc.planning.rollout import particle_returns, rollout
from gym_dgpmpc.settings import settings_of
from gym_dgpmpc.types import Transitions

NUM_TRANSITIONS = 600


def plans(case: Case, num_layers: int, repeats: int) -> Iterator[Row]:
    """A plan by each draw, and a rollout step beside GPyTorch's."""
    data = transitions(case, NUM_TRANSITIONS)
    steps = case.horizon * case.num_iterations
    for name, settings in DRAWS.items():
        model, row = deep_gp(case, num_layers, data, **settings), {"what": "plan", "how": name}
        if name in BY_STEP:
            by = {"by": f"one rollout step times {steps}"}
            yield row | by | timed(step_call(case, model, data), repeats, steps)
            continue
        before = peak_memory_mb()
        call = plan_call(case, model, data)
        call()
        yield row | {"extra_memory_mb": peak_memory_mb() - before} | timed(call, repeats)
        if not settings.get("compile", True):
            continue
        world, actions = model.draw(NUM_PARTICLES, case.horizon, seeded(1)), random_actions(case)
        rollouts = partial(rollout, world, data.observation[0], actions, NUM_PARTICLES)
        yield {"what": "rollout step", "how": name} | timed(rollouts, repeats, 1.0 / case.horizon)
    bare = {"what": "bare arithmetic of a plan", "how": "PyTorch"}
    yield bare | timed(floor.bare_step(case, num_layers), repeats, steps)
    predict = peers.gpytorch_calls(case, num_layers)["prediction"]
    yield {"what": "rollout step", "how": "GPyTorch"} | timed(predict, repeats)


def pets(case: Case, num_layers: int, repeats: int) -> Iterator[Row]:
    """A plan through PETS's networks; ``num_layers`` is only that of the deep GP that they stand beside."""
    data = transitions(case, NUM_TRANSITIONS)
    for how, settings in (("PETS, float32", {}), ("PETS, bfloat16 inside", {"half_precision": True})):
        yield {"what": "plan", "how": how} | timed(peers.pets_plan(case, data, **settings), repeats)


TOGETHER = 20
"""Training iterations that are timed together, so that each has its share of what is not done in every one."""


def chains(model: DeepGPDynamics, data: Transitions, repeats: int, *, compile: bool = True) -> Chains:
    """The sampler of a model's posterior, at the beginning of a training that lasts for all repeats."""
    generator = seeded(0)
    x, y = model._encode(data)
    standardised = Data(Normaliser.fit(x)(x), Normaliser.fit(y)(y))
    start = initial_model(model.kernel, standardised, model.num_layers, model.num_inducing, model.num_chains, generator)
    whitened = sghmc.init(x.new_zeros(model.num_chains, start.num_whitened()))
    state = initial_state(start, whitened, standardised.num_rows, generator)
    burn_in = round(BURN_IN * TOGETHER * (repeats + 2))
    return Chains(start, state, standardised, model.inference, burn_in, compile=compile)


def iteration(run: Chains, repeats: int) -> dict[str, float]:
    """Milliseconds of a training iteration."""
    generator = seeded(0)

    def iterate() -> None:
        for _ in range(TOGETHER):
            run.step(generator)

    return timed(iterate, repeats, 1 / TOGETHER)


def training(case: Case, num_layers: int, repeats: int) -> Iterator[Row]:
    """A training iteration and an SG-HMC step alone, both of all chains, and GPyTorch's training step, of one model.

    An iteration is the mean of some, so that it has its share of steps of the hyperparameters, and of an exact draw.
    """
    data, generator = transitions(case, NUM_TRANSITIONS), seeded(0)
    model = deep_gp(case, num_layers, data)
    row = {"what": "training iteration"}
    for how, compile in (("this package, PyTorch", False), ("this package", True)):
        run, ours = chains(model, data, repeats, compile=compile), {"how": how, "chains": model.num_chains}
        yield row | ours | iteration(run, repeats)
    bare = floor.bare_training(num_layers, BATCH_SIZE, model.num_chains, model.inference.hyperparameters_every)
    yield (
        row
        | {"how": "bare arithmetic", "chains": model.num_chains}
        | timed(bare, repeats, 1 / model.inference.hyperparameters_every)
    )
    yield row | {"how": "GPyTorch"} | timed(peers.gpytorch_calls(case, num_layers)["training step"], repeats)
    yield {"what": "SG-HMC step"} | ours | timed(partial(run.step, generator, frozen=True), repeats)
    resample = partial(model.resample, data, generator)
    yield {"what": "re-sampling within an episode", "how": "this package"} | timed(resample, repeats)


def parts(case: Case, num_layers: int, repeats: int) -> Iterator[Row]:
    """Where a plan's time goes, and how near its products come to what the processor does in a large product."""
    data, cem, generator = transitions(case, NUM_TRANSITIONS), planner(case), seeded(1)
    actions, scores = random_actions(case), torch.rand(NUM_CANDIDATES, generator=generator)
    model = deep_gp(case, num_layers, data)
    world = model.draw(NUM_PARTICLES, case.horizon, generator)
    states = rollout(world, data.observation[0], actions, NUM_PARTICLES)
    square = torch.randn(1500, 1500, generator=generator)
    peak = timed(partial(torch.mm, square, square, out=torch.empty(1500, 1500)), repeats)["p50_ms"]
    row, times = {"what": "part of a plan"}, case.num_iterations

    yield row | {"how": "whole"} | timed(plan_call(case, model, data), repeats)
    draw = partial(model.draw, NUM_PARTICLES, case.horizon, generator)
    yield row | {"how": "drawing the functions"} | timed(draw, repeats)
    rollouts = timed(partial(rollout, world, data.observation[0], actions, NUM_PARTICLES), repeats, times)
    flops = floor.rollout_flops(case, num_layers) * case.horizon * times
    speeds = {"product_gflops": flops / rollouts["p50_ms"] / 1e6, "large_product_gflops": 2.0 * 1500**3 / peak / 1e6}
    yield row | {"how": "rollouts"} | speeds | rollouts
    yield (
        row | {"how": "rewards and returns"} | timed(partial(particle_returns, states, actions, reward), repeats, times)
    )
    yield (
        row | {"how": "CEM itself"} | timed(partial(cem.plan, lambda _: scores, cem.initial_plan(), generator), repeats)
    )
    follow = partial(model.resample, data, generator)
    yield {"what": "beside a plan", "how": "following the last transitions"} | timed(follow, repeats)


def inductor(case: Case, num_layers: int, repeats: int) -> Iterator[Row]:
    """A rollout step by `torch.compile`."""
    data = transitions(case, NUM_TRANSITIONS)
    step, seconds = compiled_step(case, deep_gp(case, num_layers, data), data)
    yield {"what": "rollout step", "how": "torch.compile", "seconds_to_compile": seconds} | timed(step, repeats)


def scaling(case: Case, num_layers: int, repeats: int) -> Iterator[Row]:
    """A plan against K and M; a plan, a re-sampling and a training against N."""
    data = transitions(case, NUM_TRANSITIONS)
    for num_candidates in (100, 300, 1000):
        call = plan_call(case, deep_gp(case, num_layers, data), data, num_candidates)
        yield {"what": "plan", "varied": "K", "value": num_candidates} | timed(call, repeats)
    for num_inducing in (100, 200, 400):
        call = plan_call(case, deep_gp(case, num_layers, data, num_inducing=num_inducing), data)
        yield {"what": "plan", "varied": "M", "value": num_inducing} | timed(call, repeats)
    for num_rows in (1_000, 10_000, 100_000):
        many, varied, before = transitions(case, num_rows), {"varied": "N", "value": num_rows}, peak_memory_mb()
        model = deep_gp(case, num_layers, many)
        model.training_iterations = 30
        started = time.perf_counter()
        model.fit(many, seeded(0))
        whole = {"p50_ms": 1e3 * (time.perf_counter() - started), "repeats": 1}
        yield {"what": "a later fit, of 30 iterations and 10 samples"} | varied | whole
        yield {"what": "plan"} | varied | timed(plan_call(case, model, many), repeats)
        yield (
            {"what": "re-sampling within an episode"}
            | varied
            | timed(partial(model.resample, many, seeded(0)), repeats)
        )
        yield {"what": "extra memory, MB"} | varied | {"p50_ms": peak_memory_mb() - before, "repeats": 1}


KNOBS: tuple[tuple[str, Any], ...] = (
    ("nothing", None),
    ("num_candidates", 600),
    ("num_iterations", 10),
    ("horizon", 60),
    ("num_particles", 10),
    ("num_layers", 3),
    ("num_inducing", 200),
    ("num_features", 128),
    ("refresh", "step"),
    ("kernel", "rbf"),
    ("kernel", "matern12"),
    ("num_chains", 10),
    ("batch_size", 512),
    ("resample_samples", 10),
)
"""What is changed of the defaults, one at a time."""


def knobs(case: Case, num_layers: int, repeats: int) -> Iterator[Row]:
    """What a setting costs: a plan, following a transition, and a training iteration, with one changed at a time."""
    data = transitions(case, NUM_TRANSITIONS)
    for name, value in KNOBS:
        given, varied = {name: value}, {"varied": name, "value": value}
        of_model = {name: value} if name in settings_of(DeepGPDynamics) else {}
        model = deep_gp(case, of_model.pop("num_layers", num_layers), data, **of_model)
        sizes = {name: value for name, value in given.items() if name in ("num_candidates", "num_particles")}
        longer = case._replace(
            **{name: value for name, value in given.items() if name in ("horizon", "num_iterations")}
        )
        yield {"what": "plan"} | varied | timed(plan_call(longer, model, data, **sizes), repeats)
        if of_model or name in ("nothing", "num_layers"):
            following = partial(model.resample, data, seeded(0))
            yield {"what": "following a transition"} | varied | timed(following, repeats)
            yield {"what": "training iteration"} | varied | iteration(chains(model, data, repeats), repeats)


WORKERS = {
    "plans": plans, "pets": pets, "training": training, "parts": parts, "inductor": inductor, "scaling": scaling,
    "knobs": knobs,
}  # fmt: skip
