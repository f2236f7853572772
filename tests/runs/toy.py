"""A task that takes no time and draws itself without OpenGL, and the smallest agent that runs in it."""

import gymnasium
import numpy as np
from gymnasium import spaces

ENV_ID = "tests.runs.toy:ToyPush-v0"
EPISODE_STEPS = 12

SMALLEST_AGENT = {
    "num_layers": 1,
    "num_inducing": 4,
    "num_features": 4,
    "num_particles": 2,
    "horizon": 3,
    "num_candidates": 6,
    "num_iterations": 1,
    "first_training_iterations": 2,
    "training_iterations": 2,
    "num_samples": 2,
    "sample_spacing": 1,
    "resample_samples": 0,
}


class ToyPush(gymnasium.Env):
    """A number that actions push about; it should be near 1.

    ## Observation space
    | Num | Observation          | Min  | Max | Unit |
    |-----|----------------------|------|-----|------|
    | 0   | place; 1 is the aim  | -inf | inf | m    |
    | 1   | last push            | -1   | 1   | N    |
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode=None, terminate_at=None):
        self.render_mode, self.terminate_at = render_mode, terminate_at
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,))
        self.action_space = spaces.Box(-1.0, 1.0, (1,))

    @staticmethod
    def reward_fn(observation, action, next_observation):
        return -((next_observation[..., 0] - 1) ** 2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time, self.state = 0, self.np_random.normal(size=2).astype(np.float32)
        return self.state, {}

    def step(self, action):
        self.time += 1
        push = np.float32(action[0])
        self.state = np.array([self.state[0] + 0.1 * push, push], dtype=np.float32)
        reward = -float((self.state[0] - 1) ** 2)
        return self.state, reward, self.time == self.terminate_at, False, {}

    def render(self):
        frame = np.zeros((20, 30, 3), dtype=np.uint8)
        frame[:, self.time % 30] = 255
        return frame


class ToyPushWithoutReward(ToyPush):
    """The same, keeping its reward to itself."""

    reward_fn = property()


if "ToyPush-v0" not in gymnasium.registry:
    gymnasium.register("ToyPush-v0", ToyPush, max_episode_steps=EPISODE_STEPS)
    gymnasium.register("ToyPushForever-v0", ToyPush)
    gymnasium.register("ToyPushWithoutReward-v0", ToyPushWithoutReward, max_episode_steps=EPISODE_STEPS)
