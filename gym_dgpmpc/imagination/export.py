"""A trained policy as a file that acts without Stable-Baselines3 or Python: TorchScript for LibTorch, or ONNX.

The network takes observations [n, S], float32 and raw, and returns actions [n, A] in the environment's own units,
within their bounds, without noise: what `predict(observation, deterministic=True)` returns.
"""

import os
import warnings
from pathlib import Path

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Float
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor, nn

from gym_dgpmpc.errors import ExportError
from gym_dgpmpc.extras import how_to_install
from gym_dgpmpc.tasks.environment import flat_size

TRIED = 64
"""Random observations on which a written file must act as the policy does."""

TOLERANCE = 1e-4
"""In halves of the actions' ranges: far above the rounding of some hundred products in float32, far below a mistake."""


class ActingNetwork(nn.Module):
    """From observations to actions, with the scaling to the bounds that `predict` does outside of the network.

    Args:
        model: an algorithm of Stable-Baselines3 with a policy of its own, for vectors of observations.
    """

    def __init__(self, model: BaseAlgorithm):
        super().__init__()
        assert isinstance(model.action_space, spaces.Box)
        self.policy = model.policy
        low, high = (torch.from_numpy(bound.reshape(-1).copy()) for bound in _bounds(model.action_space))
        self.register_buffer("low", low.to(model.device))
        self.register_buffer("high", high.to(model.device))

    def forward(self, observation: Float[Tensor, "n S"]) -> Float[Tensor, "n A"]:
        low, high = self.get_buffer("low"), self.get_buffer("high")
        action = self.policy._predict(observation, deterministic=True).flatten(1)
        if self.policy.squash_output:
            action = low + 0.5 * (action + 1.0) * (high - low)
        return torch.minimum(torch.maximum(action, low), high)


def export_policy(model: BaseAlgorithm, path: str | os.PathLike[str]) -> Path:
    """Write a policy to a file of the kind that its suffix says: ".pt" for TorchScript, ".onnx" for ONNX.

    Before it is handed over the file is read again and acts on random observations; it must do as the policy does. (An
    ONNX file only where onnxruntime is installed.)

    Args:
        model: as `MPCAgent.imagine_policy` returns it, or another algorithm of Stable-Baselines3.
        path: the file; one that exists is replaced.

    Returns:
        The path.

    Raises:
        ValueError: another suffix, or observations that are no vectors.
        ExportError: ONNX is not installed, or the file does not act as the policy does.
    """
    path, space = Path(path), model.observation_space
    check_suffix(path)
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ValueError(
            f"only policies of observations that are vectors can be exported, got {space}: for Dict observations put "
            "gymnasium.wrappers.FlattenObservation around the environment"
        )
    was_training = model.policy.training
    model.policy.set_training_mode(False)
    network = ActingNetwork(model).eval()
    observations = np.random.default_rng(0).standard_normal((TRIED, flat_size(space))).astype(np.float32)
    example = torch.from_numpy(observations[:2]).to(model.device)
    try:
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what PyTorch would rather have one use, and of traced assertions
            write = _write_torchscript if path.suffix == ".pt" else _write_onnx
            write(network, example, path)
    finally:
        model.policy.set_training_mode(was_training)
    _check_alike(model, path, observations)
    return path


def check_suffix(path: Path) -> None:
    """Raise a ValueError unless a policy can be exported to a file of that name."""
    if path.suffix not in (".pt", ".onnx"):
        raise ValueError(f"a policy is exported to a file with the suffix .pt or .onnx, got {path.name!r}")


def run_exported(
    path: str | os.PathLike[str], observations: Float[np.ndarray, "n S"]
) -> Float[np.ndarray, "n A"] | None:
    """The actions of an exported file; None of an ONNX file where onnxruntime is not installed."""
    path = Path(path)
    if path.suffix == ".pt":
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return torch.jit.load(str(path), map_location="cpu")(torch.from_numpy(observations)).numpy()
    try:
        import onnxruntime
    except ImportError:
        return None
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return session.run(None, {"observation": observations})[0]


def _write_torchscript(network: nn.Module, example: Tensor, path: Path) -> None:
    torch.jit.trace(network, example, check_trace=False).save(str(path))


def _write_onnx(network: nn.Module, example: Tensor, path: Path) -> None:
    try:
        import onnx  # noqa: F401
    except ImportError as error:
        raise ExportError(f"to write {path.name} ONNX is needed: {how_to_install('onnx')}") from error
    batch = {"observation": {0: "n"}, "action": {0: "n"}}
    names = {"input_names": ["observation"], "output_names": ["action"], "dynamic_axes": batch}
    # The newer exporter cannot follow the distributions of Stable-Baselines3's actors.
    torch.onnx.export(network, (example,), str(path), dynamo=False, **names)  # type: ignore[arg-type]


def _check_alike(model: BaseAlgorithm, path: Path, observations: Float[np.ndarray, "n S"]) -> None:
    """Raise an `ExportError` unless the file acts as the policy does."""
    acted = run_exported(path, observations)
    if acted is None:
        return
    assert isinstance(model.action_space, spaces.Box)
    expected = model.predict(observations, deterministic=True)[0].reshape(len(observations), -1)
    low, high = (bound.reshape(-1) for bound in _bounds(model.action_space))
    half = np.maximum((high - low) / 2, np.finfo(np.float32).tiny)
    difference = float(np.abs((acted - expected) / half).max())
    if not difference <= TOLERANCE:
        raise ExportError(
            f"{path.name} acts differently from the policy, by {difference:.2g} of half the range of actions; expected "
            f"at most {TOLERANCE}. Do not use the file"
        )


def _bounds(space: spaces.Box) -> tuple[np.ndarray, np.ndarray]:
    return space.low.astype(np.float32), space.high.astype(np.float32)
