"""Tasks and jobs that take no time, keep a diary, and can be made to fail or to kill their process."""

import os
import signal
import time
from dataclasses import dataclass, replace
from pathlib import Path

import gymnasium

from benchmarks.tasks import Task
from gym_dgpmpc.agents.presets import for_mixture
from tests.runs.toy import EPISODE_STEPS, SMALLEST_AGENT, ToyPush

NETWORKS = {"num_hidden_layers": 1, "hidden_size": 8, "weight_decay": (1e-4, 1e-4)}
PLANNING = {"horizon": 3, "num_candidates": 6, "num_elites": 2, "num_iterations": 1}
PETS = NETWORKS | PLANNING | {"num_particles": 5}
OFF_POLICY = {"batch_size": 4, "buffer_size": 100, "learning_starts": EPISODE_STEPS}
DEEP_GP = {name: value for name, value in SMALLEST_AGENT.items() if name != "num_layers"}
SPARSE_GP = {"num_inducing": 6, "max_training_iterations": 3}
SEARCH = {"num_worlds": 2, "num_paths": 1, "first_search_steps": 1, "search_steps": 1, "search_horizon": 2}
TINY = {
    "DGP-MPC L=1 matern32": DEEP_GP,
    "PETS TS1": PETS,
    "PETS TSinf": PETS,
    "PETS TSinf to its optimum": PETS | {"num_epochs": 2, "patience": 1},
    "PETS as published": PETS,
    "GP-MM": PLANNING | SPARSE_GP,
    "GP-DS": PLANNING | SPARSE_GP,
    "GP-MM with noise": PLANNING | SPARSE_GP,
    "GP-DS with noise": PLANNING | SPARSE_GP,
    "GP-MPC": SPARSE_GP | {"horizon": 3, "num_iterations": 1, "num_starts": 1, "num_particles": 10},
    "MC-PILCO": DEEP_GP | SEARCH,
    "MC-PILCO DGP L=2": DEEP_GP | SEARCH,
    "DeepPILCO": SEARCH | {"hidden_size": 8, "num_epochs": 2},
    "PILCO": SPARSE_GP | {"max_search_iterations": 1, "search_horizon": 2},
    "DGP L=2 and PETS": for_mixture(SMALLEST_AGENT, NETWORKS | {"num_epochs": 2}),
    "true dynamics": PLANNING,
    "SAC": OFF_POLICY,
    "TD3": OFF_POLICY,
    "CrossQ": OFF_POLICY,
    "TQC": OFF_POLICY,
    "PPO": {"n_epochs": 1},
}
"""Settings of every method that make a run of it take less than a second."""


class Diary(ToyPush):
    """`ToyPush` that notes each step and can end badly.

    Args:
        diary: a file that grows by one byte at each step.
        ends_at: the step, counted by the diary, at which ``end`` happens.
        pauses_at: the step, counted by the diary, that takes ``pause`` seconds.
        end: "kill" for this process, or the exception to raise.
        penalise: return -100 instead of the reward, which is in the info all the same.
    """

    can_replay = True

    def __init__(
        self, diary=None, ends_at=None, end="kill", penalise=False, terminate_at=None, pauses_at=None, pause=0.0
    ):
        super().__init__(terminate_at=terminate_at)
        self.diary, self.ends_at, self.end, self.penalise = diary, ends_at, end, penalise
        self.pauses_at, self.pause = pauses_at, pause

    def step(self, action):
        if self.diary is not None:
            with open(self.diary, "ab") as file:
                file.write(b".")
            if os.path.getsize(self.diary) == self.pauses_at:
                time.sleep(self.pause)
            if os.path.getsize(self.diary) == self.ends_at:
                if self.end == "kill":
                    os.kill(os.getpid(), signal.SIGKILL)
                raise {"interrupt": KeyboardInterrupt, "failure": ConnectionError("the plant is gone")}[self.end]
        observation, reward, terminated, truncated, _ = super().step(action)
        info = {"reward_original": reward, "is_success": abs(observation[0]) > 1e3}
        return observation, -100.0 if self.penalise else reward, terminated, truncated, info


if "Diary-v0" not in gymnasium.registry:
    gymnasium.register("Diary-v0", Diary, max_episode_steps=EPISODE_STEPS)

TOY = Task("Diary-v0", EPISODE_STEPS, env_id="tests.benchmarks.toy:Diary-v0", for_model_free={"penalise": True})
CART_POLE = Task("ModCartPole-v0", EPISODE_STEPS, arguments={"max_episode_steps": EPISODE_STEPS})
"""A task that has a simulator."""


def toy(**arguments):
    """The toy with arguments of its environment."""
    return replace(TOY, arguments=arguments)


@dataclass(frozen=True)
class Errand:
    """A `Job` that writes its name; ``dies`` is how often it kills the process that it is done in."""

    name: str
    diary: str
    dies: int = 0
    fails: bool = False

    @property
    def file_name(self):
        return f"{self.name}.json"

    def is_finished(self, results):
        return (results / self.file_name).exists()

    def perform(self, folders):
        with open(self.diary, "ab") as file:
            file.write(b".")
        if os.path.getsize(self.diary) <= self.dies:
            os.kill(os.getpid(), signal.SIGKILL)
        if self.fails:
            raise ValueError("it was\nnot to be")
        folders.results.mkdir(parents=True, exist_ok=True)
        (folders.results / self.file_name).write_text(self.name)
        return "done"


def steps_in(diary: Path) -> int:
    return diary.stat().st_size
