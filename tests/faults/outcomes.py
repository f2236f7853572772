"""What must come out of a generated environment (`worlds.py`), as a recorder within it saw it.

Either exactly what it returned is in the store, and the agent predicts, is saved and loaded; or a named error came
before any step; or one that names the step, where only a step shows what is wrong, and all steps before it are kept.
"""

import io
import traceback

import numpy as np
import torch
from gymnasium import spaces

from gym_dgpmpc import DGPMPCAgent, GPMPCAgent, MPCAgent, PETSAgent
from gym_dgpmpc.errors import EnvironmentDataError, EnvironmentFailedError
from gym_dgpmpc.tasks.reward_guard import disagreements
from tests.faults.generated import count_outcomes
from tests.faults.worlds import (
    BAD_REWARD_FNS,
    BAD_TERMINATED_FNS,
    MOVING,
    Fault,
    Recorder,
    Refused,
    UsersError,
    World,
    right_reward,
    worlds,
)

ONCE_WRONG = (
    World(reward="(1,)"),
    World(reward="(1,)", num_envs=2),
    World(observation="Text"),
    World(observation="nested Dict"),
    World(observation="Dict of nothing"),
    World(observation="nothing"),
    World(action="vast float64"),
    World(action="beyond float32"),
    World(action="all fixed"),
    World(action="all fixed", wrappers=("RescaleAction",), reward_fn="right"),
    World(action="vast float64", wrappers=("RescaleAction",), reward_fn="right"),
    World(terminated_fn="a number", given_terminated="never"),
    World(reward_fn="right", vec_wrapper="VecCheckNan", num_envs=2),
    World(observation_spec="beyond", agent="still"),
    World(observation="Dict", wrappers=("TransformObservation",), num_envs=2),
    World(reward="(1,)", wrappers=("RecordEpisodeStatistics",), num_envs=1),
    World(reward="tensor", wrappers=("RecordEpisodeStatistics",), num_envs=1),
    World(fault=Fault("step", "four values", 2)),
    World(fault=Fault("step", "terminated None", 2)),
    World(fault=Fault("step", "info None", 2), num_envs=1),
)
"""Worlds in which something else came out, when they were first tried."""


class Still:
    """A `DynamicsModel` of a world in which nothing moves, which costs nothing."""

    takes_float64 = True

    def fit(self, data, generator):
        return {}

    def resample(self, data, generator):
        return {}

    def draw(self, num_particles, horizon, generator):
        return lambda observation, action, step: observation

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        assert state == {}


def still(observation_size, action_size, observation_spec):
    return Still()


PLANNING = {"num_particles": 2, "horizon": 2, "num_candidates": 6, "num_elites": 2, "num_iterations": 1}
AGENTS = {
    "DGP": (
        DGPMPCAgent,
        {
            "num_layers": 1,
            "num_inducing": 5,
            "num_features": 4,
            "first_training_iterations": 2,
            "training_iterations": 1,
            "num_samples": 1,
            "sample_spacing": 1,
            "resample_samples": 1,
        },
    ),
    "still": (MPCAgent, {"dynamics": still}),
    "PETS": (PETSAgent, {"num_members": 2, "hidden_size": 4, "num_epochs": 1}),
    "GP": (GPMPCAgent, {"num_inducing": 5, "max_training_iterations": 3}),
}
GIVEN = {None: None, "learned": "learned", "never": "never", "right": right_reward}
MAX_ERRORS = 12
OBSERVATION_CHANGERS = (
    *("own ObservationWrapper", "TransformObservation", "own Wrapper with step", "NormalizeObservation"),
    *("frozen NormalizeObservation", "FrameStackObservation", "FlattenObservation", "TimeAwareObservation"),
    *("DelayObservation", "RescaleObservation"),
)
ACTION_CHANGERS = ("own ActionWrapper with a memory", "StickyAction", "own Wrapper with step")
REWARD_CHANGERS = (
    *("own RewardWrapper", "TransformReward", "ClipReward", "frozen NormalizeReward", "NormalizeReward"),
)


def must_refuse(world: World, recorder: Recorder) -> bool | None:
    """Whether the agent must be refused before a step; None: it may be.

    Written from what the documentation says, not from what the code does.
    """
    observation, action = recorder.observation_space, recorder.action_space
    parts = observation.spaces.values() if isinstance(observation, spaces.Dict) else [observation]
    is_vector = all(isinstance(part, spaces.Box) and len(part.shape) == 1 and part.dtype.kind == "f" for part in parts)
    if not is_vector or not sum(int(np.prod(part.shape)) for part in parts):
        return True
    if not isinstance(action, spaces.Box) or action.dtype.kind != "f" or not np.prod(action.shape):
        return True
    if not (np.isfinite(action.low) & np.isfinite(action.high) & (action.low <= action.high)).all():
        return True
    with np.errstate(over="ignore"):
        width = action.high.astype(np.float32) - action.low.astype(np.float32)
    if not np.isfinite(width).all():  # the planner has float32
        return True
    if set(MOVING) & set(world.wrappers) or (world.num_envs and world.vec_wrapper == "VecNormalize"):
        return True
    offers = world.given_reward is None and world.reward_fn is not None
    if offers and world.reward_fn in BAD_REWARD_FNS:
        return True
    if world.given_terminated is None and world.terminated_fn in BAD_TERMINATED_FNS:
        return True
    if offers and world.reward_fn in ("right", "mixes precision") and set(ACTION_CHANGERS) & set(world.wrappers):
        return True
    bounds = [name for name in world.wrappers if name.startswith("RescaleAction") or name.endswith("a wide one")]
    rescales = bool(bounds) and bounds[0].startswith("RescaleAction")  # the environment's own bounds
    if offers and world.reward_fn in ("right", "mixes precision") and rescales:
        inner = recorder.unwrapped.action_space
        with np.errstate(over="ignore"):
            if (inner.low == inner.high).any() or not np.isfinite(inner.high.astype(np.float32)).all():
                return True  # Gymnasium's wrapper makes NaN or infinity of actions
    if world.observation_spec == "beyond":
        return True
    if world.observation_spec in ("plain", "angle") and set(OBSERVATION_CHANGERS) & set(world.wrappers):
        return True
    if world.compute_reward == "one at a time" and world.observation.startswith("goals"):
        return None
    return False


def flat(observation, space):
    """The vector of an observation that fits a space (axes of length one aside), or None if it is none."""
    if isinstance(space, spaces.Dict):
        if not isinstance(observation, dict) or not set(space.spaces) <= set(observation):
            return None
        parts = [flat(observation[key], space[key]) for key in sorted(space.spaces)]
        return None if any(part is None for part in parts) else np.concatenate(parts)
    try:
        array = np.asarray(observation)
    except Exception:
        return None
    if array.dtype.kind not in "fiub" or array.size != np.prod(space.shape):
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        array = array.reshape(space.shape).astype(space.dtype).astype(np.float64)
        return array if np.isfinite(array.astype(np.float32)).all() else None


def expected(row, space):
    """(observation, action, next observation, reward, terminated) of a step that can be stored, or None."""
    returned = row.returned
    if not isinstance(returned, tuple) or len(returned) != 5 or not isinstance(returned[4], dict):
        return None
    before, after = flat(row.observation, space), flat(returned[0], space)
    try:
        with np.errstate(over="ignore"):
            reward, terminated, truncated = (np.float32(np.asarray(each).item()) for each in returned[1:4])
    except Exception:
        return None
    if {terminated, truncated} - {0, 1}:
        return None
    if before is None or after is None or not np.isfinite(reward):
        return None
    return before, row.action.astype(np.float32).ravel(), after, reward, bool(terminated)


def is_same(stored, row):
    return all(np.array_equal(one, two) for one, two in zip(stored, row, strict=True))


def stored_rows(agent):
    """The store's rows [n] as `expected` has them, in the precision of the space."""
    data = agent.store.exact_transitions()
    columns = (*(column.numpy() for column in data), agent.store.rewards.numpy(), agent.store.terminated.numpy())
    return list(zip(*columns, strict=True))


def check_store(agent, recorders, errors):
    """The store holds what the recorders saw, of each environment and in order."""
    stored, num_envs = stored_rows(agent), len(recorders)
    assert len(stored) == agent.num_timesteps and len(stored) % num_envs == 0
    episodes = agent.store.episodes.numpy()
    numbers = {}
    for i, recorder in enumerate(recorders):
        told = [(expected(row, recorder.observation_space), row.episode) for row in recorder.rows]
        told = [(row, episode) for row, episode in told if row is not None]
        found, of_episodes = stored[i::num_envs], episodes[i::num_envs]
        if num_envs == 1 or not errors:
            assert len(found) == len(told), f"{len(found)} stored of {len(told)} steps"
        assert len(found) >= len(told) - len(errors), f"{len(found)} stored of {len(told)} steps, {errors}"
        place = 0
        for row, number in zip(found, of_episodes, strict=True):
            while place < len(told) and not is_same(row, told[place][0]):
                place += 1
            assert place < len(told), f"stored {row}, which did not happen: {[each[0] for each in told]}"
            assert numbers.setdefault(int(number), (i, told[place][1])) == (i, told[place][1]), "episodes are mixed"
            place += 1
    assert len(set(numbers.values())) == len(numbers), "an episode has two numbers"


def check_error(error, recorders):
    """An error in `learn` is one of the environment's, named as such."""
    assert isinstance(error, EnvironmentFailedError | EnvironmentDataError), f"{type(error).__name__}: {error}"
    cause = error
    while cause.__cause__ is not None:
        cause = cause.__cause__
    failures = [failure for recorder in recorders for failure in recorder.failures]
    if failures:
        method, raised, _ = failures[-1]
        if isinstance(error, EnvironmentFailedError) and isinstance(raised, UsersError):
            assert cause is raised, "the environment's exception is lost"
            assert "UsersError" in str(error) and "the motor and the belt" in str(error) and method in str(error)


def check_actions(action, space, num):
    actions = np.asarray(action)[None] if num is None else action
    for each in actions:
        each = np.asarray(each, dtype=space.dtype) if each.ndim == 0 else each
        assert space.contains(each), f"predicted {each!r}, which is not in {space}"


def checked_refusal(error):
    """The name of a refusal, which this package or Stable-Baselines3 raised on purpose."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    assert isinstance(error, ValueError | TypeError | AssertionError), f"{type(error).__name__}: {error}"
    on_purpose = "raise" in (last.line or "") or "assert" in (last.line or "")
    of_ours = "gym_dgpmpc" in last.filename or "stable_baselines3" in last.filename
    assert of_ours and on_purpose, f"{type(error).__name__}: {error} in {last.filename}:{last.lineno} ({last.line})"
    assert str(error), "an error without a word"
    return type(error).__name__


def outcome(world: World) -> str:
    """A word for what came out.

    Raises:
        AssertionError: it was not right.
    """
    try:
        env, recorders = world.make()
    except Refused as error:
        return f"Gymnasium or Stable-Baselines3 makes no such environment ({error})"
    kind, settings_of_kind = AGENTS[world.agent]
    arguments = {
        "reward_fn": GIVEN[world.given_reward],
        "terminated_fn": GIVEN[world.given_terminated],
        **PLANNING,
        **settings_of_kind,
        **world.settings,
        "seed": world.seed,
    }
    refuses = must_refuse(world, recorders[0])
    try:
        agent = kind(env, **arguments)
    except Exception as error:
        assert refuses is not False, f"refused without need: {type(error).__name__}: {error}"
        assert not any(recorder.rows or recorder.resets for recorder in recorders), "a step was taken before"
        return f"refused: {checked_refusal(error)}"
    assert not refuses, "what cannot be learned was not refused"

    errors, steps = [], 0
    for call in world.calls:
        steps += call
        while len(errors) < MAX_ERRORS:
            before = len(agent.store)
            try:
                agent.learn(max(steps - before, 0), reset_num_timesteps=False)
                break
            except Exception as error:
                check_error(error, recorders)
                errors.append(type(error).__name__)
    check_store(agent, recorders, errors)
    check_faults(world, recorders, errors)
    if not len(agent.store):
        return f"no step: {errors[0]}"
    check_arrays(agent, recorders)
    functions = agent.task.functions
    compares = not set(REWARD_CHANGERS) & set(world.wrappers) and world.reward not in ("int", "bool")
    if functions.reward_fn is not None and functions.reward_source in ("given", "the environment's") and compares:
        is_offered = functions.reward_source == "the environment's"
        changed = [name for name in world.wrappers if "Action" in name]
        if is_offered or not changed:
            wrong = disagreements(functions._replace(terminated_fn=None), agent.store)
            assert not wrong, wrong
    check_predictions(world, kind, agent, recorders)
    after = f" after {errors[0]}" if errors else ""
    return f"{'learned' if agent.is_fitted else 'explored'}{after}"


def check_faults(world, recorders, errors):
    """Every step that cannot be stored, and every exception, gave an error."""
    space = recorders[0].observation_space
    bad = sum(expected(row, space) is None for recorder in recorders for row in recorder.rows)
    raised = sum(len(recorder.failures) for recorder in recorders)
    if bad + raised:
        assert errors, "a step went wrong, and nothing was said"
    if errors:
        resets = [returned for recorder in recorders for returned, _ in recorder.resets]
        bad_resets = sum(
            not isinstance(each, tuple)
            or len(each) != 2
            or not isinstance(each[1], dict)
            or flat(each[0], space) is None
            for each in resets
        )
        of_wrapper = world.num_envs and world.vec_wrapper == "VecCheckNan"
        assert bad + raised + bad_resets or of_wrapper, f"nothing went wrong, but {errors}"
        assert len(errors) <= bad + raised + bad_resets or of_wrapper, errors


def check_arrays(agent, recorders):
    """What is exported is what is stored, in the spaces of the environment."""
    arrays = agent.to_arrays()
    space = recorders[0].observation_space
    rows = stored_rows(agent)
    for name, index in (("observation", 0), ("next_observation", 2)):
        column = arrays[name]
        if isinstance(space, spaces.Dict):
            assert {key: part.dtype for key, part in column.items()} == {key: part.dtype for key, part in space.items()}
            column = np.concatenate([column[key] for key in sorted(space.spaces)], axis=-1)
        else:
            assert column.dtype == space.dtype
        for one, row in zip(column, rows, strict=True):
            assert np.array_equal(one, row[index]), f"exported {one}, stored {row[index]}"
    assert np.isfinite(agent.to_replay_buffer().actions).all()
    for action in arrays["action"]:
        assert recorders[0].action_space.contains(np.asarray(action, dtype=recorders[0].action_space.dtype))


def check_predictions(world, kind, agent, recorders):
    space = recorders[0].action_space
    observation = next(
        row.returned[0] for row in recorders[0].rows if expected(row, recorders[0].observation_space) is not None
    )
    observation = as_arrays(observation, recorders[0].observation_space)
    told, _ = agent.predict(observation, deterministic=True)
    check_actions(told, space, None)
    action, _ = agent.predict(observation)
    check_actions(action, space, None)
    batch = {key: np.stack([part] * 2) for key, part in observation.items()} if isinstance(observation, dict) else None
    batch = np.stack([observation] * 2) if batch is None else batch
    check_actions(agent.predict(batch, deterministic=True)[0], space, 2)

    file = io.BytesIO()
    agent.save(file)
    file.seek(0)
    env, others = world.make(has_fault=False)
    given = {"reward_fn": right_reward} if world.given_reward == "right" else {}
    made_of = {"dynamics": still} if kind is MPCAgent else {}
    loaded = kind.load(file, env, **given, **made_of)
    again, _ = loaded.predict(observation, deterministic=True)
    assert np.array_equal(told, again), f"predicted {told}, and loaded {again}"
    for name, column in agent.store.state_dict().items():
        assert torch.equal(loaded.store.state_dict()[name], column), name
    if agent.task.modelled.reward or given:
        file.seek(0)
        alone = kind.load(file, **given, **made_of)
        vector = flat(observation, recorders[0].observation_space).astype(agent.observation_space.dtype)
        is_same_function = agent.task.functions.terminated_fn is None or agent.task.modelled.terminated
        if is_same_function:
            assert np.array_equal(told, alone.predict(vector, deterministic=True)[0]), "predicts otherwise alone"
    before = len(loaded.store)
    try:
        loaded.learn(2, reset_num_timesteps=False)
    except EnvironmentFailedError:  # a wrapper of the environment does without a fault
        assert any(recorder.failures for recorder in others)
        return
    num_envs = len(recorders)
    assert len(loaded.store) == before + -(-2 // num_envs) * num_envs


def as_arrays(observation, space):
    if isinstance(space, spaces.Dict):
        return {key: np.asarray(observation[key]).reshape(space[key].shape) for key in space.spaces}
    return np.asarray(observation).reshape(space.shape)


def run_worlds(number):
    """See `count_outcomes`."""
    return count_outcomes(worlds(), outcome, number)
