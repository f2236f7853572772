"""Process and observation noise: the estimate on linear systems whose noise is known, and what draws make of it."""

import math

import numpy as np
import pytest
import torch

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.dynamics.noise import (
    FEWEST_PAIRS,
    NoiseSplit,
    ObservationNoise,
    ObservedSampler,
    PathNoise,
    consecutive,
    split_noise,
    take_noise_split,
)
from gym_dgpmpc.types import ObservationSpec, Transitions
from tests.oracles.models import seeded

DECAY = 0.9
CPU = torch.device("cpu")


def episode(steps, process_std, observation_std, seed=0, gain=1.0):
    """x' = 0.9 x + gain a + w, observed as x + e."""
    rng = np.random.default_rng(seed)
    action, state = rng.uniform(-1, 1, (steps, 1)), np.zeros((steps + 1, 1))
    for t in range(steps):
        state[t + 1] = DECAY * state[t] + gain * action[t] + process_std * rng.standard_normal()
    observed = state + observation_std * rng.standard_normal(state.shape)
    return Transitions(*(torch.tensor(each) for each in (observed[:-1], action, observed[1:])))


def estimate(data, spec=None):
    """The split by least squares, the best linear model of what is observed."""
    encoder = Encoder(data.observation.shape[1], data.action.shape[1], spec)

    def features(raw):
        return torch.cat([raw, torch.ones_like(raw[:, :1])], 1)

    x = features(encoder.inputs(data.observation, data.action))
    y = encoder.targets(data.observation, data.next_observation)
    weights = torch.linalg.lstsq(x, y).solution
    variance = (y - x @ weights).square().mean(0)
    return split_noise(data, encoder, lambda raw: features(raw) @ weights, variance), variance


@pytest.mark.parametrize(("process_std", "observation_std"), [(0.2, 0.0), (0.0, 0.2), (0.2, 0.2)])
@pytest.mark.parametrize("spec", [ObservationSpec(), ObservationSpec(absolute=(0,))])
def test_both_variances_are_found_within_their_standard_errors(process_std, observation_std, spec):
    """Averaged over episodes. A correlation of n residuals errs by n^-1/2, and R by N / (A (1 - N / V)) times that; the
    estimate is of first order in R / V, and shrinks a correlation c by 1 / (n c)."""
    steps, num_episodes = 1000, 12
    found = [estimate(episode(steps, process_std, observation_std, seed), spec) for seed in range(num_episodes)]
    observation = np.mean([float(split.observation_variance) for split, _ in found])
    process = np.mean([float(split.process_share * variance) for split, variance in found])
    noise = process_std**2 + (1 + DECAY**2) * observation_std**2
    spread = (process_std**2 + 1 / 3) / (1 - DECAY**2) + observation_std**2
    error = noise / (DECAY * (1 - noise / spread)) / math.sqrt(steps * num_episodes)
    second_order = 3 * observation_std**4 / spread
    # Where R = 0, half of the estimates are its positive part: on average 0.2 standard errors of one episode.
    positive_part = 0.2 * error * math.sqrt(num_episodes)
    assert abs(observation - observation_std**2) < 3 * error + second_order + positive_part
    errors_of_process = 3 * error + second_order + positive_part
    assert abs(process - process_std**2) < (1 + DECAY**2) * errors_of_process + 3 * noise * math.sqrt(
        2 / (steps * num_episodes)
    )


def test_white_residuals_are_process_noise_and_little_else():
    """Beyond its standard error a correlation of white noise is negative in 16 % of the episodes."""
    splits = [estimate(episode(220, 0.2, 0.0, seed))[0] for seed in range(60)]
    mistaken = sum(bool(split.observation_variance > 0) for split in splits)
    assert mistaken <= 60 * 0.16 + 3 * math.sqrt(60 * 0.16 * 0.84)
    whole = [split for split in splits if not split.observation_variance]
    assert all(split.process_share == 1.0 and split.observation(Encoder(1, 1)) is None for split in whole)


def test_an_integrator_carries_all_of_its_noise_and_none_of_its_sensors():
    """A place that is not fed to the model: its slope is one, whatever the noise."""
    rng = np.random.default_rng(0)
    steps, std = 1000, np.array([0.1, 0.3])
    action = rng.uniform(-1, 1, (steps, 1))
    state = np.concatenate([np.zeros((1, 1)), np.cumsum(action + std[0] * rng.standard_normal((steps, 1)), 0)])
    observed = state + std[1] * rng.standard_normal(state.shape)
    data = Transitions(*(torch.tensor(each) for each in (observed[:-1], action, observed[1:])))
    split, variance = estimate(data, ObservationSpec(not_inputs=(0,)))
    error = float(variance) / math.sqrt(steps)
    assert abs(float(split.observation_variance) - std[1] ** 2) < 3 * error
    assert float(split.dilution) == 0.0


def test_noise_that_flattens_the_function_too_much_is_carried_on():
    """Of the observed variance a third is noise: the function forgets the state too soon."""
    split, _ = estimate(episode(4000, 0.2, 0.3, gain=0.1))
    assert split.observation_variance == 0 and split.process_share == 1


def test_nothing_is_told_apart_in_rows_that_do_not_follow_one_another():
    data = episode(1000, 0.0, 0.2)
    rows = torch.arange(0, 1000, 2)
    for some in (Transitions(*(field[rows] for field in data)), episode(FEWEST_PAIRS, 0.0, 0.2)):
        split, _ = estimate(some)
        assert split.observation_variance == 0 and split.process_share == 1


def test_episodes_of_several_environments_are_told_apart():
    one, other = episode(100, 0.1, 0.1, 1), episode(100, 0.1, 0.1, 2)
    mixed = Transitions(*(torch.stack(pair, 1).flatten(0, 1) for pair in zip(one, other, strict=True)))
    assert consecutive(mixed, Encoder(1, 1)) == (list(range(198)), list(range(2, 200)))


def test_a_learned_reward_does_not_hide_what_follows():
    """It has no value before a step, so an observation never equals the one that it follows."""
    plain = episode(100, 0.1, 0.1)
    reward = torch.rand(100, 1, generator=seeded(), dtype=torch.float64)
    data = Transitions(
        torch.cat([plain.observation, torch.zeros_like(reward)], 1),
        plain.action,
        torch.cat([plain.next_observation, reward], 1),
    )
    spec = ObservationSpec(absolute=(1,), not_inputs=(1,))
    assert consecutive(data, Encoder(2, 1, spec)) == (list(range(99)), list(range(1, 100)))


def test_vectors_that_turn_are_process_noise():
    data = episode(500, 0.0, 0.2)
    heading, other = torch.zeros_like(data.observation), episode(500, 0.0, 0.2, 1)
    turned = Transitions(
        torch.cat([heading, data.observation, other.observation], 1),
        torch.cat([data.action, other.action], 1),
        torch.cat([heading, data.next_observation, other.next_observation], 1),
    )
    straight, _ = estimate(turned, ObservationSpec(constant=(0,)))
    assert (straight.observation_variance > 0).all()
    split, _ = estimate(turned, ObservationSpec(constant=(0,), body_frame=((0, 1, 2),)))
    assert (split.observation_variance == 0).all() and (split.process_share == 1).all()


def test_what_is_saved_is_what_was_there_and_older_files_have_nothing():
    split, _ = estimate(episode(1000, 0.1, 0.2))
    loaded = take_noise_split(split.state(), 1, CPU)
    assert all(torch.equal(*pair) for pair in zip(split, loaded, strict=True))
    assert take_noise_split({}, 1, CPU) is None
    for missing in split.state():
        state = {name: value for name, value in split.state().items() if name != missing}
        with pytest.raises(ValueError, match=missing):
            take_noise_split(state, 1, CPU)


def test_a_step_is_fed_what_the_last_one_led_to_without_its_error():
    """With a sampler that changes nothing, what it is fed is what it gives, so the errors can be read off."""
    std, fed = torch.tensor([0.5, 0.0], dtype=torch.float64), []

    def sampler(observation, action, step):
        fed.append(observation)
        return observation

    noise = ObservationNoise(std, torch.zeros_like(std), torch.zeros_like(std))
    observed = ObservedSampler(sampler, noise, seeded())
    start, action = torch.zeros(400, 50, 2), torch.zeros(50, 1)
    state = start
    for step in range(3):
        state = observed(state, action, step)
    assert torch.allclose(fed[1], fed[0], atol=1e-6) and torch.allclose(fed[2], fed[0], atol=1e-6)
    assert all((each[..., 1] == 0).all() for each in (*fed, state)), "a constant has no noise"
    standard_error = 0.25 * math.sqrt(2 / (400 * 50))
    for seen, expected in ((fed[0], 0.25), (state, 0.5)):  # of the start alone, and with the last observation's own
        assert abs(float(seen[..., 0].var()) - expected) < 5 * 2 * standard_error
    again = observed(start, action, 0)
    assert abs(float((again - fed[-1])[..., 0].var()) - 0.25) < 5 * standard_error
    assert not torch.equal(fed[-1], fed[0]), "step 0 begins anew"


def test_what_is_fed_undoes_the_flatness_of_what_was_fitted():
    """Of a linear model, k times as steep as it should be about m: fed m + (x - m) / k it gives the true value."""
    split = NoiseSplit(*(torch.tensor([value], dtype=torch.float64) for value in (0.5, 0.04, 0.2, 3.0)))
    noise = split.observation(Encoder(1, 1))
    state = torch.tensor([[2.0], [3.0], [5.0]], dtype=torch.float64)
    flat = 0.8 * (noise.fed(state) - 3.0)
    assert torch.allclose(flat, state - 3.0)
    assert torch.allclose(noise.start_std, (torch.tensor([0.04], dtype=torch.float64) / 0.8).sqrt())


def test_process_noise_has_the_size_of_each_particles_own():
    """A standard deviation from H draws errs by (2 H)^-1/2 of itself; and no particle's luck is another's."""
    std, horizon = torch.tensor([[0.1, 2.0], [0.5, 0.0], [3.0, 1.0]], dtype=torch.float64), 10_000
    noise = PathNoise.draw(std, None, horizon, 3, torch.float64, seeded())
    assert noise.process.shape == (horizon, 3, 2) and noise.observation is None
    torch.testing.assert_close(noise.process.std(0), std, rtol=5 / math.sqrt(2 * horizon), atol=0)
    correlation = noise.process[..., [0]].flatten(1).mT.corrcoef()
    assert (correlation - torch.eye(3).double()).abs().max() < 5 / math.sqrt(horizon)
