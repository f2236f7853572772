"""Models trained to convergence on a pendulum, at a size near that of real runs: what they learn, and in float32."""

import pytest
import torch

from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.planning.rollout import rollout
from tests.oracles import pendulum
from tests.oracles.models import seeded

DATA = pendulum.simulate(200)
HORIZON, CANDIDATES, PARTICLES = 30, 20, 5
SETTINGS = {
    "num_layers": 2, "num_inducing": 100, "num_features": 128, "first_training_iterations": 300, "num_samples": 5,
    "sample_spacing": 2, "step_size": 0.03, "learning_rate": 0.03,
}  # fmt: skip


@pytest.fixture(scope="module", params=["rbf", "matern32"])
def trained(request):
    model = DeepGPDynamics(2, 1, pendulum.SPEC, kernel=request.param, **SETTINGS)
    model.fit(DATA, seeded())
    return model


def twin(trained, dtype, **settings):
    """The same posterior, rolled out in another precision or by another draw."""
    model = DeepGPDynamics(2, 1, pendulum.SPEC, kernel=trained.kernel.name, dtype=dtype, **(SETTINGS | settings))
    model.load_state_dict(trained.state_dict())
    return model


def test_it_predicts_unseen_transitions(trained):
    """The squared error of the mean prediction is a small part of the squared change."""
    test = pendulum.simulate(60, seed=1)
    after = trained.draw(PARTICLES, 1, seeded())(test.observation.expand(PARTICLES, -1, -1).clone(), test.action, 0)
    change = (test.next_observation - test.observation).square().mean(0)
    assert ((after.mean(0) - test.next_observation).square().mean(0) < 0.1 * change).all()


@pytest.mark.parametrize(
    "draw",
    [
        {"draw": "pathwise", "refresh": "step"},
        {"draw": "pathwise", "refresh": "plan"},
        {"draw": "joint"},
        {"draw": "marginal"},
    ],
    ids=["step", "plan", "joint", "marginal"],
)
def test_rollouts_in_single_precision_are_those_in_double(trained, draw):
    """Same generator, same functions: one step as near as rounding lets it be, and nine in ten states of rollouts
    within 1e-3 of the state's scale, or within what rounding may do to a single step where that is more.

    A function is a sum of correlations under large weights that cancel, sum_j alpha_j k_j. Of each term the weight and
    the correlation are rounded, to one part in 2^24, so that the sum is off by 2^-23 sum |alpha_j| at most; what the
    inner layer adds to that is small beside it. The other draws are computed in double precision whatever the states'.
    """
    actions = 2 * torch.rand(CANDIDATES, HORIZON, 1, generator=seeded(1), dtype=torch.float32) - 1
    scale = DATA.observation.std(0)

    def sampler(dtype):
        return twin(trained, dtype, **draw).draw(PARTICLES, HORIZON, seeded(2))

    def states(world, dtype):
        return rollout(world, torch.zeros(2, dtype=dtype), actions.to(dtype), PARTICLES)

    double, single = states(sampler(torch.float64), torch.float64), states(sampler(torch.float32), torch.float32)
    assert double.dtype == torch.float64 and single.dtype == torch.float32

    exact, rounded = sampler(torch.float64), sampler(torch.float32)
    # A rounding of the state itself, which is of the order of its scale, is there in any case.
    bound = 2**-23 * (1.0 + (single.abs().amax((0, 1, 2)) / scale).max())
    if draw["draw"] == "pathwise":
        weights = exact.layers[-1].kernel_out.abs().sum(-1).max()
        bound = bound + 2**-23 * weights * (trained.state_dict()["targets.std"] / scale).max()
    for step in range(HORIZON):  # one step at a time, from the same states
        state, action = single[step], actions[:, step]
        error = rounded(state, action, step) - exact(state.double(), action.double(), step)
        assert (error.abs() / scale).max() < bound
    assert ((single - double).abs() / scale).flatten().quantile(0.9) < max(1e-3, float(bound))
