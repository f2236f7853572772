"""Controllers that act by a policy of few parameters, and search a better one after each training of the model."""

from collections.abc import Mapping
from typing import Any, ClassVar, get_args

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Float
from torch import Tensor

from gym_dgpmpc.checks import check_counts, check_reals
from gym_dgpmpc.data.transitions import TransitionStore
from gym_dgpmpc.dynamics.sparse_gp.moment_matching import MomentMatchingSampler
from gym_dgpmpc.imagination.acting import ActingByPolicy
from gym_dgpmpc.imagination.worlds import LONGEST, ImaginedVecEnv, Imagining
from gym_dgpmpc.planning.risk import RiskMeasure
from gym_dgpmpc.planning.rollout import EXPECTED
from gym_dgpmpc.policy_search.moments import Belief, BeliefPath, Bounds, search
from gym_dgpmpc.policy_search.policies import Fed, LinearPolicy, PolicyForm, RBFPolicy, SquashedPolicy, SquashName
from gym_dgpmpc.policy_search.samples import SampledSearch
from gym_dgpmpc.tasks.environment import time_limit
from gym_dgpmpc.tasks.task import Task
from gym_dgpmpc.types import DynamicsModel, Planner, StateDict

START_SPREAD = 0.05
"""Of the spread of all states, the standard deviation that a start has beside that of the recorded ones."""


class PolicySearchController(ActingByPolicy):
    """What both searches have in common: the policy, how it acts, and how it is saved.

    Args:
        dynamics: see `Controller`, as for all that follow up to ``measure``.
        planner, action_space, num_particles, actions_per_plan, time_budget, measure, device: see `Controller`.
        policy_form: "rbf", a sum of radial basis functions, or "linear".
        num_centres: basis functions of an "rbf" policy.
        search_horizon: steps of the episodes that the policy is searched by; None: the environment's time limit, at
            most 200.

    Raises:
        TypeError, ValueError: as `Controller`; or a setting is out of its range.
    """

    largest: ClassVar[Mapping[str, int]] = {"num_centres": 10**4, "search_horizon": 10**4}
    squash: ClassVar[SquashName]
    precision: ClassVar[torch.dtype]
    policy: SquashedPolicy | None

    def __init__(
        self,
        dynamics: DynamicsModel,
        planner: Planner,
        action_space: spaces.Box,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        time_budget: float | None = None,
        measure: RiskMeasure = EXPECTED,
        *,
        policy_form: PolicyForm = "rbf",
        num_centres: int = 100,
        search_horizon: int | None = None,
        device: torch.device | str = "cpu",
    ):
        super().__init__(
            dynamics, planner, action_space, num_particles, actions_per_plan, time_budget, measure, device=device
        )
        check_counts(num_centres=num_centres, **({} if search_horizon is None else {"search_horizon": search_horizon}))
        if policy_form not in get_args(PolicyForm):
            raise ValueError(f"policy_form must be one of {', '.join(get_args(PolicyForm))}, got {policy_form!r}")
        self.policy_form, self.num_centres, self.search_horizon = policy_form, num_centres, search_horizon
        self.policy = None

    def decide(self, task: Task, observation: np.ndarray) -> np.ndarray | None:
        """The policy's action, [A]; None before the first training."""
        if self.policy is None:
            return None
        state = task.start(observation).to(self.precision)
        action = self.policy(state.unsqueeze(0)).squeeze(0).to(self._low)
        return (self._low + 0.5 * (action + 1.0) * (self._high - self._low)).cpu().numpy()

    def state_dict(self) -> StateDict:
        """The policy's parameters and units; nothing before the first training."""
        if self.policy is None:
            return {}
        return {name: value.detach().clone() for name, value in self.policy.state_dict().items()}

    def load_policy(self, agent: Imagining, state: StateDict) -> None:
        """Go on from `state_dict`.

        Raises:
            RuntimeError: the state is not that of a policy of these settings.
        """
        self.policy = None
        if state:
            policy = self._first_policy(agent, seed=0)
            policy.load_state_dict(state)
            self.policy = policy

    def _first_policy(self, agent: Imagining, seed: int) -> SquashedPolicy:
        fed = Fed.of(agent.store, agent.task.modelled.observation_spec, agent.task.modelled.size)
        if self.policy_form == "linear":
            return LinearPolicy(fed, len(self._low), self.squash).to(self.device, self.precision)
        generator = torch.Generator("cpu").manual_seed(seed)
        policy = RBFPolicy(fed, len(self._low), self.squash, self.num_centres, generator)
        return policy.to(self.device, self.precision)

    def _horizon_of(self, agent: Imagining) -> int:
        limit = time_limit(agent.env)
        return self.search_horizon or (LONGEST if limit is None else min(limit, LONGEST))


class SampledSearchController(PolicySearchController):
    """Acts by a policy that climbs its mean reward over episodes in sampled worlds.

    Args:
        dynamics: see `Controller`, as for all that follow up to ``measure``.
        planner, action_space, num_particles, actions_per_plan, time_budget, measure, device: see `Controller`.
        num_worlds: worlds side by side in which it learns.
        num_paths: particles in each of these worlds.
        first_search_steps: steps of the optimiser after the first training of the model.
        search_steps: steps of the optimiser after each later one, which go on from the policy before.
        search_step_size: of the optimiser's first step; it falls to a tenth.
        policy_dropout: chance that a basis function is left out at first; it falls to zero over a search.
        match_moments: after each step of a search, replace all particles by draws from the Gaussian with their means
            and variances. The model is then to tell no observation noise apart: a new particle has no error of its own
            that could be undone.
        **policy: the settings of `PolicySearchController`.

    Raises:
        TypeError, ValueError: as `PolicySearchController`.
    """

    composed_of: ClassVar[tuple[type, ...]] = (PolicySearchController,)
    largest: ClassVar[Mapping[str, int]] = {"num_worlds": 10**4, "num_paths": 10**4}
    squash: ClassVar[SquashName] = "tanh"
    precision: ClassVar[torch.dtype] = torch.float32

    def __init__(
        self,
        dynamics: DynamicsModel,
        planner: Planner,
        action_space: spaces.Box,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        time_budget: float | None = None,
        measure: RiskMeasure = EXPECTED,
        *,
        num_worlds: int = 25,
        num_paths: int = 8,
        first_search_steps: int = 300,
        search_steps: int = 300,
        search_step_size: float = 0.03,
        policy_dropout: float = 0.25,
        match_moments: bool = False,
        device: torch.device | str = "cpu",
        **policy: Any,
    ):
        super().__init__(
            dynamics, planner, action_space, num_particles, actions_per_plan, time_budget, measure, device=device,
            **policy,
        )  # fmt: skip
        check_counts(
            num_worlds=num_worlds, num_paths=num_paths, first_search_steps=first_search_steps, search_steps=search_steps
        )
        check_reals("(0, 1]", search_step_size=search_step_size)
        check_reals("[0, 1)", policy_dropout=policy_dropout)
        self.num_worlds, self.num_paths = num_worlds, num_paths
        self.first_search_steps, self.search_steps = first_search_steps, search_steps
        self.search_step_size, self.policy_dropout = search_step_size, policy_dropout
        self.match_moments = match_moments

    def improve(self, agent: Imagining, seed: int) -> Mapping[str, float]:
        """Search on from the present policy.

        Raises:
            NotDifferentiableError: no gradient comes through the reward, or through the model's draws.
        """
        worlds = ImaginedVecEnv.of(
            agent, self.num_worlds, episode_steps=self._horizon_of(agent), starts="starts", seed=seed, is_limited=False
        )
        num_steps = self.first_search_steps if self.policy is None else self.search_steps
        policy = self._first_policy(agent, seed) if self.policy is None else self.policy
        found = SampledSearch(self.num_paths, num_steps, self.search_step_size, self.policy_dropout, self.match_moments)
        with torch.enable_grad():
            metrics = found.improve(policy, worlds)
        self.policy = policy
        return metrics


class MomentSearchController(PolicySearchController):
    """Acts by a policy that climbs the expected reward of a Gaussian belief, by L-BFGS.

    Args:
        dynamics: a `SparseGPDynamics` with the draw "AMM"; the rest up to ``measure`` as for `Controller`.
        planner, action_space, num_particles, actions_per_plan, time_budget, measure, device: see `Controller`.
        num_points: points that a belief's expected reward is averaged over, more than state and action have numbers.
        max_search_iterations: iterations of L-BFGS after each training of the model, at most.
        **policy: the settings of `PolicySearchController`.

    Raises:
        TypeError, ValueError: as `PolicySearchController`.
    """

    composed_of: ClassVar[tuple[type, ...]] = (PolicySearchController,)
    largest: ClassVar[Mapping[str, int]] = {"num_points": 10**4}
    squash: ClassVar[SquashName] = "sine"
    precision: ClassVar[torch.dtype] = torch.float64

    def __init__(
        self,
        dynamics: DynamicsModel,
        planner: Planner,
        action_space: spaces.Box,
        num_particles: int = 5,
        actions_per_plan: int = 1,
        time_budget: float | None = None,
        measure: RiskMeasure = EXPECTED,
        *,
        num_points: int = 50,
        max_search_iterations: int = 100,
        device: torch.device | str = "cpu",
        **policy: Any,
    ):
        super().__init__(
            dynamics, planner, action_space, num_particles, actions_per_plan, time_budget, measure, device=device,
            **policy,
        )  # fmt: skip
        check_counts(num_points=num_points, max_search_iterations=max_search_iterations)
        self.num_points, self.max_search_iterations = num_points, max_search_iterations

    def improve(self, agent: Imagining, seed: int) -> Mapping[str, float]:
        """Search on from the present policy.

        Raises:
            ValueError: there are too few points for states and actions of this size.
            NotDifferentiableError: no gradient comes through the reward.
        """
        task, horizon = agent.task, self._horizon_of(agent)
        generator = torch.Generator(self.device).manual_seed(seed)
        sampler = self.dynamics.draw(task.modelled.size + 1, horizon, generator)
        if not isinstance(sampler, MomentMatchingSampler):
            raise TypeError(f"exact moments are those of the draw AMM, got worlds of {type(sampler).__name__}")
        reward_fn = task.planned.reward_fn
        assert reward_fn is not None
        start = _start_belief(agent.store, task.modelled.size, self._low)
        bounds = Bounds(self._low.double(), self._high.double())
        path = BeliefPath(sampler.propagate, reward_fn, start, bounds, horizon, self.num_points, generator)
        policy = self._first_policy(agent, seed) if self.policy is None else self.policy
        with torch.enable_grad():
            metrics = search(policy, path, self.max_search_iterations)
        self.policy = policy
        return metrics


def _start_belief(store: TransitionStore, size: int, like: Tensor) -> Belief:
    """Mean and covariance of the first observations, with `START_SPREAD` beside it; what else is modelled is zero."""
    states = store.exact_transitions().observation.double()
    first = states[np.unique(store.episodes.numpy(), return_index=True)[1]]
    deviation = first - first.mean(0)
    spread = (START_SPREAD * states.std(0, correction=0)).square()
    covariance = torch.zeros(size, size, dtype=torch.float64, device="cpu")
    covariance[: len(spread), : len(spread)] = deviation.mT @ deviation / len(first) + torch.diag(spread)
    mean: Float[Tensor, " S"] = torch.nn.functional.pad(first.mean(0), (0, size - first.shape[1]))
    return Belief(mean.unsqueeze(0).to(like.device), covariance.unsqueeze(0).to(like.device))
