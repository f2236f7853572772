"""The simulated cart-pole on which MC-PILCO and its predecessors are compared: `python -m benchmarks.outside`.

Amadio et al. (2022), "Model-Based Policy Search Using Monte Carlo Gradient Estimation With Real Systems Application": a
trial is 3 s at 20 Hz, all that is observed is noisy, and a trial succeeds if the pole stands for its whole last second.
One trial of random forces, then five of the learned controller. Writes `outside.md` and `outside.json`; what is in the
latter already is not done again.
"""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Float
from numpy import ndarray
from scipy.integrate import solve_ivp
from torch import Tensor

from benchmarks import RESULTS
from benchmarks.report import markdown
from benchmarks.rows import Row, made_by, measure_missing
from gym_dgpmpc import DeepPILCOAgent, DGPMPCAgent, MCPILCOAgent, PILCOAgent
from gym_dgpmpc.agents import MPCAgent
from gym_dgpmpc.agents.presets import settings_for
from gym_dgpmpc.runs.provenance import revision
from gym_dgpmpc.types import ObservationSpec

CART, POLE = 0.5, 0.5
"""Masses in kg."""
LENGTH, FRICTION, GRAVITY = 0.5, 0.1, 9.81
"""Of the pole in m, of the cart in N s/m, in m/s^2."""

FORCE, STEP, STEPS = 10.0, 0.05, 60
"""The greatest force in N, the length of a step in s, and the steps of a trial."""

LAST_STEPS, FROM_MIDDLE, FROM_UPRIGHT = 20, 0.1, np.radians(10.0)
"""Over so many steps a trial that succeeds is within so many m of the middle and rad of upright."""

TRIALS = 5
"""Of the learned controller, after a random one."""


def derivative(_: float, state: ndarray, force: float) -> list[float]:
    """Of (x, x', theta, theta'), in SI units: a uniform pole on a cart with viscous friction; theta = 0 hangs down."""
    _, speed, angle, rate = state
    sine, cosine = np.sin(angle), np.cos(angle)
    push = force - FRICTION * speed
    inertia = 4 * (CART + POLE) - 3 * POLE * cosine**2
    acceleration = (2 * POLE * LENGTH * rate**2 * sine + 3 * POLE * GRAVITY * sine * cosine + 4 * push) / inertia
    turning = 3 * POLE * LENGTH * rate**2 * sine * cosine + 6 * (CART + POLE) * GRAVITY * sine + 6 * push * cosine
    return [speed, acceleration, rate, -turning / (LENGTH * inertia)]


class OutsideCartPole(gymnasium.Env[ndarray, ndarray]):
    """Swing the pole up in the middle: 60 steps from rest, hanging down; the agent is told of the noisy state alone.

    Args:
        noise: standard deviation of each observed number's noise.

    Attributes:
        path: true states of the running trial, [4] each.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (Gymnasium demands a dict)

    def __init__(self, noise: float = 0.01):
        self.noise = noise
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.action_space = spaces.Box(-FORCE, FORCE, (1,), np.float32)
        self.observation_spec = ObservationSpec(angles=(2,))
        self.path: list[ndarray] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ndarray, dict]:
        super().reset(seed=seed)
        self.path = [0.01 * self.np_random.standard_normal(4)]
        return self._observation(), {}

    @staticmethod
    def reward_fn(
        observation: Float[Tensor, "*b 4"], action: Float[Tensor, "*b 1"], next_observation: Float[Tensor, "*b 4"]
    ) -> Float[Tensor, "*b"]:
        """One less the cost of the paper: exp(-((|theta| - pi) / 3)^2 - x^2)."""
        position, angle = next_observation[..., 0], next_observation[..., 2]
        return torch.exp(-((angle.abs() - torch.pi) / 3.0).square() - position.square())

    def step(self, action: ndarray) -> tuple[ndarray, float, bool, bool, dict[str, Any]]:
        force = float(np.clip(np.asarray(action).ravel()[0], -FORCE, FORCE))
        solution = solve_ivp(derivative, (0.0, STEP), self.path[-1], args=(force,), rtol=1e-8, atol=1e-10)
        self.path.append(solution.y[:, -1])
        observation = self._observation()
        told = torch.as_tensor(observation)
        reward = float(self.reward_fn(told, torch.zeros(1, dtype=told.dtype), told))
        return observation, reward, False, len(self.path) > STEPS, {"succeeded": self.succeeded()}

    def succeeded(self) -> bool:
        """Whether the trial is over and stood within the bounds for its whole last second, in its true states."""
        if len(self.path) <= STEPS:
            return False
        last = np.array(self.path[-LAST_STEPS:])
        from_upright = np.abs(np.abs(last[:, 2]) - np.pi)
        return bool(np.all((np.abs(last[:, 0]) < FROM_MIDDLE) & (from_upright < FROM_UPRIGHT)))

    def _observation(self) -> ndarray:
        return (self.path[-1] + self.noise * self.np_random.standard_normal(4)).astype(np.float32)


ENV_ID = "OutsideCartPole-v0"
if ENV_ID not in gymnasium.registry:  # as it is when this module runs, and is imported by `gymnasium.make` then
    gymnasium.register(ENV_ID, "benchmarks.outside:OutsideCartPole", max_episode_steps=STEPS)

CHOSEN: Mapping[str, Any] = {**settings_for(), "horizon": 15, "noise_beta": 0.5, "num_iterations": 8, "kernel": "rbf"}
"""Settings of DGP-MPC that were chosen for this task, on seeds 100 to 104."""

METHODS: Mapping[str, Callable[..., MPCAgent]] = MappingProxyType(
    {
        "DGP-MPC": DGPMPCAgent,
        "DGP-MPC, settings_for()": partial(DGPMPCAgent, **settings_for()),
        "DGP-MPC, chosen": partial(DGPMPCAgent, **CHOSEN),
        "MC-PILCO": MCPILCOAgent,
        "MC-PILCO, deep GP": partial(MCPILCOAgent, num_layers=2, kernel="matern32"),
        "DeepPILCO": DeepPILCOAgent,
        "PILCO": PILCOAgent,
    }
)
"""By name, with the defaults of their classes but for what is said here."""


class Trials(gymnasium.Wrapper[ndarray, ndarray, ndarray, ndarray]):
    """Keeps the return of each trial that is over, and whether it succeeded."""

    keeps_actions = keeps_observations = True

    def __init__(self, env: gymnasium.Env[ndarray, ndarray]):
        super().__init__(env)
        self.returns: list[float] = []
        self.succeeded: list[bool] = []
        self._return = 0.0

    def step(self, action: ndarray) -> tuple[ndarray, float, bool, bool, dict[str, Any]]:
        after = self.env.step(action)
        self._return += float(after[1])
        if after[3]:
            self.returns.append(self._return)
            self.succeeded.append(after[4]["succeeded"])
            self._return = 0.0
        return after  # type: ignore[return-value]


def measure(wanted: Row) -> Row:
    """One agent's trials."""
    started = time.process_time()
    env = Trials(gymnasium.make(ENV_ID))
    agent = METHODS[wanted["method"]](env, learning_starts=STEPS, seed=wanted["seed"])
    agent.learn((1 + TRIALS) * STEPS)
    return {
        "returns": env.returns[1:],
        "succeeded": env.succeeded[1:],
        "cpu_minutes": (time.process_time() - started) / 60,
        "revision": revision(),
    }


def page(rows: Sequence[Row]) -> str:
    """How many seeds succeed in each trial, and what they earn."""
    header = ["method", "seeds", *(f"trial {i + 1}" for i in range(TRIALS)), "mean returns", "CPU minutes", "revision"]
    cells = []
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        succeeded = np.sum([row["succeeded"] for row in own], axis=0)
        returns = np.mean([row["returns"] for row in own], axis=0)
        minutes = float(np.mean([row["cpu_minutes"] for row in own]))
        cells.append(
            [
                method, ", ".join(str(row["seed"]) for row in own), *(f"{n} of {len(own)}" for n in succeeded),
                ", ".join(markdown.number(each, 1) for each in returns), markdown.number(minutes, 1),
                ", ".join(sorted({str(row["revision"]) for row in own})),
            ]
        )  # fmt: skip
    return "\n".join([made_by(rows), "", *markdown.table(header, cells)]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.outside", description=__doc__)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS), metavar="METHOD")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(20, 30)))
    parser.add_argument("--jobs", type=int, default=1, help="measurements at a time, each of one thread")
    parser.add_argument("--results", type=Path, default=RESULTS / "outside")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    wanted: list[Row] = [{"method": method, "seed": seed} for seed in arguments.seeds for method in arguments.methods]
    print(measure_missing("outside", arguments.results, wanted, measure, page=page, jobs=arguments.jobs))


if __name__ == "__main__":
    main()
