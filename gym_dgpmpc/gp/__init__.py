"""Deep Gaussian processes: kernels, factorisation, random features, sparse layers and their composition."""
