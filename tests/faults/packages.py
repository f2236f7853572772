"""`python -m tests.faults.packages`: an episode learned in environments and by tools of packages that few have.

They are `shimmy[dm-control]` (with a MuJoCo that dm_control takes: 3.17 for 1.0.50) and `rl_zoo3`, in a virtual
environment of their own. What is missing is left out, and said.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

os.environ.setdefault("MUJOCO_GL", "disable")  # nothing is drawn

import gymnasium as gym
import numpy as np
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


QUICK = {name: value for name, value in TINY.items() if name != "seed"} | {"learning_starts": LENGTH}


def zoo(algorithm):
    """The commands of the RL Zoo: train, enjoy, plot, search; and what is trained to a hub that is a folder."""
    flags, quick = f"--algo {algorithm} --env Pendulum-v1", [f"{name}:{value!r}" for name, value in QUICK.items()]
    steps = f"--eval-freq {LENGTH} --eval-episodes 2 -n {2 * LENGTH}"
    environment = {**os.environ, "MPLBACKEND": "agg"}
    with tempfile.TemporaryDirectory() as folder:

        def run(command, *more):
            command = [sys.executable, "-W", "ignore", "-m", "gym_dgpmpc.zoo", *command.split(), *more]
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
            if done.returncode:
                raise RuntimeError(f"{' '.join(command[5:9])}: {done.stderr.strip().splitlines()[-1]}")
            return done.stdout

        for seed in range(2):
            run(f"train {flags} {steps} --seed {seed} -f logs -params", *quick)
        enjoyed = run(f"enjoy {flags} -f logs -n 200 --no-render")
        assert "Mean reward" in enjoyed, enjoyed
        run("all_plots -e Pendulum-v1 -f logs -o all -a", algorithm)
        assert (Path(folder) / "all.pkl").exists()
        search = "-optimize --n-trials 2 --n-startup-trials 1 --n-evaluations 1 --no-optim-plots"
        found = run(f"train {flags} {steps} {search} -f searched -params", *quick)
        assert "Number of finished trials:  2" in found, found
        downloaded = hub(Path(folder) / "hub", Path(folder) / "logs" / algorithm / "Pendulum-v1_2" / "Pendulum-v1.zip")
        agent = DGPMPCAgent.load(downloaded, gym.make("Pendulum-v1"))
        assert agent.is_fitted
    return f"trained, plotted, searched, pushed and loaded; {enjoyed.strip().splitlines()[-2]}"


def hub(folder, file):
    """Push a file by huggingface_sb3 to a folder in the place of the Hub, and say where it was downloaded to."""
    import huggingface_hub
    import huggingface_sb3

    def upload_file(self, path_or_fileobj, path_in_repo, repo_id, **_):
        (folder / repo_id).mkdir(parents=True)
        shutil.copy(path_or_fileobj, folder / repo_id / path_in_repo)

    def create_repo(self, repo_id, **_):
        return SimpleNamespace(repo_id=repo_id)

    def hf_hub_download(repo_id, filename, **_):
        return str(folder / repo_id / filename)

    with (
        mock.patch.object(huggingface_hub.HfApi, "create_repo", create_repo),
        mock.patch.object(huggingface_hub.HfApi, "upload_file", upload_file),
        mock.patch.object(huggingface_hub, "hf_hub_download", hf_hub_download),
        mock.patch.dict(os.environ, TRUST_REMOTE_CODE="1"),
    ):
        huggingface_sb3.push_to_hub("me/dgp-mpc-Pendulum-v1", str(file), "first")
        return huggingface_sb3.load_from_hub("me/dgp-mpc-Pendulum-v1", file.name)


def main():
    warnings.simplefilter("ignore")
    wrong = 0
    for package, function, cases in (("shimmy", dm_control, DM_CONTROL), ("rl_zoo3", zoo, ("dgp-mpc",))):
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
