"""The value types and interfaces that connect the parts of the package.

Data flows one way:

    env steps -> TransitionStore -> DynamicsModel.fit -> DynamicsModel.draw -> rollout -> Planner -> action -> env

Everything here is in raw environment units; standardisation and encoding are a model's own business. Sizes in
the shape annotations: N transitions, S observation size, A action size, K candidate action sequences,
P particles, H horizon.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import index
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

StateDict = dict[str, Any]
"""A flat mapping, dotted keys, of tensors and of values that JSON has: what goes into a checkpoint."""


@runtime_checkable
class Stateful(Protocol):
    """Something that a checkpoint keeps. It alone knows its fields, their limits, and what an older file lacks."""

    def state_dict(self) -> StateDict: ...

    def load_state_dict(self, state: StateDict) -> None:
        """Go on from `state_dict`; any exception says that the state does not fit."""
        ...


class Transitions(NamedTuple):
    """N observed steps of the environment, float32, raw units; no row crosses an episode boundary."""

    observation: Float[Tensor, "N S"]
    action: Float[Tensor, "N A"]
    next_observation: Float[Tensor, "N S"]


@dataclass(frozen=True)
class ObservationSpec:
    """How a dynamics model should read an observation. All fields hold indices into the observation.

    Lists, and integers of numpy's, are kept as tuples of Python's.

    Attributes:
        angles: enter the model as sine and cosine (the predicted change stays in radians).
        absolute: the model predicts the next value itself, not the change.
        not_inputs: predicted, but not fed to the model.
        constant: fixed within an episode; passed through unmodelled (they stay model inputs unless also in
            ``not_inputs``).
        body_frame: triples (heading, x, y): a vector that is observed along fixed axes, such as places and velocities
            on a floor, and the angle in rad, anticlockwise, of the body to them. The model is fed the vector, and
            predicts its change, along the body's axes: what was learned under one heading then holds under all. Where
            nothing else depends on the heading, put it in ``not_inputs``.

    Raises:
        TypeError: an index is not an integer.
    """

    angles: tuple[int, ...] = ()
    absolute: tuple[int, ...] = ()
    not_inputs: tuple[int, ...] = ()
    constant: tuple[int, ...] = ()
    body_frame: tuple[tuple[int, int, int], ...] = ()

    def __post_init__(self) -> None:
        for name in ("angles", "absolute", "not_inputs", "constant", "body_frame"):
            given = getattr(self, name)
            try:
                kept = tuple(tuple(map(index, each)) if name == "body_frame" else index(each) for each in given)
            except TypeError as error:
                wanted = "triples of indices such as ((2, 0, 1),)" if name == "body_frame" else "indices such as (0, 2)"
                raise TypeError(f"{name} must be {wanted}, got {given!r}") from error
            object.__setattr__(self, name, kept)


@runtime_checkable
class RewardFn(Protocol):
    """The reward r(s_t, a_t, s_{t+1}), batched over any leading dimensions; the same function ``env.step`` uses."""

    def __call__(
        self,
        observation: Float[Tensor, "*b S"],
        action: Float[Tensor, "*b A"],
        next_observation: Float[Tensor, "*b S"],
    ) -> Float[Tensor, "*b"]: ...


@runtime_checkable
class TerminatedFn(Protocol):
    """Whether the episode ends in s_{t+1}, batched over any leading dimensions."""

    def __call__(self, next_observation: Float[Tensor, "*b S"]) -> Bool[Tensor, "*b"]: ...


@runtime_checkable
class TransitionSampler(Protocol):
    """One draw of the world, valid for the plans of one moment: P particles, each a map (state, action) -> next state.

    Actions are [K, A], the same for all particles, as in a plan; or [P, K, A], each particle's own, as a policy decides
    them by where the particle is. ``step`` is the index of the step within the plan, 0 <= step < the horizon the
    sampler was drawn for; samplers whose functions do not change along a plan ignore it.

    Next states are differentiable by states and actions where these require gradients, with the values that they have
    otherwise, up to rounding; a sampler that has no gradients raises `NotDifferentiableError` then, or records none.
    """

    def __call__(
        self, observation: Float[Tensor, "P K S"], action: Float[Tensor, "*p K A"], step: int
    ) -> Float[Tensor, "P K S"]: ...


@runtime_checkable
class TrajectorySampler(TransitionSampler, Protocol):
    """A `TransitionSampler` that can take whole action sequences at once, faster than step by step."""

    def trajectories(
        self, observation: Float[Tensor, "S"], actions: Float[Tensor, "K H A"]
    ) -> Float[Tensor, "H_plus_1 P K S"]:
        """What repeated calls from ``observation`` give; ``states[0]`` is the observation itself.

        Differentiable where a step is.
        """
        ...


@runtime_checkable
class DynamicsModel(Protocol):
    """Learns from transitions and draws plausible worlds."""

    def fit(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Train on all transitions, from the present state of the model; return metrics to log."""
        ...

    def resample(self, data: Transitions, generator: torch.Generator) -> Mapping[str, float]:
        """Within an episode: let the posterior follow the grown data, hyperparameters and normaliser frozen."""
        ...

    def draw(self, num_particles: int, horizon: int, generator: torch.Generator) -> TransitionSampler:
        """Draw one world per particle, for plans of at most ``horizon`` steps."""
        ...

    def state_dict(self) -> StateDict: ...

    def load_state_dict(self, state: StateDict) -> None: ...


ProgressFn = Callable[[int, int, float], None]
"""(iterations done, of how many, the present loss): how far a training is. What a loss is, the model says."""


@runtime_checkable
class ReportsProgress(Protocol):
    """A `DynamicsModel` that says now and then, while `fit` runs, how far it is; other models need not.

    Attributes:
        on_progress: what is called; None for nothing. An agent sets it while it trains.
    """

    on_progress: ProgressFn | None


@runtime_checkable
class ReportsDiagnostics(Protocol):
    """A `DynamicsModel` that says how well it is fitted, also after it was loaded; other models need not."""

    def diagnostics(self) -> Mapping[str, float]:
        """Numbers by the names under which `fit` reports them; none before the first fit."""
        ...


class Scales(NamedTuple):
    """What a Gaussian process makes of its inputs and targets, of C chains, without units.

    Attributes:
        lengthscales: of each layer, in spreads of its D inputs, in the order of `Encoder.input_names`: the longer, the
            less that input matters.
        noise_std: of the T predicted numbers, in spreads of what is predicted: near 1 nothing of it is explained.
    """

    lengthscales: Sequence[Float[Tensor, "C D"]]
    noise_std: Float[Tensor, "C T"]


@runtime_checkable
class ReportsScales(Protocol):
    """A `DynamicsModel` with lengthscales and noise to show; other models need not."""

    def scales(self) -> Scales | None:
        """Those of the last fit; None before the first."""
        ...


DynamicsFactory = Callable[[int, int, ObservationSpec], DynamicsModel]
"""(observation size, action size, how to read the observation) -> an untrained model of such transitions."""

Objective = Callable[[Float[Tensor, "K H A"]], Float[Tensor, "K"]]
"""Scores K candidate action sequences; higher is better; a score that is not finite never wins."""


@runtime_checkable
class Plan(Protocol):
    """What a planner carries from one plan to the next: a NamedTuple of tensors of fixed shapes and dtypes.

    The rest of the package reads `actions` alone. Everything else (a standard deviation, elites, a policy's weights)
    is the planner's own business: it is stacked, saved and handed back as it is.
    """

    @property
    def actions(self) -> Float[Tensor, "H A"]:
        """The sequence to perform."""
        ...

    def _asdict(self) -> dict[str, Any]: ...


class PlanInfo(NamedTuple):
    """What a plan found.

    Attributes:
        expected_return: what the plan is expected to earn over its horizon; NaN if nothing was scored.
        num_nonfinite: candidates that were left out because their score was not finite.
        metrics: further numbers, finite or NaN, logged as ``planner/<name>``: the mean over an episode's plans.
    """

    expected_return: float
    num_nonfinite: int = 0
    metrics: Mapping[str, float] = MappingProxyType({})


AnyPlan = TypeVar("AnyPlan", bound=Plan)
"""The type of one planner's plans."""


@runtime_checkable
class Planner(Protocol[AnyPlan]):
    """Improves a plan under an objective; knows neither the model nor the environment.

    A planner is made by ``factory(action_low, action_high, *, horizon=..., <its settings>)``: bounds as finite vectors
    [A], whose dtype and device are those of the plans; keyword-only arguments with defaults are its settings. What all
    planners promise is tested by ``tests/planning/test_planner_contract.py``.
    """

    def initial_plan(self) -> AnyPlan:
        """Where the first plan of an episode starts from."""
        ...

    def plan(
        self, objective: Objective, plan: AnyPlan, generator: torch.Generator, deadline: float | None = None
    ) -> tuple[AnyPlan, PlanInfo]:
        """Optimise from ``plan``; the result's actions lie within the bounds.

        Args:
            objective: what to maximise.
            plan: `initial_plan`, or what `shift` returned; it is not changed.
            generator: for everything random.
            deadline: a time of `time.perf_counter` by which to return the best plan so far, or None. Once it has
                passed nothing is scored any more, and the result is ``plan`` with its actions within the bounds.

        Raises:
            PlanningError: no candidate had a finite score.
        """
        ...

    def shift(self, plan: AnyPlan, num_actions: int) -> AnyPlan:
        """The warm start after ``num_actions`` of the plan have been performed: its other actions come first.

        Raises:
            ValueError: the plan has fewer than ``num_actions`` actions.
        """
        ...


@runtime_checkable
class ProposalPlanner(Planner[AnyPlan], Protocol[AnyPlan]):
    """A planner that takes sequences from elsewhere, such as a policy's, among its own."""

    def plan(
        self,
        objective: Objective,
        plan: AnyPlan,
        generator: torch.Generator,
        deadline: float | None = None,
        proposals: Float[Tensor, "n H A"] | None = None,
    ) -> tuple[AnyPlan, PlanInfo]:
        """As `Planner.plan`.

        Args:
            proposals: sequences within the bounds, to try in the place of some of the planner's own.
        """
        ...


PlannerFactory = Callable[..., Planner]
"""(action_low, action_high, *, horizon=..., settings) -> a planner; see `Planner`."""
