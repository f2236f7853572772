"""The sparse Gaussian process whose Gaussian inputs have exact moments, with nothing to choose that has none."""

import torch

from gym_dgpmpc.dynamics.sparse_gp.model import SparseGPDynamics
from gym_dgpmpc.types import ObservationSpec


class MomentMatchedDynamics(SparseGPDynamics):
    """A `SparseGPDynamics` with an RBF kernel and the draw "AMM", whose fitted noise all adds up along a path.

    Args:
        observation_size: numbers in an observation, S.
        action_size: numbers in an action, A.
        observation_spec: how to read the observation.
        num_inducing: inducing points, M; while there are fewer transitions than that, each of them is one.
        exact: make every transition an inducing point and keep it there, which is the exact Gaussian process up to the
            jitter; for small data, since the cost grows with the cube of their number.
        max_training_iterations: iterations of the optimiser, L-BFGS, in each training, at most.
        dtype: precision of a rollout's states; the model itself computes in float64.
        device: where tensors live.

    Raises:
        ValueError: a setting is out of its range.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        observation_spec: ObservationSpec | None = None,
        *,
        num_inducing: int = 100,
        exact: bool = False,
        max_training_iterations: int = 200,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ):
        super().__init__(
            observation_size,
            action_size,
            observation_spec,
            num_inducing=num_inducing,
            exact=exact,
            max_training_iterations=max_training_iterations,
            draw="AMM",
            add_noise=True,
            split_noise=False,
            dtype=dtype,
            device=device,
        )
