"""Sampling inducing outputs and hyperparameters: SG-HMC in several chains, its gradients, priors, diagnostics."""
