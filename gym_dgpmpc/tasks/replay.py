"""What brings an environment back to where it was: how its running episode began, and the actions since.

An environment's state cannot be read in general, but an episode can be repeated: a reset depends on the random
generators of the environment and its wrappers alone, and a simulator that is given the same actions after the same
reset does the same. So a checkpoint holds those generators as they were before the last reset, and the store holds the
actions. That brings back every wrapper's counters and the simulator's hidden state too, such as a solver's warm start,
and it is checked: every repeated observation is compared with the one that was stored.

Actions are repeated only in simulators: a plant must not be driven by a recording. See `can_replay`.
"""

from collections.abc import Collection, Iterator
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from gym_dgpmpc.errors import CheckpointError
from gym_dgpmpc.tasks.actions import performed
from gym_dgpmpc.tasks.borders import failures_named

SIMULATORS = ("gymnasium.envs.", "gymnasium_robotics.", "gym_dgpmpc.")
"""Packages whose environments are known to be simulators."""

GeneratorStates = dict[str, dict[str, Any]]
"""States of random generators, as plain values, by where they were found in the stack of wrappers."""


StepResult = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]


class EpisodeStart(gymnasium.Wrapper):
    """Outermost of all wrappers: remembers how the running episode began, and what the last step returned.

    What a monitor within it raises becomes the cause of an `EnvironmentFailedError`, as in a `Border` of `borders.py`.
    """

    keeps_task = True  # for `known.find`

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        self.seed: int | None = None
        self.generators: GeneratorStates | None = None
        self.options: dict[str, Any] | None = None
        self.num_steps = 0
        self.last_step: StepResult | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        # With a seed the environment's own generator begins anew, whatever it was before.
        self.seed, self.num_steps = seed, 0
        self.generators = dict(_states(self.env, create=seed is None))
        with failures_named("reset"):
            result = self.env.reset(seed=seed, options=options)
        self.options = _own_options(self.env, again=True)
        return result

    def step(self, action: Any) -> StepResult:
        self.last_step = None
        with failures_named("step"):
            self.last_step = self.env.step(action)
        self.num_steps += 1
        return self.last_step


def remember_starts(vec_env: VecEnv) -> None:
    """Put an `EpisodeStart` around the environment of a VecEnv of one, in place; others are left as they are."""
    inner = vec_env.unwrapped
    if isinstance(inner, DummyVecEnv) and inner.num_envs == 1 and not isinstance(inner.envs[0], EpisodeStart):
        inner.envs[0] = EpisodeStart(inner.envs[0])


def episode_start(vec_env: VecEnv | None) -> EpisodeStart | None:
    """The wrapper of `remember_starts`; None in an environment that runs in another process, or beside others."""
    inner = None if vec_env is None else vec_env.unwrapped
    found = inner.envs[0] if isinstance(inner, DummyVecEnv) and inner.num_envs == 1 else None
    return found if isinstance(found, EpisodeStart) else None


def can_replay(start: EpisodeStart) -> bool:
    """Whether an episode may be repeated by its actions: what the environment's ``can_replay`` says, if it has one.

    Else only in environments that are known to be simulators: MuJoCo's, those of Gymnasium, Gymnasium-Robotics and
    this package.
    """
    if start.has_wrapper_attr("can_replay"):
        return start.get_wrapper_attr("can_replay") is True  # another package's method of that name says nothing
    classes = type(start.unwrapped).__mro__
    return type(start.unwrapped).__module__.startswith(SIMULATORS) or any(
        each.__module__ == "gymnasium.envs.mujoco.mujoco_env" for each in classes
    )


def describe_start(vec_env: VecEnv | None) -> dict[str, Any] | None:
    """Plain values that `return_to_start` brings the environment back with; None where there is no way to."""
    start = episode_start(vec_env)
    if start is None or start.generators is None:
        return None
    return {
        "seed": start.seed,
        "before_reset": start.generators,
        "now": generator_states(start.env),
        "options": start.options,
        "options_now": _own_options(start.env, again=False),
        "num_steps": start.num_steps,
        "can_replay": can_replay(start),
    }


def return_to_start(vec_env: VecEnv, description: dict[str, Any]) -> ndarray:
    """Begin the described episode again; its first observation, [1, S].

    Raises:
        CheckpointError: the description does not fit the environment.
    """
    start = episode_start(vec_env)
    if start is None:
        raise CheckpointError("the environment runs in another process, where its random state cannot be set")
    set_generator_states(start.env, description["before_reset"])
    vec_env.unwrapped._reset_seeds()  # a seed that waits for the next reset would undo it
    if description["seed"] is not None:
        vec_env.seed(int(description["seed"]))
    set_options(vec_env, [description.get("options")])
    observation = vec_env.reset()
    assert isinstance(observation, ndarray)
    return observation


def set_present_generators(vec_env: VecEnv, description: dict[str, Any]) -> None:
    """Let the next reset draw what it would have drawn had the described episode been given up."""
    start = episode_start(vec_env)
    if start is not None:
        set_generator_states(start.env, description["now"])
        vec_env.unwrapped._reset_seeds()
        set_options(vec_env, [description.get("options_now")])


def options_to_reset(vec_env: VecEnv | None, *, again: bool) -> list[dict[str, Any] | None] | None:
    """Of each environment the options of `reset` that begin its running episode again, or else the one after it.

    An environment whose episodes follow on one another, such as by a number that decides where the target is, has them
    as its method ``options_to_reset(again)``: a dict of plain values. The others need none.
    """
    if vec_env is None or not vec_env.has_attr("options_to_reset"):
        return None
    return vec_env.env_method("options_to_reset", again)


def set_options(vec_env: VecEnv, options: Any) -> None:
    """Let the next resets have the options of `options_to_reset`, of as many environments, if there are any.

    Raises:
        CheckpointError: they are none.
    """
    if options is None:
        return
    if not isinstance(options, list) or not all(each is None or isinstance(each, dict) for each in options):
        raise CheckpointError(f"the options for the environment's reset cannot be read: {options!r}")
    if not any(options) or not vec_env.has_attr("options_to_reset"):
        return
    if len(options) == vec_env.num_envs:
        vec_env.set_options([each or {} for each in options])


def _own_options(env: gymnasium.Env, *, again: bool) -> dict[str, Any] | None:
    offered = env.has_wrapper_attr("options_to_reset")
    return env.get_wrapper_attr("options_to_reset")(again) if offered else None


def replay(
    vec_env: VecEnv,
    actions: Float[ndarray, "k A"],
    next_observations: Float[ndarray, "k S"],
    rewards: Float[ndarray, " k"],
) -> ndarray | str:
    """Repeat an episode's actions after its reset: the present observation [1, S], or what was different.

    Args:
        actions, next_observations, rewards: as they were stored.
    """
    observation: Any = None
    assert isinstance(vec_env.action_space, gymnasium.spaces.Box)
    for step, action in enumerate(actions):
        observation, reward, dones, _ = vec_env.step(performed(action[None], vec_env.action_space))
        if dones[0]:
            return f"the episode ended at its step {step}"
        if not np.array_equal(np.asarray(observation[0], dtype=np.float32), next_observations[step]):
            return f"step {step} led to {observation[0]}, before it was {next_observations[step]}"
        if np.float32(reward[0]) != rewards[step] and not hasattr(vec_env, "ret_rms"):  # VecNormalize scales rewards
            return f"step {step} earned {reward[0]}, before it was {rewards[step]}"
    return observation


def generator_states(env: gymnasium.Env) -> GeneratorStates:
    """The states of all random generators of an environment, its wrappers and its spaces."""
    return dict(_states(env, create=True))


def _states(env: gymnasium.Env, *, create: bool) -> Iterator[tuple[str, dict[str, Any]]]:
    for place, generator in _generators(env, create=create):
        yield place, _plain(generator.bit_generator.state)


def set_generator_states(env: gymnasium.Env, states: GeneratorStates) -> None:
    """Set the generators of `generator_states`; those that the states do not name are left alone.

    Raises:
        CheckpointError: a generator is missing or of another kind, or a state is none.
    """
    generators = dict(_generators(env, spaces=states))
    for place, state in states.items():
        try:
            generators[place].bit_generator.state = _arrays(state)
        except Exception as error:
            raise CheckpointError(f"the random state of the environment's {place} cannot be set: {error!r}") from error


def _generators(
    env: gymnasium.Env, *, create: bool = True, spaces: Collection[str] = ()
) -> Iterator[tuple[str, np.random.Generator]]:
    """Every generator with its place, such as "1.action_space" (of the innermost wrapper; 0 is the environment).

    Args:
        create: make the environment's own generator, which is made on first use, if there is none yet.
        spaces: places of spaces whose generators to make likewise.
    """
    layers: list[Any] = [env]
    while isinstance(layers[-1], gymnasium.Wrapper):
        layers.append(layers[-1].env)
    if create and hasattr(layers[-1], "np_random"):
        _ = layers[-1].np_random
    for depth, layer in enumerate(reversed(layers)):
        for name, value in sorted(vars(layer).items()):
            place = f"{depth}.{name}"
            if isinstance(value, np.random.Generator):
                yield place, value
            elif isinstance(value, gymnasium.Space) and (place in spaces or vars(value).get("_np_random")):
                yield place, value.np_random


def _plain(value: Any) -> Any:
    """A bit generator's state with arrays as lists, and numpy's integers as Python's."""
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, ndarray):
        return {"array": value.tolist(), "dtype": str(value.dtype)}
    return value if isinstance(value, str) else int(value)


def _arrays(value: Any) -> Any:
    """The inverse of `_plain`."""
    if not isinstance(value, dict):
        return value
    if set(value) == {"array", "dtype"}:
        return np.array(value["array"], dtype=np.dtype(str(value["dtype"])))
    return {name: _arrays(each) for name, each in value.items()}
