"""What an SB3 user expects to work with any algorithm: evaluation, callbacks, logs, progress, monitors."""

import csv
import re

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gym_dgpmpc import MPCAgent
from tests.agents.point_mass import LENGTH, KnownPointMass, LinearModel, actions_of, agent, planner


@pytest.fixture
def registered():
    gym.register("PointMassOfTheTests-v0", entry_point=KnownPointMass)
    yield "PointMassOfTheTests-v0"
    del gym.registry["PointMassOfTheTests-v0"]


class Sum(BaseCallback):
    """A user's callback that reads the usual local variables."""

    def __init__(self):
        super().__init__()
        self.total, self.episodes, self.rollouts = 0.0, 0, 0

    def _on_step(self):
        self.total += float(self.locals["rewards"][0])
        self.episodes += "episode" in self.locals["infos"][0]
        assert self.num_timesteps == self.model.num_timesteps
        return True

    def _on_rollout_start(self):
        self.rollouts += 1


def test_evaluate_policy_carries_the_plan():
    learner = agent().learn(3 * LENGTH)
    assert isinstance(learner, BaseAlgorithm)
    returns, lengths = evaluate_policy(learner, Monitor(KnownPointMass()), 3, return_episode_rewards=True)
    assert lengths == [LENGTH] * 3
    several = DummyVecEnv([lambda: Monitor(KnownPointMass())] * 2)
    assert len(evaluate_policy(learner, several, 4, return_episode_rewards=True)[0]) == 4
    assert min(returns) > -4.0


def test_evaluation_during_training_changes_nothing(tmp_path):
    alone, watched = agent(), agent()
    alone.learn(35)
    watch = EvalCallback(
        Monitor(KnownPointMass()),
        eval_freq=7,
        n_eval_episodes=1,
        best_model_save_path=str(tmp_path),
        log_path=str(tmp_path),
        verbose=0,
    )
    with pytest.warns(UserWarning, match=r"predict.*learned"):
        watched.learn(35, callback=watch)
    np.testing.assert_array_equal(actions_of(alone.env.envs[0]), actions_of(watched.env.envs[0]))
    best = MPCAgent.load(tmp_path / "best_model", env=KnownPointMass(), dynamics=LinearModel(), planner=planner())
    assert best.num_timesteps in {7, 14, 21, 28, 35}


def test_training_stops_at_a_reward_threshold():
    learner = agent()
    stop = StopTrainingOnRewardThreshold(reward_threshold=-1e6, verbose=0)
    watch = EvalCallback(Monitor(KnownPointMass()), callback_on_new_best=stop, eval_freq=12, verbose=0)
    learner.learn(100, callback=[watch])
    assert learner.num_timesteps == 12


def test_a_callback_has_the_logger_from_the_first():
    class Early(BaseCallback):
        def _init_callback(self):
            self.logger.record("mine/value", 3.0)

        def _on_step(self):
            return True

    learner = agent()
    learner.learn(3, callback=[Early()])
    assert learner.logger.name_to_value["mine/value"] == 3.0


def test_after_a_callbacks_stop_the_last_episode_is_learned_from_on_demand():
    learner = agent().learn(100, callback=StopTrainingOnMaxEpisodes(2, verbose=0))
    assert (len(learner.store), learner.num_fitted) == (20, 10)
    assert learner.learn(0, reset_num_timesteps=False).num_fitted == 20


def test_checkpoints_and_users_callbacks(tmp_path):
    learner, total = agent(), Sum()
    learner.learn(25, callback=CallbackList([CheckpointCallback(10, str(tmp_path), verbose=0), total]))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rl_model_10_steps.zip", "rl_model_20_steps.zip"]
    assert total.total == pytest.approx(float(learner.store.rewards.sum()), rel=1e-5)
    assert (total.episodes, total.rollouts) == (2, 3)
    learner.learn(5, callback=lambda locals_, globals_: False)
    assert learner.num_timesteps == 1


def test_progress_bar(capsys):
    agent().learn(15, progress_bar=True)
    assert "15/15" in "".join(capsys.readouterr())


def test_one_readable_line_per_episode(capsys):
    agent(verbose=1).learn(25)
    lines = capsys.readouterr().out.splitlines()
    assert lines.pop(0) == "reward: the environment's | termination: unknown"
    assert len(lines) == 2
    assert re.fullmatch(r"episode +1 \| +10 steps \| return +-\d+\.\d\d \| +\d+\.\d s \| random actions", lines[0])
    assert re.fullmatch(
        r"episode +2 \| +20 steps \| return +-\d+\.\d\d \| +\d+\.\d s "
        r"\| per step: predicted +-?\d+\.\d+, obtained +-?\d+\.\d+ \| +\d+ ms per plan",
        lines[1],
    )


@pytest.mark.parametrize(("verbose", "table"), [(0, False), (1, False), (2, True)])
def test_tables_are_for_verbose_2(verbose, table, capsys):
    agent(verbose=verbose).learn(25)
    assert ("rollout/" in capsys.readouterr().out) == table


def test_tensorboard_gets_the_curves(tmp_path):
    agent(tensorboard_log=str(tmp_path)).learn(35, tb_log_name="point").learn(10, reset_num_timesteps=False)
    events = EventAccumulator(str(tmp_path / "point_1")).Reload()
    expected = {
        "rollout/ep_rew_mean", "rollout/ep_return", "rollout/ep_len_mean", "train/residual", "train/seconds",
        "train/num_transitions", "planner/expected_return", "planner/predicted_reward_per_step",
        "planner/obtained_reward_per_step", "planner/num_nonfinite", "time/plan_ms", "time/fps",
    }  # fmt: skip
    assert expected <= set(events.Tags()["scalars"])
    assert [event.step for event in events.Scalars("rollout/ep_return")] == [10, 20, 30]


def test_logged_values_are_right(tmp_path):
    learner = agent()
    learner.set_logger(configure(str(tmp_path), ["csv"]))
    learner.learn(4 * LENGTH, log_interval=2)
    rows = list(csv.DictReader((tmp_path / "progress.csv").open()))
    assert [int(row["time/total_timesteps"]) for row in rows] == [20, 40]
    returns = learner.store.rewards.reshape(4, LENGTH).sum(1)
    assert float(rows[1]["rollout/ep_return"]) == pytest.approx(float(returns[3]), rel=1e-5)
    assert float(rows[1]["rollout/ep_rew_mean"]) == pytest.approx(float(returns.mean()), rel=1e-5)
    assert float(rows[1]["train/num_transitions"]) == 30
    # With a model this good, what was predicted is what was obtained.
    predicted, obtained = (float(rows[1][f"planner/{kind}_reward_per_step"]) for kind in ("predicted", "obtained"))
    assert predicted == pytest.approx(obtained, abs=0.1)


def test_monitor_files(tmp_path):
    agent(Monitor(KnownPointMass(), str(tmp_path / "run"))).learn(25)
    rows = (tmp_path / "run.monitor.csv").read_text().splitlines()
    assert len(rows) == 2 + 2


def test_environments_by_id(registered):
    learner = agent(registered).learn(12)
    assert len(learner.store) == 12


def test_seeding_reaches_the_environment():
    starts = [agent(seed=seed).learn(1).store.transitions().observation[0].tolist() for seed in (1, 1, 2)]
    assert starts[0] == starts[1] != starts[2]


def test_parameters_are_not_read_from_pickles(tmp_path):
    learned = agent().learn(12)
    assert learned.get_parameters()["dynamics"].keys() == learned.dynamics.state_dict().keys()
    with pytest.raises(NotImplementedError, match=r"MPCAgent.load\(path\)"):
        learned.set_parameters(tmp_path / "some.zip")
