"""What a type checker knows of the agents' arguments is what they are."""

import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gym_dgpmpc.agents import MPCAgent
from tests.agents.typed import AGENTS, STUB, generated

CLONE = Path(__file__).parents[2]

RIGHT = """
from functools import partial

import gymnasium

from gym_dgpmpc import DGPMPCAgent, DynaAgent, GPMPCAgent, MixtureMPCAgent, PETSAgent, settings_for
from gym_dgpmpc.planning import CEM

agent = DGPMPCAgent("ModCartPole-v0", kernel="matern32", num_layers=2)
agent.learn(10).save("file")
number: int = agent.num_layers + agent.num_candidates
loaded: DGPMPCAgent = DGPMPCAgent.load("file")
DGPMPCAgent("MPCPolicy", "ModCartPole-v0", planner="icem", noise_beta=1.0, step_size=1)
DGPMPCAgent(gymnasium.make("ModCartPole-v0"), **settings_for("ModCartPole-v0"), seed=0)
DGPMPCAgent(policy="MPCPolicy", env=None, risk="cvar", exploration="held", terminated_fn="never")
PETSAgent("ModCartPole-v0", draw="TSinf", num_particles=3)
GPMPCAgent("ModCartPole-v0", draw="DS", planner=partial(CEM, num_elites=3))
MixtureMPCAgent("ModCartPole-v0", members=("deep-gp", "ensemble"), deep_gp_kernel="rbf")
DynaAgent("ModCartPole-v0", algorithm="SAC", num_layers=1).imagined_policy
"""

WRONG = {
    'DGPMPCAgent("a", kernel="nonsense")': "kernel",
    'DGPMPCAgent("a", nmu_layers=3)': "num_layers",  # is what it says may be meant
    'DGPMPCAgent("a", num_layers="two")': "num_layers",
    "DGPMPCAgent(3)": "Argument 1",
    'DGPMPCAgent("a", risk="none")': "risk",
    'DGPMPCAgent("a").num_layers = 3': "read-only",
    'PETSAgent("a", draw="pathwise")': "draw",
    'GPMPCAgent("a", num_layers=2)': "num_layers",
    'MixtureMPCAgent("a", members=("gp",))': "members",
    'DynaAgent("a", acts_by="hand")': "acts_by",
}


def test_the_file_is_what_the_settings_say():
    assert STUB.read_text() == generated(), "write it anew: python -m tests.agents.typed"


@pytest.mark.parametrize("agent", AGENTS)
def test_nothing_of_it_is_there_when_python_runs(agent):
    assert agent.__mro__[1].__module__ != "gym_dgpmpc.agents.typed"
    assert issubclass(agent, MPCAgent)
    assert f"class {agent.__name__}Base(" in STUB.read_text()
    for name in inspect.signature(agent).parameters:
        assert f"        {name}: " in STUB.read_text()


@pytest.mark.slow
def test_a_users_script_is_checked(tmp_path):
    pytest.importorskip("mypy")
    lines = ["from gym_dgpmpc import DGPMPCAgent, DynaAgent, GPMPCAgent, MixtureMPCAgent, PETSAgent", *WRONG]
    for name, text in (("right", RIGHT), ("wrong", "\n".join(lines))):
        (tmp_path / f"{name}.py").write_text(text)
    command = [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", "--hide-error-context"]
    command += ["--config-file=", "--follow-imports", "silent", "--ignore-missing-imports"]
    command += [
        "--cache-dir",
        str(CLONE / ".mypy_cache" / "users"),
        str(tmp_path / "right.py"),
        str(tmp_path / "wrong.py"),
    ]
    environment = {**os.environ, "MYPYPATH": str(CLONE)}
    result = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)
    errors = [line for line in result.stdout.splitlines() if ": error: " in line]
    assert not result.stderr, result.stderr
    places = [(line.split(":")[0], int(line.split(":")[1])) for line in errors]
    assert places == [("wrong.py", number) for number in range(2, 2 + len(WRONG))], result.stdout
    for line, text in zip(errors, WRONG.values(), strict=True):
        assert text in line
