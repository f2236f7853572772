"""What is known about Gymnasium's own continuous-control tasks: reward, termination, how to read the observation.

`find` looks an environment up. The functions are those of the environments' own `step`, as functions of (observation,
action, next observation), with the weights and ranges that the environment was made with. docs/environments.md has a
table of what is known about which task, and what must be learned.
"""

from collections.abc import Callable
from copy import deepcopy
from inspect import signature
from typing import Any, NamedTuple

import gymnasium as gym
from gymnasium import wrappers
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.monitor import Monitor

from gym_dgpmpc.envs import known_rewards as known
from gym_dgpmpc.envs.performed_actions import ChangingActionsError, layers_above, of_chosen, only_maps_actions
from gym_dgpmpc.types import ObservationSpec, RewardFn, TerminatedFn

HARMLESS_WRAPPERS = (
    Monitor,
    wrappers.Autoreset,
    wrappers.HumanRendering,
    wrappers.OrderEnforcing,
    wrappers.PassiveEnvChecker,
    wrappers.RecordEpisodeStatistics,
    wrappers.RecordVideo,
    wrappers.RenderCollection,
    wrappers.TimeLimit,
)
"""Wrappers that intervene in `step` and leave observation, action, reward and termination as they are."""

OBSERVATION_KEEPERS = (
    gym.ActionWrapper,
    gym.RewardWrapper,
    wrappers.DtypeObservation,
    wrappers.NormalizeReward,
)
"""Wrappers that change actions, rewards or the precision alone."""

ACTION_KEEPERS = (gym.ObservationWrapper, gym.RewardWrapper, wrappers.FrameStackObservation, wrappers.NormalizeReward)
"""Wrappers that change observations or rewards alone."""


MONITOR = f"{Monitor.__module__}:{Monitor.__qualname__}"


class KnownTask(NamedTuple):
    """What is known about an environment."""

    reward_fn: RewardFn | None
    """None: the reward is not a function of observation, action and next observation, and must be learned."""
    terminated_fn: TerminatedFn | None
    """None: an episode never terminates. Where it does, the termination of every task here is known."""
    observation_spec: ObservationSpec
    planning_reward_fn: RewardFn | None = None
    """What to plan with instead: where ``reward_fn`` shows too late, for a plan's horizon, that things go wrong, or
    where the reward is nearly, but not quite, a function of the observations."""


def find(env: gym.Env | EnvSpec) -> KnownTask | None:
    """What is known about an environment, or None if it is not one of Gymnasium's own.

    Nothing is known about an environment whose class is only derived from one of these, whose MuJoCo model was replaced
    (``xml_file``), or that stands under a wrapper that may change what its numbers mean: any that has a `step` of its
    own, but for `HARMLESS_WRAPPERS` and those that have an attribute ``keeps_task = True``. Action wrappers leave
    termination and observations as they are, and the reward is that of the action that they perform; where that is not
    a function of the chosen one, the reward is not known.

    Args:
        env: the environment with its wrappers, or the spec to make it from. If its wrappers do not record how they
            were made, nothing is known.
    """
    if isinstance(env, EnvSpec):
        made = made_from(env)
        if made is None:
            return None
        try:
            return find(made)
        finally:
            made.close()
    changing = []
    while isinstance(env, gym.Wrapper):
        if _may_change_task(env):
            if not only_maps_actions(env):
                return None
            changing.append(env)
        env = env.env
    task = _TASKS.get(f"{type(env).__module__}:{type(env).__qualname__}")
    return None if task is None or not _has_its_own_model(env) else _of_chosen_actions(task(env), changing)


def made_from(spec: EnvSpec) -> gym.Env | None:
    """The environment of a spec with its wrappers, but for SB3's monitor; None if they do not record how to."""
    spec = deepcopy(spec)
    spec.kwargs.pop("render_mode", None)
    # SB3's monitor does not record how it was made, but leaves the task as it is.
    spec.additional_wrappers = tuple(wrapper for wrapper in spec.additional_wrappers if wrapper.entry_point != MONITOR)
    if any(wrapper.kwargs is None for wrapper in spec.additional_wrappers):
        return None
    return gym.make(spec)


def _of_chosen_actions(task: KnownTask, changing: list[gym.Wrapper]) -> KnownTask:
    try:
        reward_fn, planned = (
            None if each is None else of_chosen(each, changing) for each in (task.reward_fn, task.planning_reward_fn)
        )
    except ChangingActionsError:
        reward_fn = planned = None
    return task._replace(reward_fn=reward_fn, planning_reward_fn=planned)


def offered_reward(env: gym.Env, reward_fn: RewardFn) -> RewardFn:
    """The ``reward_fn`` that a layer of an environment offers, as a function of the actions that its outermost takes.

    Raises:
        ChangingActionsError: naming a wrapper before that layer which may perform another action than the chosen one,
            and which is not a function of the chosen one alone.
    """
    return of_chosen(reward_fn, [each for each in layers_above(env, "reward_fn") if may_change_actions(each)])


def may_change_actions(wrapper: Any) -> bool:
    """Whether another action may be performed under this wrapper of an environment than the one it is given.

    It may under any wrapper with a `step` of its own. Exceptions: wrappers that keep the whole task (see `find`), that
    change observations or rewards alone, or that have an attribute ``keeps_actions = True``.
    """
    keeps = isinstance(wrapper, ACTION_KEEPERS) or getattr(type(wrapper), "keeps_actions", False)
    return not keeps and _may_change_task(wrapper)


def _may_change_task(wrapper: Any) -> bool:
    """Whether what is known about an environment may not hold for the wrapped one."""
    keeps_task = isinstance(wrapper, HARMLESS_WRAPPERS) or getattr(type(wrapper), "keeps_task", False)
    # A VecEnv's wrapper always has a step of its own.
    return not keeps_task and getattr(type(wrapper), "step", None) is not gym.Wrapper.step


def may_change_observations(wrapper: Any) -> bool:
    """Whether observations may mean something else under this wrapper of an environment or a VecEnv.

    They may under any wrapper with a `step` of its own. Exceptions: wrappers that keep the whole task (see `find`),
    that change actions or rewards alone, or that have an attribute ``keeps_observations = True``.
    """
    keeps = isinstance(wrapper, OBSERVATION_KEEPERS) or getattr(type(wrapper), "keeps_observations", False)
    return not keeps and _may_change_task(wrapper)


def _has_its_own_model(env: Any) -> bool:
    """Whether a MuJoCo environment simulates the model that its class comes with; true of all others."""
    parameter = signature(type(env)).parameters.get("xml_file")
    if parameter is None:
        return True
    from gymnasium.envs.mujoco.mujoco_env import expand_model_path  # imports MuJoCo, which is not always needed

    return bool(env.fullpath == expand_model_path(parameter.default))


def _pendulum(env: Any) -> KnownTask:
    """Observation (cos, sin, rate): the angle is encoded already."""
    return KnownTask(known.PendulumReward(float(env.max_torque)), None, ObservationSpec())


def _mountain_car(env: Any) -> KnownTask:
    goal = known.GoalReached(float(env.goal_position), float(env.goal_velocity))
    return KnownTask(known.MountainCarReward(goal), goal, ObservationSpec())


def _inverted_pendulum(env: Any) -> KnownTask:
    """A reward of 1 a step does not tell a plan that stays in the middle from one that drifts to the rail's end."""
    fallen = known.AngleBeyond(index=1, limit=0.2)
    return KnownTask(known.SurvivalReward(fallen), fallen, ObservationSpec(), known.CentredPoleReward(fallen))


def _inverted_double_pendulum(env: Any) -> KnownTask:
    """The last number, the force of the rail's end, is passed through as if it were constant.

    Neither the reward nor the termination nor what comes next depends on it. Predicted, a number that is zero but for
    jumps where the cart touches the end would have a say in the lengthscales that all predicted numbers share.
    """
    fallen = known.TipBelow(1.0)
    reward = known.DoublePendulumReward(float(env._healthy_reward), fallen)
    spec = ObservationSpec(not_inputs=(8,), constant=(8,))
    return KnownTask(reward, fallen, spec, known.SteadyTipReward(reward))


def _reacher(env: Any) -> KnownTask:
    """The arm does not feel the target (4, 5), nor does its way to it (8, 9) say more than its angles do."""
    reward = known.PlanarReacherReward(float(env._reward_dist_weight), float(env._reward_control_weight))
    return KnownTask(reward, None, ObservationSpec(not_inputs=(4, 5, 8, 9), constant=(4, 5)))


def _pusher(env: Any) -> KnownTask:
    """The object's height (19) and the goal (20 to 22) stay as they are, and nothing touches the goal."""
    reward = known.PusherReward(
        float(env._reward_near_weight), float(env._reward_dist_weight), float(env._reward_control_weight)
    )
    fixed = (19, 20, 21, 22)
    return KnownTask(reward, None, ObservationSpec(not_inputs=fixed, constant=fixed))


def _cheetah(env: Any) -> KnownTask:
    return _runner(env)


def _swimmer(env: Any) -> KnownTask:
    """In the water all places and headings are alike: places and velocities are read along the first link.

    Without the place, the velocities before and after a step tell the mean velocity in it well enough to plan with.
    """
    if not env._exclude_current_positions_from_observation:
        spec = ObservationSpec(angles=(2,), not_inputs=(0, 1, 2), body_frame=((2, 0, 1), (2, 5, 6)))
        return KnownTask(_forward_reward(env), None, spec)
    reward = known.MeanVelocityReward(3, float(env._forward_reward_weight), float(env._ctrl_cost_weight))
    spec = ObservationSpec(angles=(0,), not_inputs=(0,), body_frame=((0, 3, 4),))
    return KnownTask(None, None, spec, reward)


def _hopper(env: Any) -> KnownTask:
    return _runner(env, can_fall=True)


def _walker(env: Any) -> KnownTask:
    return _runner(env, can_fall=True)


def _runner(env: Any, can_fall: bool = False) -> KnownTask:
    """The tasks on legs that reward the way forwards in a step.

    The reward is known if the observation begins with the place along the floor
    (``exclude_current_positions_from_observation=False``), which then is predicted without being an input, because it
    does not matter where on the floor one is. The trunk's angle, after its height, turns freely.
    """
    has_position = not env._exclude_current_positions_from_observation
    first = 1 if has_position else 0
    unhealthy = None
    if can_fall:
        state_range = getattr(env, "_healthy_state_range", None)  # the hopper's
        unhealthy = known.Unhealthy(first, env._healthy_z_range, env._healthy_angle_range, state_range)
    reward = _forward_reward(env, unhealthy) if has_position else None
    ends = can_fall and env._terminate_when_unhealthy
    spec = ObservationSpec(angles=(first + 1,), not_inputs=tuple(range(first)))
    return KnownTask(reward, unhealthy if ends else None, spec)


def _forward_reward(env: Any, unhealthy: known.Unhealthy | None = None) -> known.ForwardReward:
    return known.ForwardReward(
        dt=float(env.dt),
        forward_weight=float(env._forward_reward_weight),
        ctrl_cost_weight=float(env._ctrl_cost_weight),
        healthy_reward=0.0 if unhealthy is None else float(env._healthy_reward),
        unhealthy=unhealthy,
    )


_TASKS: dict[str, Callable[[Any], KnownTask]] = {
    "gymnasium.envs.classic_control.pendulum:PendulumEnv": _pendulum,
    "gymnasium.envs.classic_control.continuous_mountain_car:Continuous_MountainCarEnv": _mountain_car,
    "gymnasium.envs.mujoco.inverted_pendulum_v5:InvertedPendulumEnv": _inverted_pendulum,
    "gymnasium.envs.mujoco.inverted_double_pendulum_v5:InvertedDoublePendulumEnv": _inverted_double_pendulum,
    "gymnasium.envs.mujoco.reacher_v5:ReacherEnv": _reacher,
    "gymnasium.envs.mujoco.pusher_v5:PusherEnv": _pusher,
    "gymnasium.envs.mujoco.half_cheetah_v5:HalfCheetahEnv": _cheetah,
    "gymnasium.envs.mujoco.swimmer_v5:SwimmerEnv": _swimmer,
    "gymnasium.envs.mujoco.hopper_v5:HopperEnv": _hopper,
    "gymnasium.envs.mujoco.walker2d_v5:Walker2dEnv": _walker,
}
"""The class of the environment, as module:name so that nothing is imported here -> what is known about an instance."""
