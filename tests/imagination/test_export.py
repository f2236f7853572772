"""Exported policies act as Stable-Baselines3's `predict` does, whatever the algorithm and the bounds."""

import builtins

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import PPO, SAC, TD3

from gym_dgpmpc.errors import ExportError
from gym_dgpmpc.imagination.export import export_policy, run_exported

pytest.importorskip("onnx")


class Anything(gym.Env):
    """Bounds that are neither symmetric nor alike."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = spaces.Box(np.float32([[-1.0, 2.0]]), np.float32([[4.0, 2.5]]))

    def __init__(self, space=None):
        if space is not None:
            self.observation_space = space


@pytest.fixture(params=[SAC, TD3, PPO, TQC, CrossQ])
def model(request):
    policy = request.param("MlpPolicy", Anything(), seed=0, device="cpu", policy_kwargs={"net_arch": [8]})
    with torch.no_grad():
        for parameter in policy.policy.parameters():
            parameter.mul_(3.0)  # so that actions come to the bounds
    return policy


@pytest.mark.parametrize("suffix", [".pt", ".onnx"])
def test_the_file_acts_as_the_policy_does(model, suffix, tmp_path):
    observations = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    path = export_policy(model, tmp_path / f"policy{suffix}")
    acted, expected = run_exported(path, observations), model.predict(observations, deterministic=True)[0]
    # Rounding: some dozen float32 operations on numbers below ten.
    np.testing.assert_allclose(acted, expected.reshape(50, 2), atol=50 * 10 * np.finfo(np.float32).eps)
    assert np.ptp(acted, axis=0).max() > 0
    assert (acted >= Anything.action_space.low).all() and (acted <= Anything.action_space.high).all()


def test_a_file_that_acts_differently_is_refused(model, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "gym_dgpmpc.imagination.export.run_exported",
        lambda path, observations: model.predict(observations, deterministic=True)[0].reshape(-1, 2) + 0.001,
    )
    with pytest.raises(ExportError, match=r"policy.pt acts differently from the policy, by 0\.004 of half the range"):
        export_policy(model, tmp_path / "policy.pt")


def test_what_cannot_be_exported_is_refused_by_name(tmp_path, monkeypatch):
    policy = SAC("MlpPolicy", Anything(), device="cpu")
    with pytest.raises(ValueError, match=r"suffix \.pt or \.onnx, got 'policy\.zip'"):
        export_policy(policy, tmp_path / "policy.zip")
    dicts = spaces.Dict({"a": spaces.Box(-1, 1, (2,), np.float32)})
    with pytest.raises(ValueError, match="FlattenObservation"):
        export_policy(SAC("MultiInputPolicy", Anything(dicts), device="cpu"), tmp_path / "policy.pt")
    found = builtins.__import__

    def without_onnx(name, *args, **kwargs):
        if name.partition(".")[0] in ("onnx", "onnxruntime"):
            raise ImportError(name)
        return found(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_onnx)
    with pytest.raises(ExportError, match=r'pip install "gym-dgpmpc\[onnx\]"'):
        export_policy(policy, tmp_path / "policy.onnx")
    assert run_exported(tmp_path / "policy.onnx", np.zeros((1, 3), np.float32)) is None
