"""Stacking: the weights with which a mixture of predictive densities has predicted best.

Yao, Vehtari, Simpson and Gelman (2018), "Using Stacking to Average Bayesian Predictive Distributions". Unlike the
models' posterior probabilities, which give all to the one that is best on the whole, the weights share out what each
predicts best, and need none of the models to be true.
"""

import torch
from jaxtyping import Float
from torch import Tensor

PRIOR = 1.0
"""Transitions that every model counts as having predicted alone, so that without any all weights are equal."""

TOLERANCE, MOST_ITERATIONS = 1e-10, 10_000
"""The largest change of a weight at which the iteration has arrived, and its bound; on few points it takes tens."""


def stacking_weights(log_density: Float[Tensor, "n M"]) -> Float[Tensor, "M"]:
    """Weights of M models, positive and of the sum 1, float64, by expectation maximisation from equal ones.

    They maximise, over the simplex, the concave

        sum_n log sum_m w_m p_m(y_n) + PRIOR sum_m log w_m.

    A density that is not a number counts as zero; points where no model has one above zero, or one has an infinite one,
    are left out.

    Args:
        log_density: log p_m(y_n) of points that the models had not learned from.
    """
    log_density = log_density.double().masked_fill(log_density.isnan(), -torch.inf)
    highest = log_density.amax(-1, keepdim=True)
    density = (log_density - highest)[highest.squeeze(-1).isfinite()].exp()  # a common factor changes no weight
    num_points, num_models = density.shape
    weights = density.new_full((num_models,), 1.0 / num_models)
    for _ in range(MOST_ITERATIONS):
        share = weights * density
        share /= share.sum(-1, keepdim=True)
        before, weights = weights, (share.sum(0) + PRIOR) / (num_points + PRIOR * num_models)
        if bool((weights - before).abs().max() < TOLERANCE):
            break
    return weights
