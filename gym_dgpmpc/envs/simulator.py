"""A MuJoCo environment's own simulator as a batched function from (observation, actions) to observations.

What an environment must offer for it: ``model`` (its MjModel), ``frame_skip``, the action written to the actuators as
it is, and an observation that determines the simulator's state. Where the observation is not simply the positions
followed by the velocities, the attribute ``simulator_layout``, a `SimulatorLayout`, says where they are in it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SimulatorLayout:
    """Where an observation holds the simulator's state. Numbers that are not named here stay as they are.

    Attributes:
        positions: index of every generalised position in the observation. None where the observation lacks it and the
            dynamics do not depend on it (how far the half-cheetah has run); it then starts at 0.
        velocities: index of every generalised velocity in the observation.
        rates: pairs (index in the observation, generalised position) of numbers that are the position's mean velocity
            over the last environment step.
    """

    positions: tuple[int | None, ...]
    velocities: tuple[int, ...]
    rates: tuple[tuple[int, int], ...] = ()


class Simulator:
    """Steps any number of copies of an environment's simulator.

    Args:
        env: a MuJoCo environment, wrapped or not; it is neither stepped nor changed.

    Raises:
        ValueError: the environment is not MuJoCo's, or its observation does not determine the simulator's state.
    """

    def __init__(self, env: Any):
        inner = getattr(env, "unwrapped", env)
        model = getattr(inner, "model", None)
        if not isinstance(model, mujoco.MjModel) or not hasattr(inner, "frame_skip"):
            raise ValueError(
                f"a simulator needs a MuJoCo environment with a model and a frame_skip, received {inner!r}"
            )
        size = int(np.prod(inner.observation_space.shape))
        layout = getattr(inner, "simulator_layout", None)
        if layout is None:
            layout = SimulatorLayout(tuple(range(model.nq)), tuple(range(model.nq, model.nq + model.nv)))
            if size != model.nq + model.nv:
                raise ValueError(
                    f"the observation of {inner!r} has {size} numbers, but its simulator has {model.nq} positions and "
                    f"{model.nv} velocities: give the environment a simulator_layout that says where they are"
                )
        _check_layout(layout, model, size)
        if model.na:
            raise ValueError(
                f"the actuators of {inner!r} have {model.na} states of their own, which no observation holds"
            )
        self.observation_size, self.action_size, self.layout = size, int(model.nu), layout
        self._model, self._frame_skip = model, int(inner.frame_skip)
        self._time_step = self._frame_skip * float(model.opt.timestep)
        self._data = mujoco.MjData(model)
        spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
        self._template = np.zeros(mujoco.mj_stateSize(model, spec))
        mujoco.mj_getState(model, self._data, self._template, spec)
        start = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_TIME)  # positions and velocities follow the time
        self._positions = slice(start, start + model.nq)
        self._velocities = slice(start + model.nq, start + model.nq + model.nv)

    def trajectories(self, observations: NDArray[Any], actions: NDArray[Any]) -> NDArray[np.float64]:
        """The observations [n, H, S] after each of the actions [n, H, A], from n observations [n, S].

        Raises:
            ValueError: a shape is wrong.
        """
        count, horizon = actions.shape[:2] if actions.ndim == 3 else (-1, -1)
        if observations.shape != (count, self.observation_size) or actions.shape[2:] != (self.action_size,):
            raise ValueError(
                f"expected observations [n, {self.observation_size}] and actions [n, H, {self.action_size}], received "
                f"shapes {observations.shape} and {actions.shape}"
            )
        layout = self.layout
        known = [i for i, index in enumerate(layout.positions) if index is not None]
        initial = np.tile(self._template, (count, 1))
        start = np.zeros((count, self._model.nq))
        start[:, known] = observations[:, [index for index in layout.positions if index is not None]]
        initial[:, self._positions] = start
        initial[:, self._velocities] = observations[:, list(layout.velocities)]
        control = np.repeat(np.asarray(actions, dtype=np.float64), self._frame_skip, axis=1)
        states, _ = mujoco.rollout.rollout(self._model, self._data, initial, control)
        states = states[:, self._frame_skip - 1 :: self._frame_skip]
        positions = states[..., self._positions]

        result = np.repeat(np.asarray(observations, dtype=np.float64)[:, None], horizon, axis=1)
        result[..., [index for index in layout.positions if index is not None]] = positions[..., known]
        result[..., list(layout.velocities)] = states[..., self._velocities]
        before = np.concatenate([start[:, None], positions[:, :-1]], axis=1)
        for index, joint in layout.rates:
            result[..., index] = (positions[..., joint] - before[..., joint]) / self._time_step
        return result


def _check_layout(layout: SimulatorLayout, model: mujoco.MjModel, size: int) -> None:
    """Raise ValueError unless the layout names every position and velocity of the model, within the observation."""
    named: Sequence[int] = [
        *(index for index in layout.positions if index is not None),
        *layout.velocities,
        *(index for index, _ in layout.rates),
    ]
    counts = len(layout.positions), len(layout.velocities)
    if counts != (model.nq, model.nv):
        raise ValueError(
            f"simulator_layout must name {model.nq} positions and {model.nv} velocities, received {counts[0]} and "
            f"{counts[1]}"
        )
    joints = [joint for _, joint in layout.rates]
    if (
        len(set(named)) != len(named)
        or not all(0 <= i < size for i in named)
        or not all(0 <= j < model.nq for j in joints)
    ):
        raise ValueError(
            f"simulator_layout must hold distinct indices into the {size} numbers of the observation (and rates of "
            f"the {model.nq} positions), received {layout}"
        )
