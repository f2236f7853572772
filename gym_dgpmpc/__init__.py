"""Sample-efficient model-predictive control with deep Gaussian processes."""
