"""Sampling inducing outputs and fitting hyperparameters: SG-HMC, moving-window MCEM, chain diagnostics."""
