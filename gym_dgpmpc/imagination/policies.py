"""A policy from the model's worlds: trained in them by an algorithm of Stable-Baselines3, chosen by held-out ones.

What is learned in imagination jumps up and down, and an algorithm learns to exploit the worlds that it lives in. So
what is used is the average of the policies along the way, in their parameters (Izmailov et al. 2018, "Averaging Weights
Leads to Wider Optima and Better Generalization"; here a moving one). It is tried, now and then, in worlds that it never
learns in, always the same ones from the same starts; the best one is kept, and training ends when none has become
better for a while. The real environment is never asked.
"""

import copy
import math
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from torch import Tensor

from gym_dgpmpc.checks import check_counts
from gym_dgpmpc.errors import TrainingError
from gym_dgpmpc.imagination.algorithms import AlgorithmName, algorithm_class, budget_of, suited_settings
from gym_dgpmpc.imagination.beginnings import StartFunction, StartName
from gym_dgpmpc.imagination.features import encoding
from gym_dgpmpc.imagination.global_randomness import lent_randomness
from gym_dgpmpc.imagination.worlds import ImaginedVecEnv, Imagining
from gym_dgpmpc.randomness import derive_seed

LEARNING, CHOOSING, REPORTING = range(3)
"""The substreams of a seed: worlds to learn in, to choose the policy by, and to say what it earns."""

LATEST = 0.3
"""Share of the latest policy in the moving average, which is taken at the trials."""


class Trial(NamedTuple):
    """What a policy earned in the worlds that it is chosen by.

    Attributes:
        timesteps: imagined steps that it had learned from.
        mean_return: over the worlds, of one episode each.
        standard_error: of the mean.
    """

    timesteps: int
    mean_return: float
    standard_error: float

    @classmethod
    def of(cls, model: BaseAlgorithm, worlds: ImaginedVecEnv, seed: int, timesteps: int) -> "Trial":
        """Act without noise for one episode in each world, all drawn from the seed."""
        worlds.seed(seed)
        returns, _ = evaluate_policy(model, worlds, worlds.num_envs, return_episode_rewards=True, warn=False)
        assert isinstance(returns, list)
        return cls(timesteps, float(np.mean(returns)), float(np.std(returns) / math.sqrt(len(returns))))


class ImaginedPolicy(NamedTuple):
    """A policy that was trained in imagination, and how that went.

    Attributes:
        model: the Stable-Baselines3 algorithm with the best policy; it acts by itself.
        trials: all of them, in the order of training.
        best: the one that the policy was chosen by.
        fresh: what it earns in worlds that it was neither trained in nor chosen by.
        seconds: wall-clock time of all of it.
    """

    model: BaseAlgorithm
    trials: list[Trial]
    best: Trial
    fresh: Trial
    seconds: float


class ChooseByWorlds(BaseCallback):
    """Tries the averaged policy every ``every`` steps, keeps the best, ends training when ``patience`` brought nothing.

    The algorithm goes on learning from its own, latest policy.

    Args:
        worlds: held out.
        seed: of these worlds and their starts, the same each time.
        every: imagined steps between two trials.
        patience: trials without a better one after which training ends.
        on_trial: called after each trial.
        on_progress: called after each step with the number of imagined steps that it took.
    """

    def __init__(
        self,
        worlds: ImaginedVecEnv,
        seed: int,
        every: int,
        patience: int,
        on_trial: Callable[[Trial], None] | None,
        on_progress: Callable[[int], None] | None,
    ):
        super().__init__()
        self._worlds, self._seed, self._every, self._patience = worlds, seed, every, patience
        self._on_trial, self._on_progress = on_trial, on_progress
        self.trials: list[Trial] = []
        self.best: Trial | None = None
        self._average: dict[str, Tensor] = {}
        self._parameters: dict[str, Tensor] = {}
        self._next = every

    def _on_step(self) -> bool:
        if self._on_progress is not None:
            self._on_progress(self.training_env.num_envs)
        if self.num_timesteps < self._next:
            return True
        self._next += self._every
        return self.try_policy()

    def try_policy(self) -> bool:
        """Try the average with the present policy in it; returns whether it is worth to go on."""
        policy = self.model.policy
        own = copy.deepcopy(policy.state_dict())
        self._average = moved(self._average, own, LATEST)
        policy.load_state_dict(self._average)
        trial = Trial.of(self.model, self._worlds, self._seed, self.num_timesteps)
        policy.load_state_dict(own)
        self.trials.append(trial)
        if math.isfinite(trial.mean_return) and (self.best is None or trial.mean_return > self.best.mean_return):
            self.best, self._parameters = trial, self._average
        self.logger.record("imagination/held_out_return", trial.mean_return)
        if self._on_trial is not None:
            self._on_trial(trial)
        since = len(self.trials) - (self.trials.index(self.best) + 1 if self.best is not None else 0)
        return since < self._patience

    def restore_best(self) -> Trial:
        """Give the model the policy of the best trial.

        Raises:
            TrainingError: no trial had a finite return.
        """
        if self.best is None:
            raise TrainingError(
                f"training in imagination diverged: of {len(self.trials)} trials none had a finite return. Observations"
                " of very different sizes are a common cause: rescale them with gymnasium.wrappers.RescaleObservation"
            )
        self.model.policy.load_state_dict(self._parameters)
        return self.best


def moved(average: Mapping[str, Tensor], latest: Mapping[str, Tensor], share: float) -> dict[str, Tensor]:
    """A moving average with this share of the latest parameters, which are the first one; counters are the latest."""
    if not average:
        return dict(latest)
    return {
        name: average[name].lerp(value, share) if value.is_floating_point() else value for name, value in latest.items()
    }


def learned_parameters(model: BaseAlgorithm) -> dict[str, Tensor]:
    """What a model has learned: its policy's parameters, and the weight of its entropy where that is learned."""
    parameters = {f"policy.{name}": value.detach().clone() for name, value in model.policy.state_dict().items()}
    weight = getattr(model, "log_ent_coef", None)
    return parameters if weight is None else parameters | {"log_ent_coef": weight.detach().clone()}


def take_over(model: BaseAlgorithm, parameters: Mapping[str, Tensor]) -> None:
    """Give a model what `learned_parameters` gave of another one, or of a file.

    Raises:
        RuntimeError, KeyError: they are those of other networks.
    """
    of_policy = {name.removeprefix("policy."): value for name, value in parameters.items() if name != "log_ent_coef"}
    model.policy.load_state_dict(of_policy)
    weight = getattr(model, "log_ent_coef", None)
    if weight is not None:
        weight.data.copy_(parameters["log_ent_coef"])


def imagine(
    agent: Imagining,
    algorithm: AlgorithmName | str | type[BaseAlgorithm] = "SAC",
    total_timesteps: int | None = None,
    *,
    num_worlds: int = 20,
    episode_steps: int | None = None,
    starts: StartName | StartFunction = "mixed",
    trial_every: int | None = None,
    patience: int = 8,
    encoded: bool = True,
    seed: int | None = None,
    begin_with: BaseAlgorithm | None = None,
    on_trial: Callable[[Trial], None] | None = None,
    on_progress: Callable[[int], None] | None = None,
    **settings: Any,
) -> ImaginedPolicy:
    """Train a policy in the worlds of an agent's model; see `MPCAgent.imagine_policy` for the arguments.

    Args:
        begin_with: a model of the same algorithm and networks, whose policy to go on from.
        on_trial: called after each trial.
        on_progress: called after each step in all worlds, with the number of imagined steps that it took.

    Raises:
        ValueError, TypeError: the agent has not learned yet, or an argument is none or out of its range.
        TrainingError: training diverged.
    """
    started = time.perf_counter()
    kind = algorithm_class(algorithm)
    total_timesteps = budget_of(kind).total_timesteps if total_timesteps is None else total_timesteps
    trial_every = budget_of(kind).trial_every if trial_every is None else trial_every
    check_counts(total_timesteps=total_timesteps, trial_every=trial_every, patience=patience)
    seed = agent.seed if seed is None else seed
    seeds = [derive_seed(seed, "imagination", part) for part in (LEARNING, CHOOSING, REPORTING)]
    worlds = ImaginedVecEnv.of(agent, num_worlds, episode_steps=episode_steps, starts=starts, seed=seeds[LEARNING])
    from_starts: StartName | StartFunction = "starts"
    held_out = ImaginedVecEnv.of(agent, num_worlds, episode_steps=worlds.episode_steps, starts=from_starts, seed=0)
    features = encoding(agent.store, agent.task.modelled.observation_spec) if encoded else {}
    suited = suited_settings(kind, num_worlds, total_timesteps, worlds.observation_space, features)
    of_policy = {**suited["policy_kwargs"], **(settings.pop("policy_kwargs", None) or {})}
    with lent_randomness():
        model = kind(
            env=worlds,
            seed=seeds[LEARNING] % 2**31,
            device=agent.device,
            **{**suited, "policy_kwargs": of_policy, **settings},
        )
        if begin_with is not None:
            take_over(model, learned_parameters(begin_with))
        chosen = ChooseByWorlds(held_out, seeds[CHOOSING], trial_every, patience, on_trial, on_progress)
        model.learn(total_timesteps, callback=chosen)
        if not chosen.trials or chosen.trials[-1].timesteps < model.num_timesteps:
            chosen.try_policy()
        best = chosen.restore_best()
        fresh = Trial.of(model, held_out, seeds[REPORTING], best.timesteps)
    model.env = None  # the worlds end here: what is left acts by itself
    return ImaginedPolicy(model, chosen.trials, best, fresh, time.perf_counter() - started)
