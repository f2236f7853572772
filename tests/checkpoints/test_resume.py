"""A run that was killed goes on to the very result that it would have had; see also tests/faults."""

import json
import os
import signal
import subprocess
import sys
import threading

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from gym_dgpmpc.agents.logs import Logs
from gym_dgpmpc.checkpoints import folder as run_checkpoints
from gym_dgpmpc.checkpoints.collect import collect
from gym_dgpmpc.checkpoints.folder import RunCheckpoints
from gym_dgpmpc.errors import (
    CheckpointError,
    CheckpointWriteError,
    EnvironmentFailedError,
    PlanningError,
    ReliabilityWarning,
    RunInUseError,
)
from gym_dgpmpc.planning import PLANNERS
from gym_dgpmpc.tasks.replay import generator_states, set_generator_states
from tests.agents.point_mass import LENGTH, TIME_STEP, KnownPointMass, agent
from tests.faults.compare import checkpoint_differences, log_differences

TOTAL = 5 * LENGTH - 3


class NoisyPointMass(KnownPointMass):
    """Its steps draw from its generator, and its state is more than what it shows."""

    can_replay = True

    def reset(self, **arguments):
        self.drift = 0.0
        return super().reset(**arguments)

    def step(self, action):
        self.drift += 0.01 * self.np_random.normal()
        self.state = self.state + np.array([TIME_STEP * self.drift, 0.0])
        return super().step(action)


class Plant(NoisyPointMass):
    """One that must not be driven by a recording."""

    can_replay = False
    performed = 0

    def step(self, action):
        self.performed += 1
        return super().step(action)


class KillAt(BaseCallback):
    """As a kill would: nothing is written once it comes."""

    def __init__(self, step):
        super().__init__()
        self.step = step

    def _on_step(self):
        if self.num_timesteps == self.step:
            raise KeyboardInterrupt
        return True


def train(folder, env=None, *, kill_at=None, total=TOTAL, every=None, resume=True, logs=True, **arguments):
    learner = agent(
        NoisyPointMass() if env is None else env, tensorboard_log=str(folder / "logs") if logs else None, **arguments
    )
    settings = {"run_folder": folder, "resume": resume, "checkpoint_every": every}
    if kill_at is None:
        return learner.learn(total, **settings)
    with pytest.raises(KeyboardInterrupt):
        learner.learn(total, KillAt(kill_at), **settings)
    return learner


def assert_same(one, other):
    assert checkpoint_differences(one / "agent.zip", other / "agent.zip") == []
    assert log_differences(one / "logs", other / "logs") == []


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    train(folder, actions_per_plan=2)
    return folder


@pytest.mark.parametrize("every", [None, 1, 4])
@pytest.mark.parametrize("kills", [[3], [LENGTH], [17, 18], [25, LENGTH + 16, 40], [46]])
def test_a_killed_run_ends_as_the_whole_one(whole, tmp_path, kills, every):
    for kill in kills:
        train(tmp_path, kill_at=kill, every=every, actions_per_plan=2)
    learner = train(tmp_path, every=every, actions_per_plan=2)
    assert learner.num_timesteps == len(learner.store) == TOTAL
    assert_same(whole, tmp_path)


@pytest.mark.parametrize("planner", PLANNERS)
def test_the_plans_of_every_planner_go_on(planner, tmp_path):
    """What they carry, such as elites, is in the checkpoint within an episode, bit by bit."""
    sequences = "num_starts" if planner == "gradient" else "num_candidates"
    settings = {"planner": planner, "horizon": 4, sequences: 30, "num_iterations": 2, "actions_per_plan": 2}
    settings |= {"total": LENGTH + 8, "logs": False}
    train(tmp_path / "whole", **settings)
    train(tmp_path / "parts", kill_at=LENGTH + 5, every=3, **settings)
    train(tmp_path / "parts", **settings)
    assert checkpoint_differences(tmp_path / "whole" / "agent.zip", tmp_path / "parts" / "agent.zip") == []


def test_a_run_goes_on_with_more_steps(whole, tmp_path):
    train(tmp_path, total=23, actions_per_plan=2)
    train(tmp_path, total=23, actions_per_plan=2)
    train(tmp_path, actions_per_plan=2)
    assert_same(whole, tmp_path)


def test_logs_that_wait_for_the_next_writing_are_kept(tmp_path):
    for name, kill in (("whole", None), ("parts", 33)):
        if kill:
            learner = agent(NoisyPointMass(), tensorboard_log=str(tmp_path / name / "logs"))
            with pytest.raises(KeyboardInterrupt):
                learner.learn(50, KillAt(kill), log_interval=2, run_folder=tmp_path / name, resume=True)
        learner = agent(NoisyPointMass(), tensorboard_log=str(tmp_path / name / "logs"))
        learner.learn(50, log_interval=2, run_folder=tmp_path / name, resume=True)
    assert_same(tmp_path / "whole", tmp_path / "parts")


def test_a_plant_goes_on_from_the_last_finished_episode(tmp_path):
    train(tmp_path / "whole", Plant())
    train(tmp_path / "parts", Plant(), kill_at=27)
    learner = train(tmp_path / "parts", Plant())
    assert learner.num_timesteps == TOTAL
    assert_same(tmp_path / "whole", tmp_path / "parts")


def test_checkpoints_within_an_episode_keep_the_steps_of_a_plant(tmp_path):
    killed = train(tmp_path, Plant(), kill_at=27, every=4)
    plant = Plant()
    learner = train(tmp_path, plant, every=4)
    assert learner.num_timesteps == len(learner.store) == TOTAL
    assert torch.equal(learner.store.transitions().observation[:24], killed.store.transitions().observation[:24])
    lengths = torch.bincount(learner.store.episodes).tolist()
    assert lengths == [LENGTH, LENGTH, 24 - 2 * LENGTH, LENGTH, LENGTH, TOTAL - 24 - 2 * LENGTH]
    assert plant.performed == TOTAL - 24  # nothing was performed a second time


def test_without_a_seed_the_run_keeps_the_one_it_drew(tmp_path):
    first = train(tmp_path, kill_at=27, seed=None)
    second = train(tmp_path, seed=None)
    assert second.seed == first.seed
    assert torch.equal(second.store.transitions().action[:20], first.store.transitions().action[:20])


class Unrepeatable(NoisyPointMass):
    """Draws from what no one can set."""

    def __init__(self, also_at_the_start=False):
        super().__init__()
        self.also_at_the_start, self.entropy = also_at_the_start, iter(np.random.default_rng().normal(size=1000))

    def reset(self, **arguments):
        observation, info = super().reset(**arguments)
        self.state = observation + self.also_at_the_start * next(self.entropy)
        return self.state.copy(), info

    def step(self, action):
        self.state = self.state + 1e-3 * next(self.entropy)
        return super().step(action)


@pytest.mark.parametrize("also_at_the_start", [False, True])
def test_an_environment_that_does_not_repeat_itself_is_told_of(tmp_path, also_at_the_start):
    train(tmp_path, Unrepeatable(also_at_the_start), kill_at=27, every=5)
    with pytest.warns(ReliabilityWarning, match="does not repeat the episode that was interrupted after 25 steps"):
        learner = train(tmp_path, Unrepeatable(also_at_the_start))
    assert learner.num_timesteps == TOTAL
    assert learner.store.episodes.tolist()[18:27] == [1, 1, 2, 2, 2, 2, 2, 3, 3]


def test_a_given_vec_env_goes_on_too(whole, tmp_path):
    def wrapped():
        return VecNormalize(DummyVecEnv([lambda: Monitor(NoisyPointMass())]), norm_obs=False)

    train(tmp_path, wrapped(), kill_at=27, every=3, actions_per_plan=2)
    train(tmp_path, wrapped(), actions_per_plan=2)
    assert_same(whole, tmp_path)


class Generators(gymnasium.Wrapper):
    def __init__(self, env, bits):
        super().__init__(env)
        self.own = np.random.Generator(bits(5))
        self.action_space.seed(3)


@pytest.mark.parametrize("kind", ["PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64"])
def test_every_kind_of_generator_is_brought_back(kind):
    env = gymnasium.wrappers.TimeLimit(Generators(NoisyPointMass(), getattr(np.random, kind)), 5)
    env.reset(seed=1)
    env.env.own.integers(0, 7, dtype=np.uint8)
    states = json.loads(json.dumps(generator_states(env)))
    assert len(states) == 3

    def draw():
        return [env.np_random.normal(), *env.env.own.normal(size=700), *env.action_space.sample()]

    expected = draw()
    set_generator_states(env, states)
    assert draw() == expected
    states["1.own"]["bit_generator"] = "Other"
    with pytest.raises(CheckpointError, match=r"random state of the environment's 1.own"):
        set_generator_states(env, states)


class FailsToReset(NoisyPointMass):
    def reset(self, **arguments):
        raise OSError("the plant is switched off")


def test_a_run_that_never_began_leaves_its_folder_free(tmp_path):
    with pytest.raises(EnvironmentFailedError, match="switched off"):
        train(tmp_path, FailsToReset())
    assert not (tmp_path / "agent.zip").exists()
    assert len(train(tmp_path, resume=False, total=12).store) == 12


def test_the_run_of_another_environment_is_refused(tmp_path):
    def learn(env_id):
        agent(gymnasium.make(env_id), reward_fn=lambda o, a, n: n[..., 0]).learn(4, run_folder=tmp_path, resume=True)

    learn("ModCartPole-v0")
    with pytest.raises(CheckpointError, match=r"the environment was ModCartPole-v0, now SwingUpCartPole-v0"):
        learn("SwingUpCartPole-v0")
    learn("ModCartPole-v0")


def test_another_agents_run_is_refused(tmp_path):
    train(tmp_path, total=12)
    with pytest.raises(CheckpointError, match=r"other settings: num_particles was 5, now 6; seed was 0, now 1"):
        train(tmp_path, num_particles=6, seed=1)
    with pytest.raises(CheckpointError, match="holds a run: pass resume=True"):
        train(tmp_path, resume=False)
    with pytest.raises(ValueError, match="need a run_folder"):
        agent().learn(5, resume=True)
    with pytest.raises(ValueError, match="checkpoint_every must be at least 1, got 0"):
        train(tmp_path / "new", every=0)


def test_a_damaged_checkpoint_is_told_of_and_the_one_before_it_used(whole, tmp_path):
    train(tmp_path, kill_at=36, actions_per_plan=2)
    data = (tmp_path / "agent.zip").read_bytes()
    (tmp_path / "agent.zip").write_bytes(data[: len(data) // 2])
    previous = (tmp_path / "agent.previous.zip").read_bytes()
    with pytest.warns(ReliabilityWarning, match=r"agent.zip is not.*damaged.*going on from the one before"):
        train(tmp_path, kill_at=25, actions_per_plan=2)
    assert (tmp_path / "agent.previous.zip").read_bytes() == previous
    (tmp_path / "agent.zip").unlink()  # as between the two renames of a file system without links
    train(tmp_path, actions_per_plan=2)
    assert_same(whole, tmp_path)
    for name in ("agent.zip", "agent.previous.zip"):
        (tmp_path / name).write_bytes(b"PK")
    with pytest.raises(CheckpointError, match=r"no checkpoint in .* can be read: .*agent.zip.*agent.previous.zip"):
        train(tmp_path, actions_per_plan=2)


def test_a_file_system_without_links(whole, tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(os, "link", refuse)
    train(tmp_path, kill_at=36, actions_per_plan=2)
    assert (tmp_path / "agent.previous.zip").exists()
    train(tmp_path, actions_per_plan=2)
    assert_same(whole, tmp_path)


def test_what_killed_writers_left_is_removed(tmp_path):
    (tmp_path / ".agent.zip.0123abcd.tmp").write_bytes(b"half of it")
    train(tmp_path, total=12)
    assert list(tmp_path.glob("*.tmp")) == list(tmp_path.glob(".*.tmp")) == []


def test_the_second_run_in_a_folder_is_refused(tmp_path):
    with RunCheckpoints(tmp_path):
        holder = rf"in use by process {os.getpid()} on .* since 20\d\d-"
        with pytest.raises(RunInUseError, match=holder):
            train(tmp_path)
        script = f"from gym_dgpmpc.checkpoints.folder import RunCheckpoints; RunCheckpoints({str(tmp_path)!r})"
        result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
        assert f"in use by process {os.getpid()} on " in result.stderr
        (tmp_path / run_checkpoints.HOLDER).write_text("[]")
        with pytest.raises(RunInUseError, match="in use by another process"):
            RunCheckpoints(tmp_path)
    train(tmp_path, total=12)


def test_the_folder_of_a_dead_process_is_free(tmp_path):
    script = (
        "import os, signal; from gym_dgpmpc.checkpoints.folder import RunCheckpoints; "
        f"held = RunCheckpoints({str(tmp_path)!r}); os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", script]).returncode == -signal.SIGKILL
    assert (tmp_path / run_checkpoints.HOLDER).exists()
    RunCheckpoints(tmp_path).close()


def test_a_folder_that_cannot_be_used(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointWriteError, match=r"folder .*file.* cannot be written to"):
        RunCheckpoints(tmp_path / "file" / "run")
    closed = RunCheckpoints(tmp_path)
    closed.close()
    with pytest.raises(RuntimeError, match="was closed"):
        closed.save(collect(agent()))


@pytest.mark.parametrize("failure", [ConnectionError("the plant is gone"), np.nan, ("reward", np.inf)])
def test_what_was_gathered_before_a_failure_is_saved(tmp_path, failure):
    env = NoisyPointMass(fail_at=27, failure=failure)
    with pytest.raises((EnvironmentFailedError, ValueError), match="step 27"):
        train(tmp_path, env)
    learner = train(tmp_path)
    assert learner.num_timesteps == len(learner.store) == TOTAL
    assert learner.store.episodes.tolist()[:30] == [0] * 10 + [1] * 10 + [2] * 7 + [3] * 3


def test_a_plan_without_a_finite_candidate_comes_after_the_data_is_saved(tmp_path):
    learner = agent(NoisyPointMass())
    resample = learner.dynamics.resample
    learner.dynamics.resample = lambda data, generator: (
        {"mean": learner.dynamics.mean.fill_(torch.nan).sum()} if len(data.action) == 26 else resample(data, generator)
    )
    with pytest.raises(PlanningError, match=r"none of the 40 candidate.*\(40 non-finite.*observation \["):
        learner.learn(TOTAL, run_folder=tmp_path, resume=True)
    later = train(tmp_path, logs=False)
    assert len(later.store) == TOTAL
    assert later.store.episodes.tolist()[24:28] == [2, 2, 3, 3]


def test_a_checkpoint_that_fails_after_a_failure_does_not_hide_it(tmp_path, monkeypatch):
    env = NoisyPointMass(fail_at=27, failure=ConnectionError("the plant is gone"))

    def full(*_):
        raise OSError(28, "No space left on device")

    env.failure.__cause__ = None
    step = env.step

    def step_and_fill(action):
        if env.num_steps == 27:
            monkeypatch.setattr(os, "fsync", full)
        return step(action)

    env.step = step_and_fill
    with (
        pytest.warns(ReliabilityWarning, match=r"no checkpoint could be written after that error.*No space left"),
        pytest.raises(EnvironmentFailedError, match="the plant is gone"),
    ):
        train(tmp_path, env)
    monkeypatch.undo()
    assert len(train(tmp_path, total=20).store) == 20


def test_a_full_disk_ends_the_run_and_leaves_the_checkpoint_before(whole, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    class FillAt(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 30:
                monkeypatch.setattr(os, "fsync", full)
            return True

    learner = agent(NoisyPointMass(), actions_per_plan=2, tensorboard_log=str(tmp_path / "logs"))
    with (
        pytest.warns(ReliabilityWarning, match="no checkpoint could be written"),
        pytest.raises(CheckpointWriteError, match=r"could not write .*agent.zip: No space left.*before it is whole"),
    ):
        learner.learn(TOTAL, FillAt(), run_folder=tmp_path, resume=True)
    monkeypatch.undo()
    train(tmp_path, actions_per_plan=2)
    assert_same(whole, tmp_path)


def steps_on_disk(folder):
    with RunCheckpoints(folder) as held:
        checkpoint = held.load()
    steps = checkpoint.config["values"]["progress"]["num_timesteps"]
    assert len(checkpoint.tensors["transitions"]["reward"]) == steps
    return steps


class SignalAt(BaseCallback):
    def __init__(self, step, number):
        super().__init__()
        self.step, self.number = step, number

    def _on_step(self):
        if self.num_timesteps == self.step:
            os.kill(os.getpid(), self.number)
        return True


@pytest.mark.parametrize(("number", "raised"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)])
def test_signals_end_a_run_after_a_checkpoint(whole, tmp_path, number, raised):
    handlers = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    learner = agent(NoisyPointMass(), actions_per_plan=2, tensorboard_log=str(tmp_path / "logs"))
    with pytest.raises(raised) as stop:
        learner.learn(TOTAL, SignalAt(27, number), run_folder=tmp_path, resume=True)
    if raised is SystemExit:
        assert stop.value.code == 143
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert steps_on_disk(tmp_path) == 27
    train(tmp_path, actions_per_plan=2)
    assert_same(whole, tmp_path)


def test_a_signal_costs_no_data_where_the_episode_cannot_be_repeated(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        agent(Plant()).learn(TOTAL, SignalAt(27, signal.SIGINT), run_folder=tmp_path)
    assert steps_on_disk(tmp_path) == 27
    learner = train(tmp_path, Plant(), logs=False)
    assert learner.num_timesteps == len(learner.store) == TOTAL
    assert learner.store.episodes.tolist()[:30] == [0] * 10 + [1] * 10 + [2] * 7 + [3] * 3


def test_a_signal_stops_training_at_once(tmp_path):
    learner = agent(NoisyPointMass())
    fit = learner.dynamics.fit

    def fit_and_signal(data, generator):
        if len(data.action) == 20:
            os.kill(os.getpid(), signal.SIGTERM)
            raise AssertionError("training went on")
        return fit(data, generator)

    learner.dynamics.fit = fit_and_signal
    with pytest.raises(SystemExit):
        learner.learn(TOTAL, run_folder=tmp_path)
    assert steps_on_disk(tmp_path) == 20


@pytest.mark.parametrize("env", [NoisyPointMass, Plant])
def test_a_signal_in_a_training_within_an_episode_costs_no_data(tmp_path, env):
    settings = {"learning_starts": 4, "train_freq": 4}
    learner = agent(env(), tensorboard_log=str(tmp_path / "parts" / "logs"), **settings)
    fit = learner.dynamics.fit

    def fit_and_signal(data, generator):
        if len(data.action) == 28:
            os.kill(os.getpid(), signal.SIGINT)
        return fit(data, generator)

    learner.dynamics.fit = fit_and_signal
    with pytest.raises(KeyboardInterrupt):
        learner.learn(TOTAL, run_folder=tmp_path / "parts")
    assert steps_on_disk(tmp_path / "parts") == 28
    assert len(train(tmp_path / "parts", env(), **settings).store) == TOTAL
    if env.can_replay:
        train(tmp_path / "whole", env(), **settings)
        assert_same(tmp_path / "whole", tmp_path / "parts")


def test_a_second_signal_stops_at_once(tmp_path):
    learner = agent(NoisyPointMass())

    class Impatient(BaseCallback):
        def _on_step(self):
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            raise AssertionError("the step went on")

    with pytest.raises(KeyboardInterrupt):
        learner.learn(TOTAL, Impatient(), run_folder=tmp_path)
    assert steps_on_disk(tmp_path) == 0


def test_outside_the_main_thread_there_are_no_signals_to_handle(tmp_path):
    worker = threading.Thread(target=lambda: train(tmp_path, total=12))
    worker.start()
    worker.join()
    assert (tmp_path / "agent.zip").exists()


def test_a_run_killed_before_it_has_logged_goes_on_in_the_folder_that_it_had_chosen(whole, tmp_path, monkeypatch):
    def killed(*_, **__):
        raise KeyboardInterrupt

    (tmp_path / "logs" / "Other_7").mkdir(parents=True)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Logs, "open", killed)
        train(tmp_path, actions_per_plan=2)
    train(tmp_path, kill_at=12, actions_per_plan=2)
    (tmp_path / "logs" / "MPC_2").mkdir()  # of another run, begun in between
    train(tmp_path, actions_per_plan=2)
    assert sorted(path.name for path in (tmp_path / "logs").iterdir()) == ["MPC_1", "MPC_2", "Other_7"]
    assert list((tmp_path / "logs" / "MPC_2").iterdir()) == []
    assert_same(whole, tmp_path)


def test_what_was_logged_at_the_end_of_a_call_is_written_in_the_next(tmp_path):
    learner = agent(NoisyPointMass())
    learner.learn(2 * LENGTH, run_folder=tmp_path / "one")
    for _ in range(2):
        learner.learn(0, reset_num_timesteps=False)
    assert learner.logger.name_to_value["train/num_transitions"] == 2 * LENGTH
    learner.learn(0, run_folder=tmp_path / "other", reset_num_timesteps=False)
    assert checkpoint_differences(tmp_path / "one" / "agent.zip", tmp_path / "other" / "agent.zip") == []
