"""docs/environments.md says of every environment what the code says."""

import ast
from pathlib import Path

import gymnasium
import pytest

from gym_dgpmpc.envs import known
from gym_dgpmpc.envs.registration import ENVIRONMENTS
from gym_dgpmpc.types import ObservationSpec
from tests.envs.common import rows_of

TEXT = (Path(__file__).parents[2] / "docs" / "environments.md").read_text(encoding="utf-8")
OURS, GYMNASIUMS = (rows_of(part) for part in TEXT.split("\n## ")[1:3])


def indices(cell):
    return tuple(int(number) for number in cell.split(",") if number.strip())


def documented_spec(columns, vectors=""):
    return ObservationSpec(*map(indices, columns), body_frame=ast.literal_eval(f"({vectors},)") if vectors else ())


def test_every_environment_has_a_row():
    assert [row[0].strip("`") for row in OURS] == list(ENVIRONMENTS)
    made = {gymnasium.make(row[0].strip("`")).unwrapped for row in GYMNASIUMS}
    assert {f"{type(env).__module__}:{type(env).__qualname__}" for env in made} == set(known._TASKS)


@pytest.mark.parametrize("row", OURS, ids=lambda row: row[0])
def test_those_of_this_package(row):
    env = gymnasium.make(row[0].strip("`"))
    assert row[1].strip("`") == type(env.unwrapped).__name__
    sizes = (env.observation_space.shape[0], env.action_space.shape[0], env.spec.max_episode_steps)
    assert tuple(map(int, row[2:5])) == sizes
    assert float(row[5]) == pytest.approx(env.unwrapped.dt)
    assert documented_spec(row[-4:]) == env.get_wrapper_attr("observation_spec")
    assert env.has_wrapper_attr("reward_fn") and env.get_wrapper_attr("terminated_fn") is None


@pytest.mark.parametrize("row", GYMNASIUMS, ids=lambda row: f"{row[0]} {row[1]}")
def test_gymnasiums_own(row):
    arguments = dict([row[1].strip("`").split("=")]) if row[1] else {}
    arguments = {name: ast.literal_eval(value) for name, value in arguments.items()}
    task = known.find(gymnasium.make(row[0].strip("`"), **arguments))
    if task.reward_fn is not None:
        assert row[2].startswith("known")
    else:
        assert row[2].startswith("learned" if task.planning_reward_fn is None else "approximated, planned with another")
    assert ("planned with another" in row[2]) == (task.planning_reward_fn is not None)
    assert row[3].split()[0] == ("never" if task.terminated_fn is None else "known")
    assert documented_spec(row[-5:-1], row[-1]) == task.observation_spec
