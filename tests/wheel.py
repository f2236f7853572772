"""Is this an installed wheel that brings its compiled code? `python tests/wheel.py`, with no compiler to help out.

Not a test of pytest's: the release runs it in an environment that has the wheel alone.
"""

import os
import warnings

os.environ["CXX"] = "no-compiler-is-asked"
warnings.simplefilter("error", UserWarning)

from gym_dgpmpc import DGPMPCAgent  # noqa: E402
from gym_dgpmpc.compiler import PREBUILT  # noqa: E402
from gym_dgpmpc.dynamics.deep_gp import compiled_rollout  # noqa: E402
from gym_dgpmpc.inference import compiled_layers  # noqa: E402

for module in (compiled_rollout, compiled_layers):
    library = module._library()
    assert library is not None and PREBUILT in library._name, f"{module.__name__} has no library of the wheel"
    print(library._name)

agent = DGPMPCAgent("ModCartPole-v0", num_candidates=50, first_training_iterations=50, learning_starts=50, seed=0)
agent.learn(total_timesteps=60)
print("learned and planned with it")
