"""What the agents of `files` predict, as numbers."""

from pathlib import Path

import numpy as np

FILES = Path(__file__).parent / "files"
SCHEMAS = (1, 2, 3, 4, 5)


def predictions(path):
    """Actions over an episode of five steps in which the plan is carried on, and of one plan made from scratch."""
    from gym_dgpmpc import DGPMPCAgent

    agent = DGPMPCAgent.load(path, env="ToyPush-v0")
    actions, state = [], None
    for observation in np.random.default_rng(0).normal(size=(5, 2)).astype(np.float32):
        action, state = agent.predict(observation, state, deterministic=True)
        actions.append(action)
    actions.append(agent.predict(np.array([0.5, -0.2], dtype=np.float32))[0])  # with the file's own random stream
    return np.stack(actions).astype(float).tolist()
