"""Data of every kind through learning, drawing, planning and predicting: a finite action in bounds, or a named error.

An environment returns what a case says, whatever it is asked to do; an agent learns in it and predicts.
"""

from typing import NamedTuple

import gymnasium
import hypothesis.strategies as st
import numpy as np
from gymnasium import spaces

from gym_dgpmpc import DGPMPCAgent
from gym_dgpmpc.dynamics.deep_gp.draws import DRAWS, REFRESHES
from gym_dgpmpc.errors import DGPMPCError
from gym_dgpmpc.gp.kernels import KERNELS
from tests.faults.generated import count_outcomes

STEPS = 8


class Case(NamedTuple):
    """What the environment is and returns, and how the agent is set."""

    observations: np.ndarray  # [STEPS + 2, S]
    rewards: np.ndarray  # [STEPS]
    ends: tuple[int, ...]  # steps that end an episode
    low: np.ndarray  # [A]
    high: np.ndarray  # [A]
    reward_scale: float
    settings: dict


class Scripted(gymnasium.Env):
    """Returns a case's observations and rewards; keeps the actions it was given."""

    def __init__(self, case):
        size = case.observations.shape[1]
        self.case, self.time, self.actions = case, 0, []
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float64)
        self.action_space = spaces.Box(case.low, case.high, dtype=np.float32)

    def reward_fn(self, observation, action, next_observation):
        return self.case.reward_scale * next_observation[..., 0] - action.square().sum(-1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.case.observations[min(self.time, STEPS)].copy(), {}

    def step(self, action):
        self.actions.append(np.array(action))
        reward, ended = self.case.rewards[self.time % STEPS], self.time in self.case.ends
        self.time += 1
        return self.case.observations[min(self.time, STEPS)].copy(), float(reward), False, ended, {}


SCALES = st.sampled_from([0.0, 1e-30, 1e-12, 1e-6, 1e-3, 1.0, 1.0, 1.0, 1e3, 1e6, 1e12, 1e18, 1e30, 1e38])
ANY_FLOAT = st.floats(allow_nan=True, allow_infinity=True)


@st.composite
def columns(draw, length):
    """One dimension over time: constant, repeating, noise or drift of any scale about any offset, or anything."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["constant", "two values", "noise", "drift", "spike", "rounding", "anything"]))
    scale, offset = draw(SCALES), draw(st.sampled_from([-1.0, 0.0, 1.0])) * draw(SCALES)
    noise = rng.normal(size=length)
    with np.errstate(all="ignore"):
        if kind == "anything":
            return np.array(draw(st.lists(ANY_FLOAT, min_size=length, max_size=length)))
        shapes = {
            "constant": np.zeros(length),
            "two values": (noise > 0).astype(float),
            "noise": noise,
            "drift": noise.cumsum(),
            "spike": np.where(np.arange(length) == length // 2, 1e6, noise),
            "rounding": noise * np.spacing(np.float32(max(abs(offset), 1e-30))).astype(float) / max(scale, 1e-30),
        }
        return offset + scale * shapes[kind]


@st.composite
def cases(draw):
    """A case, the agent's sizes included: N from 1 to 8, M from 1 to 6, up to three layers."""
    size, action_size = draw(st.integers(1, 3)), draw(st.integers(1, 2))
    low = np.array([draw(st.sampled_from([-1e6, -2.0, -1e-3, 0.0, 3.0])) for _ in range(action_size)])
    width = np.array([draw(st.sampled_from([0.0, 1e-6, 1.0, 4.0, 1e6])) for _ in range(action_size)])
    random_steps = draw(st.integers(1, STEPS - 1))
    return Case(
        np.stack([draw(columns(STEPS + 2)) for _ in range(size)], axis=1),
        draw(columns(STEPS)),
        tuple(sorted(draw(st.sets(st.integers(0, STEPS - 1), max_size=4)))),
        low.astype(np.float32),
        (low + width).astype(np.float32),
        draw(st.sampled_from([0.0, 1.0, -1.0, 1e6, 1e30, float("nan")])),
        {
            "num_layers": draw(st.integers(1, 3)),
            "kernel": draw(st.sampled_from(sorted(KERNELS))),
            "num_inducing": draw(st.integers(1, 6)),
            "draw": draw(st.sampled_from(sorted(DRAWS))),
            "refresh": draw(st.sampled_from(sorted(REFRESHES))),
            "num_features": 2 * draw(st.integers(1, 2)),
            "num_particles": draw(st.integers(1, 3)),
            "horizon": draw(st.integers(1, 4)),
            "num_candidates": draw(st.integers(2, 8)),
            "num_iterations": draw(st.integers(1, 2)),
            "first_training_iterations": draw(st.integers(1, 6)),
            "training_iterations": draw(st.integers(1, 3)),
            "num_samples": draw(st.integers(1, 4)),
            "sample_spacing": 1,
            "resample_samples": draw(st.integers(0, 2)),
            "gibbs_every": draw(st.sampled_from([0, 1, 3])),
            "learning_starts": random_steps,
            "time_budget": draw(st.sampled_from([None, None, None, 1e-9, 1.0])),
            "seed": draw(st.integers(0, 1000)),
        },
    )


def check_action(case, action):
    """The action is finite and within the bounds."""
    assert np.isfinite(action).all(), f"the action {action} is not finite"
    assert ((case.low <= action) & (action <= case.high)).all(), f"{action} is not in [{case.low}, {case.high}]"


def outcome(case):
    """ "actions", or the names of the errors that stopped learning and predicting, or a refusal of the reward.

    Raises:
        AssertionError: an action was not finite, or out of bounds.
        Exception: an error that is not a named one.
    """
    env = Scripted(case)
    told = []
    try:
        agent = DGPMPCAgent(env, **case.settings)
    except ValueError as error:
        assert np.isnan(case.reward_scale) and "reward_fn must return finite numbers" in str(error), error
        return "refused when the agent is made"
    while len(told) < 4:
        try:
            agent.learn(max(STEPS - env.time, 1), reset_num_timesteps=False)
            break
        except DGPMPCError as error:
            told.append(type(error).__name__)
    assert len(agent.store) == agent.num_timesteps <= env.time
    for observation in case.observations[[0, -1]]:
        try:
            action, state = agent.predict(observation, deterministic=True)
            check_action(case, action)
            action, _ = agent.predict(observation, state)
            check_action(case, action)
        except DGPMPCError as error:
            told.append(type(error).__name__)
    for action in env.actions:
        check_action(case, action)
    return ", ".join(sorted(set(told))) or "actions alone"


def run_cases(number):
    """See `count_outcomes`."""
    return count_outcomes(cases(), outcome, number)
