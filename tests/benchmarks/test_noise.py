"""`python -m benchmarks.noise`: the plant is what it says, intervals are counted rightly, and rows are written."""

import json
import math
import sys

import numpy as np
import torch

from benchmarks import noise
from tests.oracles.models import seeded


class Truth:
    """A model that knows the plant, whose noise it draws or not."""

    def __init__(self, std):
        self.std = std

    def draw(self, num_particles, horizon, generator):
        def step(observation, action, step):
            return noise.DECAY * observation + action + self.std * torch.randn(observation.shape, generator=generator)

        return step

    def _never(self, *arguments):
        raise AssertionError("there is nothing to learn")

    fit = resample = state_dict = load_state_dict = _never


def test_the_plant_is_an_autoregression():
    data = noise.episode(4000, 1.0, 0.2, 0.0, 0)
    assert torch.equal(data.observation[1:], data.next_observation[:-1])
    residual = data.next_observation - noise.DECAY * data.observation - data.action
    assert abs(float(residual.std()) - 0.2) < 5 * 0.2 / math.sqrt(2 * 4000)
    blurred = noise.episode(4000, 1.0, 0.2, 0.3, 0)
    error = blurred.observation - data.observation
    assert abs(float(error.std()) - 0.3) < 5 * 0.3 / math.sqrt(2 * 4000)


def test_intervals_of_the_truth_hold_nine_times_in_ten():
    """One step ahead the starts are independent: within five standard errors, and one for the particles' own std."""
    tests = [noise.episode(1000, 1.0, 0.2, 0.0, seed) for seed in range(4)]
    held = noise.coverage(Truth(0.2), tests, seeded())
    starts = 4 * 980 / 5
    assert set(held) == set(noise.HORIZONS)
    assert abs(held[1] - 0.9) < 5 * math.sqrt(0.9 * 0.1 / starts) + 0.02
    assert noise.coverage(Truth(0.02), tests, seeded())[1] < 0.3


def test_rows_are_written_and_not_measured_twice(monkeypatch, tmp_path):
    measured = []
    monkeypatch.setattr(noise, "measure", lambda wanted: measured.append(wanted) or {"none_1": 0.5})
    monkeypatch.setattr(noise.torch, "set_num_threads", lambda _: None)
    monkeypatch.setattr(sys, "argv", ["x", "--seeds", "100", "--results", str(tmp_path)])
    noise.main()
    noise.main()
    assert len(measured) == len(noise.MODELS) * len(noise.NOISES)
    rows = json.loads((tmp_path / "noise.json").read_text())["rows"]
    assert {(row["model"], row["noise"]) for row in rows} == {(m, n) for m in noise.MODELS for n in noise.NOISES}


def test_a_measurement_has_every_draw_at_every_horizon(monkeypatch):
    monkeypatch.setattr(noise, "TEST_SEEDS", range(5000, 5001))
    row = noise.measure({"steps": 80, "gain": 1.0, "model": "GP", "noise": "process", "seed": 100})
    assert {f"{draw}_{horizon}" for draw in noise.DRAWS for horizon in noise.HORIZONS} <= set(row)
    assert row["none_1"] < row["all_1"], "the function alone holds less than with its noise"
    assert np.isfinite(list(row.values())).all()
