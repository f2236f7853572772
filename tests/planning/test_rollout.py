"""The rollout and its objective against a linear-Gaussian system, whose law is known, and the rules of termination."""

import math

import numpy as np
import pytest
import torch

from gym_dgpmpc.errors import NotDifferentiableError
from gym_dgpmpc.planning import particle_returns, rollout, rollout_objective
from gym_dgpmpc.planning.risk import RiskMeasure
from tests.oracles import linear_gaussian

A = np.array([[1.0, 0.2, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.1, 0.8]])
B = np.array([[0.0, 0.1], [0.3, 0.0], [0.2, -0.4]])
NOISE_ROOT = np.array([[0.2, 0.0, 0.0], [0.1, 0.3, 0.0], [0.0, -0.1, 0.1]])
NOISE = NOISE_ROOT @ NOISE_ROOT.T
Q, R = np.diag([1.0, 0.5, 0.2]), np.diag([0.1, 0.3])
START = np.array([1.0, -0.5, 0.3])
H, K, P = 6, 3, 40_000
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (K, H, 2))


def linear_gaussian_sampler(generator):
    """Fresh noise for every particle, candidate and step."""
    a, b, root = (torch.tensor(each) for each in (A, B, NOISE_ROOT))

    def step(observation, action, step):
        noise = torch.randn(observation.shape, generator=generator, dtype=observation.dtype)
        return observation @ a.T + action @ b.T + noise @ root.T

    return step


def quadratic_reward(observation, action, next_observation):
    q, r = torch.tensor(Q), torch.tensor(R)
    return -((next_observation @ q) * next_observation).sum(-1) - ((action @ r) * action).sum(-1)


@pytest.fixture(scope="module")
def states():
    sampler = linear_gaussian_sampler(torch.Generator().manual_seed(0))
    return rollout(sampler, torch.tensor(START), torch.tensor(ACTIONS), P)


class TestAgainstTheLinearGaussianSystem:
    """Deviations in units of their own standard error; 4.5 of them happen once in 150,000 comparisons."""

    def test_means_and_covariances_of_all_states(self, states):
        assert states.shape == (H + 1, P, K, 3)
        for k in range(K):
            means, covariances = linear_gaussian.moments(A, B, NOISE, START, ACTIONS[k])
            sample = states[:, :, k].numpy()
            np.testing.assert_array_equal(sample[0], np.tile(START, (P, 1)))
            for t in range(1, H + 1):
                variance = np.diag(covariances[t])
                assert np.all(np.abs(sample[t].mean(0) - means[t]) < 4.5 * np.sqrt(variance / P))
                standard_error = np.sqrt((np.outer(variance, variance) + covariances[t] ** 2) / P)
                assert np.all(np.abs(np.cov(sample[t].T) - covariances[t]) < 4.5 * standard_error)

    def test_particles_and_candidates_are_independent_and_steps_are_not(self, states):
        last = states[-1, :, :, 0].numpy()
        assert np.all(np.abs(np.corrcoef(last.T)[np.triu_indices(K, 1)]) < 4.5 / math.sqrt(P))
        assert np.corrcoef(states[-2, :, 0, 0], states[-1, :, 0, 0])[0, 1] > 0.5

    def test_the_score_is_the_expected_return(self):
        sampler = linear_gaussian_sampler(torch.Generator().manual_seed(1))
        scores = rollout_objective(sampler, quadratic_reward, torch.tensor(START), P)(torch.tensor(ACTIONS))
        sampler = linear_gaussian_sampler(torch.Generator().manual_seed(1))
        returns = particle_returns(
            rollout(sampler, torch.tensor(START), torch.tensor(ACTIONS), P), torch.tensor(ACTIONS), quadratic_reward
        )
        torch.testing.assert_close(scores, returns.mean(dim=0))
        for k in range(K):
            means, covariances = linear_gaussian.moments(A, B, NOISE, START, ACTIONS[k])
            expected = -sum(
                linear_gaussian.expected_quadratic(means[t + 1], covariances[t + 1], Q) + u @ R @ u
                for t, u in enumerate(ACTIONS[k])
            )
            standard_error = returns[:, k].std().item() / math.sqrt(P)
            assert scores[k].item() == pytest.approx(expected, abs=4.5 * standard_error)


def count_up(observation, action, step):
    return observation + action


def ones(observation, action, next_observation):
    return torch.ones_like(next_observation[..., 0])


def first(observation, action, next_observation):
    return next_observation[..., 0]


def test_every_step_gets_its_own_action_and_index():
    seen = []

    def sampler(observation, action, step):
        seen.append((step, action.clone()))
        return count_up(observation, action, step)

    actions = torch.arange(24.0).reshape(4, 3, 2)
    states = rollout(sampler, torch.tensor([10.0, 20.0]), actions, 5)
    assert [step for step, _ in seen] == [0, 1, 2]
    for step, action in seen:
        assert torch.equal(action, actions[:, step])
    expected = torch.tensor([10.0, 20.0]) + torch.cat([torch.zeros(4, 1, 2), actions.cumsum(dim=1)], dim=1)
    assert torch.equal(states, expected.transpose(0, 1)[:, None].expand(4, 5, 4, 2))


def test_nothing_is_recorded_for_a_gradient():
    """A learned model and a learned reward have parameters; a plan's memory would grow with its steps."""
    weight, actions = torch.ones(1, requires_grad=True), torch.ones(2, 3, 1)
    states = rollout(lambda observation, action, step: weight * observation + action, torch.zeros(1), actions, 2)
    returns = particle_returns(states, actions, lambda x, u, after: (weight * after).sum(-1))
    assert not states.requires_grad and not returns.requires_grad


@pytest.mark.parametrize("risk", ["mean", "mean-std", "cvar", "worst", "best"])
def test_a_scores_gradient_is_that_of_its_value(risk):
    """By the actions and the start, with particles that terminate at different times, against central differences.

    What comes after a termination has no part in it; when it comes is piecewise constant.
    """
    a, b = torch.tensor(A), torch.tensor(B)
    drift = torch.randn(5, 1, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    places = torch.tensor(START), torch.tensor(ACTIONS)

    def terminated(after):
        return after[..., 1] > 1.5

    def sampler(observation, action, step):
        return observation @ a.T + action @ b.T + 0.5 * drift

    def value_of(start, actions):
        measure = RiskMeasure(risk, cvar_share=0.5)
        return rollout_objective(sampler, quadratic_reward, start, 5, terminated, measure)(actions).sum()

    with torch.no_grad():
        states = rollout(sampler, *places, 5)
    ends = terminated(states[1:]).any(0)
    assert ends.any() and not ends.all()
    variables = [place.clone().requires_grad_() for place in places]
    value = value_of(*variables)
    assert value.item() == value_of(*places).item()
    for place, gradient, variable in zip(places, torch.autograd.grad(value, variables), variables, strict=True):
        known = torch.zeros_like(place)
        for index in range(place.numel()):
            shift = torch.zeros_like(place)
            shift.view(-1)[index] = 1e-5
            up, down = ([each + shift * sign if each is place else each for each in places] for sign in (1, -1))
            known.view(-1)[index] = (value_of(*up) - value_of(*down)) / 2e-5
        torch.testing.assert_close(gradient, known, rtol=1e-7, atol=1e-7)
        assert variable.grad is None


def test_a_world_that_records_no_gradient_is_refused():
    """One that steps and one that gives trajectories, and which it is."""
    plans = torch.zeros(3, 4, 2, requires_grad=True)

    class Numpy:
        def __call__(self, observation, action, step):
            return torch.from_numpy(observation.detach().numpy() + action.detach().numpy())

    for sampler in (Numpy(), InOneGo(torch.zeros(5, 2, 3, 2))):
        with pytest.raises(NotDifferentiableError, match=rf"^{type(sampler).__name__} has no gradients.*cem"):
            rollout(sampler, torch.zeros(2), plans, 2)


def test_the_reward_is_one_call_on_all_steps_with_matching_triples():
    calls = []

    def reward(observation, action, next_observation):
        calls.append((observation.shape, action.shape, next_observation.shape))
        assert torch.equal(observation + action, next_observation)
        return next_observation.sum(dim=-1)

    actions = torch.arange(24.0).reshape(4, 3, 2)
    scores = rollout_objective(count_up, reward, torch.zeros(2), 5)(actions)
    assert calls == [((3, 5, 4, 2),) * 3]
    torch.testing.assert_close(scores, actions.cumsum(dim=1).sum(dim=(1, 2)))


def test_particles_keep_their_own_worlds():
    drift = torch.arange(1.0, 4.0)[:, None, None]
    states = rollout(lambda s, a, step: s + drift, torch.zeros(1), torch.zeros(2, 5, 1), 3)
    assert torch.equal(states[-1, :, :, 0], 5 * drift[:, :, 0].expand(3, 2))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_dtype_is_that_of_the_observation(dtype):
    actions = torch.ones(4, 3, 1, dtype=torch.float32)
    observation = torch.zeros(1, dtype=dtype)
    assert rollout(count_up, observation, actions, 2).dtype == dtype
    assert rollout_objective(count_up, first, observation, 2)(actions).dtype == dtype


class InOneGo:
    """A sampler that offers trajectories; its steps must then not be asked for."""

    def __init__(self, states):
        self.states = states

    def __call__(self, observation, action, step):
        raise AssertionError("asked for a step although there are trajectories")

    def trajectories(self, observation, actions):
        return self.states


def test_a_sampler_that_takes_whole_sequences_is_asked_once():
    states = torch.arange(48.0).reshape(4, 2, 3, 2)
    found = rollout(InOneGo(states), torch.zeros(2, dtype=torch.float64), torch.zeros(3, 3, 1), 2)
    assert torch.equal(found, states.double())


def test_trajectories_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r"trajectories .*\(4, 5, 3, 2\).*\(4, 2, 3, 2\)"):
        rollout(InOneGo(torch.zeros(4, 2, 3, 2)), torch.zeros(2), torch.zeros(3, 3, 1), 5)


def test_no_gradient_is_recorded():
    weight = torch.ones((), requires_grad=True)
    score = rollout_objective(lambda s, a, step: s * weight + a, first, torch.zeros(1), 2)
    assert not score(torch.ones(4, 3, 1)).requires_grad


class TestTermination:
    """States are running sums of the actions; the episode ends above 2.5."""

    @staticmethod
    def ended(next_observation):
        return next_observation[..., 0] > 2.5

    def test_the_terminating_step_earns_and_nothing_after_it(self):
        actions = torch.ones(1, 6, 1)  # states 1 .. 6, ending in 3
        assert rollout_objective(count_up, first, torch.zeros(1), 2, self.ended)(actions).tolist() == [1 + 2 + 3]
        assert rollout_objective(count_up, first, torch.zeros(1), 2)(actions).tolist() == [21]

    def test_a_particle_cannot_come_back(self):
        actions = torch.tensor([1.0, 2.0, -3.0, 1.0, 0.0, 0.0]).reshape(1, 6, 1)  # 1, 3 (end), 0, 1, 1, 1
        assert rollout_objective(count_up, ones, torch.zeros(1), 2, self.ended)(actions).tolist() == [2]

    def test_it_ends_each_particle_and_candidate_alone(self):
        drift = torch.tensor([0.0, 1.0])[:, None, None]
        actions = torch.tensor([0.0, 1.0]).reshape(2, 1, 1).expand(2, 4, 1)
        states = rollout(lambda s, a, step: s + a + drift, torch.zeros(1), actions, 2)
        lengths = particle_returns(states, actions, ones, self.ended)
        assert lengths.tolist() == [[4, 3], [3, 2]]  # by slope: 0 never ends, 1 ends in step 3, 2 in step 2

    def test_many_steps_do_not_revive_it(self):
        """300 steps, more than a byte can count."""
        actions = torch.full((1, 300, 1), 3.0)
        assert rollout_objective(count_up, ones, torch.zeros(1), 1, self.ended)(actions).tolist() == [1]

    def test_what_is_predicted_after_the_end_does_not_matter(self):
        actions = torch.tensor([3.0, math.nan, math.inf]).reshape(1, 3, 1)
        assert rollout_objective(count_up, first, torch.zeros(1), 2, self.ended)(actions).tolist() == [3]


class TestDivergence:
    actions = torch.zeros(3, 4, 1)

    @staticmethod
    def diverging(value):
        """Particle 2 of candidate 1 leaves the finite numbers in step 1, and may come back."""

        def sampler(observation, action, step):
            following = torch.ones_like(observation)
            if step == 1:
                following[2, 1] = value
            return following

        return sampler

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    @pytest.mark.parametrize("reward", [first, ones])
    def test_one_particle_makes_the_score_not_finite_even_where_the_reward_hides_it(self, value, reward):
        scores = rollout_objective(self.diverging(value), reward, torch.zeros(1), 5)(self.actions)
        assert scores.isfinite().tolist() == [True, False, True]

    def test_a_diverged_particle_does_not_pass_for_one_that_ended(self):
        def ended(next_observation):
            return ~(next_observation[..., 0].abs() < 10)

        scores = rollout_objective(self.diverging(math.nan), ones, torch.zeros(1), 5, ended)(self.actions)
        assert scores.isfinite().tolist() == [True, False, True]

    def test_a_reward_that_is_not_finite_is_kept(self):
        def reward(observation, action, next_observation):
            return torch.log(next_observation[..., 0] - 1.0)

        scores = rollout_objective(count_up, reward, torch.ones(1), 2)(torch.tensor([0.0, 1.0]).reshape(2, 1, 1))
        assert scores.isfinite().tolist() == [False, True]


class TestWhatAUserMayGetWrong:
    observation, actions = torch.zeros(2), torch.zeros(3, 4, 2)

    def score(self, reward_fn=ones, terminated_fn=None, sampler=count_up):
        return rollout_objective(sampler, reward_fn, self.observation, 5, terminated_fn)(self.actions)

    @pytest.mark.parametrize(
        ("reward", "error", "message"),
        [
            (lambda s, a, n: n[..., :1], ValueError, r"reward_fn .*\(4, 5, 3\).*\(4, 5, 3, 1\)"),
            (lambda s, a, n: n.sum(), ValueError, r"reward_fn .* \(\), torch\.float32"),
            (lambda s, a, n: n[..., 0].long(), ValueError, r"reward_fn .*torch\.int64"),
            (lambda s, a, n: n[..., 0].numpy(), TypeError, "reward_fn .*ndarray"),
        ],
    )
    def test_rewards(self, reward, error, message):
        with pytest.raises(error, match=message):
            self.score(reward)

    @pytest.mark.parametrize(
        ("ended", "error", "message"),
        [
            (lambda n: n > 0, ValueError, r"terminated_fn .*\(4, 5, 3\).*\(4, 5, 3, 2\)"),
            (lambda n: n[..., 0], ValueError, r"terminated_fn .*torch\.float32"),
            (lambda n: False, TypeError, "terminated_fn .*bool$"),
        ],
    )
    def test_terminations(self, ended, error, message):
        with pytest.raises(error, match=message):
            self.score(terminated_fn=ended)

    def test_samplers_whose_result_would_be_broadcast(self):
        with pytest.raises(ValueError, match=r"sampler .*\(5, 3, 2\).* \(3, 2\)"):
            self.score(sampler=lambda s, a, step: s[0])

    @pytest.mark.parametrize(
        ("observation", "particles", "message"),
        [
            (torch.zeros(2), 0, "num_particles .* 0$"),
            (torch.zeros(2, 1), 1, r"observation .*\(2, 1\)"),
            (torch.zeros(2, dtype=torch.int64), 1, r"observation .*torch\.int64"),
        ],
    )
    def test_starts(self, observation, particles, message, unchecked):
        with pytest.raises(ValueError, match=message):
            rollout_objective(count_up, ones, observation, particles)
