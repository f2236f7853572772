"""The examples run, at a tiny size."""

import math

from examples import quickstart

TINY = {
    "num_inducing": 10,
    "num_features": 8,
    "first_training_iterations": 5,
    "training_iterations": 2,
    "num_samples": 4,
    "sample_spacing": 1,
    "resample_steps": 1,
    "num_candidates": 10,
    "num_iterations": 1,
    "horizon": 2,
    "num_particles": 2,
    "learning_starts": 20,
}


def test_quickstart(tmp_path, capsys):
    mean = quickstart.main(220, tmp_path, **TINY)
    assert math.isfinite(mean)
    assert (tmp_path / "agent.zip").exists()
    printed = capsys.readouterr().out
    assert "return over two episodes" in printed
    assert "first action at" in printed
