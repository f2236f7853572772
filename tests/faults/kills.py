"""Kills a run with SIGKILL at random moments of training, planning, stepping and checkpointing, and lets it go on.

Each run is a process forked from this one, so that nothing has to be imported again. A byte of shared memory tells
what the run is doing; the killer waits until it does what is wanted, and then a random moment more.
"""

import itertools
import mmap
import os
import random
import signal
import struct
import sys
import time
from pathlib import Path
from typing import NamedTuple

import gymnasium

from gym_dgpmpc import DGPMPCAgent, cli
from gym_dgpmpc.checkpoints import folder as run_checkpoints
from gym_dgpmpc.checkpoints.folder import RunCheckpoints
from gym_dgpmpc.checkpoints.format import read_checkpoint
from gym_dgpmpc.dynamics.deep_gp.model import DeepGPDynamics
from gym_dgpmpc.planning.controller import Controller
from gym_dgpmpc.runs import training as _imported_before_the_fork  # noqa: F401  # with Matplotlib, which takes seconds
from tests.faults.compare import checkpoint_differences, folder_differences, log_differences
from tests.runs.toy import ToyPush

PHASES = ("other", "training", "planning", "re-sampling", "checkpointing")
STEPS = 20

TINY = {"num_layers": 2, "num_inducing": 8, "num_features": 8, "num_particles": 2, "horizon": 4, "num_candidates": 10}
TINY |= {"num_iterations": 2, "first_training_iterations": 20, "training_iterations": 10, "num_samples": 4}
TINY |= {"sample_spacing": 2, "resample_samples": 2}


class NoisyPush(ToyPush):
    """Its steps draw from its generator."""

    can_replay = True

    def step(self, action):
        self.state[0] += 0.01 * self.np_random.normal()
        return super().step(action)


for name, entry_point in (("NoisyPush-v0", NoisyPush), ("ShortCartPole-v0", None)):
    if name not in gymnasium.registry:
        source = entry_point or gymnasium.spec("ModCartPole-v0").entry_point
        gymnasium.register(name, source, max_episode_steps=STEPS)


class Task(NamedTuple):
    """One way to run: what is called in the child, and how two folders are compared."""

    name: str
    run: object
    differences: object


def train_by_command(env_id, *options):
    arguments = ["train", env_id, "--no-video", "--no-progress", "--episodes=3", *options]
    arguments += [f"--{name.replace('_', '-')}={value}" for name, value in TINY.items()]
    return lambda folder: cli.app([*arguments, "--out", str(folder)], standalone_mode=False)


def learn(folder):
    agent = DGPMPCAgent(gymnasium.make("NoisyPush-v0"), seed=0, tensorboard_log=str(folder / "logs"), **TINY)
    agent.learn(4 * STEPS + 7, run_folder=folder, resume=True, checkpoint_every=3)


def learn_differences(one, other):
    found = checkpoint_differences(one / "agent.zip", other / "agent.zip")
    return found + log_differences(one / "logs", other / "logs")


TASKS = (
    Task("dgpmpc train ShortCartPole-v0", train_by_command("ShortCartPole-v0"), folder_differences),
    Task(
        "dgpmpc train NoisyPush-v0 --checkpoint-every 1",
        train_by_command("NoisyPush-v0", "--checkpoint-every=1"),
        # Of the episode in whose middle a run goes on, the forecasts begun before are missing from the picture.
        lambda one, other: [name for name in folder_differences(one, other) if not name.startswith("prediction_fan")],
    ),
    Task("agent.learn(run_folder=..., resume=True, checkpoint_every=3)", learn, learn_differences),
)


class Watch:
    """Shared memory: what the child is doing, and the steps of the last checkpoint that it has finished writing."""

    def __init__(self):
        self._memory = mmap.mmap(-1, 16)

    def clear(self):
        self._memory[:] = bytes(16)

    @property
    def phase(self):
        return PHASES[self._memory[0]]

    @property
    def steps(self):
        return struct.unpack("<q", self._memory[8:16])[0]

    def instrument(self):
        """In the child: tell what it does."""
        for owner, method, phase in (
            (DeepGPDynamics, "fit", "training"),
            (Controller, "act", "planning"),
            (DeepGPDynamics, "resample", "re-sampling"),
            (RunCheckpoints, "save", "checkpointing"),
        ):
            setattr(owner, method, self._telling(getattr(owner, method), PHASES.index(phase)))

    def _telling(self, call, phase):
        def told(*arguments, **keywords):
            self._memory[0] = phase
            try:
                result = call(*arguments, **keywords)
            finally:
                self._memory[0] = 0
            if PHASES[phase] == "checkpointing":
                self._memory[8:16] = struct.pack("<q", arguments[1].config["values"]["progress"]["num_timesteps"])
            return result

        return told


def start(task, folder, watch):
    """Fork a run; the child never returns."""
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        log = os.open(folder.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(null, 1)
        os.dup2(log, 2)
        watch.instrument()
        task.run(folder)
        status = 0
    except BaseException as error:
        os.write(2, f"{type(error).__name__}: {error}\n".encode())
    finally:
        os._exit(status)


def kill_when(child, watch, phase, rng):
    """Kill the child in that phase, or after a random time in whatever it does; None if it has ended before."""
    skip, seen, before = rng.randrange(2 if phase == "training" else 6), 0, None
    limit = time.monotonic() + 60
    while time.monotonic() < limit:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            if status:
                raise RuntimeError(f"the run ended with status {status} by itself")
            return None
        now = watch.phase
        seen += now == phase and now != before
        before = now
        if now == phase and seen > skip:
            break
        time.sleep(0.0002)
    time.sleep(rng.random() * (0.02 if phase == "training" else 0.003))
    killed_in = watch.phase
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return killed_in


def run_kills(folder, num_kills, seed=0):
    """Kill and resume until ``num_kills`` kills have been survived.

    Returns:
        Rows for the table: task, kills by phase, runs compared, what was lost.
    """
    rng, watch, rows, phases = random.Random(seed), Watch(), [], itertools.cycle(PHASES)
    folder = Path(folder)
    for index, task in enumerate(TASKS):
        wanted = num_kills // len(TASKS) + (index < num_kills % len(TASKS))
        whole = folder / f"whole{index}"
        whole.parent.mkdir(parents=True, exist_ok=True)
        watch.clear()
        _, status = os.waitpid(start(task, whole, watch), 0)
        assert status == 0, whole.with_suffix(".log").read_text()
        kills, runs, lost, different = dict.fromkeys(PHASES, 0), 0, [], []
        while sum(kills.values()) < wanted:
            runs += 1
            killed = folder / f"killed{index}_{runs}"
            watch.clear()
            for _ in range(rng.randint(2, 6)):
                child = start(task, killed, watch)
                enough = sum(kills.values()) == wanted
                if enough or (hit := kill_when(child, watch, next(phases), rng)) is None:
                    break
                kills[hit] += 1
                lost += check_nothing_lost(killed, watch)
            else:
                child = start(task, killed, watch)
            try:
                _, status = os.waitpid(child, 0)
                assert status == 0, killed.with_suffix(".log").read_text()
            except ChildProcessError:
                pass  # it ended before it could be killed, and was waited for
            different += [f"{killed.name}: {name}" for name in task.differences(whole, killed)]
        rows.append((task.name, kills, runs, lost, different))
    return rows


def check_nothing_lost(folder, watch):
    """What a checkpoint that was finished before a kill has, its folder must still have."""
    if watch.steps == 0:
        return []
    found = []
    for name in (run_checkpoints.NEWEST, run_checkpoints.PREVIOUS):
        if (folder / name).exists():
            found.append(read_checkpoint(folder / name).config["values"]["progress"]["num_timesteps"])
    return [] if found and max(found) >= watch.steps else [f"{folder.name}: has {found}, had {watch.steps}"]


def summary(rows):
    """(tried, lost) texts for the table."""
    kills = {phase: sum(row[1][phase] for row in rows) for phase in PHASES}
    runs, lost = sum(row[2] for row in rows), [text for row in rows for text in (*row[3], *row[4])]
    told = ", ".join(f"{count} while {phase}" for phase, count in kills.items() if phase != "other")
    told += f", {kills['other']} otherwise"
    tried = f"{sum(kills.values())} SIGKILLs ({told}) and as many resumes, in {runs} runs of {len(rows)} kinds"
    return tried, lost
