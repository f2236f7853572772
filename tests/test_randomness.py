"""The split of the seed: fixed for ever, different for every use."""

import numpy as np
import scipy.stats
import torch

from gym_dgpmpc.randomness import STREAMS, derive_seed, fresh_seed, observation_generator, quick_normals, split_seed


def test_the_split_is_the_documented_one():
    for index, name in enumerate(STREAMS):
        expected = np.random.SeedSequence(5, spawn_key=(index,)).generate_state(1)[0]
        assert derive_seed(5, name) == expected
    assert STREAMS[:4] == ("exploration", "fit", "planning", "prediction")
    assert derive_seed(0, "exploration") == 3757552657


def test_streams_and_substreams_differ():
    seeds = [derive_seed(seed, name, *key) for seed in range(20) for name in STREAMS for key in ((), (0,), (1,))]
    assert len(set(seeds)) == len(seeds)
    draws = [torch.rand((), generator=generator).item() for generator in split_seed(1)]
    assert len(set(draws)) == 4


def test_generators_continue_from_their_state():
    generators, others = split_seed(1), split_seed(2)
    torch.rand(7, generator=generators.fit)
    others.load_state_dict(generators.state_dict())
    for one, other in zip(generators, others, strict=True):
        assert torch.equal(torch.rand(3, generator=one), torch.rand(3, generator=other))


def test_the_generator_of_an_observation():
    def draw(seed, observation):
        return torch.rand((), generator=observation_generator(seed, np.array(observation, dtype=np.float32))).item()

    assert draw(0, [1.0, 2.0]) == draw(0, [1.0, 2.0])
    assert len({draw(0, [1.0, 2.0]), draw(0, [1.0, 2.1]), draw(1, [1.0, 2.0])}) == 3


def test_fresh_seeds_are_fresh_and_fit_an_environment():
    seeds = [fresh_seed() for _ in range(5)]
    assert len(set(seeds)) == 5
    assert all(0 <= seed < 2**32 for seed in seeds)


def test_quick_normals_are_normal_and_fine_grained():
    """Against the normal law in its middle and its tails, and the generator decides everything."""
    like, generator = torch.zeros(1, dtype=torch.float64), split_seed(0).fit
    drawn = quick_normals((4, 100_000), like, generator)
    assert drawn.dtype == torch.float64 and drawn.shape == (4, 100_000)
    assert scipy.stats.kstest(drawn.flatten().numpy(), "norm").pvalue > 1e-3
    beyond = int((drawn.abs() > 4.0).sum())  # binomial with a mean of 25
    assert abs(beyond - 25.3) < 5 * 25.3**0.5
    assert len(drawn.unique()) > 0.95 * drawn.numel()
    again = quick_normals((4, 100_000), like, split_seed(0).fit)
    assert torch.equal(again, drawn)
