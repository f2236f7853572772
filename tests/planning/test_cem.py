"""The cross-entropy method against its own recursion, its sampling law and the exact optimum of an LQR."""

import math

import numpy as np
import pytest
import scipy.stats
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gym_dgpmpc.errors import PlanningError
from gym_dgpmpc.planning import CEM, rollout_objective
from gym_dgpmpc.planning.cem import GaussianPlan, elite_shares, truncated_normal
from tests.oracles import lqr

CPU = torch.device("cpu")


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def bounds(low, high, dtype=torch.float32):
    return {"action_low": torch.tensor(low, dtype=dtype), "action_high": torch.tensor(high, dtype=dtype)}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_noise_is_a_normal_truncated_at_two(dtype):
    """The Kolmogorov distance exceeds 2.23 / sqrt(n) with probability 1e-4 under the right law."""
    n = 200_000
    noise = truncated_normal((n,), seeded(), device=CPU, dtype=dtype)
    assert noise.dtype == dtype
    assert noise.abs().max() <= 2.0
    exact = scipy.stats.truncnorm(-2.0, 2.0)
    assert scipy.stats.kstest(noise.double().numpy(), exact.cdf).statistic < 2.23 / math.sqrt(n)
    fourth = exact.moment(4)
    standard_error = math.sqrt((fourth - exact.var() ** 2) / n)
    assert noise.double().square().mean().item() == pytest.approx(exact.var(), abs=4 * standard_error)


@pytest.mark.parametrize("uniform", [0.0, 0.5, 1.0 - 2.0**-24])
def test_the_ends_of_the_uniform_draw_stay_finite(monkeypatch, uniform):
    monkeypatch.setattr(torch, "rand", lambda shape, **kwargs: torch.full(shape, uniform))
    noise = truncated_normal((1,), seeded(), device=CPU, dtype=torch.float32)
    assert noise.item() == pytest.approx(scipy.stats.truncnorm.ppf(uniform, -2.0, 2.0), abs=1e-5)


@pytest.mark.parametrize(("num_candidates", "num_elites"), [(300, 30), (19, 1), (3, 1)])
def test_a_tenth_of_the_candidates_are_elites(num_candidates, num_elites):
    assert CEM(**bounds([-1.0], [1.0]), num_candidates=num_candidates).num_elites == num_elites


def test_all_candidates_may_be_elites():
    """The mean of all of K candidates of standard deviation s errs by s / sqrt(K)."""
    cem = CEM(**bounds([-1.0], [1.0]), horizon=4, num_candidates=400, num_elites=400, num_iterations=1, smoothing=0.0)
    plan, _ = cem.plan(lambda actions: actions.sum(dim=(1, 2)), cem.initial_plan(), seeded())
    assert plan.mean.abs().max() < 5 * 0.5 / math.sqrt(400)


def test_every_plan_starts_from_a_quarter_of_the_range():
    cem = CEM(**bounds([-3.0, 0.0], [3.0, 2.0]), horizon=2)
    plan = cem.initial_plan()
    assert torch.equal(plan.mean, torch.tensor([[0.0, 1.0]] * 2))
    assert torch.equal(plan.std, torch.tensor([[1.5, 0.5]] * 2))
    narrowed = GaussianPlan(torch.tensor([[1.0, 0.5], [2.0, 1.5]]), torch.full((2, 2), 1e-3))
    assert torch.equal(cem.shift(narrowed, 1).std, plan.std)


def test_the_recursion_is_the_one_computed_by_hand():
    """Two iterations of K = 6, E = 2, a = 0.25, from a mean so near a bound that the cap on the std is active."""
    cem = CEM(
        **bounds([-1.0], [1.0], torch.float64), horizon=1, num_candidates=6, num_elites=2, num_iterations=2,
        smoothing=0.25, min_std=0.0,
    )  # fmt: skip
    start = GaussianPlan(torch.tensor([[0.8]], dtype=torch.float64), torch.tensor([[0.5]], dtype=torch.float64))
    seen = []

    def objective(actions):
        seen.append(actions.numpy().ravel())
        return -actions[:, 0, 0].abs()

    plan, info = cem.plan(objective, start, seeded(5))

    generator, mean, variance = seeded(5), 0.8, 0.25
    for candidates in seen:
        std = min(math.sqrt(variance), (1.0 - mean) / 2, (mean + 1.0) / 2)
        noise = truncated_normal((6, 1, 1), generator, device=CPU, dtype=torch.float64).numpy().ravel()
        np.testing.assert_allclose(candidates, mean + std * noise, rtol=1e-14)
        elites = sorted(candidates, key=abs)[:2]
        mean = 0.25 * mean + 0.75 * (elites[0] + elites[1]) / 2
        variance = 0.25 * variance + 0.75 * ((elites[0] - elites[1]) / 2) ** 2  # the variance of two, over n = 2
    assert len(seen) == 2
    assert plan.mean.item() == pytest.approx(mean, rel=1e-13)
    assert plan.std.item() == pytest.approx(math.sqrt(variance), rel=1e-13)
    assert info.expected_return == pytest.approx(-sum(map(abs, elites)) / 2, rel=1e-13)


def test_fewer_finite_scores_than_elites_are_all_the_elites():
    cem = CEM(**bounds([-1.0], [1.0]), horizon=2, num_candidates=20, num_elites=10, num_iterations=1, smoothing=0.0)
    finite = torch.tensor([4, 11, 17])
    seen = []

    def objective(actions):
        seen.append(actions)
        return torch.full((20,), math.nan).index_fill(0, finite, -1e30)

    plan, info = cem.plan(objective, cem.initial_plan(), seeded())
    torch.testing.assert_close(plan.mean, seen[0][finite].mean(dim=0))
    torch.testing.assert_close(plan.std, seen[0][finite].std(dim=0, correction=0))
    assert info.num_nonfinite == 17
    assert info.expected_return == pytest.approx(-1e30)


@pytest.mark.parametrize(
    ("scores", "shares"),
    [
        ([3.0, 1.0, 2.0, 0.0], [1 / 2, 0, 1 / 2, 0]),
        ([3.0, 2.0, 2.0, 0.0], [1 / 2, 1 / 4, 1 / 4, 0]),
        ([2.0, 2.0, 2.0, 2.0], [1 / 4, 1 / 4, 1 / 4, 1 / 4]),
        ([2.0, math.nan, 2.0, 2.0], [1 / 3, 0, 1 / 3, 1 / 3]),
        ([math.inf, math.nan, -math.inf, -5.0], [0, 0, 0, 1]),
        ([math.nan] * 4, [0, 0, 0, 0]),
    ],
)
def test_candidates_that_tie_share_the_last_places(scores, shares):
    torch.testing.assert_close(elite_shares(torch.tensor(scores), 2), torch.tensor(shares, dtype=torch.float32))


def test_a_flat_objective_neither_moves_nor_narrows_the_plan():
    """Of K = 400 candidates of standard deviation s the mean errs by s / sqrt(K), their spread by less.

    Any 10 of them would err by s / sqrt(10), which is six times as much.
    """
    cem = CEM(**bounds([-1.0], [1.0]), horizon=8, num_candidates=400, num_elites=10, num_iterations=1, smoothing=0.0)
    spread = 0.5 * scipy.stats.truncnorm(-2.0, 2.0).std()
    plan, _ = cem.plan(lambda actions: torch.ones(400), cem.initial_plan(), seeded())
    assert plan.mean.abs().max() < 5 * spread / math.sqrt(400)
    assert (plan.std - spread).abs().max() < 5 * spread / math.sqrt(400)


def test_an_action_that_cannot_vary_does_not_keep_it_from_stopping():
    """Its deviation is as small as it will ever be from the start."""

    def distance(actions):
        return -(actions[..., 0] - 0.2).square().sum(1)

    counts, settings = [], {"horizon": 3, "num_iterations": 50}
    for low, high in (([-1.0], [1.0]), ([-1.0, 0.1], [1.0, 0.1])):
        cem = CEM(**bounds(low, high), **settings)
        plan, info = cem.plan(distance, cem.initial_plan(), seeded())
        counts.append(info.metrics["num_iterations"])
    assert max(counts) < 20
    assert torch.equal(plan.mean[:, 1], torch.full((3,), 0.1))


@pytest.mark.parametrize(("min_std", "expected"), [(0.0, 5), (1.0, 1)])
def test_it_stops_when_the_plan_is_narrow(min_std, expected):
    cem = CEM(**bounds([-1.0], [1.0]), horizon=3, min_std=min_std)
    _, info = cem.plan(lambda actions: actions.sum(dim=(1, 2)), cem.initial_plan(), seeded())
    assert info.metrics["num_iterations"] == expected


def test_plans_do_not_depend_on_the_units_of_the_action():
    """A power of two scales floating-point numbers exactly."""
    plans = []
    for scale in (1.0, 2.0**-20):
        cem = CEM(**bounds([-scale], [scale]), horizon=3, num_iterations=30)
        plan, info = cem.plan(
            lambda actions, scale=scale: -(actions / scale - 0.3).square().sum(dim=(1, 2)), cem.initial_plan(), seeded()
        )
        plans.append((plan.mean / scale, info.metrics["num_iterations"]))
    assert torch.equal(plans[0][0], plans[1][0]) and plans[0][1] == plans[1][1] < 30


class TestAgainstLQR:
    """The excess over the optimal cost is e' G e for an error e of the plan, with G known.

    The scale to compare it with is tr(G diag(std^2)), the expected excess of one candidate drawn around a perfect
    mean: while it is smaller, what the plan lacks is less than what the search still explores. It grows beyond that
    only if the search has narrowed before it arrived.
    """

    problem = lqr.LQR(
        A=np.array([[1.0, 0.2], [-0.1, 0.95]]),
        B=np.array([[0.0, 0.1], [0.3, 0.0]]),
        Q=np.diag([1.0, 0.2]),
        R=np.diag([0.1, 0.2]),
    )
    start = np.array([1.5, -0.5])
    bound = 4.0  # twice the largest optimal action

    def search(self, horizon, seed, **arguments):
        A, B, Q, R = map(torch.tensor, self.problem)

        def reward(observation, action, next_observation):
            return -((next_observation @ Q) * next_observation).sum(-1) - ((action @ R) * action).sum(-1)

        objective = rollout_objective(lambda x, u, step: x @ A.T + u @ B.T, reward, torch.tensor(self.start), 1)
        actions, optimum = lqr.solve(self.problem, self.start, horizon)
        assert np.abs(actions).max() < self.bound / 2
        assert -objective(torch.tensor(actions)[None]).item() == pytest.approx(optimum, rel=1e-12)
        cem = CEM(**bounds([-self.bound] * 2, [self.bound] * 2, torch.float64), horizon=horizon, **arguments)
        plan, _ = cem.plan(objective, cem.initial_plan(), seeded(seed))
        excess = -objective(plan.mean[None]).item() - optimum
        explored = np.diag(lqr.condensed(self.problem, horizon)) @ plan.std.numpy().ravel() ** 2
        assert excess > -1e-12 * optimum, "better than the optimum"
        return excess, explored, optimum, objective

    @pytest.mark.parametrize("seed", range(4))
    def test_it_converges_to_the_optimum(self, seed):
        excess, explored, optimum, _ = self.search(
            5, seed, num_candidates=1000, num_elites=100, num_iterations=100, min_std=1e-3
        )
        assert excess < explored < 1e-4 * optimum

    @pytest.mark.parametrize("seed", range(4))
    def test_the_default_budget_comes_near_it(self, seed):
        """20 dimensions in 5 iterations; the same number of sequences drawn uniformly does worse than doing nothing."""
        excess, explored, optimum, objective = self.search(10, seed)
        nothing = -objective(torch.zeros(1, 10, 2).double()).item() - optimum
        uniform = (torch.rand(1500, 10, 2, generator=seeded(seed), dtype=torch.float64) * 2 - 1) * self.bound
        assert -objective(uniform).max().item() - optimum > nothing
        assert excess < explored
        assert excess < 0.1 * nothing  # the largest of 100 seeds: 0.061


@settings(max_examples=40, deadline=None)
@given(
    widths=st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(0.0, 1e6)), min_size=1, max_size=3),
    where=st.floats(0.0, 1.0),
    pull=st.floats(-1.0, 1.0),
    seed=st.integers(0, 2**31),
)
def test_from_a_mean_at_a_bound_there_is_no_way_out(widths, where, pull, seed):
    """There is no room to explore, for an action that is fixed nowhere."""
    low = torch.tensor([lower for lower, _ in widths])
    high = torch.maximum(torch.tensor([lower + width for lower, width in widths]), low)
    cem = CEM(low, high, horizon=2, num_candidates=16, num_elites=3, num_iterations=3)

    def objective(actions):
        assert bool((actions >= low).all()) and bool((actions <= high).all())
        return pull * actions.sum(dim=(1, 2))

    mean = (low + where * (high - low)).clamp(low, high).expand(2, -1)
    plan, _ = cem.plan(objective, cem.initial_plan()._replace(mean=mean), seeded(seed))
    assert bool((plan.mean >= low).all()) and bool((plan.mean <= high).all())
    assert bool(plan.std.isfinite().all()) and bool((plan.std >= 0).all())


def test_no_finite_score_is_an_error_that_says_how_many():
    cem = CEM(**bounds([-1.0], [1.0]), horizon=2, num_candidates=64)
    calls = iter([torch.zeros(64), torch.full((64,), math.nan)])
    with pytest.raises(PlanningError, match=r"\b64 candidate.*iteration 2 \(64 "):
        cem.plan(lambda actions: next(calls), cem.initial_plan(), seeded())


def test_an_objective_of_the_wrong_shape_is_named():
    cem = CEM(**bounds([-1.0], [1.0]), horizon=2, num_candidates=64)
    with pytest.raises(ValueError, match=r"objective .*\(64,\).*\(64, 1\)"):
        cem.plan(lambda actions: actions[:, :1, 0], cem.initial_plan(), seeded())


def test_what_a_shift_leaves_open_is_the_middle():
    cem = CEM(**bounds([-1.0], [3.0]), horizon=3)
    plan = GaussianPlan(torch.tensor([[0.1], [0.2], [0.3]]), torch.full((3, 1), 0.01))
    assert torch.equal(cem.shift(plan, 2).mean, torch.tensor([[0.3], [1.0], [1.0]]))


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (GaussianPlan(torch.zeros(3, 2), torch.ones(3, 2)), r"plan\.mean .*\(4, 2\).*\(3, 2\)"),
        (GaussianPlan(torch.zeros(4, 2), torch.ones(4, 2).double()), r"plan\.std .*float32.*float64"),
        (GaussianPlan(torch.full((4, 2), math.nan), torch.ones(4, 2)), r"plan\.mean .*\bnan\b"),
    ],
)
def test_a_plan_of_another_planner_is_refused(plan, message):
    cem = CEM(**bounds([-1.0, -2.0], [1.0, 3.0]), horizon=4)
    with pytest.raises(ValueError, match=message):
        cem.plan(lambda actions: actions.sum(dim=(1, 2)), plan, seeded())
    with pytest.raises(ValueError, match=message):
        cem.shift(plan, 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon": 0}, "horizon must be at least 1, got 0"),
        ({"num_elites": 0}, "num_elites must be at least 1, got 0"),
        ({"num_iterations": 0}, "num_iterations .* 0$"),
        ({"num_elites": 301}, "num_elites .*301.*300"),
        ({"smoothing": 1.0}, r"smoothing .* 1\.0$"),
        ({"smoothing": math.nan}, "smoothing .* nan$"),
        ({"min_std": -0.1}, r"min_std .*-0\.1$"),
        (bounds([1.0], [-1.0]), r"action_low .*\[1\.0\] and \[-1\.0\]"),
        (bounds([-1.0], [math.inf]), r"bounds .*\[inf\]"),
        (bounds([math.nan], [1.0]), r"bounds .*\[nan\]"),
        (bounds([-3.4e38], [3.4e38]), r"bounds .*e\+38"),
        (bounds([], []), r"action_low .*\(0,\) and \(0,\)"),
        ({"action_low": torch.tensor([-1.0]).double()}, "action_low .*float64.*float32"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        CEM(**{**bounds([-1.0], [1.0]), "horizon": 3, **arguments})


def test_bounds_that_are_no_tensors(unchecked):
    with pytest.raises(TypeError, match=r"action_low .*ndarray and ndarray"):
        CEM(action_low=-np.ones(2), action_high=np.ones(2), horizon=3)
