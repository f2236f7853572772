"""Numbers that float32, PyTorch's defaults or its modes would change: the same model and plans all the same."""

import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from gym_dgpmpc import DGPMPCAgent, GPMPCAgent, PETSAgent
from gym_dgpmpc.planning import rollout

LENGTH = 12
PLANNING = {"num_candidates": 20, "horizon": 4, "num_iterations": 2, "num_particles": 2, "seed": 0}
DEEP_GP = {
    **PLANNING, "num_layers": 2, "num_inducing": 12, "num_features": 16, "first_training_iterations": 40,
    "training_iterations": 10, "num_samples": 6, "sample_spacing": 2, "resample_samples": 1,
}  # fmt: skip
PETS = {**PLANNING, "num_members": 2, "num_hidden_layers": 1, "hidden_size": 8, "weight_decay": (1e-4, 1e-4)}
GP = {**PLANNING, "num_inducing": 12, "max_training_iterations": 10}


def climbing(settings, optimiser):
    """By gradients, from as many sequences as others are sampled."""
    others = {name: value for name, value in settings.items() if name != "num_candidates"}
    return {**others, "planner": "gradient", "num_starts": settings["num_candidates"], "optimiser": optimiser}


AGENTS = {
    "compiled": (DGPMPCAgent, DEEP_GP),
    "pathwise": (DGPMPCAgent, {**DEEP_GP, "compile": False}),
    "joint": (DGPMPCAgent, {**DEEP_GP, "draw": "joint"}),
    "PETS": (PETSAgent, PETS),
    "PETS MM": (PETSAgent, {**PETS, "draw": "MM"}),
    "GP": (GPMPCAgent, GP),
    "gradient": (DGPMPCAgent, climbing(DEEP_GP, "lbfgs")),
    "PETS, gradient": (PETSAgent, {**climbing(PETS, "adam"), "draw": "TSinf"}),
    "GP, gradient": (GPMPCAgent, {**climbing(GP, "adam"), "draw": "DS"}),
    "GP AMM": (GPMPCAgent, {**GP, "draw": "AMM", "num_particles": 4}),
}


class Place(gym.Env):
    """Observation (place, velocity), with the place at an offset; a step changes the place by about 0.01.

    The offsets of the tests are whole numbers, so the place less the offset is the same in all of them up to float64.
    """

    def __init__(self, offset=0.0, dtype=np.float64, action_space=None):
        self.offset = offset
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), dtype)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32) if action_space is None else action_space

    def reward_fn(self, observation, action, next_observation):
        return -100.0 * (next_observation[..., 0] - self.offset - 0.1).square()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.velocity, self.time = 0.0, 0.0, 0
        return self.seen(), {}

    def seen(self):
        return np.array([self.offset + self.place, self.velocity], dtype=self.observation_space.dtype)

    def step(self, action):
        assert self.action_space.contains(action)
        before = torch.from_numpy(self.seen()).double()
        self.velocity = 0.8 * self.velocity + 0.01 * float(action[0])
        self.place, self.time = self.place + self.velocity, self.time + 1
        reward = self.reward_fn(before, torch.as_tensor(action), torch.from_numpy(self.seen()).double())
        return self.seen(), float(reward), False, self.time >= LENGTH, {}


def learned(name, offset=0.0, episodes=2, **arguments):
    agent, settings = AGENTS[name]
    return agent(Place(offset), **settings, **arguments).learn(episodes * LENGTH)


@pytest.mark.parametrize("offset", [5e3, 5e5, 1.7e9])
@pytest.mark.parametrize("name", AGENTS)
def test_an_offset_changes_nothing(name, offset):
    """Model, predictions and plans are those without the offset, up to what float64 keeps of a change at the offset."""
    near, far = learned(name, 0.0, episodes=1), learned(name, offset, episodes=1)
    fraction = np.finfo(np.float64).eps * offset / 0.01  # of a change
    assert len(np.unique(np.diff(far.to_arrays()["observation"][:, 0]))) == LENGTH - 1
    start, shift = np.array([0.05, 0.01]), np.array([offset, 0.0])
    actions = torch.linspace(-1.0, 1.0, 4 * 3, dtype=torch.float32).view(3, 4, 1)
    states = []
    for agent, observation in ((near, start), (far, start + shift)):
        particles = agent.num_particles
        with torch.no_grad():
            world = agent.dynamics.draw(particles, 4, torch.Generator().manual_seed(0))
            states.append(rollout(world, agent.task.start(observation), actions, particles))
    moved = states[1] - torch.from_numpy(shift)
    assert states[1].dtype == torch.float64
    changes = (states[0] - torch.from_numpy(start)).abs().amax()
    error = (moved - states[0]).abs().amax()
    # Rounding enters the data once, and an optimiser and a rollout amplify it; float32 would be off by 1 and more.
    assert error <= (1e-2 + 1e3 * fraction) * changes, (error, changes)


def test_the_precision_is_saved(tmp_path):
    learner = learned("compiled", 5e5)
    learner.save(tmp_path / "agent")
    loaded = DGPMPCAgent.load(tmp_path / "agent", env=Place(5e5))
    before, after = (agent.store.exact_transitions().observation for agent in (learner, loaded))
    assert before.dtype == torch.float64 and torch.equal(before, after) and loaded.task.is_exact
    observation = before[3].numpy()
    actions = [agent.predict(observation, deterministic=True)[0] for agent in (learner, loaded)]
    np.testing.assert_array_equal(*actions)
    np.testing.assert_array_equal(loaded.to_arrays()["observation"], before.numpy())


def test_without_an_offset_the_model_sees_float32():
    learner = learned("GP", 0.0)
    assert not learner.task.is_exact
    assert learner.task.transitions(learner.store).observation.dtype == torch.float32


def test_float32_observations_that_lose_their_changes_are_warned_of():
    with pytest.warns(UserWarning, match=r"\[0\].*5e\+05.*float32.*dtype float64"):
        GPMPCAgent(Place(5e5, np.float32), **GP, reward_fn="learned").learn(LENGTH)


def test_a_reward_that_takes_float32_alone_gets_it():
    weights, seen = torch.tensor([1.0, 0.0]), set()

    def reward_fn(observation, action, next_observation):
        seen.add(next_observation.dtype)
        return next_observation @ weights

    with pytest.warns(UserWarning, match="reward_fn does not take float64"):
        learned("GP", 5e5, reward_fn=reward_fn)
    assert torch.float32 in seen


DEFAULTS = """
import sys, tempfile, warnings
import torch
from tests.agents.test_precision import AGENTS, LENGTH, Place
dtype, device = sys.argv[1:]
warnings.simplefilter("ignore")
torch.set_num_threads(1)
torch.set_default_dtype(getattr(torch, dtype))
torch.set_default_device(device)
for name, (agent_class, settings) in AGENTS.items():
    agent = agent_class(Place(), **settings, reward_fn="learned" if name == "pathwise" else None)
    agent.learn(2 * LENGTH)
    observation = agent.store.exact_transitions().observation[3].numpy()
    with tempfile.TemporaryDirectory() as folder:
        agent.save(folder + "/agent")
        loaded = agent_class.load(folder + "/agent", env=Place())
    actions = [each.predict(observation, deterministic=True)[0].tolist() for each in (agent, loaded.learn(0))]
    print(name, agent.store.rewards.tolist(), actions)
"""


def test_the_defaults_of_the_process_change_nothing():
    """On the device "meta" there are no numbers, so a tensor that is made there by mistake is an error."""
    printed = []
    for defaults in (("float32", "cpu"), ("float64", "cpu"), ("float32", "meta")):
        command = [sys.executable, "-c", DEFAULTS, *defaults]
        run = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stderr
        printed.append(run.stdout)
    assert printed[0] == printed[1] == printed[2] and len(printed[0].splitlines()) == len(AGENTS)


@pytest.mark.parametrize("name", ["compiled", "pathwise", "PETS", "GP", "gradient", "PETS, gradient", "GP, gradient"])
def test_torchs_modes_around_an_agent_change_nothing(name, tmp_path):
    agent_class, settings = AGENTS[name]
    plain = agent_class(Place(), **settings).learn(2 * LENGTH)
    with torch.inference_mode():
        made = agent_class(Place(), **settings)
    with torch.no_grad():
        made.learn(LENGTH)
    with torch.inference_mode():
        made.learn(LENGTH, reset_num_timesteps=False)
        observation = np.array([0.02, 0.01])
        actions = [agent.predict(observation, deterministic=True)[0] for agent in (plain, made)]
        made.save(tmp_path / "agent")
        loaded = agent_class.load(tmp_path / "agent", env=Place())
    plain_again, made_again = plain.learn(LENGTH), made.learn(LENGTH)
    np.testing.assert_array_equal(*actions)
    assert torch.equal(plain_again.store.rewards, made_again.store.rewards)
    loaded.learn(LENGTH)
    assert len(loaded.store) == 3 * LENGTH


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1.0, 1.0, (1,), np.float16),
        spaces.Box(-0.1, 0.1, (1,), np.float64),
        spaces.Box(0.1, 0.1, (1,), np.float64),
        spaces.Box(np.float16(0.1), np.float16(0.7), (1,), np.float16),
    ],
)
def test_actions_are_in_their_space(space):
    """The environment itself asserts that; what is stored is what was performed."""
    learner = PETSAgent(Place(action_space=space), **PETS).learn(2 * LENGTH)
    action, _ = learner.predict(np.array([0.02, 0.01]))
    assert space.contains(action)
    stored = learner.store.transitions().action
    assert torch.equal(stored, torch.from_numpy(stored.numpy().astype(space.dtype)).float())
