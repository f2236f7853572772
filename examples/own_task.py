"""A task of one's own, in full: docs/own_task.md goes through it. `python examples/own_task.py` takes some minutes."""

import gymnasium as gym
import numpy as np
import torch

from gym_dgpmpc import DGPMPCAgent, settings_for


class TwoTanks(gym.Env):
    """A pump (0 to 1) fills a tank that drains into another, whose level should be 0.5 m; observed: both levels."""

    observation_space = gym.spaces.Box(0.0, 1.0, (2,), np.float64)
    action_space = gym.spaces.Box(0.0, 1.0, (1,), np.float32)

    def reward_fn(self, observation, action, next_observation):  # torch tensors with any leading dimensions
        return -((next_observation[..., 1] - 0.5) ** 2) - 0.001 * action[..., 0] ** 2

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.levels = self.np_random.uniform(0.0, 0.2, 2)
        return self.levels.copy(), {}

    def step(self, action):
        before, drain = self.levels, 0.1 * np.sqrt(self.levels)
        change = np.array([0.12 * action[0] - drain[0], drain[0] - drain[1]])
        self.levels = np.clip(before + change, 0.0, 1.0)
        reward = self.reward_fn(*map(torch.as_tensor, (before, action, self.levels)))
        return self.levels.copy(), float(reward), False, False, {}


def main(episodes=4, **settings):
    env = gym.wrappers.TimeLimit(TwoTanks(), max_episode_steps=60)
    agent = DGPMPCAgent(env, **{**settings_for(), "seed": 0, "verbose": 1, **settings})
    return agent.learn(60 * episodes)


if __name__ == "__main__":
    main()
