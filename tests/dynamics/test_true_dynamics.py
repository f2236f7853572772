"""The simulator as a dynamics model: what a plan foresees is what happens."""

import gymnasium
import numpy as np
import pytest
import torch

from gym_dgpmpc import MPCAgent
from gym_dgpmpc.dynamics.true_dynamics import TrueDynamics
from gym_dgpmpc.planning import CEM, rollout
from tests.oracles.models import seeded


def test_a_rollout_is_what_the_environment_does():
    env = gymnasium.make("ModCartPole-v0")
    observation, _ = env.reset(seed=1)
    actions = 6 * torch.rand(3, 12, 1, generator=seeded()) - 3
    sampler = TrueDynamics(env).draw(2, 12, seeded())
    start = torch.tensor(observation, dtype=torch.float32)
    states = rollout(sampler, start, actions, 2)
    whole = sampler.trajectories(start, actions)
    assert states.shape == whole.shape == (13, 2, 3, 4) and whole.dtype == torch.float32
    for k in range(3):
        env.unwrapped.set_state(*start.double().numpy().reshape(2, 2))
        for t, action in enumerate(actions[k].numpy()):
            after, *_ = env.step(action)
            # Rounding to single precision, once at the end or at each step, where errors grow by less than ten.
            np.testing.assert_allclose(whole[t + 1, 0, k], after, rtol=2e-7, atol=1e-6)
            np.testing.assert_allclose(states[t + 1, 1, k], after, rtol=1e-5, atol=1e-5)


def test_the_planner_foresees_its_own_return():
    """With nothing to learn the predicted states are the obtained ones, from the first step on."""
    env = gymnasium.make("SwingUpCartPole-v0")
    planner = CEM(
        action_low=torch.tensor([-3.0]), action_high=torch.tensor([3.0]),
        horizon=8, num_candidates=20, num_elites=4, num_iterations=2,
    )  # fmt: skip
    agent = MPCAgent(env, TrueDynamics(env), planner, num_particles=1, learning_starts=1, seed=0)
    agent.learn(6)
    data = agent.store.transitions()
    sampler = agent.dynamics.draw(1, 8, seeded())
    predicted = torch.stack([sampler(s.view(1, 1, -1), a.view(1, -1), 0)[0, 0] for s, a in zip(*data[:2], strict=True)])
    torch.testing.assert_close(predicted, data.next_observation, rtol=1e-5, atol=1e-5)


def test_there_is_nothing_to_learn_or_to_load():
    model = TrueDynamics(gymnasium.make("ModCartPole-v0"))
    assert model.state_dict() == {}
    model.load_state_dict({})
    with pytest.raises(ValueError, match=r"state.*\['pool'\]"):
        model.load_state_dict({"pool": torch.zeros(1)})
