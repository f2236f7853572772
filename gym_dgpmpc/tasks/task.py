"""What an agent has to do, and what its model must predict for that: the one place that knows both.

The agent asks it for functions of what the model predicts (`planned`), for where a plan starts (`start`) and for what
the model learns from (`transitions`); it alone knows whether a reward is a function or one more number to predict.
"""

import math
import warnings
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Float
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.errors import UnknownRewardError
from gym_dgpmpc.tasks.environment import about_environment, describe, flat_size
from gym_dgpmpc.tasks.first_batch import REWARD_SIGNATURE, example_batch
from gym_dgpmpc.tasks.functions import (
    LEARNED,
    NEVER,
    Learned,
    Never,
    TaskFunctions,
    find_functions,
    find_observation_spec,
)
from gym_dgpmpc.tasks.modelled import ModelledVector
from gym_dgpmpc.tasks.precision import hidden_changes, in_double, warn_of_hidden_changes
from gym_dgpmpc.types import ObservationSpec, RewardFn, StateDict, TerminatedFn, Transitions

MISSING_TERMINATION = (
    "the saved agent planned with a termination function, and this one has none: it plans as if episodes did not end. "
    "Pass terminated_fn=... to load, or an environment that offers it"
)


class TaskArguments(NamedTuple):
    """What the user gave of a task: each a function or a spec, or None to look for one on the environment."""

    reward_fn: RewardFn | Learned | None
    terminated_fn: TerminatedFn | Learned | Never | None
    observation_spec: ObservationSpec | None


class Task:
    """Reward, termination and observation spec of an agent, and the vector that its model predicts.

    Args:
        env: the environment, or None of an agent that was loaded without one.
        observation_space, action_space: of the agent.
        given: by the user.
        device: where the functions are tried, and plans are made.

    Attributes:
        modelled: the vector that the model predicts: the observation, and reward and termination if they are learned.
        is_exact: whether the model is given observations as float64, because float32 would hide their changes.
        can_model_more: whether a model can be made that predicts more; not of a ready-made one.

    Raises:
        ValueError, TypeError: see `find_functions` and `find_observation_spec`, and `Encoder` for a spec that does not
            fit the observation.
    """

    def __init__(
        self,
        env: VecEnv | None,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        given: TaskArguments,
        device: torch.device,
    ):
        self._env, self._spaces, self._device = env, (observation_space, action_space), device
        self._given = given
        self._found: TaskFunctions | None = None
        if env is not None or given.reward_fn is not None:
            self._found = self.find(env)
        # Of the file that the agent was loaded from: what it says of its environment, for the next file.
        self._loaded_about: dict[str, Any] = {}
        self._loaded_sources: dict[str, Any] = {}
        self._had_terminated_fn = False
        self._has_warned = False
        self.can_model_more = True
        self.is_exact = False
        spec = find_observation_spec(env, given.observation_spec)
        Encoder(flat_size(observation_space), flat_size(action_space), spec)  # an error if it fits no such observation
        self.modelled = ModelledVector(
            flat_size(observation_space),
            spec,
            reward=self.must_learn_reward,
        )

    @property
    def must_learn_reward(self) -> bool:
        """Whether it is known that there is no reward function."""
        return self._found is not None and self._found.reward_fn is None

    @property
    def may_learn_termination(self) -> bool:
        """Whether it is known that termination must be learned once there is one."""
        return self._found is not None and self._found.terminated_source == LEARNED

    @property
    def functions(self) -> TaskFunctions:
        """Reward and termination as far as they are functions of the observation, and where they come from.

        Warns, once, if a loaded agent lacks the termination function that the saved one had.

        Raises:
            UnknownRewardError: there is no reward function, and the model does not predict the reward.
        """
        if self._found is None:
            self._found = self.find(self._env)
        if self._found.reward_fn is None and not self.modelled.reward:
            raise self.unknown_reward()
        if self.lacks_terminated_fn and not self._has_warned:
            self._has_warned = True
            warnings.warn(MISSING_TERMINATION, stacklevel=3)
        return self._found

    @cached_property
    def planned(self) -> TaskFunctions:
        """The same as functions of the predicted vector.

        Raises:
            UnknownRewardError: as `functions`.
        """
        return self.modelled.functions(self.functions_of_data)

    @cached_property
    def functions_of_data(self) -> TaskFunctions:
        """`functions`, for observations in the precision that the model is given them in.

        Raises:
            UnknownRewardError: as `functions`.
        """
        if not self.is_exact:
            return self.functions
        tried = (tensor.double() for tensor in example_batch(*self._spaces, self._device))
        return in_double(self.functions, Transitions(*tried))

    def start(self, observation: Float[np.ndarray, "S"]) -> Float[Tensor, "S_all"]:
        """The vector that a plan starts from, in the precision of the plan's states and on its device."""
        dtype = torch.float64 if self.is_exact else torch.float32
        return torch.from_numpy(self.modelled.start(observation)).to(self._device, dtype)

    def transitions(self, store: TransitionStore) -> Transitions:
        """The stored transitions as the model sees them."""
        return self.modelled.transitions(store, exact=self.is_exact)

    def look_at_precision(self, store: TransitionStore, *, takes_float64: bool) -> None:
        """Before a training: go on in float64 if float32 hides how observations change, or warn that it does.

        Args:
            store: of all transitions.
            takes_float64: whether the model may be given float64.
        """
        if self.is_exact:
            return
        data = store.exact_transitions()
        if data.observation.dtype != torch.float64:
            warn_of_hidden_changes(data, "give the observation space the dtype float64")
        elif not takes_float64:
            warn_of_hidden_changes(data, "this dynamics model has no attribute takes_float64 = True")
        elif hidden_changes(data).any():
            self.is_exact = True
            self._forget_planned()

    def model(self, *, reward: bool, terminated: bool) -> None:
        """From now on the model predicts these beside the observation.

        Raises:
            UnknownRewardError: the model is a ready-made one, which cannot be given more to predict.
        """
        if (reward or terminated) and not self.can_model_more:
            raise self.unknown_reward()
        self.modelled = ModelledVector(
            self.modelled.observation_size, self.modelled.observation_spec, reward, terminated
        )
        self._forget_planned()

    def find(self, env: VecEnv | None) -> TaskFunctions:
        """Reward and termination in an environment of the same spaces.

        Raises:
            ValueError, TypeError: see `find_functions`.
        """
        return find_functions(env, self._given.reward_fn, self._given.terminated_fn, self._spaces, self._device)

    def move(self, env: VecEnv, found: TaskFunctions) -> None:
        """Go on in another environment, with what `find` found in it."""
        self._env, self._found = env, found
        self._forget_planned()

    @property
    def learns_termination(self) -> bool:
        """Whether the model is to predict termination from when the first one is seen."""
        return self.can_model_more and self.functions.terminated_source == LEARNED

    @property
    def lacks_terminated_fn(self) -> bool:
        """Whether the agent was loaded from the file of one that planned with a termination function, and has none.

        An environment that says that its episodes never end lacks nothing, nor does a wish to learn when they do.
        """
        if self._found is None or not self._had_terminated_fn:
            return self._had_terminated_fn
        is_unknown = self._found.terminated_fn is None and self._found.terminated_source == LEARNED
        return is_unknown and not self.to_learn["terminated_fn"]

    @property
    def to_learn(self) -> dict[str, bool]:
        """Which of reward and termination the user asked to be learned whatever the environment offers."""
        given = {"reward_fn": self._given.reward_fn, "terminated_fn": self._given.terminated_fn}
        return {name: isinstance(value, str) and value == LEARNED for name, value in given.items()}

    @property
    def _said_never(self) -> bool:
        """Whether the user said that episodes never terminate."""
        given = self._given.terminated_fn
        return isinstance(given, str) and given == NEVER

    def describe(self) -> str:
        """Where reward and termination come from, on one line, for a person."""
        return self.functions.describe(can_learn_termination=self.learns_termination)

    def about_environment(self) -> dict[str, Any]:
        """What a file says of the environment; of an agent without one, what its own file said."""
        return self._loaded_about if self._env is None else about_environment(self._env)

    def unknown_reward(self, env: VecEnv | None = None) -> UnknownRewardError:
        """The error that says what to pass, for an environment in place of the agent's own."""
        env = self._env if env is None else env
        lacks = "the agent has no environment" if env is None else f"{describe(env)} has no attribute 'reward_fn'"
        sizes = [math.prod(space.shape) for space in self._spaces]
        return UnknownRewardError(
            f"{lacks} and no reward_fn was passed; nor was this agent's model made to predict the reward (a ready-made "
            "one cannot be: pass dynamics=... as a function of observation size, action size and observation spec that "
            "makes one). Planning scores predicted trajectories, so it needs the reward as a function of batched torch "
            "tensors: pass reward_fn=... to the agent or give the environment that attribute, with the signature "
            f"{REWARD_SIGNATURE} where S = {sizes[0]}, A = {sizes[1]} and *b stands for any leading dimensions"
        )

    def state_dict(self) -> StateDict:
        """What the model predicts, what was to be learned, and what is known of the environment."""
        has_terminated_fn = self._found is not None and self._found.terminated_fn is not None
        return {
            "reward": self.modelled.reward,
            "terminated": self.modelled.terminated,
            "to_learn": self.to_learn,
            "never_terminates": self._said_never,
            "is_exact": self.is_exact,
            "has_terminated_fn": has_terminated_fn or self.lacks_terminated_fn,
            "sources": self._sources(),
            "about_environment": self.about_environment(),
        }

    def _sources(self) -> dict[str, Any]:
        """Where reward and termination come from, for who looks into a file; of a loaded agent, what its own said."""
        if self._found is None:
            return self._loaded_sources
        return {"reward_fn": self._found.reward_source, "terminated_fn": self._found.terminated_source}

    def load_state_dict(self, state: StateDict) -> None:
        """Take over what a file says of its environment, and what its model predicted.

        Raises:
            UnknownRewardError: the saved model predicted more than a ready-made one can.
            KeyError, ValueError: the state is not one of a task.
        """
        reward, terminated, had_terminated_fn, about = (
            state[name] for name in ("reward", "terminated", "has_terminated_fn", "about_environment")
        )
        for name in ("reward", "terminated", "has_terminated_fn"):
            if not isinstance(state[name], bool):
                raise ValueError(f"{name} must be true or false, got {state[name]!r}")
        if not isinstance(about, dict):
            raise ValueError(f"about_environment must be an object, got {about!r}")
        if (reward, terminated) != (self.modelled.reward, self.modelled.terminated):
            self.model(reward=reward, terminated=terminated)
        self.is_exact = bool(state.get("is_exact", False))  # older files do not say
        self._loaded_about, self._had_terminated_fn = about, had_terminated_fn
        sources = state.get("sources")  # older files do not say
        self._loaded_sources = sources if isinstance(sources, dict) else {}
        self._forget_planned()

    def _forget_planned(self) -> None:
        for name in ("planned", "functions_of_data"):
            self.__dict__.pop(name, None)
