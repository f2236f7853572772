"""The vector that the dynamics model learns: the observation, and what else of a step it has to predict.

A reward or termination that nobody knows as a function becomes one more number of the vector, predicted as it is and
no input. Nothing but this module knows the difference: to the model it is a dimension like any other, and the planner
reads it off the predicted vectors with a reward or termination function as usual.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.tasks.functions import TaskFunctions
from gym_dgpmpc.types import ObservationSpec, RewardFn, TerminatedFn, Transitions


@dataclass(frozen=True)
class Component:
    """One number of the predicted vector, as a reward."""

    index: int

    def __call__(
        self,
        observation: Float[Tensor, "*b S_all"],
        action: Float[Tensor, "*b A"],
        next_observation: Float[Tensor, "*b S_all"],
    ) -> Float[Tensor, "*b"]:
        return next_observation[..., self.index]


@dataclass(frozen=True)
class ComponentAboveHalf:
    """One number of the predicted vector, which was 1 in steps that terminated and else 0, as a termination."""

    index: int

    def __call__(self, next_observation: Float[Tensor, "*b S_all"]) -> Bool[Tensor, "*b"]:
        return next_observation[..., self.index] > 0.5


@dataclass(frozen=True)
class ModelledVector:
    """(observation, reward if it is predicted, termination if it is predicted), of S_all numbers.

    Attributes:
        observation_size: S.
        observation_spec: how to read the observation.
        reward: whether the reward is predicted.
        terminated: whether termination is predicted, as 0 or 1.
    """

    observation_size: int
    observation_spec: ObservationSpec
    reward: bool = False
    terminated: bool = False

    @property
    def size(self) -> int:
        """S_all."""
        return self.observation_size + self.reward + self.terminated

    @property
    def spec(self) -> ObservationSpec:
        """How to read the vector: what was added is predicted as it is, and no input.

        What is constant, such as a goal, and the headings of vectors are inputs then even if the dynamics do not depend
        on them, because what was added may.
        """
        added = tuple(range(self.observation_size, self.size))
        spec = self.observation_spec
        if not added:
            return spec
        let_in = {heading for heading, _, _ in spec.body_frame} | set(spec.constant)
        not_inputs = (*(i for i in spec.not_inputs if i not in let_in), *added)
        return replace(spec, absolute=(*spec.absolute, *added), not_inputs=not_inputs)

    def transitions(self, store: TransitionStore) -> Transitions:
        """The stored transitions as the model sees them."""
        observation, action, after = store.transitions()
        added = [store.rewards] * self.reward + [store.terminated.to(after.dtype)] * self.terminated
        if not added:
            return Transitions(observation, action, after)
        column = torch.stack(added, dim=-1)
        # Before a step the added numbers mean nothing, and neither inputs nor targets take them from there.
        return Transitions(
            torch.cat([observation, torch.zeros_like(column)], dim=-1), action, torch.cat([after, column], dim=-1)
        )

    def start(self, observation: Float[np.ndarray, " S"]) -> Float[np.ndarray, " S_all"]:
        """The vector from which a plan starts."""
        return np.pad(observation, (0, self.size - self.observation_size))

    def functions(self, found: TaskFunctions) -> TaskFunctions:
        """The same reward and termination as functions of the vector; a function that is known goes before.

        Raises:
            ValueError: the reward is neither known nor predicted.
        """
        size = self.observation_size
        reward_fn, terminated_fn = found.reward_fn, found.terminated_fn
        if reward_fn is None:
            if not self.reward:
                raise ValueError("the reward is neither known as a function nor predicted")
            reward_fn = Component(size)
        elif self.size > size:
            reward_fn = _OfObservation(reward_fn, size)
        if terminated_fn is not None and self.size > size:
            terminated_fn = _EndOfObservation(terminated_fn, size)
        elif terminated_fn is None and self.terminated and found.terminated_source == "learned":
            terminated_fn = ComponentAboveHalf(size + self.reward)
        return found._replace(reward_fn=reward_fn, terminated_fn=terminated_fn)


@dataclass(frozen=True)
class _OfObservation:
    """A reward of the observation, which is the beginning of the vector."""

    reward_fn: RewardFn
    size: int

    def __call__(
        self,
        observation: Float[Tensor, "*b S_all"],
        action: Float[Tensor, "*b A"],
        next_observation: Float[Tensor, "*b S_all"],
    ) -> Float[Tensor, "*b"]:
        return self.reward_fn(observation[..., : self.size], action, next_observation[..., : self.size])


@dataclass(frozen=True)
class _EndOfObservation:
    """A termination of the observation, which is the beginning of the vector."""

    terminated_fn: TerminatedFn
    size: int

    def __call__(self, next_observation: Float[Tensor, "*b S_all"]) -> Bool[Tensor, "*b"]:
        return self.terminated_fn(next_observation[..., : self.size])
