"""Checkpoints: the file an agent is saved in, a run's folder, and what keeps a run safe while it learns."""
