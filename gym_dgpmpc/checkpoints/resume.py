"""Putting an agent and its environment back to where a checkpoint was written, so that a run goes on exactly."""

import warnings
from typing import Any

import numpy as np
from numpy import ndarray

from gym_dgpmpc.checkpoints.arguments import encode, saved_arguments
from gym_dgpmpc.checkpoints.format import Checkpoint
from gym_dgpmpc.checkpoints.interface import Checkpointed
from gym_dgpmpc.checkpoints.restore import about_environment, restore, saved_num_envs, saved_spaces
from gym_dgpmpc.errors import CheckpointError, ReliabilityWarning
from gym_dgpmpc.randomness import derive_seed
from gym_dgpmpc.tasks.environment import environment_id
from gym_dgpmpc.tasks.replay import replay, return_to_start, set_options, set_present_generators

MAY_DIFFER = {"verbose", "tensorboard_log", "stats_window_size", "time_budget"}
"""Arguments that a run may go on with other values of."""


def resume_agent(agent: Checkpointed, checkpoint: Checkpoint) -> None:
    """Put everything of a checkpoint into an agent that was made as the one that wrote it, and its environment back.

    The running episode goes on where it was: its beginning is drawn again, and, in a simulator, its actions are
    repeated. Where that is impossible (a plant, an environment in another process, a step that failed) a new episode
    begins; a warning says so if what was repeated differs from what was stored.

    Args:
        agent: an `MPCAgent` with an environment; an agent that was made without a seed takes over the checkpoint's.

    Raises:
        CheckpointError: the checkpoint is another agent's, or of another registered environment; the message says in
            what.
    """
    _refuse_another(agent, checkpoint)
    agent.seed = checkpoint.config["arguments"]["seed"]
    restore(agent, checkpoint)
    _ = agent.task.functions  # an error if the reward that was given is missing
    agent.begin_at(None)
    assert agent.env is not None
    episode = checkpoint.config.get("episode")
    if episode is None:
        if agent.seeds_environment:
            agent.env.seed(derive_seed(agent.seed, "environment", agent.num_timesteps))
        set_options(agent.env, about_environment(checkpoint).get("reset_options"))
        return
    try:
        if episode["goes_on"] and (episode["num_steps"] == 0 or episode["can_replay"]):
            _continue_episode(agent, checkpoint, episode)
        else:
            set_present_generators(agent.env, episode)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"the checkpoint does not say how its episode began: {error!r}") from error


def _continue_episode(agent: Checkpointed, checkpoint: Checkpoint, episode: dict[str, Any]) -> None:
    """Begin the episode again and repeat its actions; on a difference, warn and let a new one begin."""
    rows = np.flatnonzero(agent.store.episodes.numpy() == agent.collector.running[0].index)
    rows = rows[len(rows) - episode["num_steps"] :] if episode["num_steps"] else rows[:0]
    last = checkpoint.tensors["progress"]["last_observation"].numpy()
    data = agent.store.transitions()
    first = data.observation[rows[0]].numpy() if len(rows) else last[0].astype(np.float32)
    assert agent.env is not None
    begun = return_to_start(agent.env, episode)
    observation: ndarray | str = begun
    if len(rows) != episode["num_steps"]:
        observation = f"it has {episode['num_steps']} steps, of which {len(rows)} were stored"
    elif not np.array_equal(np.asarray(begun[0], dtype=np.float32), first):
        observation = f"it began at {begun[0]}, before it was {first}"
    elif len(rows):
        actions, after = data.action[rows].numpy(), data.next_observation[rows].numpy()
        observation = replay(agent.env, actions, after, agent.store.rewards[rows].numpy())
    if isinstance(observation, str):
        warnings.warn(
            f"the environment does not repeat the episode that was interrupted after {agent.num_timesteps} steps "
            f"({observation}): a new one begins, and the run is not the same as without the interruption",
            ReliabilityWarning,
            stacklevel=2,
        )
        if len(rows):
            return  # `learn` resets
        observation = begun
    agent.begin_at(observation, np.array([len(rows) == 0]))


def _refuse_another(agent: Checkpointed, checkpoint: Checkpoint) -> None:
    name = checkpoint.config.get("class")
    if name != type(agent).__name__:
        raise CheckpointError(f"the checkpoint is of a {name}, the agent is a {type(agent).__name__}")
    saved, present = saved_arguments(checkpoint, agent, agent.planner_given), agent.arguments()
    given_seed = {"seed"} if agent.seeds_environment else set()
    differing = [
        f"{name} was {saved[name]}, now {present.get(name)}"
        for name in sorted(set(saved) - MAY_DIFFER - ({"seed"} - given_seed))
        if encode(saved[name]) != encode(present.get(name))
    ]
    to_learn = checkpoint.state("task").get("to_learn", agent.task.to_learn)
    if to_learn != agent.task.to_learn:
        differing.append(f"what was to be learned was {to_learn}, now {agent.task.to_learn}")
    num_envs = saved_num_envs(checkpoint)
    if num_envs != agent.n_envs:
        differing.append(f"it had {num_envs} environments, now {agent.n_envs}")
    both = agent.observation_space, agent.action_space
    if saved_spaces(checkpoint) != both:
        differing.append(f"its spaces were {saved_spaces(checkpoint)}, now {both}")
    ids = about_environment(checkpoint).get("environment"), environment_id(agent.env)
    # One that is not registered has no id; older files lack the module that registers Gymnasium-Robotics' ones.
    if None not in ids and len({str(each).rpartition(":")[-1] for each in ids}) > 1:
        differing.append(f"the environment was {ids[0]}, now {ids[1]}")
    if differing:
        raise CheckpointError(f"the checkpoint is of an agent with other settings: {'; '.join(differing)}")
