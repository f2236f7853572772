"""`python -m benchmarks.calibration`: scores have closed forms, forecasts meet what was recorded."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from benchmarks.calibration import forecasts, uci
from benchmarks.calibration.episodes import NUM_LEARNED, SMOOTH, WHITE, Recording, load, save
from benchmarks.calibration.forecasts import NUM_DRAWS, NUM_PARTICLES, STRIDE, forecast
from benchmarks.calibration.measure import HORIZONS, measure
from benchmarks.calibration.tables import OURS, RIVALS, SCORES, all_scores, beside_rivals
from gym_dgpmpc.dynamics.scores import LEVELS, scores
from gym_dgpmpc.dynamics.sparse_gp.model import SparseGPDynamics
from gym_dgpmpc.types import Transitions
from tests.oracles.models import normal, seeded


def episode(action, slope=1.0):
    """x' = 0.5 x + slope a, from zero: exact in binary for actions that are small integers."""
    observation = torch.zeros(len(action) + 1, action.shape[1], dtype=action.dtype)
    for step, each in enumerate(action):
        observation[step + 1] = 0.5 * observation[step] + slope * each
    return Transitions(observation[:-1], action, observation[1:])


class Exact:
    """A model that knows that law, and asks for its steps in their order."""

    def draw(self, num_particles, horizon, generator):
        expected = iter(range(horizon))

        def step(observation, action, index):
            assert index == next(expected)
            return 0.5 * observation + action

        return step

    def _never(self, *arguments):
        raise AssertionError("there is nothing to learn")

    fit = resample = state_dict = load_state_dict = _never


def test_intervals_hold_their_share():
    """Of 199 particles and a further one each order is as likely, so that the levels are met exactly, on average."""
    drawn, points = normal(seeded(), 200, 4000, 1), 4000
    found = scores(drawn[1:], drawn[0])
    for level in LEVELS:
        assert abs(found[f"coverage_{round(100 * level)}"] - level) < 5 * math.sqrt(level * (1 - level) / points)


def test_crps_of_a_normal():
    """s (z (2 Phi(z) - 1) + 2 phi(z) - 1 / sqrt(pi)) (Gneiting and Raftery 2007), within the particles' own error."""
    spread, num, points = 3.0, 200, 1000
    truth = 2.0 * spread * normal(seeded(1), points, 1)
    found = scores(spread * normal(seeded(), num, points, 1), truth)["crps"]
    z, unit = truth / spread, Normal(torch.tensor(0.0, dtype=torch.float64), 1.0)
    expected = spread * (z * (2 * unit.cdf(z) - 1) + 2 * unit.log_prob(z).exp() - 1 / math.sqrt(math.pi))
    error = math.sqrt((spread**2 + float(truth.square().mean())) / (num * points))  # var |x - y| <= E (x - y)^2
    assert abs(found - float(expected.mean())) < 5 * error


def test_moments_and_likelihood():
    """Particles of exact moments, and truths 1.5 deviations above their mean."""
    particles = normal(seeded(), 50, 30, 2)
    mean, std = normal(seeded(1), 30, 2), normal(seeded(2), 30, 2).exp()
    particles = mean + std * (particles - particles.mean(0)) / particles.std(0)
    found = scores(particles, mean + 1.5 * std)
    expected = {
        "z2": 1.5**2,
        "rmse": 1.5 * float(std.square().mean().sqrt()),
        "nll": -float(Normal(mean, std).log_prob(mean + 1.5 * std).mean()),
        "lost": 0.0,
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-9)


def test_particles_that_are_not_finite_are_lost():
    particles, truth = normal(seeded(), 40, 30, 2), normal(seeded(1), 30, 2)
    whole = scores(particles[10:], truth)
    particles[:10, 7, 1] = torch.tensor([math.nan, math.inf]).repeat(5)
    assert scores(particles, truth) == whole | {"lost": 0.25}
    particles[2:] = math.nan
    found = scores(particles, truth)
    assert found.pop("lost") == 1.0 and all(math.isnan(value) for value in found.values())
    particles[3:] = normal(seeded(2), 37, 30, 2)
    assert math.isfinite(scores(particles[:6], truth)["coverage_95"]), "three particles have no tails to cut off"


def test_forecasts_of_the_truth_meet_it():
    lengths, horizons = (24, 30), (1, 3, 10)
    episodes = [episode(torch.arange(1.0, num + 1).square().unsqueeze(1).remainder(7)) for num in lengths]
    found = forecast(Exact(), episodes, horizons, seeded())
    assert tuple(found) == horizons
    starts = [range(0, num - 10 + 1, STRIDE) for num in lengths]
    for horizon, (particles, truth) in found.items():
        met = [each.next_observation[s + horizon - 1] for each, own in zip(episodes, starts, strict=True) for s in own]
        assert torch.equal(truth, torch.stack(met))
        assert torch.equal(particles, truth.expand(NUM_DRAWS * NUM_PARTICLES, -1, -1))
    assert len({tuple(found[horizon].truth.flatten().tolist()) for horizon in horizons}) == 3


def test_a_recording_gives_its_episodes_back():
    episodes = [episode(normal(seeded(seed), 6, 2).float()) for seed in range(3)]
    recording = Recording.of(episodes)
    assert recording.observation.shape == (3, 7, 2) and recording.action.shape == (3, 6, 2)
    for columns in zip(recording.transitions([2, 0]), episodes[2], episodes[0], strict=True):
        assert torch.equal(columns[0], torch.cat(columns[1:]))


def test_a_file_has_the_recording_of_each_seed(tmp_path):
    recordings = {
        seed: Recording.of([episode(normal(seeded(seed), 6, 2).float(), slope) for slope in (1.0, 2.0)])
        for seed in (100, 103)
    }
    save(tmp_path / "pendulum.npz", recordings)
    for seed, recording in recordings.items():
        for found, expected in zip(load("pendulum", seed, tmp_path), recording, strict=True):
            assert torch.equal(found, expected)
    with pytest.raises(ValueError, match="101"):
        load("pendulum", 101, tmp_path)


def test_a_model_is_tested_on_and_off_the_policy(monkeypatch, tmp_path):
    """What comes next in the run obeys the law that was learned; in the other two episodes actions work backwards."""
    slopes = [1.0] * NUM_LEARNED + [-1.0, -1.0]
    episodes = [episode(normal(seeded(seed), 26, 1).float(), slope) for seed, slope in enumerate(slopes)]
    assert (WHITE, SMOOTH) == (NUM_LEARNED, NUM_LEARNED + 1)
    save(tmp_path / "pendulum.npz", {100: Recording.of(episodes)})
    monkeypatch.setattr(forecasts, "NUM_DRAWS", 4)
    monkeypatch.setitem(HORIZONS, "pendulum", (1, 4))
    make = partial(SparseGPDynamics, num_inducing=10, max_training_iterations=20)
    rows = measure(make, "pendulum", 100, (1, 2), tmp_path)
    kinds = [(row["episodes"], row["test"], row["horizon"]) for row in rows]
    assert kinds == [(count, test, H) for count in (1, 2) for test in ("on", "off") for H in (1, 4)]
    for row in rows:
        assert (row["task"], row["seed"], row["lost"]) == ("pendulum", 100, 0.0)
        assert row["rmse"] < 0.1 if row["test"] == "on" else row["rmse"] > 1.0
    assert rows[0]["fit_seconds"] < rows[-1]["fit_seconds"]


def test_a_regression_is_learned_in_raw_units(tmp_path):
    """y = 1000 + 50 x1 - 20 x2 + N(0, 5^2): the error is the noise's, and so is the likelihood, up to what is learned.

    Of n held-out rows the mean square error over 25 has a standard error of sqrt(2 / n), the mean log likelihood one of
    sqrt(1 / (2 n)); learning from 100 rows costs a share of a few hundredths of either.
    """
    rng, noise, num = np.random.default_rng(0), 5.0, 300
    x = rng.normal(2.0, 3.0, (num, 2))
    y = 1000 + 50 * x[:, 0] - 20 * x[:, 1] + noise * rng.standard_normal(num)
    held_out = np.arange(100, num)
    np.savez(tmp_path / "made_up.npz", x=x, y=y, test=held_out[None])
    row = uci.measure(tmp_path, {"set": "made_up", "split": 0, "model": "sparse GP"})
    assert abs(row["rmse"] ** 2 / noise**2 - 1.0) < 5 * math.sqrt(2 / len(held_out)) + 0.1
    entropy = 0.5 * math.log(2 * math.pi * math.e * noise**2)
    assert abs(row["log_likelihood"] + entropy) < 5 * math.sqrt(0.5 / len(held_out)) + 0.1
    assert abs(row["z2"] - 1.0) < 5 * math.sqrt(2 / len(held_out)) + 0.2


def test_a_regression_reads_its_inputs_alone():
    x, y = np.arange(6.0).reshape(3, 2), np.array([7.0, 8.0, 9.0])
    data, model = uci.transitions(x, y), SparseGPDynamics(3, 0, uci.spec(2))
    inputs, targets = model._encode(data)
    assert inputs.tolist() == x.tolist() and targets.flatten().tolist() == y.tolist()


def test_large_sets_are_trained_for_as_many_passes_and_small_ones_for_the_defaults():
    """128 passes over 8,000 rows in minibatches of 256 are 4,000 iterations; over 300 they are fewer than 1,000."""
    assert uci._iterations("DGP L=2", 8000) == {"first_training_iterations": 4000}
    assert uci._iterations("DGP L=2", 300) == {"first_training_iterations": 1000}
    assert uci._iterations("sparse GP", 8000) == {}


def test_the_page_of_regressions_has_means_over_splits_beside_what_was_published():
    about = {"command": "python -m benchmarks.calibration.uci FOLDER", "revision": "abc", "set": "boston"}
    rows = [
        about | {"split": split, "model": "DGP L=2", "log_likelihood": value, "rmse": 2.0 + split, "z2": 1.0}
        for split, value in enumerate((-2.0, -2.5, -3.0))
    ]
    page = uci.page(rows)
    error = 0.5 / 3**0.5
    assert f"| boston | -2.50 ± {error:.2f}; 3; 1.00; 3 | -2.51 ± 0.07 | -2.43 ± 0.05 |" in page
    assert "abc" in page and "energy" not in page


def row(model, seed, nll, coverage=0.9, z2=1.0, horizon=1):
    found = dict.fromkeys(SCORES, 0.25) | {"nll": nll, "coverage_90": coverage, "z2": z2}
    return {"model": model, "seed": seed, "task": "cartpole", "episodes": 1, "test": "on", "horizon": horizon} | found


def test_the_deep_gp_stands_beside_its_rivals_on_the_same_seeds():
    rows = [row(OURS, 1, -1.0), row(OURS, 2, -2.0), row(OURS, 3, -9.0), row(OURS, 1, 1.0, 0.8, 2.0, horizon=10)]
    rows += [row(RIVALS[0], 1, 1.0), row(RIVALS[0], 2, 0.5), row(RIVALS[0], 4, -99.0)]
    rows += [row(RIVALS[1], 1, 0.0, horizon=10)]
    summary, _, _, _, first, second = beside_rivals(rows)
    # Means of -12 / 3 with the error 2.517; differences -2 and -2.5 have the mean -2.25 and the error 0.25.
    assert first == "| cartpole | 1 | on | 1 | 3 | 90 | 1.00 | -4.00 ± 2.52 | **-2.25 ± 0.25** | – |"
    assert second == "| cartpole | 1 | on | 10 | 1 | 80 | 2.00 | 1.00 | – | 1.00 |"
    assert "of 2 points 90 % intervals hold 85 to 95 % at 1, mean z² is 0.8 to 1.3 at 1" in summary
    assert f"of {RIVALS[0]} at 1, of {RIVALS[1]} at 0." in summary


def test_scores_are_means_over_seeds():
    *_, line = all_scores([row(OURS, 1, -1.0), row(OURS, 2, -2.0, coverage=0.7)])
    assert line == f"| cartpole | 1 | on | 1 | {OURS} | 2 | 0.25 | 0.80 | 0.25 | -1.50 ± 0.50 | 0.250 | 0.250 | 1.00 |"
