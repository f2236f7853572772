"""What is seen inside an agent while it learns, and that the agent does not notice."""

import csv
import json

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps
from stable_baselines3.common.logger import KVWriter, configure
from stable_baselines3.common.vec_env import DummyVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gym_dgpmpc import DGPMPCAgent, GPMPCAgent
from gym_dgpmpc.dynamics.scores import scores
from gym_dgpmpc.randomness import derive_seed
from gym_dgpmpc.runs import LookInside
from gym_dgpmpc.runs.looking_back import picked_starts
from tests.agents import point_mass
from tests.faults.compare import checkpoint_differences
from tests.runs.toy import EPISODE_STEPS, SMALLEST_AGENT

MIXING = SMALLEST_AGENT | {"num_samples": 20}
"""Samples enough of each chain for an R-hat."""

BY_STEP = ("coverage_50", "coverage_90", "nll", "crps", "particle_std")


def make(env="ToyPush-v0", **arguments):
    return DGPMPCAgent(env, seed=0, **{**MIXING, **arguments})


def learn(agent, folder, *formats, callback=None, num_episodes=3):
    if formats:
        agent.set_logger(configure(str(folder), list(formats)))
    agent.learn(num_episodes * EPISODE_STEPS, callback)
    return agent


def actions_of(agent):
    return agent.store.transitions().action.numpy()


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """Three episodes that were looked at for TensorBoard: agent, callback, and what is in the file."""
    folder, callback = tmp_path_factory.mktemp("seen"), LookInside(num_particles=20, share=1, video=True)
    env = gymnasium.make("ToyPush-v0", render_mode="rgb_array")
    agent = learn(make(env), folder, "tensorboard", "csv", "json", "log", callback=callback)
    events = EventAccumulator(str(folder), size_guidance={"images": 0, "tensors": 0, "scalars": 0}).Reload()
    return agent, callback, events, folder


def test_the_agent_acts_as_without(seen):
    agent, callback, _, _ = seen
    np.testing.assert_array_equal(actions_of(agent), actions_of(learn(make(), None)))
    assert callback.seconds > 0
    assert agent.dynamics.on_progress is None


def test_every_output_has_the_numbers(seen):
    _, _, events, folder = seen
    wanted = {f"look/{name}" for name in ("saturated_actions", "effective_sample_size", "r_hat", "noise_std")}
    wanted |= {f"look/{name}_reward_per_step" for name in ("predicted", "obtained")}
    wanted |= {f"look/{name}_step_{step}" for name in BY_STEP for step in (1, 2, 3)}
    assert wanted <= set(events.Tags()["scalars"])
    with (folder / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert wanted <= set(rows[0])
    lines = [json.loads(line) for line in (folder / "progress.json").read_text().splitlines()]
    assert wanted <= {name for line in lines for name in line}
    assert "coverage_90_step_1" in (folder / "log.txt").read_text()
    # Of the two planned episodes, at the steps that ended them.
    points = events.Scalars("look/coverage_90")
    assert [point.step for point in points] == [2 * EPISODE_STEPS, 3 * EPISODE_STEPS]


def test_tensorboard_has_pictures_settings_and_charts(seen):
    _, callback, events, _ = seen
    assert set(callback.pictures) == {"fan", "scores", "training", "planning"}
    assert {f"look/{name}" for name in callback.pictures} <= set(events.Tags()["images"])
    assert "look/action_0" in events.Tags()["histograms"]
    (text,) = events.Tensors("look/settings/text_summary")
    assert b"| num_inducing | 4 |" in text.tensor_proto.string_val[0]
    (layout,) = events.Tensors("custom_scalars__config__")
    assert b"look/predicted_reward_per_step" in layout.tensor_proto.string_val[0]
    labels = [axes.get_ylabel() for axes in callback.pictures["fan"].axes]
    assert "place (m)" in labels and "reward" in labels and "actions" in labels
    names = [[text.get_text() for text in axes.get_yticklabels()] for axes in callback.pictures["training"].axes[1:]]
    assert names == [["place (m)", "last push (N)"], ["place (m)", "last push (N)", "action 0"]]


def test_the_video_has_the_episode_with_a_line_of_text(seen):
    _, _, events, _ = seen
    films = [each.encoded_image_string for each in events.Images("look/video")]
    assert len(films) == 3 and all(each.startswith(b"GIF89a") for each in films)
    assert events.Images("look/video")[0].height == 20 + 16


def test_the_rewards_are_those_of_the_records(seen):
    agent, _, events, _ = seen
    predicted, obtained = agent.episode_records[0].predicted_and_obtained()
    assert events.Scalars("look/predicted_reward_per_step")[-1].value == pytest.approx(predicted)
    assert events.Scalars("look/obtained_reward_per_step")[-1].value == pytest.approx(obtained)


class KeepWhatWasWritten(KVWriter):
    """An output of a logger that keeps rows."""

    def __init__(self):
        self.rows = []

    def write(self, key_values, key_excluded, step=0):
        self.rows.append({**key_values, "step": step})

    def close(self):
        pass


def looked_at(agent, callback, num_steps):
    """The rows that the callback wrote, and not the agent."""
    agent.set_logger(configure(None, []))
    kept = KeepWhatWasWritten()
    agent.logger.output_formats.append(kept)
    agent.learn(num_steps, callback)
    return [row for row in kept.rows if any(name.startswith("look/") for name in row)]


def test_scores_are_of_the_model_before_it_saw_the_episode():
    """The linear model of the point mass can be drawn from by hand, at the steps that were picked."""
    drawn = {}

    class Spy(LookInside):
        def _on_step(self):
            number, record = self.agent.store.episodes.max(), self.agent.episode_records[0]
            if self.agent.is_fitted and len(record.rewards) in picked_starts(self.agent, int(number), 2):
                drawn[len(record.rewards)] = (self.agent.dynamics.mean.clone(), self.agent.dynamics.moved)
            return super()._on_step()

    agent = point_mass.agent()
    rows = looked_at(agent, Spy(num_windows=2, num_particles=50), 2 * point_mass.LENGTH)
    observation, action, after = agent.store.transitions()
    unit, found = observation.double().std(0), []
    for start, (mean, moved) in drawn.items():
        key = point_mass.LENGTH + start
        generator = torch.Generator().manual_seed(derive_seed(0, "forecast", key))
        noise = torch.randn(50, *mean.shape, generator=generator)
        weight = mean + 1e-3 * (1 + 1e-2 * moved) * noise
        state = observation[key].expand(50, 1, -1)
        state = torch.cat([state, action[key].expand(50, 1, 1), torch.ones(50, 1, 1)], -1) @ weight
        found.append((state[:, 0].double() / unit, after[key].double() / unit))
    assert len(found) == 2
    expected = scores(torch.stack([p for p, _ in found], 1), torch.stack([t for _, t in found]))
    (row,) = [row for row in rows if "look/nll_step_1" in row]
    for name in ("coverage_90", "nll", "crps"):
        assert row[f"look/{name}_step_1"] == pytest.approx(expected[name], rel=1e-3, abs=1e-6)


def test_one_point_an_episode_of_several_environments():
    agent = make(DummyVecEnv([lambda: gymnasium.make("ToyPush-v0") for _ in range(3)]))
    callback = LookInside(num_particles=10)
    rows = looked_at(agent, callback, 3 * 3 * EPISODE_STEPS)
    steps = [row["step"] for row in rows if "look/predicted_reward_per_step" in row]
    assert steps == [2 * 3 * EPISODE_STEPS, 3 * 3 * EPISODE_STEPS]
    assert len(callback._rewards) == 6  # episodes that were planned


def test_called_now_and_then():
    callback = LookInside(num_particles=10)
    agent = make()
    rows = looked_at(agent, EveryNTimesteps(5, callback), 4 * EPISODE_STEPS)
    np.testing.assert_array_equal(actions_of(agent), actions_of(learn(make(), None, num_episodes=4)))
    assert any("look/coverage_90" in row for row in rows)


class Repeatable(point_mass.KnownPointMass):
    """One whose episode a run may go on in, after it was killed."""

    can_replay = True


class Kill(BaseCallback):
    """Within the third episode."""

    def _on_step(self):
        if self.num_timesteps == 2 * point_mass.LENGTH + 7:
            raise KeyboardInterrupt
        return True


def test_a_run_that_goes_on_equals_one_that_was_not_stopped(tmp_path):
    """Killed within an episode, after a forecast of it has begun: all that a checkpoint holds is the same."""

    def train(folder, *callbacks):
        logs = str(tmp_path / folder / "logs")
        learner = point_mass.agent(Repeatable(), tensorboard_log=logs)
        learner.learn(3 * point_mass.LENGTH, list(callbacks), run_folder=tmp_path / folder, resume=True)

    train("whole")
    with pytest.raises(KeyboardInterrupt):
        train("parts", LookInside(num_particles=10), Kill())
    train("parts", LookInside(num_particles=10))
    assert checkpoint_differences(tmp_path / "whole" / "agent.zip", tmp_path / "parts" / "agent.zip") == []


def test_models_of_other_kinds():
    """One that reports neither loss nor scales, and one of a single chain."""
    callback = LookInside(num_particles=10)
    assert any("look/crps" in row for row in looked_at(point_mass.agent(), callback, 2 * point_mass.LENGTH))
    agent = GPMPCAgent("ToyPush-v0", seed=0, num_inducing=4, horizon=3, num_candidates=6, num_iterations=1)
    assert any("look/crps" in row for row in looked_at(agent, LookInside(num_particles=10), 2 * EPISODE_STEPS))
    scales = agent.dynamics.scales()
    assert [tuple(each.shape) for each in scales.lengthscales] == [(1, 3)] and scales.noise_std.shape == (1, 2)


@pytest.mark.parametrize(
    ("arguments", "named"), [({"num_windows": 0}, "num_windows"), ({"share": 0.0}, "share"), ({"share": 2.0}, "share")]
)
def test_refuses_what_it_cannot_do(arguments, named):
    with pytest.raises(ValueError, match=named):
        LookInside(**arguments)


def test_refuses_other_algorithms_and_environments_that_do_not_render():
    with pytest.raises(TypeError, match="MPCAgent, got SAC"):
        SAC("MlpPolicy", "Pendulum-v1", buffer_size=10).learn(1, LookInside())
    with pytest.raises(ValueError, match="rgb_array"):
        make(gymnasium.make("ToyPush-v0")).learn(1, LookInside(video=True))


def test_without_time_each_picture_comes_once_at_the_end(tmp_path):
    callback = LookInside(num_particles=10, share=1e-6)
    agent = learn(make(), tmp_path, "tensorboard", callback=callback, num_episodes=3)
    assert set(callback.pictures) == {"fan", "scores", "planning", "training"}
    events = EventAccumulator(str(tmp_path)).Reload()
    assert {event.step for name in callback.pictures for event in events.Images(f"look/{name}")} == {
        agent.num_timesteps
    }
    assert len(events.Images("look/fan")) == 1 and len(events.Scalars("look/coverage_90")) == 2
    agent.learn(agent.num_timesteps // 3, reset_num_timesteps=False, callback=callback)
    assert len(EventAccumulator(str(tmp_path)).Reload().Images("look/fan")) == 1
