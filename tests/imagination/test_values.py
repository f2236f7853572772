"""Plans that see past their horizon: the tail of a return, values of critics, and what a policy proposes."""

import numpy as np
import pytest
import torch
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import PPO, SAC, TD3

from gym_dgpmpc import DynaAgent
from gym_dgpmpc.imagination.gradient import PolicyGradient
from gym_dgpmpc.imagination.values import state_value
from gym_dgpmpc.imagination.worlds import ImaginedVecEnv
from gym_dgpmpc.planning.rollout import Tail, particle_returns, rollout_objective
from tests.agents.point_mass import LENGTH, KnownPointMass, agent
from tests.agents.test_dgp_mpc import TINY
from tests.agents.test_dyna import QUICK, point_mass
from tests.imagination.test_export import Anything
from tests.planning.toy_planners import RandomShooting

STATES, ACTIONS = torch.randn(6, 3, 4, 2, generator=torch.Generator().manual_seed(0)).double(), torch.zeros(4, 5, 1)


def reward_fn(observation, action, next_observation):
    return next_observation[..., 0]


def value(states):
    return 10 * states[..., 1]


@pytest.mark.parametrize("depths", [1, 3, 5, 9])
def test_a_return_with_a_tail_is_its_definition(depths):
    found = particle_returns(STATES, ACTIONS, reward_fn, tail=Tail(value, 0.9, depths))
    for p in range(3):
        for k in range(4):
            each = [
                sum(0.9**t * STATES[t + 1, p, k, 0] for t in range(h)) + 0.9**h * 10 * STATES[h, p, k, 1]
                for h in range(5, max(5 - depths, 0), -1)
            ]
            assert found[p, k].item() == pytest.approx(np.mean(each), rel=1e-12)


def test_what_has_terminated_has_no_tail():
    def terminated_fn(after):
        return after[..., 0] > 1.0

    found = particle_returns(STATES, ACTIONS, reward_fn, terminated_fn, Tail(value, 0.9, 2))
    for p in range(3):
        for k in range(4):
            over = next((t for t in range(5) if STATES[t + 1, p, k, 0] > 1.0), 5)
            each = [
                sum(0.9**t * STATES[t + 1, p, k, 0] for t in range(min(h, over + 1)))
                + (0.9**h * 10 * STATES[h, p, k, 1] if h <= over else 0.0)
                for h in (5, 4)
            ]
            assert found[p, k].item() == pytest.approx(np.mean(each), rel=1e-12)


def test_a_value_of_the_wrong_shape_is_named():
    with pytest.raises(ValueError, match="value must return a floating-point tensor"):
        particle_returns(STATES, ACTIONS, reward_fn, tail=Tail(lambda states: states, 0.9))


def test_the_exact_value_makes_one_step_as_good_as_many():
    """With V of the optimal policy the best first action is the same for every horizon: Bellman's equation."""
    step, cost = 0.5, 0.1  # s' = s + a, r = -s'^2 - cost a^2, discounted; V(s) = -v s^2, a = -g s

    def world(observation, action, index):
        return observation + action

    def reward(s, a, after):
        return -(after[..., 0] ** 2) - cost * a[..., 0] ** 2

    v = 0.0
    for _ in range(500):  # Riccati: minimise (1 + d v)(s + a)^2 + cost a^2
        v = (1 + 0.9 * v) * cost / (1 + 0.9 * v + cost)
    gain = (1 + 0.9 * v) / (1 + 0.9 * v + cost)
    start = torch.tensor([step], dtype=torch.float64)
    grid = torch.linspace(-1, 1, 2001, dtype=torch.float64)
    for horizon in (1, 3):
        actions = grid.view(-1, 1, 1).repeat(1, horizon, 1)
        for t in range(1, horizon):  # the optimal policy after the first action
            state = start + actions[:, 0] if t == 1 else state + actions[:, t - 1]
            actions[:, t] = -gain * state
        tail = Tail(lambda states: -v * states[..., 0] ** 2, 0.9)
        scores = rollout_objective(world, reward, start, 1, tail=tail)(actions)
        assert grid[scores.argmax()].item() == pytest.approx(-gain * step, abs=1e-3)
        assert scores.max().item() == pytest.approx(-v * step**2, abs=1e-6)


@pytest.mark.parametrize("algorithm", [SAC, TD3, TQC, CrossQ, PPO])
def test_values_are_those_of_the_critics_for_the_policys_own_actions(algorithm):
    model = algorithm("MlpPolicy", Anything(), seed=0, device="cpu", policy_kwargs={"net_arch": [8]})
    observations = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    found = state_value(model)(torch.from_numpy(observations).reshape(2, 2, 3))
    model.policy.set_training_mode(False)
    assert found.shape == (2, 2)
    rows = torch.from_numpy(observations)
    if algorithm is PPO:
        expected = model.policy.predict_values(rows)[:, 0]
    else:
        scaled = model.policy.scale_action(model.predict(observations, deterministic=True)[0]).reshape(4, -1)
        of_critic = model.critic(rows, torch.from_numpy(scaled))
        expected = of_critic.mean((1, 2)) if algorithm is TQC else torch.minimum(*of_critic)[:, 0]
    torch.testing.assert_close(found.flatten(), expected, atol=1e-5, rtol=1e-5)


def test_an_actor_without_critics_has_no_value():
    learned = agent().learn(25)
    model = PolicyGradient("MlpPolicy", ImaginedVecEnv.of(learned, 2, seed=0))
    with pytest.raises(ValueError, match="PolicyGradient learns no values"):
        state_value(model)


@pytest.fixture(scope="module")
def seeing():
    arguments = {**TINY, **QUICK, "acts_by": "planner", "proposes": True, "terminal_value": True, "value_depths": 2}
    return DynaAgent(point_mass(), **arguments).learn(2 * LENGTH)


def test_the_planner_is_told_of_the_policys_sequences_and_values(seeing, monkeypatch):
    offered = []
    original = seeing.planner.plan

    def plan(objective, plan, generator, deadline=None, proposals=None):
        offered.append((proposals, objective(proposals)))
        return original(objective, plan, generator, deadline, proposals)

    monkeypatch.setattr(seeing.planner, "plan", plan)
    observation = np.array([0.7, -0.1])
    seeing.predict(observation, deterministic=True)
    ((proposals, scores),) = offered
    assert proposals.shape == (TINY["num_particles"], TINY["horizon"], 1) and scores.isfinite().all()
    first = seeing.imagined_policy.predict(observation, deterministic=True)[0]
    np.testing.assert_allclose(proposals[:, 0].numpy(), np.broadcast_to(first, (3, 1)), rtol=1e-6)
    assert seeing.controller.tail(seeing.task).discount == 0.99


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"algorithm": "gradient", "terminal_value": True}, "'gradient' learns no values"),
        ({"planner": RandomShooting, "proposes": True}, "RandomShooting takes no proposals"),
        ({"value_depths": 0}, "value_depths must be at least 1"),
    ],
)
def test_what_cannot_see_further_is_named(wrong, message):
    tiny = {name: value for name, value in TINY.items() if name not in ("num_candidates", "num_iterations", "horizon")}
    with pytest.raises(ValueError, match=message):
        DynaAgent(KnownPointMass(), **tiny, **wrong)
