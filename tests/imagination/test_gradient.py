"""A policy that climbs by gradients: the slope against differences of the value, and the optimum that is known."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import TimeLimit
from scipy.linalg import solve_discrete_are
from stable_baselines3 import TD3

from gym_dgpmpc.agents import MPCAgent
from gym_dgpmpc.errors import NotDifferentiableError
from gym_dgpmpc.imagination.export import export_policy, run_exported
from gym_dgpmpc.imagination.features import EncodedObservation, encoding, features_of
from gym_dgpmpc.imagination.gradient import Paths, PolicyGradient
from gym_dgpmpc.imagination.policies import imagine
from gym_dgpmpc.imagination.worlds import ImaginedVecEnv
from gym_dgpmpc.types import ObservationSpec
from tests.agents.point_mass import TIME_STEP, KnownPointMass, LinearModel, agent, planner
from tests.imagination.test_worlds import Goal, Shift, beginnings, worlds


@pytest.fixture(scope="module")
def learned():
    return agent(TimeLimit(KnownPointMass(), 30), learning_starts=60).learn(70)


def bent_actor():
    torch.manual_seed(0)
    layers = torch.nn.Linear(2, 3), torch.nn.Tanh(), torch.nn.Linear(3, 1), torch.nn.Tanh()
    return torch.nn.Sequential(*layers).double()


@pytest.mark.parametrize(("noise", "matches_moments"), [(0.0, False), (0.1, False), (0.1, True)])
def test_the_slope_is_that_of_the_value(noise, matches_moments):
    """Central differences in float64: their error is of the order of the step squared and of rounding over the step."""
    actor, env = bent_actor(), worlds(num_worlds=3)

    def value():
        env.generator.manual_seed(1)
        return Paths(env, 4, 5, noise, matches_moments=matches_moments).mean_reward(actor)

    value().backward()
    for parameter in actor.parameters():
        flat = parameter.data.view(-1)
        for i in range(len(flat)):
            ends = []
            for sign in (1, -1):
                flat[i] += sign * 1e-6
                ends.append(value().item())
                flat[i] -= sign * 1e-6
            assert parameter.grad.view(-1)[i].item() == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-6, abs=1e-8)


def test_what_is_lost_or_over_earns_as_in_the_worlds():
    """Worlds end beyond 9 and terminate beyond 4; the same actions, taken by hand, earn the same."""
    for limit in (4.0, 99.0):
        env = worlds(
            num_worlds=3, terminated_fn=lambda after, limit=limit: after[..., 0] > limit, least_reward=-7.0,
            episode_steps=8,
        )  # fmt: skip
        actor = torch.nn.Sequential(torch.nn.Linear(2, 1)).double()
        with torch.no_grad():
            actor[0].weight.zero_()
            actor[0].bias.fill_(0.75)  # of a range of -2 to 2
        env.generator.manual_seed(3)
        mean_reward = Paths(env, 8, 1, 0.0).mean_reward(actor).item()
        env.generator.manual_seed(3)
        env.reset()
        earned, over = np.zeros(3), np.zeros(3, dtype=bool)
        for _ in range(8):
            _, rewards, dones, _ = env.step(np.full((3, 1), 1.5))
            earned += np.where(over, 0.0, rewards)
            over |= dones
        assert mean_reward == pytest.approx(earned.mean() / 8, rel=1e-6)


class Watched(Shift):
    """Keeps what each step of a draw begins from and what it gives."""

    def draw(self, num_particles, horizon, generator):
        sampler, self.before, self.after = super().draw(num_particles, horizon, generator), [], []

        def watching(observation, action, step):
            self.before.append(observation)
            self.after.append(sampler(observation, action, step))
            return self.after[-1]

        return watching


def idle():
    """An actor that does nothing."""
    actor = torch.nn.Linear(2, 1).double()
    torch.nn.init.zeros_(actor.weight)
    torch.nn.init.zeros_(actor.bias)
    return actor


def test_particles_are_drawn_anew_from_their_moments():
    """Within five standard errors, of a mean sqrt(V / n), of a variance sqrt(2 / n) V, of a correlation sqrt(1 / n):
    there is none between a particle and that in whose place it comes."""
    env, count = worlds(num_worlds=1000), 1000 * 4
    env.dynamics = Watched()
    Paths(env, 4, 4, 0.0, matches_moments=True).mean_reward(idle())
    for after, before in zip(env.dynamics.after[:-1], env.dynamics.before[1:], strict=True):
        old, new = after.detach().flatten(0, 1), before.detach().flatten(0, 1)
        variance = old.var(0, correction=0)
        assert ((new.mean(0) - old.mean(0)).abs() <= 5 * (variance / count).sqrt()).all()
        assert ((new.var(0) - variance).abs() <= 5 * variance * (2 / count) ** 0.5).all()
        assert abs(np.corrcoef(old[:, 0], new[:, 0])[0, 1]) <= 5 * count**-0.5


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("num_lost", [1, 3])
def test_only_particles_that_go_on_have_a_part_in_the_moments(num_lost):
    """They all move alike, to 1, 2, ...; those lost at the first step stay where they were. None may be left."""

    class Lost(Watched):
        def draw(self, num_particles, horizon, generator):
            own = torch.ones(3, 1, 1, dtype=torch.float64)
            own[3 - num_lost :] = torch.nan
            self.before = []

            def sampler(observation, action, step):
                self.before.append(observation.detach())
                return observation + action + own

            return sampler

    env = worlds(num_worlds=3, least_reward=-7.0)
    env.dynamics = Lost()
    mean_reward = Paths(env, 4, 1, 0.0, matches_moments=True).mean_reward(idle()).item()
    for step, before in enumerate(env.dynamics.before):
        assert before[:, 0, 0].tolist() == [step] * (3 - num_lost) + [0.0] * num_lost
    earned = -(3 - num_lost) * (1 + 4 + 9 + 16) - 7 * 4 * num_lost
    assert mean_reward == pytest.approx(earned / 3 / 4, rel=1e-12)


def test_it_finds_the_optimum_of_a_linear_quadratic_problem(learned, monkeypatch):
    """The regulator of the exact system, from the Riccati equation, earns the most that any policy can.

    Paths that went on would lead to states in which the bounds of the actions count, and another policy is best.
    """
    monkeypatch.setattr("gym_dgpmpc.imagination.gradient.GOES_ON", 0.0)
    found = imagine(
        learned, "gradient", total_timesteps=150 * 30 * 32, num_worlds=4, trial_every=10**6, seed=0, horizon=30,
        policy_kwargs={"net_arch": []}, learning_rate=0.15, action_noise=0.0, encoded=False,
        starts=lambda count, rng: rng.uniform(-0.1, 0.1, (count, 2)),
    )  # fmt: skip
    a, b = np.array([[1, TIME_STEP], [0, 1]]), np.array([[TIME_STEP**2], [TIME_STEP]])
    # The reward is of the next position: (s A + a B)_0^2 + 0.01 a^2, a quadratic form of state and action.
    q, r, cross = np.outer(a[0], a[0]), np.array([[0.01]]) + b[0] ** 2, np.outer(a[0], b[0])
    cost = solve_discrete_are(a, b, q, r, s=cross)
    gain = np.linalg.solve(r + b.T @ cost @ b, b.T @ cost @ a + cross.T)

    def loss(act):
        state, total = np.random.default_rng(1).uniform(-0.1, 0.1, (200, 2)), 0.0
        for _ in range(30):
            action = np.clip(act(state), -2, 2)
            state = state @ a.T + action @ b.T
            total += (state[:, 0] ** 2 + 0.01 * action[:, 0] ** 2).mean()
        return total

    best = loss(lambda state: -state @ gain.T)
    reached = loss(lambda state: found.model.predict(state, deterministic=True)[0])
    assert best <= reached < 1.1 * best < loss(lambda state: np.zeros((len(state), 1)))


def test_its_file_is_a_td3s_and_can_be_exported(learned, tmp_path):
    model = learned.imagine_policy("gradient", total_timesteps=1_000, num_worlds=2, trial_every=500, horizon=5)
    assert isinstance(model, PolicyGradient)
    model.save(tmp_path / "policy.zip")
    assert (tmp_path / "policy.zip").stat().st_size < 2_000_000  # the worlds are not in it
    observations = np.random.default_rng(0).normal(size=(5, 2)).astype(np.float32)
    expected = model.predict(observations, deterministic=True)[0]
    loaded = TD3.load(tmp_path / "policy.zip", env=KnownPointMass(), device="cpu")
    np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], expected)
    path = export_policy(model, tmp_path / "policy.pt")
    np.testing.assert_allclose(run_exported(path, observations), expected, atol=1e-5)


def test_features_are_what_the_model_reads_in_units_of_its_spread(learned):
    spec = ObservationSpec(angles=(1,))
    arguments = encoding(learned.store, spec)["features_extractor_kwargs"]
    assert (arguments["plain"], arguments["angles"]) == ([0], [1])
    extractor = EncodedObservation(learned.observation_space, **arguments)
    seen = learned.store.transitions().observation
    features = extractor(seen)
    raw = torch.stack([seen[:, 0], seen[:, 1].sin(), seen[:, 1].cos()], -1)
    assert torch.equal(features_of(seen, [0], [1]), raw)
    torch.testing.assert_close(features.mean(0), torch.zeros(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(features.std(0, correction=0), torch.ones(3), atol=1e-4, rtol=0)
    turned = seen + torch.tensor([0.0, 2 * np.pi])
    torch.testing.assert_close(extractor(turned), features, atol=1e-5, rtol=0)


def test_what_the_model_is_not_fed_the_policy_is_not_either(learned):
    spec = ObservationSpec(not_inputs=(0,))
    assert encoding(learned.store, spec)["features_extractor_kwargs"]["plain"] == [1]
    spec = ObservationSpec(not_inputs=(0,), constant=(0,))
    assert encoding(learned.store, spec)["features_extractor_kwargs"]["plain"] == [0, 1]


def test_a_reward_without_a_gradient_is_named():
    env = ImaginedVecEnv(
        Shift(), lambda s, a, after: after[..., 0].detach(), beginnings, KnownPointMass().observation_space,
        KnownPointMass().action_space, seed=0,
    )  # fmt: skip
    with pytest.raises(NotDifferentiableError, match=r"no gradient comes through the reward.* such as SAC"):
        PolicyGradient("MlpPolicy", env).learn(1_000)


def test_dict_observations_are_refused_by_name():
    bound = torch.ones(2)
    one = MPCAgent(Goal(), LinearModel(), planner().__class__(-bound, bound, horizon=3, num_candidates=9), seed=0)
    one.learn(10)
    with pytest.raises(ValueError, match=r"observations that are vectors.*FlattenObservation"):
        one.imagine_policy("gradient")


def test_half_of_the_paths_go_on_where_the_last_ones_ended(learned):
    class Actor(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = torch.nn.Parameter(torch.zeros(()))

        def forward(self, observation):
            return self.weight.expand(len(observation), 1)

    env = ImaginedVecEnv.of(learned, 3, seed=0, episode_steps=5)
    paths = Paths(env, 5, 400, 0.0)
    paths.mean_reward(Actor())
    last = paths._states
    begun = paths._starts()
    goes_on = (begun == last).all(-1)
    share = goes_on[~paths._ended].float().mean().item()
    assert abs(share - 0.5) < 5 * 0.5 / (~paths._ended).sum().item() ** 0.5  # binomial
    assert not goes_on[paths._ended].any()


def test_gym_is_not_asked(learned, monkeypatch):
    monkeypatch.setattr(gym.Env, "step", lambda *_: pytest.fail("the environment was asked"))
    monkeypatch.setattr(KnownPointMass, "step", lambda *_: pytest.fail("the environment was asked"))
    learned.imagine_policy("gradient", total_timesteps=300, num_worlds=2, trial_every=200, horizon=5)
