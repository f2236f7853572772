"""A small task and a small model to try agents on: a point on a line, pushed, and Bayesian linear regression."""

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces

from gym_dgpmpc.agents import MPCAgent
from gym_dgpmpc.planning import CEM

LENGTH = 10  # steps of an episode
TIME_STEP = 0.3


def reward_fn(observation, action, next_observation):
    return -(next_observation[..., 0] ** 2) - 0.01 * action[..., 0] ** 2


class PointMass(gym.Env):
    """Observation (position, velocity), action the force in [-2, 2]; the aim is to rest at the origin.

    Keeps every step as (observation, action, next observation) in ``steps``, and can be told to misbehave.

    Args:
        fixed_start: begin every episode at position 1 instead of at a random one.
        terminate_beyond: an episode terminates when the position's magnitude exceeds this.
        fail_at: the step, counted over all episodes from 0, at which ``failure`` happens.
        failure: an exception to raise, or a value to return as the position, or ("reward", value).
    """

    def __init__(self, fixed_start=False, terminate_beyond=None, fail_at=None, failure=np.nan):
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)
        self.fixed_start, self.terminate_beyond = fixed_start, terminate_beyond
        self.fail_at, self.failure = fail_at, failure
        self.steps, self.num_steps = [], 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array([1.0 if self.fixed_start else self.np_random.uniform(0.5, 1.0), 0.0])
        self.time = 0
        return self.state.copy(), {}

    def step(self, action):
        before, force = self.state, float(action[0])
        velocity = before[1] + TIME_STEP * force
        after = np.array([before[0] + TIME_STEP * velocity, velocity])
        self.state = after
        self.time += 1
        reward = float(reward_fn(*map(torch.tensor, (before, action, after))))
        failing, self.num_steps = self.num_steps == self.fail_at, self.num_steps + 1
        if failing and isinstance(self.failure, Exception):
            raise self.failure
        if failing and isinstance(self.failure, tuple):
            reward = self.failure[1]
        elif failing:
            after = np.array([self.failure, velocity])
        self.steps.append((before, np.array(action), after))
        terminated = self.terminate_beyond is not None and bool(abs(after[0]) > self.terminate_beyond)
        return after.copy(), reward, terminated, not terminated and self.time >= LENGTH, {}


class KnownPointMass(PointMass):
    """The same, offering its reward."""

    reward_fn = staticmethod(reward_fn)


class LinearModel:
    """s' = [s, a, 1] W with W ~ N(mean, 1e-6) independent per particle; a `DynamicsModel` with an exact fit.

    Counts what it was asked for, and keeps a number that every draw of training's random stream moves.
    """

    def __init__(self):
        self.mean, self.fits, self.resamples, self.moved = None, [], 0, 0.0

    def fit(self, data, generator):
        self.fits.append(len(data.observation))
        self._solve(data, generator)
        return {"residual": 0.5}

    def resample(self, data, generator):
        self.resamples += 1
        self._solve(data, generator)
        return {}

    def draw(self, num_particles, horizon, generator):
        assert not torch.is_grad_enabled()
        noise = torch.randn(num_particles, *self.mean.shape, generator=generator)
        weight = self.mean + 1e-3 * (1 + 1e-2 * self.moved) * noise

        def sampler(observation, action, step):
            assert 0 <= step < horizon
            one = torch.ones(*observation.shape[:-1], 1)
            return torch.cat([observation, action.expand(num_particles, -1, -1), one], -1) @ weight

        return sampler

    def state_dict(self):
        return {} if self.mean is None else {"mean": self.mean, "moved": self.moved}

    def load_state_dict(self, state):
        self.mean, self.moved = state.get("mean"), state.get("moved", 0.0)

    def _solve(self, data, generator):
        inputs = torch.cat([data.observation, data.action, torch.ones(len(data.action), 1)], -1).double()
        gram = inputs.T @ inputs + 1e-6 * torch.eye(inputs.shape[1])
        self.mean = torch.linalg.solve(gram, inputs.T @ data.next_observation.double()).float()
        self.moved = float(torch.rand((), generator=generator, dtype=torch.float64))


def planner(**arguments):
    bound = torch.tensor([2.0])
    settings = {"horizon": 5, "num_candidates": 40, "num_elites": 5, "num_iterations": 3, **arguments}
    return CEM(action_low=-bound, action_high=bound, **settings)


def agent(env=None, **arguments):
    """An `MPCAgent` on the point mass, quick and seeded."""
    env = KnownPointMass() if env is None else env
    made_of = [arguments.pop("dynamics", None) or LinearModel(), arguments.pop("planner", None) or planner()]
    return MPCAgent(env, *made_of, **{"seed": 0, **arguments})


def actions_of(env):
    """Every action the environment was given, in order."""
    return np.array([action for _, action, _ in env.unwrapped.steps])
