"""The split of the seed: fixed for ever, different for every use."""

import numpy as np
import torch

from gym_dgpmpc.randomness import STREAMS, derive_seed, fresh_seed, observation_generator, split_seed


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
