"""What a run keeps of its episodes while they happen: the last one with its pictures, and forecasts made in it."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from jaxtyping import Float
from numpy import ndarray
from stable_baselines3.common.callbacks import BaseCallback

from gym_dgpmpc.agents import MPCAgent
from gym_dgpmpc.agents.forecasting import draw_worlds, states_along
from gym_dgpmpc.runs.figures import Forecast
from gym_dgpmpc.runs.rendering import shrink
from gym_dgpmpc.tasks.dict_observations import flatten
from gym_dgpmpc.types import TransitionSampler
from gym_dgpmpc.wrappers.risk_sensitive import ORIGINAL_REWARD

NUM_FORECAST_PARTICLES = 100
MAX_FRAMES, MAX_FRAMES_PER_SECOND = 400, 25


class Episode(NamedTuple):
    """T steps of an environment, from a reset to the episode's end."""

    observations: Float[ndarray, "T_plus_1 S"]
    actions: Float[ndarray, "T A"]
    rewards: Float[ndarray, " T"]
    frames: list[ndarray]
    frames_per_second: float


class EpisodeRecorder(gymnasium.Wrapper):
    """Keeps the last episode that ended, its pictures too if the environment renders `rgb_array`.

    Where `RiskSensitiveReward` makes `step` return another reward, it keeps the task's own.

    A long episode's pictures are thinned out, evenly, so that its GIF keeps the true speed at a readable size.

    Args:
        env: an environment with observations that are vectors, or dicts of such, and actions that are vectors.
        on_end: called with each episode that ends.
    """

    keeps_task = True  # for `known.find`: what is known of the environment holds for the recorded one too

    def __init__(self, env: gymnasium.Env, on_end: Callable[[Episode], None] | None = None):
        super().__init__(env)
        self.last: Episode | None = None
        self._on_end = on_end
        self._steps_per_frame, self._frames_per_second = frame_rate(env.metadata, env.spec)
        self._observations: list[ndarray] = []
        self._actions: list[ndarray] = []
        self._rewards: list[float] = []
        self._frames: list[ndarray] = []

    @property
    def num_steps(self) -> int:
        """Steps of the running episode."""
        return len(self._actions)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(**kwargs)
        self._observations, self._actions, self._rewards, self._frames = [np.array(flatten(observation))], [], [], []
        self._add_frame()
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        result = observation, reward, terminated, truncated, info = self.env.step(action)
        self._observations.append(np.array(flatten(observation)))
        self._actions.append(np.array(action))
        self._rewards.append(float(info.get(ORIGINAL_REWARD, reward)))
        if self.num_steps % self._steps_per_frame == 0:
            self._add_frame()
        if terminated or truncated:
            observations, actions = np.stack(self._observations), np.stack(self._actions)
            rewards = np.array(self._rewards)
            self.last = Episode(observations, actions, rewards, self._frames, self._frames_per_second)
            if self._on_end is not None:
                self._on_end(self.last)
        return result

    def _add_frame(self) -> None:
        if self.env.render_mode == "rgb_array":
            frame = self.env.render()
            assert isinstance(frame, ndarray)
            self._frames.append(shrink(frame))


def frame_rate(metadata: Mapping[str, Any], spec: EnvSpec | None) -> tuple[int, float]:
    """Steps of an environment between two pictures that are kept, and how many pictures a second that makes."""
    # The metadata of a vector environment or of a wrapper may lack the rate.
    rate = float(metadata.get("render_fps") or MAX_FRAMES_PER_SECOND)
    limit = (spec.max_episode_steps if spec is not None else None) or MAX_FRAMES
    steps = max(1, round(rate / MAX_FRAMES_PER_SECOND), -(-limit // MAX_FRAMES))
    return steps, rate / steps


class ForecastCallback(BaseCallback):
    """Draws worlds early in each planned episode, and compares them with what happened when it has ended.

    The worlds are drawn when the step that they start from has just been made, so the model has not seen what it
    predicts. Their generator depends on the seed and the step alone: they leave the run as it is without them, and a
    run that goes on draws what it would have drawn. (Forecasts that had been begun when a run was killed within an
    episode are missing from it.)

    Args:
        agent: the agent that learns.
        recorder: around its environment.
        num_particles: worlds per forecast.
    """

    def __init__(self, agent: MPCAgent, recorder: EpisodeRecorder, num_particles: int = NUM_FORECAST_PARTICLES):
        super().__init__()
        self.agent, self.recorder, self.num_particles = agent, recorder, num_particles
        self.horizon = agent.controller.horizon
        self.forecasts: list[Forecast] = []
        """Those of the last planned episode that ended."""
        self._worlds: dict[int, TransitionSampler] = {}

    def _on_step(self) -> bool:
        if self.locals["dones"][0]:
            if self._worlds and self.recorder.last is not None:
                episode = self.recorder.last
                starts = [start for start in self._worlds if start < len(episode.actions)]
                self.forecasts = [self._compare(episode, start) for start in starts]
            self._worlds = {}
        elif self.agent.is_fitted and self.recorder.num_steps in (1, 1 + self.horizon):
            worlds = draw_worlds(self.agent, self.num_particles, self.horizon, self.agent.num_timesteps)
            self._worlds[self.recorder.num_steps] = worlds
        return True

    def _compare(self, episode: Episode, start: int) -> Forecast:
        """What the worlds drawn at a step predict for the actions taken from it, beside what happened."""
        actions = episode.actions[start : start + self.horizon]
        actions = actions.reshape(len(actions), -1)
        states = states_along(self.agent, self._worlds[start], episode.observations[start], actions, self.num_particles)
        observed = episode.observations[start : start + len(actions) + 1]
        return Forecast(start, states[..., : self.agent.task.modelled.observation_size].cpu().numpy(), observed)
