"""The environments are found by name, and importing the package is light and repeatable."""

import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest

import gym_dgpmpc
from gym_dgpmpc.envs.registration import ENVIRONMENTS, register_environments


def run_python(code: str, *flags: str) -> str:
    """Run code in a fresh interpreter, without the runtime type checks of this one; return what it prints."""
    environment = {**os.environ, "PYTHONPATH": str(Path(gym_dgpmpc.__file__).parents[1])}
    result = subprocess.run(
        [sys.executable, *flags, "-c", code], env=environment, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_make_and_make_vec_by_name(env_id):
    for name in (env_id, f"gym_dgpmpc:{env_id}"):
        env = gymnasium.make(name)
        assert env.spec.max_episode_steps == ENVIRONMENTS[env_id][1]
        vector_env = gymnasium.make_vec(name, num_envs=2)
        observations, _ = vector_env.reset(seed=0)
        assert observations.shape == (2, *env.observation_space.shape)
        vector_env.close()
        env.close()


def test_import_is_light_and_registering_again_is_silent():
    printed = run_python(
        "import importlib, sys, gymnasium, gym_dgpmpc\n"
        "print(sorted({'torch', 'mujoco', 'stable_baselines3'} & set(sys.modules)))\n"
        "importlib.reload(gym_dgpmpc)\n"
        "del sys.modules['gym_dgpmpc']\n"
        "import gym_dgpmpc\n"
        "gymnasium.make('gym_dgpmpc:ModCartPole-v0')\n",
        "-Werror",
    )
    assert printed.strip() == "[]"


def test_registering_leaves_a_present_entry_alone():
    spec = gymnasium.spec("ModCartPole-v0")
    register_environments()
    assert gymnasium.spec("ModCartPole-v0") is spec


def test_public_names():
    from gym_dgpmpc import envs

    for module in (gym_dgpmpc, envs):
        assert set(module.__all__) <= set(dir(module))
        with pytest.raises(AttributeError, match="'nonsense'"):
            module.nonsense  # noqa: B018
    for name in envs.__all__:
        assert getattr(envs, name).__name__ == name
    assert gym_dgpmpc.ModCartPoleEnv is envs.ModCartPoleEnv


def test_arguments_of_a_wrong_type_are_named():
    code = """
from gym_dgpmpc import ModCartPoleEnv
for arguments in (dict(start_position="left"), dict(frame_skip=1.5), dict(target=2.0), dict(target=(None, 0.6))):
    try:
        ModCartPoleEnv(**arguments)
    except ValueError as error:
        print(error)
"""
    assert run_python(code).splitlines() == [
        "start_position must be a finite number; got 'left'",
        "frame_skip must be a positive integer; got 1.5",
        "target must be two finite numbers, x and z in m; got 2.0",
        "target must be a finite number; got None",
    ]
