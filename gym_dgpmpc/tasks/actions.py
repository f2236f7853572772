"""Actions on their way to an environment; the planner and the store have them as float32 vectors."""

import numpy as np
from gymnasium import spaces
from jaxtyping import Float


def performed(actions: Float[np.ndarray, "n A"], space: spaces.Box) -> np.ndarray:
    """Actions [n, ...] as the space contains them: of its shape and dtype, and within its bounds in that dtype.

    A copy, so that an environment may change what it is given.
    """
    actions = actions.reshape(-1, *space.shape)
    return np.clip(actions.astype(space.dtype), space.low, space.high)
