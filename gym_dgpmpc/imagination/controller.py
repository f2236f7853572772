"""A controller that learns a policy in the model's worlds after every training, and acts by it."""

import inspect
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, get_args

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Float
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.imagination.acting import ActingByPolicy
from gym_dgpmpc.imagination.algorithms import AlgorithmName, algorithm_class, budget_of, suited_settings
from gym_dgpmpc.imagination.features import encoding
from gym_dgpmpc.imagination.global_randomness import lent_randomness
from gym_dgpmpc.imagination.policies import imagine, learned_parameters, take_over
from gym_dgpmpc.imagination.values import learns_values, state_value
from gym_dgpmpc.imagination.worlds import ImaginedVecEnv, Imagining
from gym_dgpmpc.planning.risk import RiskMeasure
from gym_dgpmpc.planning.rollout import EXPECTED, Tail
from gym_dgpmpc.tasks.dict_observations import original_space, unflattened
from gym_dgpmpc.tasks.task import Task
from gym_dgpmpc.types import DynamicsModel, Planner, StateDict, TransitionSampler

ActsBy = Literal["policy", "planner"]


class PolicyController(ActingByPolicy):
    """Acts by a policy that an algorithm of Stable-Baselines3 learns in the model's worlds.

    Args:
        dynamics: see `Controller`, as for all that follow up to ``measure``.
        planner, action_space, num_particles, actions_per_plan, time_budget, measure, device: see `Controller`.
        algorithm: "SAC", "TD3", "DDPG", "PPO" or "A2C" of Stable-Baselines3; "TQC" or "CrossQ" of sb3-contrib; or
            "gradient", which climbs the return through the worlds' derivatives.
        acts_by: "policy", or "planner": then the policy is learned all the same, for when the run is over.
        imagined_timesteps: imagined steps from which the policy learns after each training of the model, at most;
            default: a third of what suits the algorithm from the start.
        num_worlds: worlds side by side in which it learns.
        trial_every: imagined steps between two trials in worlds that it never learns in; default: as before.
        trial_patience: trials without a better one after which it stops learning until the next training.
        proposes: with ``acts_by="planner"``, whether the policy's action sequences, one in each particle's world, are
            among the planner's candidates.
        terminal_value: with ``acts_by="planner"``, whether what the policy's critics expect after a plan's last step is
            part of a plan's return, which is discounted then; so that plans see past their horizon.
        value_depths: of how many of a plan's last steps the mean of such returns is taken.

    Raises:
        TypeError, ValueError: as `Controller`; or a setting is out of its range.
    """

    largest: ClassVar[Mapping[str, int]] = {"num_worlds": 10**4}

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
        algorithm: AlgorithmName = "SAC",
        acts_by: ActsBy = "policy",
        imagined_timesteps: int | None = None,
        num_worlds: int = 20,
        trial_every: int | None = None,
        trial_patience: int = 8,
        proposes: bool = False,
        terminal_value: bool = False,
        value_depths: int = 1,
        device: torch.device | str = "cpu",
    ):
        super().__init__(
            dynamics, planner, action_space, num_particles, actions_per_plan, time_budget, measure, device=device
        )
        optional = {"imagined_timesteps": imagined_timesteps, "trial_every": trial_every}
        check_counts(**{name: count for name, count in optional.items() if count is not None})
        check_counts(num_worlds=num_worlds, trial_patience=trial_patience, value_depths=value_depths)
        if acts_by not in get_args(ActsBy):
            raise ValueError(f"acts_by must be one of {', '.join(get_args(ActsBy))}, got {acts_by!r}")
        self._kind = algorithm_class(algorithm)
        if terminal_value and not learns_values(self._kind):
            raise ValueError(f"{algorithm!r} learns no values for terminal_value: take SAC, TD3, TQC or CrossQ")
        if proposes and "proposals" not in inspect.signature(planner.plan).parameters:
            raise ValueError(f"{type(planner).__name__} takes no proposals (see types.ProposalPlanner)")
        self.proposes, self.terminal_value, self.value_depths = proposes, terminal_value, value_depths
        self.acts_by, self.imagined_timesteps, self.num_worlds = acts_by, imagined_timesteps, num_worlds
        self.trial_every, self.trial_patience = trial_every, trial_patience
        self.policy: BaseAlgorithm | None = None

    def improve(self, agent: Imagining, seed: int) -> dict[str, float]:
        """Go on learning in the worlds of the agent's model as it is now; metrics to log.

        Raises:
            TrainingError: learning diverged.
        """
        imagined = imagine(
            agent,
            self._kind,
            self.imagined_timesteps or budget_of(self._kind).total_timesteps // 3,
            num_worlds=self.num_worlds,
            trial_every=self.trial_every,
            patience=self.trial_patience,
            seed=seed,
            begin_with=self.policy,
        )
        self.policy = imagined.model
        return {
            "imagined_steps": imagined.trials[-1].timesteps,
            "imagined_return": imagined.fresh.mean_return,
            "imagination_seconds": imagined.seconds,
        }

    def decide(self, task: Task, observation: np.ndarray) -> np.ndarray | None:
        """The policy's action, without noise; None before the first training, and if the planner acts."""
        if self.policy is None or self.acts_by == "planner":
            return None
        asked = unflattened(observation[None], self.policy.observation_space)
        return np.asarray(self.policy.predict(asked, deterministic=True)[0], dtype=np.float32).reshape(-1)

    def tail(self, task: Task) -> Tail | None:
        """The value that the policy's critics give to the states after a plan."""
        if self.policy is None or not self.terminal_value:
            return None
        value, size = state_value(self.policy), task.modelled.observation_size
        return Tail(lambda states: value(states[..., :size]), self.policy.gamma, self.value_depths)  # type: ignore[attr-defined]

    def proposals(
        self, task: Task, sampler: TransitionSampler, start: Float[Tensor, " S_all"]
    ) -> Float[Tensor, "P H A"] | None:
        """What the policy would do from here in each particle's world, step after step."""
        if self.policy is None or not self.proposes:
            return None
        states, actions = start.expand(self.num_particles, 1, -1), []
        size, space = task.modelled.observation_size, self.policy.observation_space
        for step in range(self.horizon):
            shown = unflattened(states[:, 0, :size].cpu().numpy(), space)
            taken = np.asarray(self.policy.predict(shown, deterministic=True)[0], dtype=np.float32)
            action = torch.from_numpy(taken.reshape(self.num_particles, 1, -1)).to(start)
            states = sampler(states, action, step)
            actions.append(action.squeeze(1))
        found = torch.stack(actions, dim=1)
        return found[found.isfinite().all(-1).all(-1)]

    def state_dict(self) -> StateDict:
        """What the policy has learned; nothing before the first training."""
        return {} if self.policy is None else dict(learned_parameters(self.policy))

    def load_policy(self, agent: Imagining, state: StateDict) -> None:
        """Go on from `state_dict`.

        Raises:
            RuntimeError, KeyError: the state is not that of a policy of this algorithm for these spaces.
        """
        self.policy = None
        if not state:
            return
        space = original_space(agent.env, agent.observation_space)
        features = encoding(agent.store, agent.task.modelled.observation_spec)
        settings = suited_settings(self._kind, self.num_worlds, 1, space, features)
        # The algorithm reads the spaces off its environment; this one is never stepped.
        never = ImaginedVecEnv(self.dynamics, _unasked, _unasked, space, agent.action_space, num_worlds=1)
        with lent_randomness():
            model = self._kind(env=never, device=self.device, **settings)
        model.env = None
        take_over(model, state)
        self.policy = model


def _not_asked(*_: Any) -> Any:
    raise NotImplementedError("these worlds are there for their spaces alone")


_unasked: Any = _not_asked
"""In place of the functions of worlds in which nobody lives."""
