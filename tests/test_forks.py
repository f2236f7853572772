"""A forked child computes although its parent has used PyTorch's threads, which are not in it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FORKED = """
import os, torch
import numpy as np
torch.set_num_threads(2)
{work}
before = work()
torch.rand(10**6).exp()  # on both threads
child = os.fork()
if child == 0:
    after = work()
    print(np.allclose(before, after, atol=1e-3), torch.get_num_threads(), flush=True)
    os._exit(0)
os.waitpid(child, 0)
print(torch.get_num_threads())
"""

PREDICT = """
from gym_dgpmpc import DGPMPCAgent
few = dict(num_inducing=60, first_training_iterations=5, num_samples=5, num_candidates=100, num_elites=10, horizon=5)
agent = DGPMPCAgent("Pendulum-v1", seed=0, learning_starts=100, **few)
agent.learn(101)
def work():
    return agent.predict(np.array([1.0, 0.0, 0.0], np.float32), deterministic=True)[0]
"""

FIT = """
from gym_dgpmpc.dynamics.ensemble import EnsembleDynamics
from gym_dgpmpc.types import Transitions
generator = torch.Generator().manual_seed(0)
states = torch.rand(300, 3, generator=generator)
def work():
    model = EnsembleDynamics(3, 1, num_epochs=1)
    return model.fit(Transitions(states, states[:, :1], states), generator.manual_seed(1))["rmse"]
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.parametrize("work", [PREDICT, FIT], ids=["predict", "fit"])
def test_a_child_of_a_parent_with_two_threads(work):
    done = subprocess.run(
        [sys.executable, "-W", "error::RuntimeWarning", "-c", FORKED.format(work=work)],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.stdout == "True 1\n2\n", done.stderr
