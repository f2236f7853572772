"""Priors of the hyperparameters of a deep Gaussian process, for standardised inputs and targets.

`sampler.py` samples under them; `dynamics/deep_gp/start.py` starts at their centres. They are wide: the logarithm of a
lengthscale, a variance or a noise variance is normal about the value that training starts from, with a standard
deviation of `WIDTH`: a factor of e^3 = 20 to either side lies within one. Inducing inputs are normal about zero with
`INDUCING_WIDTH`, ten times the inputs' own: a narrower prior draws them together, which costs accuracy
(docs/calibration.md).
"""

import math

from torch import Tensor

from gym_dgpmpc.gp.deep_gp import DeepGP

WIDTH, INDUCING_WIDTH = 3.0, 10.0

LARGEST = 15.0
"""Of the logarithm of a variance that is plausible, five standard deviations from the centre: three million."""

INNER_VARIANCE = 0.01
SLOPE = 0.5
"""Of the last layer's linear part, so that at a typical point its variance is a quarter of the other part's."""

NOISE_VARIANCE = 0.05


def log_lengthscale_centre(input_size: int) -> float:
    """log sqrt(D): two points at random are then about one and a half lengthscales apart, however large D."""
    return 0.5 * math.log(input_size)


def log_variance_centre(*, last: bool) -> float:
    """Of a layer's kernel: the targets' own variance for the last; inner layers begin close to the identity."""
    return 0.0 if last else math.log(INNER_VARIANCE)


def are_plausible(model: DeepGP) -> bool:
    """Whether kernel and noise variances are finite and not absurd. Long lengthscales, and no noise, are no fault."""
    variances = [layer.log_variance for layer in model.layers] + [model.log_noise]
    variances += [2.0 * layer.log_slope for layer in model.layers if layer.log_slope is not None]
    return all(bool((value < LARGEST).all()) for value in variances)


def log_prior_gradient(model: DeepGP) -> list[Tensor]:
    """d log p(theta) / d theta, in the order of `DeepGP.parameters`."""
    by_parameter = []
    for index, layer in enumerate(model.layers):
        last = index == len(model.layers) - 1
        centre = log_lengthscale_centre(layer.inducing_inputs.shape[-1])
        by_parameter += [
            -layer.inducing_inputs / INDUCING_WIDTH**2,
            (centre - layer.log_lengthscale) / WIDTH**2,
            (log_variance_centre(last=last) - layer.log_variance) / WIDTH**2,
        ]
        if layer.log_slope is not None:
            by_parameter.append((math.log(SLOPE) - layer.log_slope) / WIDTH**2)
    return [*by_parameter, (math.log(NOISE_VARIANCE) - model.log_noise) / WIDTH**2]
