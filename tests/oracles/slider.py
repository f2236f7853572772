"""A mass on a rail as MuJoCo simulates it, and the same as the linear system that it is.

With MuJoCo's Euler integrator, which takes the damping d implicitly, one step of length h under the force u is

    v' = v + h (u - d v) / (m + h d),    x' = x + h v'.

The third number of an observation is a constant that nothing depends on.
"""

from types import SimpleNamespace

import mujoco
import numpy as np
import torch
from gymnasium import spaces

from gym_dgpmpc.envs.simulator import SimulatorLayout
from gym_dgpmpc.types import ObservationSpec, Transitions

MASS, DAMPING, TIME_STEP = 1.5, 0.8, 0.25
SPEC = ObservationSpec(constant=(2,))
CONSTANT = 0.7

_XML = f"""
<mujoco>
  <option timestep="{TIME_STEP}" integrator="Euler" gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="slide" type="slide" axis="1 0 0" damping="{DAMPING}"/>
      <inertial pos="0 0 0" mass="{MASS}" diaginertia="1 1 1"/>
    </body>
  </worldbody>
  <actuator><motor joint="slide"/></actuator>
</mujoco>
"""

_GAIN = TIME_STEP / (MASS + TIME_STEP * DAMPING)
A = np.array([[1.0, TIME_STEP * (1 - _GAIN * DAMPING), 0.0], [0.0, 1 - _GAIN * DAMPING, 0.0], [0.0, 0.0, 1.0]])
B = np.array([[TIME_STEP * _GAIN], [_GAIN], [0.0]])


def environment():
    """What of an environment its simulator needs."""
    return SimpleNamespace(
        model=mujoco.MjModel.from_xml_string(_XML),
        frame_skip=1,
        observation_space=spaces.Box(-np.inf, np.inf, (3,)),
        simulator_layout=SimulatorLayout((0,), (1,)),
    )


def transitions(num_steps, noise_std, seed=0):
    """Independent transitions from states spread over [-2, 2], with Gaussian noise on position and velocity."""
    rng = np.random.default_rng(seed)
    state = np.column_stack([rng.uniform(-2, 2, (num_steps, 2)), np.full(num_steps, CONSTANT)])
    action = rng.uniform(-1, 1, (num_steps, 1))
    noise = np.column_stack([noise_std * rng.standard_normal((num_steps, 2)), np.zeros(num_steps)])
    after = state @ A.T + action @ B.T + noise
    return Transitions(*(torch.tensor(part, dtype=torch.float32) for part in (state, action, after)))
