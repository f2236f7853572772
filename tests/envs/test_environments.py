"""Every environment of the package keeps Gymnasium's contract, knows its own reward and documents itself truly."""

import ast
import inspect
import pickle
import re

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from gym_dgpmpc import envs
from gym_dgpmpc.data.encoding import Encoder
from gym_dgpmpc.envs import ModCartPoleEnv, Reacher7DoFEnv, VelocityHalfCheetahEnv, registration
from gym_dgpmpc.envs.registration import ENVIRONMENTS
from gym_dgpmpc.wrappers import RiskSensitiveReward
from tests.envs.common import play, section, table, uniform_actions

CLASSES = [getattr(envs, name) for name in registration.CLASSES]
DESCRIBED = {ModCartPoleEnv: "ModCartPole-v0", Reacher7DoFEnv: "Reacher7DoF-v0"}
DESCRIBED |= {VelocityHalfCheetahEnv: "VelocityHalfCheetah-v0"}  # classes with a full description, and an id of each


@pytest.fixture(params=ENVIRONMENTS)
def env(request):
    env = gymnasium.make(request.param)
    yield env
    env.close()


@pytest.mark.filterwarnings(
    "ignore:.*normalized:UserWarning", "ignore:.*infinity:UserWarning", "ignore:.*different from the unwrapped version"
)
def test_gymnasium_and_sb3_accept_it(env):
    check_env(env.unwrapped, skip_render_check=True)
    wrapped = RiskSensitiveReward(type(env.unwrapped)(), angle_index=1, penalise_step=True)
    check_env(wrapped, skip_render_check=True)
    sb3_check_env(env, skip_render_check=True)


def test_same_seed_same_episode(env):
    actions = uniform_actions(env.action_space, 30, seed=0)
    first, second = play(env, actions, seed=3), play(gymnasium.make(env.spec.id), actions, seed=3)
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])
    if env.spec.id != "BiasedReacher-v0":  # whose targets are the same for every seed
        assert not np.array_equal(first[0][0], play(env, [], seed=4)[0][0])


def test_step_pays_exactly_what_reward_fn_says(env):
    reward_fn = env.unwrapped.reward_fn
    actions = np.stack([uniform_actions(env.action_space, 60, seed, stretch=1.5) for seed in range(3)])
    episodes = [play(env, actions[seed], seed) for seed in range(3)]

    observations = torch.as_tensor(np.stack([episode[0] for episode in episodes]))
    rewards = torch.as_tensor(np.stack([episode[1] for episode in episodes]))
    before, after = observations[:, :-1], observations[:, 1:]
    one_by_one = [
        [reward_fn(before[e, t], torch.as_tensor(actions[e, t]), after[e, t]).item() for t in range(60)]
        for e in range(3)
    ]
    assert one_by_one == rewards.tolist()
    # A processor may round the elements of a batch differently by a unit in the last place of any term.
    batched = reward_fn(before, torch.as_tensor(actions), after)
    torch.testing.assert_close(batched, rewards, rtol=1e-14, atol=1e-14)
    single = reward_fn(before.float(), torch.as_tensor(actions), after.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), rewards, rtol=1e-5, atol=1e-5)


def test_info_has_the_parts_of_the_reward(env):
    env.reset(seed=0)
    _, reward, _, _, info = env.step(uniform_actions(env.action_space, 1, seed=0)[0])
    parts = [value for name, value in info.items() if re.match(r"reward_(?!original|risk)", name)]
    assert len(parts) == 2 and sum(parts) == reward
    assert all(type(value) is float for value in info.values())


def test_returned_objects_are_fresh(env):
    observation, info = env.reset(seed=0)
    kept, kept_info = observation.copy(), dict(info)
    action = env.action_space.low
    next_observation, _, _, _, next_info = env.step(action)
    env.step(action)
    np.testing.assert_array_equal(observation, kept)
    assert info == kept_info and next_info is not info
    assert not np.shares_memory(next_observation, env.unwrapped.data.qpos)


def test_actions_are_clipped_for_dynamics_and_reward(env):
    outcomes = []
    for factor in (1.0, 20.0):
        env.reset(seed=0)
        action = factor * env.action_space.low
        kept = action.copy()
        outcomes.append(env.step(action))
        np.testing.assert_array_equal(action, kept)  # the caller's array is not changed
    np.testing.assert_array_equal(outcomes[0][0], outcomes[1][0])
    assert outcomes[0][1] == outcomes[1][1]
    before, after = (torch.as_tensor(outcomes[0][0]) for _ in range(2))
    rewards = [
        env.unwrapped.reward_fn(before, torch.as_tensor(factor * env.action_space.low), after) for factor in (1, 20)
    ]
    assert rewards[0] == rewards[1]


def test_bad_actions_are_refused(env):
    task = env.unwrapped
    task.reset(seed=0)
    shape = env.action_space.shape
    for action in (np.full(shape, np.nan, np.float32), np.zeros(8, np.float32), np.zeros((1, *shape))):
        with pytest.raises(ValueError, match=rf"action .*{re.escape(str(shape))}.*{re.escape(repr(action))}"):
            task.step(action)


def test_integer_actions_are_taken_as_numbers(env):
    outcomes = []
    for dtype in (np.int64, np.float32):
        env.reset(seed=0)
        outcomes.append(env.unwrapped.step(np.ones(env.action_space.shape, dtype)))
    np.testing.assert_array_equal(outcomes[0][0], outcomes[1][0])
    assert outcomes[0][1] == outcomes[1][1]


def test_what_the_agent_looks_for(env):
    size = env.observation_space.shape[0], env.action_space.shape[0]
    spec = env.get_wrapper_attr("observation_spec")
    encoder = Encoder(*size, spec)
    # PETS's sizes for the cart-pole and the cheetah; of the reacher's target, 3 numbers are neither read nor predicted
    # and its 2 free rolls are read as sine and cosine.
    sizes = {4: (6, 4), 17: (17 - 3 + 2 + 7, 14), 18: (24, 18)}
    assert (encoder.input_size, encoder.target_size) == sizes[size[0]]
    assert env.get_wrapper_attr("terminated_fn") is None  # says that it never terminates
    observations, _, _ = play(env, uniform_actions(env.action_space, 5, seed=0), seed=0)
    assert np.all(np.ptp(observations, axis=0)[list(spec.constant)] == 0)
    # Angles are the hinges that turn freely, and no others.
    model = env.unwrapped.model
    free = [j for j in range(model.njnt) if int(model.jnt_type[j]) == mujoco.mjtJoint.mjJNT_HINGE.value]
    free = {int(model.jnt_qposadr[j]) for j in free if not model.jnt_limited[j]}
    task = env.unwrapped
    task.set_state(np.arange(1.0, 1 + model.nq) / 100, np.zeros(model.nv))
    observation, *_ = task.step(np.zeros(env.action_space.shape))
    assert {int(np.argmin(np.abs(task.data.qpos - observation[i]))) for i in spec.angles} == free


def test_specs_and_pickles_make_the_same_environment(env):
    actions = uniform_actions(env.action_space, 3, seed=0)
    truth = play(env, actions, seed=0)
    made = [gymnasium.make(env.spec), gymnasium.make(EnvSpec.from_json(env.spec.to_json()))]
    assert [str(copy) for copy in made] == [str(env)] * 2
    for copy in (*made, pickle.loads(pickle.dumps(env))):
        assert copy.get_wrapper_attr("reward_fn") == env.get_wrapper_attr("reward_fn")
        observations, rewards, _ = play(copy, actions, seed=0)
        np.testing.assert_array_equal(observations, truth[0])
        np.testing.assert_array_equal(rewards, truth[1])


@pytest.mark.parametrize("cls", CLASSES)
def test_arguments_are_checked(cls):
    defaults = {p.name: p.default for p in inspect.signature(CLASSES[CLASSES.index(cls)]).parameters.values()}
    common = [
        ("ctrl_cost_weight", -1.0),
        ("ctrl_cost_weight", float("nan")),
        ("frame_skip", 0),
        ("width", -1),
        ("render_mode", "ascii"),
    ]
    if "reset_noise_scale" in defaults:
        common.append(("reset_noise_scale", -0.1))
    for name, value in common:
        with pytest.raises(ValueError, match=rf"{name} .*{re.escape(repr(value))}$"):
            cls(**{name: value})


# --- documentation ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cls", CLASSES)
def test_documented_arguments_are_the_signature(cls):
    documented = {row[0].strip("`"): ast.literal_eval(row[2].strip("`")) for row in table(cls, "Arguments")}
    parameters = inspect.signature(cls).parameters.values()
    assert documented == {p.name: p.default for p in parameters if p.default is not inspect.Parameter.empty}


@pytest.mark.parametrize("cls", CLASSES)
def test_documented_version(cls):
    assert section(cls, "Version history").splitlines()[0] == "* v0: first version."
    assert {env_id.split("-")[1] for env_id in ENVIRONMENTS} == {"v0"}


@pytest.mark.parametrize("cls", DESCRIBED)
def test_documented_spaces_are_the_spaces(cls):
    env = cls()
    for title, space in (("Action space", env.action_space), ("Observation space", env.observation_space)):
        text = re.sub(r"\s+", " ", section(cls, title).splitlines()[0])
        assert text.startswith(f"`{space}`")
        rows = table(cls, title)
        assert [int(row[0]) for row in rows] == list(range(space.shape[0]))
        np.testing.assert_array_equal([float(row[2]) for row in rows], space.low)
        np.testing.assert_array_equal([float(row[3]) for row in rows], space.high)


@pytest.mark.parametrize("cls", DESCRIBED)
def test_documented_joints_and_units(cls):
    env = cls()
    env.reset(seed=0)
    for action in uniform_actions(env.action_space, 5, seed=0):
        observation = env.step(action)[0]

    def joint(row):
        kind, name = re.fullmatch(r"(\w+) \((\w+)\)", row[4]).groups()
        joint = env.model.joint(name)
        assert int(joint.type[0]) == {"slide": 2, "hinge": 3}[kind]
        return joint

    for row in table(cls, "Action space"):
        gear = re.search(r"(\d+) N", row[5])
        actuator = env.model.actuator(int(row[0]))
        assert int(actuator.trnid[0]) == joint(row).id
        assert actuator.gear[0] == (float(gear.group(1)) if gear else 1.0)
    for row in table(cls, "Observation space"):
        if row[4] == "none" or "in the step" in row[1]:
            continue
        number, is_rate, of = int(row[0]), row[-1].endswith("/s"), joint(row)
        assert observation[number] == (env.data.qvel[of.dofadr[0]] if is_rate else env.data.qpos[of.qposadr[0]])
        assert row[-1].split("/")[0] == {2: "m", 3: "rad"}[int(of.type[0])]
        if len(row) == 7 and row[5]:
            limits = [float(limit) for limit in row[5].split(" to ")] if row[5] != "free" else None
            assert bool(env.model.jnt_limited[of.id]) == (limits is not None)
            if limits is not None:
                np.testing.assert_allclose(of.range, limits, atol=5e-5)


@pytest.mark.parametrize("cls", DESCRIBED)
def test_documented_episode(cls):
    env = gymnasium.make(DESCRIBED[cls])
    steps, seconds = re.search(r"after (\d+) steps of ([\d.]+) s", section(cls, "Episode end")).groups()
    assert (int(steps), float(seconds)) == (env.spec.max_episode_steps, pytest.approx(env.unwrapped.dt))
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)
    truncations = [env.step(action)[3] for _ in range(int(steps))]
    assert truncations == [False] * (int(steps) - 1) + [True]
    assert float(re.search(r"Simulator steps of ([\d.]+) s", section(cls, "Arguments")).group(1)) == pytest.approx(
        env.unwrapped.model.opt.timestep
    )
