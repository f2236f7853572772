"""The three cases of the contact study: short sequences beside the end of the rail, and what a fixed action does there.

The supplement of the paper trains a model on sequences of the modified cart-pole at a finer time step, and rolls it out
under a fixed action. In case a the cart is driven into the end of the rail, in case b away from it, in case c both.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray

from gym_dgpmpc.envs.mod_cartpole import RAIL_LIMIT, ModCartPoleEnv
from gym_dgpmpc.envs.simulator import Simulator
from gym_dgpmpc.types import Transitions

FRAME_SKIP = 1
"""Simulator steps of 0.02 s in one step of the study; the task's own step has two."""

NUM_SEQUENCES = 50
"""Sequences of training data."""

_TRAINING, _TEST = 0, 1
"""Streams of random numbers."""


class ContactCase(NamedTuple):
    """What a model is trained on and tested with."""

    title: str
    lowest_action: float
    highest_action: float
    """Training actions are uniform between the two; one unit is 100 N towards the end of the rail."""
    length: int
    """Steps of a training sequence."""
    test_action: float
    """The action that is held in the test."""
    horizon: int
    """Steps of the test."""


CASES = {
    "a": ContactCase("the cart is driven into the end of the rail", 0.0, 3.0, 10, 0.75, 15),
    "b": ContactCase("the cart moves freely along the rail", -3.0, 0.0, 10, -1.0, 15),
    "c": ContactCase("free motion and the end of the rail", -3.0, 3.0, 20, 0.75, 20),
}
"""As in the supplement, which does not say how long the tests are. Those of a and b are half as long again as the
training sequences: from the mean start, the held action of case a reaches the end of the rail in the tenth step."""


class ContactTest(NamedTuple):
    """True trajectories under a case's fixed action, raw units."""

    action: Float[ndarray, "K 1"]
    states: Float[ndarray, "H_plus_1 K S"]
    """``states[0]`` are the starts: the mean of the start distribution first, then draws from the distribution."""

    @property
    def in_contact(self) -> Bool[ndarray, "H K"]:
        """Whether the cart has been beyond the end of the rail by the end of each step."""
        return np.logical_or.accumulate(beyond_the_end(self.states[1:]), axis=0)


def find_case(name: str) -> ContactCase:
    """The case of that name.

    Raises:
        ValueError: there is no case of that name.
    """
    if name not in CASES:
        raise ValueError(f"unknown case {name!r}: expected one of {', '.join(CASES)}")
    return CASES[name]


def training_sequences(name: str, seed: int) -> tuple[Float[ndarray, "n T_plus_1 S"], Float[ndarray, "n T 1"]]:
    """States and actions of a case's training sequences, which depend on case and seed alone."""
    case, rng = find_case(name), _rng(name, seed, _TRAINING)
    starts = _starts(NUM_SEQUENCES, rng)
    drawn = rng.uniform(case.lowest_action, case.highest_action, (NUM_SEQUENCES, case.length, 1))
    actions = drawn.astype(np.float32).astype(np.float64)  # the very actions that a model reads
    return _simulate(starts, actions), actions


def training_data(name: str, seed: int) -> Transitions:
    """The transitions of `training_sequences`, one sequence after the other."""
    states, actions = training_sequences(name, seed)
    columns = states[:, :-1], actions, states[:, 1:]
    return Transitions(*(torch.from_numpy(c.reshape(-1, c.shape[-1])).to(torch.float32) for c in columns))


def contact_test(name: str, seed: int, num_starts: int) -> ContactTest:
    """What happens from starts that no training has seen; they depend on case and seed alone.

    Raises:
        ValueError: ``num_starts`` is less than 1.
    """
    if num_starts < 1:
        raise ValueError(f"a test needs at least 1 start, received {num_starts}")
    case = find_case(name)
    mean, _ = ModCartPoleEnv(frame_skip=FRAME_SKIP, reset_noise_scale=0.0).reset()
    starts = np.concatenate([mean[None], _starts(num_starts - 1, _rng(name, seed, _TEST))])
    actions = np.full((num_starts, case.horizon, 1), case.test_action)
    return ContactTest(actions[:, 0], _simulate(starts, actions).swapaxes(0, 1))


def beyond_the_end(states: Float[ndarray, "*b S"]) -> Bool[ndarray, "*b"]:
    """Where the end of the rail, a stiff spring, pushes the cart back."""
    return states[..., 0] > RAIL_LIMIT


def _rng(name: str, seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng([seed, list(CASES).index(name), stream])


def _starts(count: int, rng: np.random.Generator) -> Float[ndarray, "{count} S"]:
    """Draws from the start distribution of `ModCartPole-v0`."""
    env = ModCartPoleEnv(frame_skip=FRAME_SKIP)
    env.reset(seed=int(rng.integers(2**31)))
    return np.array([env.reset()[0] for _ in range(count)]).reshape(count, env.model.nq + env.model.nv)


def _simulate(starts: Float[ndarray, "n S"], actions: Float[ndarray, "n T 1"]) -> Float[ndarray, "n T_plus_1 S"]:
    after = Simulator(ModCartPoleEnv(frame_skip=FRAME_SKIP)).trajectories(starts, actions)
    return np.concatenate([starts[:, None], after], axis=1)
