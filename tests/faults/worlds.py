"""Generated environments: what a space, a wrapper or somebody else's code may be, and a recorder around all of it.

`worlds()` draws them, `World.make` makes the environment of one. `outcomes.py` says what must come out.
"""

from collections.abc import Mapping
from copy import deepcopy
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import hypothesis.strategies as st
import numpy as np
import torch
from gymnasium import spaces, wrappers
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecEnv, VecMonitor, VecNormalize

from gym_dgpmpc.types import ObservationSpec

INF = np.inf

F2, F4, F8, I4, I8, U1, BOOL = np.float16, np.float32, np.float64, np.int32, np.int64, np.uint8, np.bool_


def box(shape=(2,), dtype=F4, low=-INF, high=INF):
    return spaces.Box(low, high, shape, dtype)


OBSERVATIONS = {
    "vector": box,
    "float64": partial(box, dtype=F8),
    "float16": partial(box, dtype=F2),
    "one number": partial(box, (1,)),
    "five numbers": partial(box, (5,), F8),
    "bounded": partial(box, low=-1e7, high=1e7, dtype=F8),
    "narrow": partial(box, low=-0.5, high=0.25),
    "half bounded": partial(box, low=0.0),
    "matrix": partial(box, (2, 3)),
    "scalar": partial(box, ()),
    "nothing": partial(box, (0,)),
    "integers": lambda: spaces.Box(-1000, 1000, (2,), I8),
    "bytes": lambda: spaces.Box(0, 255, (3,), U1),
    "image": lambda: spaces.Box(0, 255, (36, 36, 3), U1),
    "truths": lambda: spaces.Box(0, 1, (2,), BOOL),
    "Discrete": lambda: spaces.Discrete(5),
    "MultiDiscrete": lambda: spaces.MultiDiscrete([3, 4]),
    "MultiBinary": lambda: spaces.MultiBinary(3),
    "Text": lambda: spaces.Text(5),
    "Tuple": lambda: spaces.Tuple((box(), box((1,)))),
    "Dict": lambda: spaces.Dict(b=box(), a=box((1,))),
    "Dict of dtypes": lambda: spaces.Dict(z=box(dtype=F8), a=box((1,)), k=box((1,), F2)),
    "Dict of one": lambda: spaces.Dict(only=box()),
    "Dict of float16": lambda: spaces.Dict(a=box(dtype=F2), b=box((1,), F2)),
    "Dict of nothing": lambda: spaces.Dict(),
    "Dict with a matrix": lambda: spaces.Dict(a=box(), b=box((2, 2))),
    "Dict with a scalar": lambda: spaces.Dict(a=box(), b=box(())),
    "Dict with integers": lambda: spaces.Dict(a=box(), b=spaces.Box(0, 9, (1,), I4)),
    "Dict with a Discrete": lambda: spaces.Dict(a=box(), b=spaces.Discrete(3)),
    "nested Dict": lambda: spaces.Dict(a=box(), b=spaces.Dict(c=box())),
    "goals": lambda: spaces.Dict(observation=box(), achieved_goal=box(), desired_goal=box()),
    "goals in float64": lambda: spaces.Dict(
        {name: box((3,), F8) for name in ("observation", "achieved_goal", "desired_goal")}
    ),
}
EASY_OBSERVATIONS = (
    *("vector", "float64", "float16", "one number", "five numbers", "bounded", "narrow", "half bounded"),
    *("Dict", "Dict of dtypes", "Dict of one", "Dict of float16", "goals", "goals in float64", "vector", "float64"),
)

ACTIONS = {
    "unit": partial(box, (1,), low=-1, high=1),
    "two": partial(box, low=-1, high=1),
    "float64": partial(box, dtype=F8, low=-0.1, high=0.3),
    "float16": partial(box, dtype=F2, low=-0.1, high=0.7),
    "wide": partial(box, low=-1e5, high=3e6),
    "vast float64": partial(box, dtype=F8, low=-1e300, high=1e300),
    "vast float32": partial(box, low=-3e38, high=3e38),
    "vast float16": partial(box, dtype=F2, low=-6e4, high=6e4),
    "minute": partial(box, dtype=F8, low=-1e-60, high=1e-60),
    "far": partial(box, dtype=F8, low=1e9 + 0.1, high=1e9 + 0.7),
    "beyond float32": partial(box, dtype=F8, low=16777216.5, high=16777217.5),
    "fixed": lambda: spaces.Box(np.array([0.1, -1.0]), np.array([0.1, 1.0]), dtype=F8),
    "all fixed": partial(box, (1,), dtype=F8, low=0.1, high=0.1),
    "uneven": lambda: spaces.Box(np.array([-0.3, 5.0]), np.array([0.1, 9.1]), dtype=F8),
    "matrix": partial(box, (2, 2), low=-1, high=1),
    "scalar": partial(box, (), low=-1, high=1),
    "nothing": partial(box, (0,), low=-1, high=1),
    "unbounded": box,
    "half bounded": partial(box, low=0.0),
    "the wrong way round": lambda: reversed_box(),
    "whole": lambda: spaces.Box(-2, 2, (1,), I4),
    "Discrete": lambda: spaces.Discrete(3),
    "MultiDiscrete": lambda: spaces.MultiDiscrete([3, 2]),
    "MultiBinary": lambda: spaces.MultiBinary(2),
    "Dict": lambda: spaces.Dict(a=box(low=-1, high=1)),
    "Tuple": lambda: spaces.Tuple((box(low=-1, high=1),)),
}
EASY_ACTIONS = (
    *("unit", "two", "float64", "float16", "wide", "vast float16", "far", "beyond float32", "fixed", "all fixed"),
    *("uneven", "matrix", "scalar", "vast float32", "minute", "unit", "two"),
)


def reversed_box():
    space = box((1,), low=-1, high=1)
    space.low, space.high = space.high, space.low
    return space


ALIASING = (
    *("changes the action", "keeps the action", "one buffer", "spoils it", "one info", "mutates infos", "read-only"),
    *("strided", "a list", "a tensor", "another dtype", "a column"),
)

REWARDS = ("float", "float", "float32", "0-d", "(1,)", "int", "tensor", "bool")
ENDS = ("terminated", "truncated", "both", "never")
TRUTHS = {
    "bool": bool,
    "numpy": np.bool_,
    "int": int,
    "0-d": lambda ends: np.array(ends),
    "(1,)": lambda ends: np.array([ends]),
    "float": float,
    "tensor": lambda ends: torch.tensor(bool(ends)),
}

STEP_FAULTS = (
    *("raises", "raises what cannot be copied", "raises a StopIteration", "nan", "inf", "huge", "longer", "shorter"),
    *("empty", "None", "text", "complex", "object", "ragged", "four values", "three values", "only an observation"),
    *("reward None", "reward nan", "reward inf", "reward huge", "reward (2,)", "reward text", "info None"),
    *("info a list", "part missing", "terminated (2,)", "terminated None", "masked", "too large for its space"),
)
RESET_FAULTS = (
    *("raises", "nan", "inf", "longer", "empty", "None", "text", "bare", "three values", "info None", "part missing"),
)


class Fault(NamedTuple):
    """What goes wrong, once."""

    method: str
    kind: str
    at: int
    """In which call of the method, of the environment's life."""


class UsersError(Exception):
    """An environment's own."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


def right_reward(observation, action, next_observation):
    return -torch.tanh(action.double().sum(-1)).square().to(next_observation.dtype)


def nan_reward(observation, action, next_observation):
    return torch.full_like(next_observation[..., 0], torch.nan)


def wrong_shape(observation, action, next_observation):
    return next_observation


def raises(observation, action, next_observation):
    raise KeyError("distance")


def numpys(observation, action, next_observation):
    return np.zeros(next_observation.shape[:-1])


def changes_arguments(observation, action, next_observation):
    next_observation.mul_(2)
    return next_observation[..., 0]


def mixes_precision(observation, action, next_observation):
    """Cannot take float64."""
    weights = torch.zeros(next_observation.shape[-1], 1, dtype=torch.float32)
    return (next_observation @ weights)[..., 0] + right_reward(observation, action, next_observation)


def never(state):
    return torch.zeros(state.shape[:-1], dtype=torch.bool)


REWARD_FNS = {
    "right": right_reward,
    "mixes precision": mixes_precision,
    "two arguments": lambda observation, info: (0.0, {}),
    "text": "dense",
    "number": 3,
    "None": None,
    "nan": nan_reward,
    "wrong shape": wrong_shape,
    "raises": raises,
    "NumPy": numpys,
    "changes its arguments": changes_arguments,
}
BAD_REWARD_FNS = ("nan", "wrong shape", "raises", "NumPy", "changes its arguments")
TERMINATED_FNS = {
    "None": None,
    "false": False,
    "right": never,
    "no arguments": lambda: False,
    "text": "never",
    "a number": lambda state: 0,
}
BAD_TERMINATED_FNS = ("a number",)
SPECS = {
    "plain": ObservationSpec(),
    "angle": ObservationSpec(angles=(0,)),
    "beyond": ObservationSpec(angles=(40,)),
    "dm_env": lambda: {"position": (1,)},
    "dict": {"angles": (0,)},
    "list": [1],
}


class Generated(gym.Env):
    """x' = 0.9 x + 0.1 tanh(sum a) and a little noise, told as its world says; reward -tanh(sum a)^2."""

    def __init__(self, world, has_fault=True):
        self.world, self.fault = world, world.fault if has_fault else None
        self.observation_space = OBSERVATIONS[world.observation]()
        self.action_space = ACTIONS[world.action]()
        self.calls = {"reset": 0, "step": 0}
        self.buffer, self.info, self.kept = None, {"list": []}, []
        for name, table in (("reward_fn", REWARD_FNS), ("terminated_fn", TERMINATED_FNS), ("observation_spec", SPECS)):
            if getattr(world, name) is not None:
                setattr(self, name, table[getattr(world, name)])
        if world.observation.startswith("goals") and world.compute_reward:
            self.compute_reward = self._compute_reward
        self.given = []  # copies of what `step` was given

    def _compute_reward(self, achieved, desired, info):
        if self.world.compute_reward == "hindsight" and not isinstance(info, list):
            raise AssertionError("info must be a list")
        if self.world.compute_reward == "one at a time" and achieved.ndim != 1:
            raise ValueError("one at a time")
        return -np.abs(achieved - desired).sum(-1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._again("reset")
        self.x, self.time = self.np_random.normal(size=3), 0
        return self._faulty((self._told("reset"), self._info()), "reset")

    def step(self, action):
        self._again("step")
        self.given.append(np.array(action))
        if "keeps the action" in self.world.aliasing and "changes the action" not in self.world.aliasing:
            self.kept.append((action, np.array(action)))
            assert all(np.array_equal(one, two, equal_nan=True) for one, two in self.kept), "a kept action has changed"
        squashed = np.tanh(np.sum(self.given[-1], dtype=np.float64))
        self.x = 0.9 * self.x + 0.1 * squashed + 0.01 * self.np_random.normal(size=3)
        self.time += 1
        if "changes the action" in self.world.aliasing and isinstance(action, np.ndarray) and action.ndim:
            action *= 5
        over = self.time >= self.world.length
        told = TRUTHS[self.world.truth]
        terminated = told(over and self.world.ends in ("terminated", "both"))
        truncated = told(over and self.world.ends in ("truncated", "both"))
        return self._faulty((self._told("step"), self._reward(squashed), terminated, truncated, self._info()), "step")

    def _reward(self, squashed):
        reward = -(squashed**2)
        return {
            "float": float,
            "float32": np.float32,
            "0-d": np.array,
            "(1,)": lambda each: np.array([each]),
            "int": lambda each: round(each),
            "tensor": torch.tensor,
            "bool": lambda each: bool(each < -0.5),
        }[self.world.reward](reward)

    def _info(self):
        if "one info" not in self.world.aliasing:
            return {"time": self.time}
        if "mutates infos" in self.world.aliasing:
            self.info["list"].append(self.time)
            self.info[self.time] = np.zeros(2)
        return self.info

    def _again(self, method):
        self.calls[method] += 1
        if "spoils it" in self.world.aliasing and self.buffer is not None:
            for array in _leaves(self.buffer):
                array.fill(77)

    def _told(self, method):
        aliasing = self.world.aliasing
        fresh = _shaped(self.observation_space, self.world.offset + self.world.scale * self.x)
        if "one buffer" in aliasing:
            if self.buffer is None:
                self.buffer = deepcopy(fresh)
            for array, value in zip(_leaves(self.buffer), _leaves(fresh), strict=True):
                array[...] = value
            fresh = self.buffer
        elif isinstance(fresh, np.ndarray) and fresh.ndim and not isinstance(self.observation_space, spaces.Discrete):
            fresh = self._in_disguise(fresh)
        return fresh

    def _in_disguise(self, fresh):
        aliasing = self.world.aliasing
        if "strided" in aliasing:
            fresh = np.repeat(fresh, 2, axis=0)[::2]
        if "another dtype" in aliasing:
            fresh = fresh.astype(np.float32 if fresh.dtype == np.float64 else np.float64)
        if "read-only" in aliasing:
            fresh.flags.writeable = False
        if "a column" in aliasing:
            fresh = fresh[..., None]
        if "a list" in aliasing:
            return fresh.tolist()
        return torch.tensor(fresh) if "a tensor" in aliasing else fresh

    def _faulty(self, returned, method):
        fault = self.fault
        if fault is None or fault.method != method or fault.at != self.calls[method]:
            return returned
        kind = fault.kind
        if kind == "raises":
            raise UsersError("the motor", "the belt")
        if kind == "raises what cannot be copied":
            error = ValueError("broken pipe")
            error.lock = (each for each in ())
            raise error
        if kind == "raises a StopIteration":
            raise StopIteration
        if kind in ("four values", "three values"):
            return (*returned, {})[: {"step": 4, "reset": 3}[method]] if kind == "four values" else (*returned, {})[:3]
        if kind in ("only an observation", "bare"):
            return returned[0]
        return _spoiled(returned, kind, self.observation_space)


def _spoiled(returned, kind, space):
    """What a fault makes of the five values of a step, or of the two of a reset."""
    observation, *others = returned
    if kind.startswith("reward"):
        value = {
            "None": None,
            "nan": float("nan"),
            "inf": float("inf"),
            "huge": 1e300,
            "(2,)": np.zeros(2),
            "text": "high",
        }[kind.removeprefix("reward ")]
        return (observation, value, *others[1:])
    if kind.startswith("terminated"):
        value = None if kind == "terminated None" else np.array([True, False])
        return (observation, others[0], value, *others[2:])
    if kind.startswith("info"):
        return (observation, *others[:-1], None if kind == "info None" else [1])
    if kind == "part missing":
        if isinstance(observation, dict):
            return (dict(list(observation.items())[1:]), *others)
        return (np.array([]), *others)
    replace = {
        "nan": lambda array: np.full_like(array, np.nan) if array.dtype.kind == "f" else np.array(["nan"]),
        "inf": lambda array: np.where(np.arange(array.size).reshape(array.shape) == 0, np.inf, array),
        "huge": lambda array: np.full(array.shape, 1e300),
        "too large for its space": lambda array: np.full(array.shape, 1e6),
        "longer": lambda array: np.append(array, 0),
        "shorter": lambda array: array.ravel()[:-1],
        "empty": lambda array: array.ravel()[:0],
        "None": lambda array: None,
        "text": lambda array: "a state",
        "complex": lambda array: array + 1j,
        "object": lambda array: object(),
        "ragged": lambda array: [[1.0], [2.0, 3.0]],
        "masked": lambda array: np.ma.masked_array(array, mask=np.ones(array.shape, dtype=bool)),
    }[kind]
    if isinstance(observation, dict) and observation:
        first = next(iter(observation))
        return ({**observation, first: replace(np.asarray(observation[first]))}, *others)
    return (replace(np.asarray(observation)) if not isinstance(observation, tuple | str) else None, *others)


def _leaves(value):
    if isinstance(value, Mapping):
        return [leaf for each in value.values() for leaf in _leaves(each)]
    if isinstance(value, tuple):
        return [leaf for each in value for leaf in _leaves(each)]
    return [value] if isinstance(value, np.ndarray) else []


def _shaped(space, numbers):
    """An element of a space, made of numbers."""
    if isinstance(space, spaces.Dict):
        return {key: _shaped(part, numbers) for key, part in space.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_shaped(part, numbers) for part in space.spaces)
    if isinstance(space, spaces.Discrete):
        return np.int64(int(abs(numbers[0])) % int(space.n))
    if isinstance(space, spaces.Text):
        return "abc"
    array = np.resize(numbers, space.shape)
    if isinstance(space, spaces.Box) and space.dtype == np.float16:
        array = np.clip(array, -1e4, 1e4)
    if not isinstance(space, spaces.Box):
        return (np.abs(array).astype(np.int64) % 2).astype(space.dtype)
    if space.dtype.kind != "f":
        array = np.abs(array).astype(np.int64) % 100
    if np.isfinite(space.low).all() and np.isfinite(space.high).all():
        array = np.clip(array, space.low, space.high)
    return array.astype(space.dtype)


class OwnAction(gym.ActionWrapper):
    def action(self, action):
        return action / 2


class Filtered(gym.ActionWrapper):
    last = 0.0

    def action(self, action):
        self.last = 0.5 * self.last + 0.5 * action
        return self.last


class OwnObservation(gym.ObservationWrapper):
    """Writes into what it is given."""

    def observation(self, observation):
        if isinstance(observation, np.ndarray) and observation.flags.writeable:
            observation += 1
        return observation


class OwnReward(gym.RewardWrapper):
    def reward(self, reward):
        return 3 * reward


class OwnStep(gym.Wrapper):
    def step(self, action):
        return super().step(action)


class Keeping(OwnStep):
    keeps_actions = keeps_observations = True


class Refused(Exception):
    """Gymnasium refuses to make the wrapper, or it cannot stand here."""


def _frozen(wrapper, env):
    wrapped = wrapper(env)
    wrapped.update_running_mean = False
    return wrapped


WRAPPERS = {
    "RescaleAction": lambda env: wrappers.RescaleAction(env, -1.0, 1.0),
    "RescaleAction to [0, 5]": lambda env: wrappers.RescaleAction(env, 0.0, 5.0),
    "ClipAction": wrappers.ClipAction,
    "TransformAction": lambda env: wrappers.TransformAction(env, lambda action: action * 0.5, env.action_space),
    "TransformAction to a wide one": lambda env: wrappers.TransformAction(
        env, lambda action: np.tanh(action), spaces.Box(-3, 3, env.action_space.shape, env.action_space.dtype)
    ),
    "own ActionWrapper": OwnAction,
    "own ActionWrapper with a memory": Filtered,
    "StickyAction": lambda env: wrappers.StickyAction(env, 0.25),
    "own ObservationWrapper": OwnObservation,
    "TransformObservation": lambda env: wrappers.TransformObservation(
        env, lambda observation: observation * 2, env.observation_space
    ),
    "own RewardWrapper": OwnReward,
    "TransformReward": lambda env: wrappers.TransformReward(env, lambda reward: reward + 1),
    "ClipReward": lambda env: wrappers.ClipReward(env, -0.5, 0.5),
    "own Wrapper with step": OwnStep,
    "own Wrapper that keeps": Keeping,
    "NormalizeObservation": wrappers.NormalizeObservation,
    "NormalizeReward": wrappers.NormalizeReward,
    "frozen NormalizeObservation": partial(_frozen, wrappers.NormalizeObservation),
    "frozen NormalizeReward": partial(_frozen, wrappers.NormalizeReward),
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 2),
    "FlattenObservation": wrappers.FlattenObservation,
    "DtypeObservation": lambda env: wrappers.DtypeObservation(env, np.float32),
    "DtypeObservation of float64": lambda env: wrappers.DtypeObservation(env, np.float64),
    "TimeAwareObservation": wrappers.TimeAwareObservation,
    "DelayObservation": lambda env: wrappers.DelayObservation(env, 1),
    "RescaleObservation": lambda env: wrappers.RescaleObservation(env, -1, 1),
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 3),
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "OrderEnforcing": wrappers.OrderEnforcing,
    "PassiveEnvChecker": wrappers.PassiveEnvChecker,
}
MOVING = ("NormalizeObservation", "NormalizeReward")
EASY_WRAPPERS = tuple(name for name in WRAPPERS if name not in MOVING)

VEC_WRAPPERS = {
    "VecMonitor": VecMonitor,
    "VecNormalize of rewards": lambda env: VecNormalize(env, norm_obs=False),
    "VecNormalize": VecNormalize,
    "VecCheckNan": lambda env: VecCheckNan(env, raise_exception=True),
}


class Row(NamedTuple):
    """A step as the outermost wrapper returned it, copied at once."""

    observation: Any
    action: np.ndarray
    returned: Any
    episode: int
    count: int
    """How many calls of `reset` and `step` there were before."""


class Recorder(gym.Wrapper):
    """Outermost of a world's wrappers: keeps copies of all that goes in and comes out."""

    keeps_task = True

    def __init__(self, env):
        super().__init__(env)
        self.rows, self.failures, self.resets = [], [], []
        self.present, self.episode, self.count = None, -1, 0

    def reset(self, *, seed=None, options=None):
        self.episode, self.count = self.episode + 1, self.count + 1
        try:
            returned = self.env.reset(seed=seed, options=options)
        except Exception as error:
            self.failures.append(("reset", error, self.count))
            raise
        self.resets.append((copied(returned), self.count))
        self.present = copied(returned)[0] if isinstance(returned, tuple) else None
        return returned

    def step(self, action):
        self.count += 1
        assert self.action_space.contains(action), f"{action!r} is not in {self.action_space}"
        given = np.array(action)
        try:
            returned = self.env.step(action)
        except Exception as error:
            self.failures.append(("step", error, self.count))
            raise
        self.rows.append(Row(self.present, given, copied(returned), self.episode, self.count))
        self.present = copied(returned)[0] if isinstance(returned, tuple) else None
        return returned


def copied(value):
    """A copy in which nothing is shared, also of what refuses to be copied."""
    if isinstance(value, tuple):
        return tuple(copied(each) for each in value)
    try:
        return deepcopy(value)
    except Exception:
        return value


class World(NamedTuple):
    """What an environment is, how it is wrapped, what goes wrong in it, and how an agent is made for it."""

    observation: str = "vector"
    action: str = "unit"
    offset: float = 0.0
    scale: float = 1.0
    aliasing: frozenset = frozenset()
    wrappers: tuple = ()
    reward: str = "float"
    truth: str = "bool"
    length: int = 4
    ends: str = "truncated"
    reward_fn: str | None = None
    terminated_fn: str | None = None
    observation_spec: str | None = None
    compute_reward: str | None = None
    fault: Fault | None = None
    num_envs: int = 0
    """0: an environment, not a VecEnv."""
    vec_wrapper: str | None = None
    agent: str = "DGP"
    given_reward: str | None = None
    given_terminated: str | None = None
    settings: Mapping = {}
    calls: tuple = (9,)
    seed: int = 0

    def layers(self, has_fault=True):
        """One environment with its wrappers, within a `Recorder`.

        Raises:
            Refused: Gymnasium makes no such thing.
        """
        try:
            env = Generated(self, has_fault)
            for name in self.wrappers:
                env = WRAPPERS[name](env)
        except Exception as error:
            raise Refused(type(error).__name__) from error
        return Recorder(env)

    def make(self, has_fault=True):
        """(What the agent is given, the recorders within)."""
        recorders = [self.layers(has_fault and not i) for i in range(max(self.num_envs, 1))]
        if not self.num_envs:
            return recorders[0], recorders
        try:
            env: VecEnv = DummyVecEnv([partial(lambda each: each, each) for each in recorders])
            env = env if self.vec_wrapper is None else VEC_WRAPPERS[self.vec_wrapper](env)
        except Exception as error:
            raise Refused(type(error).__name__) from error
        return env, recorders


def rarely(common, rare, one_in=8):
    """``rare`` once in a while."""
    return st.integers(0, one_in - 1).flatmap(lambda chance: rare if chance == one_in - 1 else common)


def nothing_but(choices, one_in=4):
    return rarely(st.none(), st.sampled_from(sorted(choices)), one_in)


def faults():
    return st.one_of(
        st.builds(Fault, st.just("step"), st.sampled_from(STEP_FAULTS), st.integers(1, 8)),
        st.builds(Fault, st.just("step"), st.sampled_from(STEP_FAULTS), st.integers(1, 8)),
        st.builds(Fault, st.just("reset"), st.sampled_from(RESET_FAULTS), st.integers(1, 3)),
    )


def worlds():
    """Worlds, of which most can be learned in."""
    return st.builds(
        World,
        observation=rarely(st.sampled_from(EASY_OBSERVATIONS), st.sampled_from(sorted(OBSERVATIONS)), 5),
        action=rarely(st.sampled_from(EASY_ACTIONS), st.sampled_from(sorted(ACTIONS)), 5),
        offset=rarely(st.just(0.0), st.sampled_from([1.0, 1e3, 5e5, 1.7e9]), 3),
        scale=rarely(st.just(1.0), st.sampled_from([0.0, 1e-6, 1e-2, 1e3]), 4),
        aliasing=st.frozensets(st.sampled_from(ALIASING), max_size=4),
        wrappers=st.lists(
            rarely(st.sampled_from(EASY_WRAPPERS), st.sampled_from(sorted(WRAPPERS)), 10), max_size=3
        ).map(tuple),
        reward=st.sampled_from(REWARDS),
        truth=st.sampled_from(sorted(TRUTHS)),
        length=st.integers(1, 6),
        ends=st.sampled_from(ENDS),
        reward_fn=nothing_but(REWARD_FNS, 3),
        terminated_fn=nothing_but(TERMINATED_FNS),
        observation_spec=nothing_but(SPECS, 6),
        compute_reward=st.sampled_from([None, "arrays", "hindsight", "one at a time"]),
        fault=rarely(st.none(), faults(), 3),
        num_envs=rarely(st.just(0), st.integers(1, 3), 2),
        vec_wrapper=nothing_but(VEC_WRAPPERS, 6),
        agent=st.sampled_from(["still", "still", "still", "DGP", "GP", "PETS"]),
        given_reward=rarely(st.none(), st.sampled_from(["learned", "right"]), 3),
        given_terminated=rarely(st.none(), st.sampled_from(["learned", "never"]), 4),
        settings=st.fixed_dictionaries(
            {},
            optional={
                "learning_starts": st.integers(1, 6),
                "train_freq": st.integers(2, 6),
                "actions_per_plan": st.just(2),
                "horizon": st.just(3),
            },
        ),
        calls=st.sampled_from([(6,), (3, 5), (7, 0), (4, 4), (9,)]),
        seed=st.integers(0, 99),
    )
