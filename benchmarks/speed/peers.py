"""What is measured beside the deep GP of this package: PETS's networks, and the same deep GP in GPyTorch."""

from collections.abc import Callable
from typing import Any

import torch

from benchmarks.speed.cases import BATCH_SIZE, NUM_CANDIDATES, NUM_INDUCING, NUM_PARTICLES, Case, plan_call
from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.dynamics.ensemble.model import EnsembleDynamics
from gym_dgpmpc.types import Transitions


def pets_plan(case: Case, data: Transitions, **settings: Any) -> Callable[[], None]:
    """A plan of the same K, P, H and iterations through five networks of the size that PETS has for the task."""
    depth, width = case.hidden
    model = EnsembleDynamics(
        case.observation_size, case.action_size, case.spec, num_hidden_layers=depth, hidden_size=width,
        weight_decay=(1e-4,) * (depth + 1), num_epochs=1, draw="TSinf", **settings,
    )  # fmt: skip
    model.fit(Transitions(*(field[:64] for field in data)), torch.Generator().manual_seed(0))
    return plan_call(case, model, data)


def gpytorch_calls(case: Case, num_layers: int) -> dict[str, Callable[[], None]]:
    """Prediction of P K points with one sample, and a training step with one sample; float32, GPyTorch's default."""
    import gpytorch
    from gpytorch.models.deep_gps import DeepGP, DeepGPLayer

    encoder = Encoder(case.observation_size, case.action_size, case.spec)
    generator = torch.Generator().manual_seed(0)

    class Layer(DeepGPLayer):
        """M inducing points, Matern-3/2 with ARD, identity mean in inner layers and zero in the last."""

        def __init__(self, outputs: int, is_last: bool):
            size, shape = encoder.input_size, torch.Size([outputs])
            inducing = torch.randn(outputs, NUM_INDUCING, size, generator=generator)
            distribution = gpytorch.variational.CholeskyVariationalDistribution(NUM_INDUCING, batch_shape=shape)
            strategy = gpytorch.variational.VariationalStrategy(self, inducing, distribution)
            super().__init__(strategy, size, outputs)
            zero = gpytorch.means.ZeroMean(batch_shape=shape)
            self.mean_module = zero if is_last else gpytorch.means.LinearMean(size, batch_shape=shape)
            self.covar_module = gpytorch.kernels.ScaleKernel(
                gpytorch.kernels.MaternKernel(1.5, batch_shape=shape, ard_num_dims=size), batch_shape=shape
            )

        def forward(self, x: torch.Tensor) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    class Model(DeepGP):
        """L layers of the width of the encoded input, the last of that of the targets."""

        def __init__(self) -> None:
            super().__init__()
            inner = [Layer(encoder.input_size, False) for _ in range(num_layers - 1)]
            self.layers = torch.nn.ModuleList([*inner, Layer(encoder.target_size, True)])
            self.likelihood = gpytorch.likelihoods.MultitaskGaussianLikelihood(encoder.target_size)

        def forward(self, x: torch.Tensor) -> Any:
            for layer in self.layers:
                x = layer(x)
            return x

    model = Model()
    objective = gpytorch.mlls.DeepApproximateMLL(
        gpytorch.mlls.VariationalELBO(model.likelihood, model, num_data=BATCH_SIZE)
    )
    optimiser = torch.optim.Adam(model.parameters(), lr=0.01)
    x = torch.randn(BATCH_SIZE, encoder.input_size, generator=generator)
    y = torch.randn(BATCH_SIZE, encoder.target_size, generator=generator)
    points = torch.randn(NUM_PARTICLES * NUM_CANDIDATES, encoder.input_size, generator=generator)

    def train() -> None:
        model.train()
        with gpytorch.settings.num_likelihood_samples(1):
            optimiser.zero_grad()
            (-objective(model(x), y)).backward()
            optimiser.step()

    def predict() -> None:
        model.eval()
        with torch.no_grad(), gpytorch.settings.num_likelihood_samples(1):
            prediction = model(points)
            assert prediction.mean.isfinite().all() and prediction.variance.isfinite().all()

    return {"training step": train, "prediction": predict}
