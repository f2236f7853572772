"""What `LookInside` computes: where forecasts begin, what they were worth in the end, and the scores of a plan.

Nothing here moves a random stream of the agent, or changes anything of it.
"""

from collections.abc import Mapping
from contextlib import suppress
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from gym_dgpmpc.agents import MPCAgent
from gym_dgpmpc.agents.forecasting import draw_worlds, states_along
from gym_dgpmpc.dynamics.scores import scores
from gym_dgpmpc.errors import PlanningError
from gym_dgpmpc.planning.rollout import rollout_objective
from gym_dgpmpc.randomness import derive_seed
from gym_dgpmpc.runs.figures import Forecast
from gym_dgpmpc.types import TransitionSampler

SCORES = ("coverage_50", "coverage_90", "nll", "crps")


class PlayedEpisode(NamedTuple):
    """T steps of an episode, from its first one."""

    observations: Float[ndarray, "T_plus_1 S"]
    actions: Float[ndarray, "T A"]
    rewards: Float[ndarray, " T"]


class Compared(NamedTuple):
    """Forecasts of an episode beside what happened; numbers by the steps ahead, in spreads of each observed number."""

    forecasts: list[Forecast]
    """Their last column is the reward."""
    scores: Mapping[str, Float[ndarray, " H"]]
    """Those of `SCORES`."""
    spread: Float[ndarray, "H S_predicted"]
    """Standard deviation of the particles, for the numbers of `predicted_numbers`."""


def picked_starts(agent: MPCAgent, index: int, num_windows: int) -> list[int]:
    """Steps at which forecasts begin, one in each of equal parts of an episode as long as the longest so far.

    They depend on the seed, the episode and the stored lengths alone, so that a run that goes on picks the same ones.

    Args:
        agent: that learns.
        index: of the episode, in the store.
        num_windows: forecasts, at most.
    """
    lengths = torch.unique(agent.store.episodes, return_counts=True)[1]
    last = max(int(lengths.max()) - agent.controller.horizon, 1)
    generator = np.random.default_rng(derive_seed(agent.seed, "forecast", index))
    edges = np.linspace(1, last + 1, num_windows + 1)
    return sorted({int(start) for start in generator.uniform(edges[:-1], edges[1:])})


def plan_scores(agent: MPCAgent, key: int) -> list[Float[ndarray, " K"]]:
    """The scores of all candidates of one plan from where the first environment is, by iteration.

    The plan is not performed. What the planner is given is what it would be for the next action, in other worlds.

    Args:
        agent: that learns.
        key: decides worlds and candidates, with the agent's seed.
    """
    control, task, found = agent.controller, agent.task, list[ndarray]()
    reward_fn, terminated_fn = task.planned[:2]
    assert agent._last_obs is not None and reward_fn is not None
    generator = torch.Generator(agent.device).manual_seed(derive_seed(agent.seed, "forecast", key, 1))
    plan, age = agent.collector.running[0].carried
    with torch.no_grad():
        objective = rollout_objective(
            draw_worlds(agent, control.num_particles, control.horizon, key),
            reward_fn,
            task.start(agent._last_obs[0]),
            control.num_particles,
            terminated_fn,
            measure=control.measure,
            tail=control.tail(task),
        )

        def recorded(candidates: Float[Tensor, "K H A"]) -> Float[Tensor, " K"]:
            result = objective(candidates)
            found.append(result.detach().cpu().numpy())
            return result

        with suppress(PlanningError):  # what was scored shows why; whether the agent's own plans fail, it says itself
            agent.planner.plan(recorded, agent.planner.shift(plan, age), generator)
    return found


def played(agent: MPCAgent, index: int) -> PlayedEpisode | None:
    """An episode of the store; None if no step of it was stored."""
    rows = agent.store.episodes == index
    if not bool(rows.any()):
        return None
    observation, action, after = (part[rows].numpy() for part in agent.store.exact_transitions())
    return PlayedEpisode(np.concatenate([observation, after[-1:]]), action, agent.store.rewards[rows].numpy())


def predicted_numbers(agent: MPCAgent) -> list[int]:
    """Which numbers of an observation the model predicts."""
    modelled = agent.task.modelled
    return [i for i in range(modelled.observation_size) if i not in modelled.observation_spec.constant]


def compare(
    agent: MPCAgent, worlds: Mapping[int, TransitionSampler], episode: PlayedEpisode, num_particles: int
) -> Compared | None:
    """What worlds predicted for the actions that were taken; None if the episode ended before there were any.

    Args:
        agent: that learns.
        worlds: by the step, at least 1, at which they were drawn.
        episode: that they were drawn in.
        num_particles: worlds of each draw.
    """
    size, horizon, predicted = agent.task.modelled.observation_size, agent.controller.horizon, predicted_numbers(agent)
    unit = agent.store.exact_transitions().observation.double().std(0).clamp_min(1e-12)[predicted]
    forecasts, ahead = list[Forecast](), [list[tuple[Tensor, Tensor]]() for _ in range(horizon)]
    for start, drawn in worlds.items():
        actions = episode.actions[start : start + horizon]
        if not len(actions):
            continue
        states = states_along(agent, drawn, episode.observations[start], actions, num_particles)
        end = start + len(actions)
        # A reward comes with the state that it led to, so that of the first one is known.
        came = np.c_[episode.observations[start : end + 1], episode.rewards[start - 1 : end]]
        reward = torch.nn.functional.pad(_rewards(agent, states, actions), (0, 0, 1, 0), value=float(came[0, -1]))
        foreseen = torch.cat([states[..., :size], reward.unsqueeze(-1)], dim=-1)
        forecasts.append(Forecast(start, foreseen.cpu().numpy(), came, actions))
        particles = states[..., predicted].double().cpu() / unit
        truth = torch.from_numpy(came[:, predicted]).double() / unit
        for step in range(len(actions)):
            ahead[step].append((particles[step + 1], truth[step + 1]))
    if not forecasts:
        return None
    steps = [(torch.stack(p, 1), torch.stack(t)) for p, t in (zip(*each, strict=True) for each in ahead if each)]
    found = [scores(particles, truth) for particles, truth in steps]
    by_name = {name: np.array([each[name] for each in found]) for name in SCORES}
    return Compared(forecasts, by_name, np.stack([particles.std(0).mean(0).numpy() for particles, _ in steps]))


def _rewards(agent: MPCAgent, states: Float[Tensor, "H_plus_1 P S_all"], actions: ndarray) -> Float[Tensor, "H P"]:
    """The reward of each step of each particle, as plans count it."""
    reward_fn = agent.task.planned.reward_fn
    assert reward_fn is not None
    action = torch.from_numpy(actions).to(states).unsqueeze(1).expand(-1, states.shape[1], -1)
    with torch.no_grad():
        return reward_fn(states[:-1], action, states[1:]).to(states.dtype)
