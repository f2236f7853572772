"""The recorded episodes that models are trained and tested on: `python -m benchmarks.calibration.episodes RUNS`.

One file a task, `benchmarks/data/calibration/TASK.npz`, with `observation` [5 seeds, 7 episodes, T + 1, S] and `action`
[5, 7, T, A], raw units. Of each seed the first five episodes are those of one learning run: random actions, then four
planned ones. The other two were never learned from: uniform random actions, and smoother ones that go elsewhere.
The runs were made with the `COMMAND` below; a cheap model is good enough for that, since all models meet the same data.
"""

import argparse
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

    def transitions(self, episodes: range) -> Transitions:
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


def random_episode(env: gymnasium.Env, seed: int, smoothing: float) -> tuple[np.ndarray, np.ndarray]:
    """Observations [T + 1, S] and actions [T, A] of an episode under random actions.

    They are uniform (``smoothing`` 0) or follow a bounded autoregression.
    """
    rng, actions = np.random.default_rng(seed), []
    assert isinstance(env.action_space, gymnasium.spaces.Box)
    low, high = env.action_space.low, env.action_space.high
    observation, _ = env.reset(seed=seed)
    observations, level, done = [observation], (low + high) / 2, False
    while not done:
        noise = rng.normal(0, 0.2 * (high - low)) if smoothing else rng.uniform(low, high)
        level = np.clip(smoothing * level + noise, low, high)
        observation, _, terminated, truncated, _ = env.step(level.astype(np.float32))
        actions.append(level)
        observations.append(observation)
        done = terminated or truncated
    return np.array(observations, np.float32), np.array(actions, np.float32)


def record(runs: Path, task: str) -> dict[str, np.ndarray]:
    """The arrays of one file, from the folders of finished runs."""
    by_seed = []
    for seed in SEEDS:
        agent = DGPMPCAgent.load(runs / f"{task}-{seed}" / "agent.zip")
        arrays = agent.to_arrays()
        episodes = []
        for index in range(NUM_LEARNED):
            rows = arrays["episode"] == index
            last = arrays["next_observation"][rows][-1:]
            episodes.append((np.concatenate([arrays["observation"][rows], last]), arrays["action"][rows]))
        env = gymnasium.make(TASKS[task])
        episodes += [random_episode(env, 5000 + seed, smoothing) for smoothing in (0.0, 0.8)]
        by_seed.append(tuple(np.array(column, np.float32) for column in zip(*episodes, strict=True)))
    observation, action = (np.stack(column) for column in zip(*by_seed, strict=True))
    return {"seed": np.array(SEEDS), "observation": observation, "action": action}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration.episodes", description=__doc__)
    parser.add_argument("runs", type=Path, help=f"folder of runs made by: {COMMAND}")
    parser.add_argument("--out", type=Path, default=DATA)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for task in arguments.tasks:
        np.savez_compressed(arguments.out / f"{task}.npz", **record(arguments.runs, task))


if __name__ == "__main__":
    main()
