"""How an agent is made again from what `collect.py` put into its file.

`load_agent` makes one; `restore` fills one that is made, which is also how a run goes on (`resume.py`).
"""

from typing import Any, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from gym_dgpmpc.checkpoints.arguments import arguments_to_load, class_of
from gym_dgpmpc.checkpoints.collect import SPACES
from gym_dgpmpc.checkpoints.format import Checkpoint, CheckpointPath, read_checkpoint
from gym_dgpmpc.checkpoints.interface import Checkpointed
from gym_dgpmpc.errors import CheckpointError, DGPMPCError, UnknownRewardError
from gym_dgpmpc.randomness import derive_seed
from gym_dgpmpc.tasks.dict_observations import layout
from gym_dgpmpc.tasks.environment import wrapped_env
from gym_dgpmpc.tasks.replay import set_options

Agent = TypeVar("Agent")

MOST_ENVIRONMENTS = 10_000
"""What a file may claim."""


def load_agent(
    asked: type[Agent],
    path: CheckpointPath,
    env: GymEnv | str | None,
    device: torch.device | str,
    force_reset: bool,
    replaced: dict[str, Any],
) -> Agent:
    """Make the agent that a file holds; see `MPCAgent.load`.

    Args:
        asked: the class whose `load` was called.
        path: the file.
        env: the environment to go on in, or None.
        device: where planning computes.
        force_reset: begin a new episode when learning goes on, instead of the one that was running.
        replaced: constructor arguments in place of the saved ones.

    Raises:
        CheckpointError: the file cannot be read, holds something else, or does not fit ``env``.
    """
    checkpoint = read_checkpoint(path)
    agent_class = class_of(checkpoint, asked)
    arguments, num_envs = arguments_to_load(checkpoint, agent_class, replaced), saved_num_envs(checkpoint)
    if env is not None:
        env = wrapped_env(env)
        _refuse_another_environment(env, checkpoint)
    try:
        agent = agent_class(env=env, device=device, _init_setup_model=False, **arguments)
        agent.observation_space, agent.action_space = saved_spaces(checkpoint)
        agent.n_envs = num_envs if env is None else env.num_envs
        agent._setup_model()
    except DGPMPCError:
        raise
    except Exception as error:
        raise CheckpointError(f"no {checkpoint.config['class']} can be made with {arguments}: {error}") from error
    restore(agent, checkpoint, keep_seed="seed" not in replaced)
    if force_reset:
        agent.begin_at(None)
    if agent.env is not None:
        _ = agent.task.functions  # an error if the reward that was given is missing
    if agent.env is not None and agent.seeds_environment and force_reset:
        # Not the seed itself: an environment that is seeded with it again repeats the episodes of the first run.
        agent.env.seed(derive_seed(agent.seed, "environment", agent.num_timesteps))
    if agent.env is not None and force_reset:
        set_options(agent.env, about_environment(checkpoint).get("reset_options"))
    assert isinstance(agent, asked)
    return agent


def restore(agent: Checkpointed, checkpoint: Checkpoint, *, keep_seed: bool = True) -> None:
    """Put a file's contents into an agent of the same arguments; see `load_agent`.

    Args:
        agent: the agent.
        checkpoint: the file's contents.
        keep_seed: go on with the random streams of the file, instead of the agent's own.

    Raises:
        CheckpointError: they do not fit. The agent may hold a part of them then, and must not be used.
    """
    try:
        unknown = {*checkpoint.tensors, *checkpoint.config["values"]} - {*agent.nouns(), "spaces"}
        if unknown:
            raise CheckpointError(
                f"the file holds {sorted(unknown)}, which no {type(agent).__name__} of this version has: load it with "
                "the version that wrote it"
            )
        for name in agent.nouns():
            if name != "random" or keep_seed:
                # Looked up anew, for a noun may be made again by the one before it.
                agent.nouns()[name].load_state_dict(checkpoint.state(name))
    except UnknownRewardError as error:
        raise CheckpointError(
            "the file's model predicts the reward or termination too: pass dynamics=... as the function that made it"
        ) from error
    except CheckpointError:
        raise
    except Exception as error:
        raise CheckpointError(f"the file does not fit a {type(agent).__name__} of its arguments: {error!r}") from error


def saved_spaces(checkpoint: Checkpoint) -> tuple[spaces.Box, spaces.Box]:
    """Observation and action space of the saved agent.

    Raises:
        CheckpointError: the file does not describe them.
    """
    try:
        bounds, dtypes = checkpoint.tensors["spaces"], checkpoint.config["space_dtypes"]
        observation, action = (
            spaces.Box(bounds[f"{name}.low"].numpy(), bounds[f"{name}.high"].numpy(), dtype=np.dtype(dtypes[name]).type)
            for name in SPACES
        )
        return observation, action
    except Exception as error:
        raise CheckpointError(f"the file does not describe the spaces of its agent: {error!r}") from error


def saved_num_envs(checkpoint: Checkpoint) -> int:
    """How many environments the saved agent had.

    Raises:
        CheckpointError: the file does not say, or no agent has so many.
    """
    num_envs = checkpoint.config.get("num_envs")
    if not isinstance(num_envs, int) or isinstance(num_envs, bool) or not 1 <= num_envs <= MOST_ENVIRONMENTS:
        raise CheckpointError(f"an agent has 1 to {MOST_ENVIRONMENTS} environments, the file says {num_envs!r}")
    return num_envs


def about_environment(checkpoint: Checkpoint) -> dict[str, Any]:
    """What a file says of its agent's environment: "environment" (its id), "observation_parts", "reset_options"."""
    about = checkpoint.state("task").get("about_environment")
    return about if isinstance(about, dict) else {}


def _refuse_another_environment(env: VecEnv, checkpoint: Checkpoint) -> None:
    """Raise a `CheckpointError` if observations or actions are others than those the agent was saved for."""
    both_spaces = saved_spaces(checkpoint)
    if (env.observation_space, env.action_space) != both_spaces:
        raise CheckpointError(
            f"the agent was saved for observations {both_spaces[0]} and actions {both_spaces[1]}, "
            f"the environment has {env.observation_space} and {env.action_space}"
        )
    parts, present = about_environment(checkpoint).get("observation_parts") or {}, layout(env)
    if parts and present and parts != {key: [part.start, part.stop] for key, part in present.items()}:
        raise CheckpointError(f"the agent was saved for Dict observations of {parts}, the environment has {present}")
