"""`python -m tests.faults.packages`: an episode learned in environments and by tools of packages that few have.

They are `shimmy[dm-control]` (with a MuJoCo that dm_control takes: 3.17 for 1.0.50) and `rl_zoo3`, in a virtual
environment of their own. What is missing is left out, and said.
"""

import importlib.util
import os
import sys
import tempfile
import warnings
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "disable")  # nothing is drawn

import gymnasium as gym
import numpy as np
import yaml
from gymnasium import wrappers

from gym_dgpmpc import DGPMPCAgent

TINY = {
    "num_layers": 1,
    "num_inducing": 20,
    "num_features": 16,
    "num_candidates": 20,
    "num_iterations": 2,
    "num_particles": 2,
    "horizon": 3,
    "first_training_iterations": 20,
    "training_iterations": 10,
    "num_samples": 5,
    "resample_samples": 1,
    "seed": 0,
}
LENGTH = 12
DM_CONTROL = (
    *("cartpole-swingup", "reacher-easy", "cheetah-run", "pendulum-swingup", "finger-spin", "walker-walk"),
    *("ball_in_cup-catch", "point_mass-easy", "hopper-hop", "acrobot-swingup"),
)


def dm_control(task):
    """An episode of random actions and one that is planned, through Shimmy's Dict observations."""
    import shimmy  # noqa: F401 (registers them)

    env_id = f"dm_control/{task}-v0"
    try:
        return episode(gym.make(env_id))
    except ValueError as error:  # a part is no vector but a number: the error says what to do
        assert "FlattenObservation" in str(error)
        return f"{episode(wrappers.FlattenObservation(gym.make(env_id)))}, flattened, as an error told"


def episode(env):
    env = wrappers.TimeLimit(env, LENGTH)
    agent = DGPMPCAgent(env, **TINY).learn(2 * LENGTH)
    assert agent.is_fitted and len(agent.store) == 2 * LENGTH
    observation, _ = env.reset(seed=0)
    action, _ = agent.predict(observation, deterministic=True)
    assert env.action_space.contains(action), action
    with tempfile.TemporaryDirectory() as folder:
        agent.save(Path(folder) / "agent")
        loaded = DGPMPCAgent.load(Path(folder) / "agent", env)
    np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], action)
    return f"{agent.task.describe()}; {agent.observation_space.shape[0]} numbers"


def zoo(policy):
    """rl_zoo3's train.py, with an evaluation."""
    import rl_zoo3.exp_manager
    import rl_zoo3.train

    for algorithms in (rl_zoo3.ALGOS, rl_zoo3.exp_manager.ALGOS, rl_zoo3.train.ALGOS):
        algorithms["dgp_mpc"] = DGPMPCAgent
    settings = {**TINY, "policy": policy, "n_timesteps": 2 * LENGTH, "learning_starts": LENGTH}
    del settings["seed"]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "settings.yml"
        file.write_text(yaml.safe_dump({"Pendulum-v1": settings}))
        flags = "--algo dgp_mpc --env Pendulum-v1 --seed 0 --eval-freq 15 --eval-episodes 1 --n-eval-envs 1 --verbose 0"
        sys.argv = ["train.py", *flags.split(), "--conf-file", str(file), "-f", folder]
        rl_zoo3.train.train()
        kept = sorted(path.name for path in Path(folder).rglob("*.zip"))
    assert "Pendulum-v1.zip" in kept, kept
    return f"trained, evaluated and saved: {', '.join(kept)}"


def main():
    warnings.simplefilter("ignore")
    wrong = 0
    for package, function, cases in (("shimmy", dm_control, DM_CONTROL), ("rl_zoo3", zoo, ("MPCPolicy", "MlpPolicy"))):
        if importlib.util.find_spec(package) is None:
            print(f"{package} is not installed", flush=True)
            continue
        for case in cases:
            try:
                told = function(case)
            except Exception as error:
                told, wrong = f"WRONG {type(error).__name__}: {error}", wrong + 1
            print(f"{package} {case}: {told}", flush=True)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
