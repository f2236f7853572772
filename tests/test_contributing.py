"""The recipes of CONTRIBUTING.md: what they show can be run, and does what it says."""

import functools
import re
import sys
import types
from pathlib import Path

import gymnasium
import pytest
import torch

from gym_dgpmpc import DGPMPCAgent
from gym_dgpmpc.gp.kernels import KERNELS
from gym_dgpmpc.planning import PLANNERS, register_planner
from tests.oracles.models import seeded

PAGE = Path(__file__).parents[1] / "CONTRIBUTING.md"
RECIPES = {part.split("\n")[0]: part for part in PAGE.read_text(encoding="utf-8").split("\n### ")[1:]}


@functools.cache
def shown(recipe, block=0):
    """What a block of the recipe's Python defines, as a module, where annotations find what they name."""
    code = re.findall(r"```python\n(.*?)```", RECIPES[recipe], re.DOTALL)[block]
    module = types.ModuleType(f"shown_{recipe.split()[-1]}_{block}")
    sys.modules[module.__name__] = module
    exec(compile(code, PAGE.name, "exec"), vars(module))
    return module


def test_a_planner_is_known_by_its_name_and_brings_its_settings(monkeypatch):
    monkeypatch.setattr("gym_dgpmpc.planning.registry.PLANNERS", dict(PLANNERS))
    register_planner("best-of-random", shown("A planner").BestOfRandom)
    agent = DGPMPCAgent("ModCartPole-v0", planner="best-of-random", num_candidates=20, horizon=3)
    assert agent.planner.num_candidates == 20
    plan, info = agent.planner.plan(lambda a: -a.square().sum((1, 2)), agent.planner.initial_plan(), seeded())
    assert torch.equal(plan.actions, torch.zeros(3, 1)) and info.expected_return == 0.0  # the carried one is the best
    assert info.metrics == {"share_finite": 1.0}


def test_a_kernels_slope_and_features_are_those_of_its_value(monkeypatch):
    kernel = shown("A kernel").RationalQuadratic()
    monkeypatch.setitem(KERNELS, kernel.name, kernel)
    r = torch.linspace(0.1, 3.0, 20, dtype=torch.float64)
    sqdist = r.square().requires_grad_()
    assert torch.autograd.gradcheck(kernel.correlation, sqdist)
    torch.testing.assert_close(kernel.correlation_(kernel.argument_scale * r.square()), kernel.correlation(r.square()))
    # E cos(omega r) is the kernel, and a mean of F cosines errs by less than F^-1/2.
    frequency = kernel.draw_frequencies(100_000, 1, seeded())
    error = (torch.cos(frequency * r).mean(0) - kernel.correlation(r.square())).abs().max()
    assert error < 5 * 100_000**-0.5


def test_an_environment_starts_where_it_says():
    env = shown("An environment").CrossCartPoleEnv()
    assert env.reset(seed=0)[0][0] == pytest.approx(-2.4, abs=0.5)
    env.close()


def test_a_model_learns_and_its_agent_has_its_settings(monkeypatch):
    monkeypatch.setitem(sys.modules, "gym_dgpmpc.dynamics.linear", shown("A dynamics model"))
    agent = shown("A dynamics model", block=1).LinearMPCAgent(
        gymnasium.make("Pendulum-v1"), ridge=0.1, horizon=2, num_candidates=10, learning_starts=50, seed=0
    )
    agent.learn(60)
    assert agent.is_fitted and agent.dynamics.ridge == 0.1
