"""The pictures of docs/concepts.md: worlds that a model thinks possible, and how a plan is searched in them.

python examples/concepts.py     # learns three episodes of the modified cart-pole, one to two minutes on one core
"""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from matplotlib.figure import Figure

import gym_dgpmpc  # noqa: F401  # registers the environments
from gym_dgpmpc import DGPMPCAgent, settings_for
from gym_dgpmpc.planning import make_planner, rollout, rollout_objective

ANGLE, HORIZON, NUM_WORLDS = 1, 30, 30


def main(episode_steps: int = 200, folder: Path = Path("docs/concepts"), **settings: Any) -> None:
    """Learn from one episode and from three; draw what each model foresees of the same actions, and how one plans."""
    env = gym.make("ModCartPole-v0")
    agent = DGPMPCAgent(env, **{**settings_for("ModCartPole-v0"), "seed": 0, "verbose": 1, **settings})
    generator = torch.Generator().manual_seed(0)

    agent.learn(episode_steps)
    worlds = {"after one episode of random actions": agent.dynamics.draw(NUM_WORLDS, HORIZON, generator)}
    agent.learn(2 * episode_steps, reset_num_timesteps=False)
    worlds["after two planned ones more"] = agent.dynamics.draw(NUM_WORLDS, HORIZON, generator)

    observations, actions = episode(env, agent)
    start, candidate = torch.as_tensor(observations[0]), torch.as_tensor(actions)[None]
    foreseen = {when: rollout(world, start, candidate, NUM_WORLDS) for when, world in worlds.items()}
    angles = {when: states[:, :, 0, ANGLE] for when, states in foreseen.items()}
    draw_worlds(angles, observations[:, ANGLE]).savefig(folder / "worlds.png", dpi=110)

    world = agent.dynamics.draw(agent.num_particles, HORIZON, generator)
    reward_fn = env.get_wrapper_attr("reward_fn")
    objective = rollout_objective(world, reward_fn, start, agent.num_particles)
    tried: list[tuple[torch.Tensor, torch.Tensor]] = []

    def recorded(candidates: torch.Tensor) -> torch.Tensor:
        scores = objective(candidates)
        tried.append((candidates, scores))
        return scores

    planner = make_planner("cem", agent.action_space, agent.device, horizon=HORIZON)
    planner.plan(recorded, planner.initial_plan(), generator)
    draw_plan(tried).savefig(folder / "plan.png", dpi=110)


def episode(env: gym.Env, agent: DGPMPCAgent) -> tuple[np.ndarray, np.ndarray]:
    """The first steps of an episode: observations [H + 1, S] and actions [H, A]."""
    observation, _ = env.reset(seed=1)
    observations, actions, state = [observation], [], None
    for _ in range(HORIZON):
        action, state = agent.predict(observation, state=state)
        observation = env.step(action)[0]
        observations.append(observation)
        actions.append(action)
    return np.array(observations, np.float32), np.array(actions, np.float32)


def draw_worlds(foreseen: dict[str, torch.Tensor], happened: np.ndarray) -> Figure:
    """The pole's angle in every world, [H + 1, P], beside what happened."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    for axes, (when, angle) in zip(figure.subplots(1, 2, sharey=True), foreseen.items(), strict=True):
        axes.plot(angle, color="tab:blue", linewidth=0.7, alpha=0.6)
        axes.plot(angle[:, :1], color="tab:blue", linewidth=0.7, label=f"{NUM_WORLDS} worlds")
        axes.plot(happened, "k--", label="what happened")
        axes.set(title=when, xlabel="step", ylim=(happened.min() - 2, happened.max() + 2))
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("angle of the pole (rad)")
    figure.axes[0].legend(loc="upper left")
    return figure


def draw_plan(tried: list[tuple[torch.Tensor, torch.Tensor]]) -> Figure:
    """The candidates of the first, a middle and the last iteration, and the returns of all."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    sequences, returns = figure.subplots(1, 2)
    shown = sorted({0, len(tried) // 2, len(tried) - 1})
    for iteration, colour in zip(shown, ("tab:grey", "tab:orange", "tab:blue"), strict=False):
        low, high = tried[iteration][0][:, :, 0].quantile(torch.tensor([0.1, 0.9]), dim=0)
        sequences.fill_between(range(len(low)), low, high, color=colour, alpha=0.4, label=f"iteration {iteration + 1}")
    sequences.set(title="eight in ten candidates lie here", xlabel="step of the plan", ylim=(-3, 3))
    sequences.set_ylabel("action (100 N)")
    sequences.legend(loc="upper left", ncols=3, fontsize="small")
    returns.violinplot([scores.numpy() for _, scores in tried], showmedians=True)
    returns.set(title="what they earn in the worlds", xlabel="iteration", ylabel="mean return over the plan's steps")
    for axes in figure.axes:
        axes.grid(alpha=0.3)
    return figure


if __name__ == "__main__":
    main()
