"""The recorded episodes that models are trained and tested on: `python -m benchmarks.calibration.episodes RUNS`.

One file a task, `benchmarks/data/calibration/TASK.npz`, with `observation` [5 seeds, 7 episodes, T + 1, S] and `action`
[5, 7, T, A], raw units. Of each seed the first five episodes are those of one learning run: random actions, then four
planned ones. The other two were never learned from: uniform random actions, and smoother ones that go elsewhere.
The runs were made with the `COMMAND` below; a cheap model is good enough for that, since all models meet the same data.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc import DGPMPCAgent
from gym_dgpmpc.types import ObservationSpec, Transitions

DATA = Path(__file__).parents[1] / "data" / "calibration"

TASKS = {
    "cartpole": "ModCartPole-v0",
    "pendulum": "Pendulum-v1",
    "reacher": "Reacher7DoF-v0",
    "cheetah": "VelocityHalfCheetah-v0",
}
SEEDS = (100, 101, 102, 103, 104)

NUM_LEARNED = 5
WHITE, SMOOTH = 5, 6
"""The episodes that were not learned from."""

COMMAND = (
    "dgpmpc train ENV_ID --layers 1 --num-inducing 100 --first-training-iterations 1500 --training-iterations 500 "
    "--resample-steps 2 --num-samples 50 --sample-spacing 5 --no-video --episodes 4 --seed SEED --out RUNS/TASK-SEED"
)
"""How each run was made; the half-cheetah's with --num-inducing 200 --num-iterations 5 --num-candidates 200
--num-elites 20."""


class Recording(NamedTuple):
    """The episodes of one seed."""

    observation: Float[Tensor, "E T+1 S"]
    action: Float[Tensor, "E T A"]

    @classmethod
    def of(cls, episodes: Sequence[Transitions]) -> "Recording":
        """Episodes of one length."""
        observation = [torch.cat([episode.observation, episode.next_observation[-1:]]) for episode in episodes]
        return cls(torch.stack(observation), torch.stack([episode.action for episode in episodes]))

    def transitions(self, episodes: Sequence[int]) -> Transitions:
        """These episodes, one after the other."""
        chosen = list(episodes)
        observation, action = self.observation[chosen], self.action[chosen]
        return Transitions(
            observation[:, :-1].flatten(0, 1), action.flatten(0, 1), observation[:, 1:].flatten(0, 1).contiguous()
        )


def load(task: str, seed: int, data: Path = DATA) -> Recording:
    """The recording of one of the `SEEDS`."""
    with np.load(data / f"{task}.npz") as file:
        index = list(file["seed"]).index(seed)
        return Recording(torch.as_tensor(file["observation"][index]), torch.as_tensor(file["action"][index]))


def spread(task: str, data: Path = DATA) -> Float[Tensor, "S"]:
    """The standard deviation of each dimension over all episodes of a task, which scores are in units of."""
    with np.load(data / f"{task}.npz") as file:
        observation = torch.as_tensor(file["observation"]).double()
    return observation.flatten(0, 2).std(0)


def observation_spec(task: str) -> ObservationSpec | None:
    """How the task's environment says that an observation is to be read."""
    env = gymnasium.make(TASKS[task])
    return env.get_wrapper_attr("observation_spec") if env.has_wrapper_attr("observation_spec") else None


def random_episode(env: gymnasium.Env, seed: int, smoothing: float) -> Transitions:
    """An episode under actions that are uniform (``smoothing`` 0) or follow a bounded autoregression."""
    rng, rows = np.random.default_rng(seed), []
    assert isinstance(env.action_space, gymnasium.spaces.Box)
    low, high = env.action_space.low, env.action_space.high
    observation, _ = env.reset(seed=seed)
    level, done = (low + high) / 2, False
    while not done:
        noise = rng.normal(0, 0.2 * (high - low)) if smoothing else rng.uniform(low, high)
        level = np.clip(smoothing * level + noise, low, high)
        after, _, terminated, truncated, _ = env.step(level.astype(np.float32))
        rows.append((observation, level, after))
        observation, done = after, terminated or truncated
    return Transitions(*(torch.as_tensor(np.array(column), dtype=torch.float32) for column in zip(*rows, strict=True)))


def record(runs: Path, task: str, seed: int) -> Recording:
    """The episodes of a finished run, and the two that are not learned from."""
    arrays = DGPMPCAgent.load(runs / f"{task}-{seed}" / "agent.zip").to_arrays()
    episodes = []
    for index in range(NUM_LEARNED):
        rows = arrays["episode"] == index
        episodes.append(Transitions(*(torch.as_tensor(arrays[name][rows]) for name in Transitions._fields)))
    env = gymnasium.make(TASKS[task])
    return Recording.of(episodes + [random_episode(env, 5000 + seed, smoothing) for smoothing in (0.0, 0.8)])


def save(file: Path, recordings: Mapping[int, Recording]) -> None:
    """Write the recordings of a task, by their seeds."""
    observation, action = (torch.stack(column).float().numpy() for column in zip(*recordings.values(), strict=True))
    np.savez_compressed(file, seed=np.array(list(recordings)), observation=observation, action=action)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration.episodes", description=__doc__)
    parser.add_argument("runs", type=Path, help=f"folder of runs made by: {COMMAND}")
    parser.add_argument("--out", type=Path, default=DATA)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for task in arguments.tasks:
        save(arguments.out / f"{task}.npz", {seed: record(arguments.runs, task, seed) for seed in SEEDS})


if __name__ == "__main__":
    main()
