"""Whether a change of the code has changed what agents do: `python -m benchmarks.fingerprint`.

Runs every agent for three short episodes at tiny settings, resumed once in between, and prints a digest of its
transitions, returns and next actions. Two revisions that print the same lines on one machine do the same, bit for bit.
Uses nothing but the public interface, so that it runs on both.
"""

import argparse
import hashlib
import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.vec_env import DummyVecEnv

import gym_dgpmpc  # noqa: F401  # registers the environments
from gym_dgpmpc import DGPMPCAgent, GPMPCAgent, MPCAgent, PETSAgent
from gym_dgpmpc.dynamics.true_dynamics import TrueDynamics
from gym_dgpmpc.planning import CEM

STEPS = 12
"""Length of an episode."""

PLANNING = {"num_candidates": 30, "horizon": 6, "num_iterations": 2}
DEEP_GP = {
    **PLANNING, "num_inducing": 20, "num_features": 32, "first_training_iterations": 60, "training_iterations": 30,
    "num_samples": 10, "sample_spacing": 2, "resample_samples": 2, "num_particles": 3,
}  # fmt: skip
PETS = {**PLANNING, "num_members": 3, "num_hidden_layers": 2, "hidden_size": 16, "weight_decay": (1e-4,) * 3}
PETS |= {"num_particles": 3}
GP = {**PLANNING, "num_inducing": 20, "max_training_iterations": 20, "num_particles": 3}


def make(env_id: str = "ModCartPole-v0") -> gym.Env:
    return TimeLimit(gym.make(env_id), STEPS)


def true_dynamics(env: gym.Env, **arguments: Any) -> MPCAgent:
    assert isinstance(env.action_space, gym.spaces.Box)
    low, high = (torch.as_tensor(bound) for bound in (env.action_space.low, env.action_space.high))
    planner = CEM(action_low=low, action_high=high, num_elites=3, **PLANNING)
    return MPCAgent(env, TrueDynamics(env), planner, num_particles=1, learning_starts=1, **arguments)


def cases() -> Iterator[tuple[str, Callable[..., Any], Callable[[], Any], dict[str, Any]]]:
    """Name, agent, environment and settings of each."""
    for layers, kernel, draw, refresh in [
        (1, "rbf", "pathwise", "step"), (2, "matern32", "pathwise", "step"), (3, "matern52", "pathwise", "plan"),
        (2, "matern12", "joint", "step"), (2, "rbf", "marginal", "step"),
    ]:  # fmt: skip
        own = {"num_layers": layers, "kernel": kernel, "draw": draw, "refresh": refresh}
        yield f"deep GP L={layers} {kernel} {draw} {refresh}", DGPMPCAgent, make, {**DEEP_GP, **own}
    yield "deep GP in PyTorch, SG-HMC alone", DGPMPCAgent, make, {**DEEP_GP, "compile": False, "gibbs_every": 0}
    own = {**DEEP_GP, "actions_per_plan": 2, "train_freq": 7}
    yield "deep GP, 2 actions per plan, trained every 7 steps", DGPMPCAgent, make, own
    yield "deep GP, learned reward", DGPMPCAgent, lambda: make("Pendulum-v1"), {**DEEP_GP, "reward_fn": "learned"}
    yield "deep GP, reacher", DGPMPCAgent, lambda: make("BiasedReacher-v0"), DEEP_GP
    yield "deep GP, half-cheetah", DGPMPCAgent, lambda: make("RiskSensitiveHalfCheetah-v0"), DEEP_GP
    yield "deep GP, swimmer", DGPMPCAgent, lambda: make("Swimmer-v5"), DEEP_GP
    yield "deep GP, two environments", DGPMPCAgent, lambda: DummyVecEnv([make, make]), DEEP_GP
    for draw in ("TS1", "TSinf", "DS", "MM", "expectation"):
        yield f"PETS {draw}", PETSAgent, make, {**PETS, "draw": draw}
    yield "PETS in bfloat16", PETSAgent, make, {**PETS, "half_precision": True}
    gps: list[dict[str, Any]] = [
        {"draw": "DS"},
        {"draw": "MM", "add_noise": True},
        {"draw": "AMM", "num_particles": 8},
        {"exact": True, "update_within_episode": True, "kernel": "matern52"},
    ]
    for settings in gps:
        yield f"GP {settings}", GPMPCAgent, make, {**GP, **settings}
    yield "true dynamics", true_dynamics, make, {}


def digest(*arrays: Any) -> str:
    whole = hashlib.sha256()
    for array in arrays:
        whole.update(np.ascontiguousarray(array).tobytes())
    return whole.hexdigest()[:16]


def fingerprint(agent_of: Callable[..., Any], env_of: Callable[[], Any], settings: dict[str, Any], keep: Path) -> str:
    """Two episodes, the third in a new agent that continues from the folder; then some predictions."""
    num_envs = getattr(env_of(), "num_envs", 1)
    with tempfile.TemporaryDirectory() as folder:
        for steps in (2 * STEPS + 4, 3 * STEPS):  # killed within the third episode
            env = env_of()
            agent = agent_of(env, seed=7, **settings)
            agent.learn(steps * num_envs, run_folder=folder, resume=True)
    data = agent.store.transitions()
    agent.save(keep)
    actions: list[Any] = []
    state: Any = None
    for observation in data.observation[:3]:
        row = np.tile(observation.numpy()[: agent.observation_space.shape[0]], (num_envs, 1))
        action, state = agent.predict(row, state=state, deterministic=True)
        actions.append(action)
    returns = [info["r"] for info in agent.ep_info_buffer]
    return f"{digest(*data, agent.store.rewards, agent.store.episodes)} {digest(*actions, *(state or ()))} {returns}"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fingerprint", description=__doc__)
    parser.add_argument("--out", type=Path, help="also write the lines as JSON, and keep the agents beside it")
    parser.add_argument("--only", default="", help="cases whose names hold this text")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    lines: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if arguments.out is None else arguments.out.parent
        for name, agent_of, env_of, settings in cases():
            if arguments.only in name:
                file = folder / f"{''.join(c if c.isalnum() else '-' for c in name)}.zip"
                lines[name] = fingerprint(agent_of, env_of, settings, file)
                print(f"{name}: {lines[name]}", flush=True)
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(lines, indent=1) + "\n")


if __name__ == "__main__":
    main()
