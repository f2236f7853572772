"""What the agents of `files` predict, as numbers to keep beside them.

    python -m tests.checkpoints.predictions

prints them. `files/predictions.json` is what revision d6a075d printed, the last that wrote files of schema 4 (with this
module and the files copied into it, and with `tests.reporting.toy` in place of `tests.runs.toy`).
"""

import json
from pathlib import Path

import numpy as np

FILES = Path(__file__).parent / "files"
SCHEMAS = (1, 2, 3, 4)


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


if __name__ == "__main__":
    import tests.runs.toy  # noqa: F401  # registers the environment

    print(json.dumps({f"schema{schema}": predictions(FILES / f"schema{schema}.zip") for schema in SCHEMAS}, indent=1))
