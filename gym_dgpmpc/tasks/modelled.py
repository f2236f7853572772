"""The vector that the dynamics model learns: the observation, and a reward or termination that has to be learned.

A reward or termination that is not known as a function becomes one more number of the vector. The model predicts its
value, not its change, and is not fed it. Only this module knows the difference: to the model it is a dimension like any
other, and the planner reads it from the predicted vectors with a reward or termination function as usual.
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
class PredictedReward:
    """A reward function that reads the reward from the predicted vector, at ``index``."""

    index: int

    def __call__(
        self,
        observation: Float[Tensor, "*b S_all"],
        action: Float[Tensor, "*b A"],
        next_observation: Float[Tensor, "*b S_all"],
    ) -> Float[Tensor, "*b"]:
        return next_observation[..., self.index]


@dataclass(frozen=True)
class PredictedTermination:
    """A termination function that reads the predicted vector at ``index``: in the data 1 if terminated, else 0."""

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
        """How to read the vector. The model predicts the values of the added numbers and is not fed them.

        With added numbers, constants such as a goal, and the headings of vectors, are inputs even if the dynamics do
        not depend on them, because the added numbers may.
        """
        added = tuple(range(self.observation_size, self.size))
        spec = self.observation_spec
        if not added:
            return spec
        inputs = {heading for heading, _, _ in spec.body_frame} | set(spec.constant)
        not_inputs = (*(i for i in spec.not_inputs if i not in inputs), *added)
        return replace(spec, absolute=(*spec.absolute, *added), not_inputs=not_inputs)

    def transitions(self, store: TransitionStore, *, exact: bool = False) -> Transitions:
        """The stored transitions as the model sees them; ``exact``: in the precision that they came in."""
        observation, action, after = store.exact_transitions() if exact else store.transitions()
        added = [store.rewards.to(after.dtype)] * self.reward + [store.terminated.to(after.dtype)] * self.terminated
        if not added:
            return Transitions(observation, action, after)
        column = torch.stack(added, dim=-1)
        # The added numbers have no value before a step. As absolute and not inputs, they are never read from there.
        return Transitions(
            torch.cat([observation, torch.zeros_like(column)], dim=-1), action, torch.cat([after, column], dim=-1)
        )

    def start(self, observation: Float[np.ndarray, " S"]) -> Float[np.ndarray, " S_all"]:
        """The vector from which a plan starts."""
        return np.pad(observation, (0, self.size - self.observation_size))

    def functions(self, found: TaskFunctions) -> TaskFunctions:
        """Reward and termination as functions of the vector; a known function is preferred to what is predicted.

        Raises:
            ValueError: the reward is neither known nor predicted.
        """
        size = self.observation_size
        reward_fn, terminated_fn = found.reward_fn, found.terminated_fn
        if reward_fn is None:
            if not self.reward:
                raise ValueError("the reward must be known as a function or predicted, got neither: pass reward_fn")
            reward_fn = PredictedReward(size)
        elif self.size > size:
            reward_fn = RewardOnObservation(reward_fn, size)
        if terminated_fn is not None and self.size > size:
            terminated_fn = TerminationOnObservation(terminated_fn, size)
        elif terminated_fn is None and self.terminated and found.terminated_source == "learned":
            terminated_fn = PredictedTermination(size + self.reward)
        return found._replace(reward_fn=reward_fn, terminated_fn=terminated_fn)


@dataclass(frozen=True)
class RewardOnObservation:
    """A known reward function, applied to the observation: the first ``size`` numbers of the vector."""

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
class TerminationOnObservation:
    """A known termination function, applied to the observation: the first ``size`` numbers of the vector."""

    terminated_fn: TerminatedFn
    size: int

    def __call__(self, next_observation: Float[Tensor, "*b S_all"]) -> Bool[Tensor, "*b"]:
        return self.terminated_fn(next_observation[..., : self.size])
