"""The file of an agent that has learned within an episode, with an action left of its plan."""

import pytest

from tests.agents.point_mass import KnownPointMass, agent


@pytest.fixture(scope="session")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "agent.zip"
    agent(KnownPointMass(fixed_start=True), actions_per_plan=2).learn(25).save(path)
    return path
