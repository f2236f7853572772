"""The recorder keeps what happened, and a forecast is what the model said before it happened."""

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from gym_dgpmpc.agents import DGPMPCAgent
from gym_dgpmpc.planning import rollout
from gym_dgpmpc.randomness import derive_seed
from gym_dgpmpc.runs.recording import EpisodeRecorder, ForecastCallback
from tests.runs.toy import EPISODE_STEPS, SMALLEST_AGENT


def play(recorder, actions, seed=0):
    observations, rewards = [recorder.reset(seed=seed)[0].copy()], []
    for action in actions:
        observation, reward, terminated, truncated, _ = recorder.step(action)
        observations.append(observation.copy())
        rewards.append(reward)
    return np.stack(observations), rewards, terminated or truncated


def test_keeps_the_last_episode():
    ended = []
    recorder = EpisodeRecorder(gymnasium.make("ToyPush-v0", render_mode="rgb_array"), ended.append)
    actions = np.random.default_rng(0).uniform(-1, 1, (EPISODE_STEPS, 1)).astype(np.float32)
    observations, rewards, done = play(recorder, actions)
    assert done
    recorder.reset()
    recorder.step(actions[0])
    assert recorder.num_steps == 1
    assert ended == [recorder.last]
    np.testing.assert_array_equal(recorder.last.observations, observations)
    np.testing.assert_array_equal(recorder.last.actions, actions)
    np.testing.assert_array_equal(recorder.last.rewards, rewards)
    assert len(recorder.last.frames) == EPISODE_STEPS + 1
    assert recorder.last.frames_per_second == 10


def test_renders_only_what_can_be_rendered():
    recorder = EpisodeRecorder(gymnasium.make("ToyPush-v0"))
    play(recorder, np.zeros((EPISODE_STEPS, 1), np.float32))
    assert recorder.last.frames == []


def test_thins_out_the_frames_of_long_episodes():
    recorder = EpisodeRecorder(gymnasium.make("ToyPush-v0", render_mode="rgb_array", max_episode_steps=1200))
    play(recorder, np.zeros((1200, 1), np.float32))
    assert len(recorder.last.frames) == 401
    assert recorder.last.frames_per_second * 3 == 10


class DrawItself(BaseCallback):
    """Draws with a generator like the forecast's, at the same moments, from the agent's model at that time."""

    def __init__(self, agent, recorder):
        super().__init__()
        self.agent, self.recorder, self.worlds = agent, recorder, {}

    def _on_step(self):
        done = bool(self.locals["dones"][0])
        if not done and self.agent.is_fitted and self.recorder.num_steps in (1, 4):
            generator = torch.Generator().manual_seed(derive_seed(self.agent.seed, "forecast", self.num_timesteps))
            self.worlds[self.recorder.num_steps] = self.agent.dynamics.draw(20, 3, generator)
        return True


def learn(make_callbacks):
    recorder = EpisodeRecorder(gymnasium.make("ToyPush-v0"))
    agent = DGPMPCAgent(recorder, seed=0, **SMALLEST_AGENT)
    callbacks = make_callbacks(agent, recorder)
    agent.learn(2 * EPISODE_STEPS, callbacks)
    return agent, recorder, callbacks


def test_forecasts_are_of_what_was_done_by_the_model_of_that_time():
    _, recorder, (forecasts, drawn) = learn(
        lambda agent, recorder: [ForecastCallback(agent, recorder, 20), DrawItself(agent, recorder)]
    )
    assert [forecast.start_step for forecast in forecasts.forecasts] == [1, 4]
    for forecast in forecasts.forecasts:
        start = forecast.start_step
        steps = slice(start, start + 3)
        np.testing.assert_array_equal(forecast.observed, recorder.last.observations[start : start + 4])
        states = rollout(
            drawn.worlds[start],
            torch.from_numpy(recorder.last.observations[start]),
            torch.from_numpy(recorder.last.actions[None, steps]),
            20,
        )
        np.testing.assert_array_equal(forecast.predicted, states[:, :, 0])
        np.testing.assert_array_equal(forecast.predicted[0], np.broadcast_to(forecast.observed[0], (20, 2)))


def test_forecasting_leaves_learning_as_it_is():
    with_forecasts, without = learn(ForecastCallback)[0], learn(lambda agent, recorder: None)[0]
    np.testing.assert_array_equal(with_forecasts.store.transitions().action, without.store.transitions().action)


def test_a_forecast_ends_with_its_episode():
    recorder = EpisodeRecorder(gymnasium.make("ToyPush-v0"))
    agent = DGPMPCAgent(recorder, seed=0, **(SMALLEST_AGENT | {"horizon": 8}))
    forecasts = ForecastCallback(agent, recorder, 5)
    agent.learn(2 * EPISODE_STEPS, forecasts)
    assert [len(forecast.observed) for forecast in forecasts.forecasts] == [9, 4]
    assert [forecast.predicted.shape[:2] for forecast in forecasts.forecasts] == [(9, 5), (4, 5)]
