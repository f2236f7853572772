"""Settings as data: keyword arguments of an agent for a task, by the environment's id."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from gymnasium.envs.registration import find_highest_version

from gym_dgpmpc.dynamics.deep_gp import DeepGPDynamics
from gym_dgpmpc.planning.registry import settings_of_others
from gym_dgpmpc.settings import of_member, settings_of


def _paper(horizon: int, num_iterations: int, actions_per_plan: int) -> MappingProxyType[str, Any]:
    """What the paper holds fixed over its tasks, and what it does not."""
    return MappingProxyType(
        {
            "num_candidates": 300,
            "num_elites": 30,
            "num_particles": 5,
            "horizon": horizon,
            "num_iterations": num_iterations,
            "actions_per_plan": actions_per_plan,
        }
    )


_CART_POLE = _paper(horizon=30, num_iterations=5, actions_per_plan=1)
_REACHER = _paper(horizon=20, num_iterations=5, actions_per_plan=1)
_HALF_CHEETAH = _paper(horizon=40, num_iterations=10, actions_per_plan=2)

PAPER = MappingProxyType(
    {
        "ModCartPole-v0": _CART_POLE,
        "SwingUpCartPole-v0": _CART_POLE,
        "Reacher7DoF-v0": _REACHER,
        "BiasedReacher-v0": _REACHER,
        "VelocityHalfCheetah-v0": _HALF_CHEETAH,
        "RiskSensitiveHalfCheetah-v0": _HALF_CHEETAH,
    }
)
"""The planning settings of Gadd et al. (2020); layers and kernel are what the paper compares, so they are not here. Nor
is its number of inducing points, 200: half as many predict as well here (docs/calibration.md), in less than half of the
time."""


def _stock(**settings: Any) -> MappingProxyType[str, Any]:
    """Of a task of Gymnasium's own: what all have in common, and ``settings``."""
    return MappingProxyType({"num_layers": 2, "num_particles": 5, **settings})


STOCK = MappingProxyType(
    {
        "Pendulum-v1": _stock(horizon=30, num_candidates=300, num_iterations=5),
        "InvertedPendulum-v5": _stock(horizon=15, num_candidates=200, num_iterations=5, learning_starts=150),
        "InvertedDoublePendulum-v5": _stock(horizon=12, num_candidates=300, num_iterations=5, learning_starts=200),
        "Reacher-v5": _stock(horizon=15, num_candidates=200, num_iterations=4, learning_starts=150),
        "Swimmer-v5": _stock(horizon=20, num_candidates=200, num_iterations=4, actions_per_plan=2),
        "FetchReachDense-v4": _stock(
            num_inducing=64, horizon=8, num_candidates=100, num_iterations=3, learning_starts=100
        ),
    }
)
"""Settings of `DGPMPCAgent` for tasks of Gymnasium and Gymnasium-Robotics, the latter without the module before the id.

Horizons are long enough for what a task is about (half a swing of the pendulum, a reach) and no longer, because a plan
that is not corrected on its way cannot balance for long: that of the double pendulum is 0.6 s. The horizons of
Pendulum-v1, Reacher-v5 and Swimmer-v5 were tried with the true dynamics first, the others in single runs; all with seed
100. For the swimmer nothing that was tried is good enough: its settings are those that cost least.
Episodes that end early teach little, hence the numbers of random steps. docs/environments.md has what they earn.
"""


# With 24 inputs and one episode of data a longer training fits the accidents of the data.
_HALF_CHEETAHS_DEEP_GP = MappingProxyType({"linear": True, "first_training_iterations": 300})

DEEP_GP = MappingProxyType(
    {
        "VelocityHalfCheetah-v0": _HALF_CHEETAHS_DEEP_GP,
        "RiskSensitiveHalfCheetah-v0": _HALF_CHEETAHS_DEEP_GP,
        # Its dynamics are smooth, and a rough kernel is overconfident there after one episode.
        "Pendulum-v1": MappingProxyType({"kernel": "rbf"}),
    }
)
"""Settings of the deep Gaussian process for a task that are not the paper's, or not the defaults, and better
(docs/calibration.md)."""


_CART_POLE_PLANNING = MappingProxyType({"planner": "icem", "noise_beta": 1.0, "exploration": "held"})

PLANNING = MappingProxyType(
    {
        "ModCartPole-v0": _CART_POLE_PLANNING,
        "SwingUpCartPole-v0": _CART_POLE_PLANNING,
        # Seven torques over 20 steps: sampling stays far from the top.
        "BiasedReacher-v0": MappingProxyType({"planner": "gradient"}),
    }
)
"""How to plan and to explore where that earns more than the paper's way (docs/planning.md). Planning by gradients is
for draws of whole functions, as a deep Gaussian process has them; the rest is for any model."""


OF_A_TASK: tuple[Mapping[str, Mapping[str, Any]], ...] = (PAPER, STOCK, DEEP_GP, PLANNING)
"""What `settings_for` lays over each other, the later ones over the earlier."""


OWN_TASK = MappingProxyType({"planner": "icem", "noise_beta": 1.0, "horizon": 20, "exploration": "held"})
"""How to plan and to explore on a task that nobody has tried yet: over the first episodes of four tasks without their
presets it earns more than the paper's way, which is what agents do by default (docs/planning.md)."""


def _with_version(env_id: str) -> str:
    """The id that presets are under: without a module, and with the newest version where none is given."""
    task = env_id.rpartition(":")[2]
    newest = find_highest_version(None, task)
    return task if newest is None else f"{task}-v{newest}"


def settings_for(env_id: str | None = None, planner: str | None = None) -> Mapping[str, Any]:
    """Settings of `DGPMPCAgent` for a task: its presets, or `OWN_TASK` if it has none.

    Args:
        env_id: id of the environment, with or without a module before it that registers it
            ("gym_dgpmpc.envs.robotics:FetchReachDense-v4"); without a version it is the newest registered one, as in
            `gymnasium.make`. None: a task of one's own.
        planner: name of a planner in the place of the task's; settings that it does not have are left out.

    Raises:
        ValueError: no planner is registered under this name.
    """
    task = "" if env_id is None else _with_version(env_id)
    settings = {name: value for table in OF_A_TASK for name, value in table.get(task, {}).items()} or dict(OWN_TASK)
    if planner is not None:
        settings["planner"] = planner
    others = settings_of_others(settings.get("planner", "cem"))
    return {name: value for name, value in settings.items() if name not in others}


REAL_TIME = MappingProxyType(
    {"ModCartPole-v0": MappingProxyType({"num_candidates": 192, "num_elites": 19, "num_iterations": 4})}
)
"""Planning settings quick enough for a plant's own clock, to be laid over others: 25 plans a second at L = 2."""


def _networks(hidden: tuple[int, int], decay: tuple[float, ...], learning_rate: float) -> dict[str, Any]:
    """An ensemble's layers and how they are trained."""
    layers, size = hidden
    return {
        "num_hidden_layers": layers,
        "hidden_size": size,
        "weight_decay": decay,
        "learning_rate": learning_rate,
    }


_CART_POLE_NETWORKS = _networks((3, 500), (1e-4, 2.5e-4, 2.5e-4, 5e-4), 1e-3)
_REACHER_NETWORKS = _networks((4, 200), (2.5e-4, 5e-4, 5e-4, 5e-4, 7.5e-4), 7.5e-4)
_HALF_CHEETAH_NETWORKS = _networks((4, 200), (2.5e-5, 5e-5, 7.5e-5, 7.5e-5, 1e-4), 1e-3)

NETWORKS = {
    "ModCartPole-v0": _CART_POLE_NETWORKS,
    "SwingUpCartPole-v0": _CART_POLE_NETWORKS,
    "Reacher7DoF-v0": _REACHER_NETWORKS,
    "BiasedReacher-v0": _REACHER_NETWORKS,
    "VelocityHalfCheetah-v0": _HALF_CHEETAH_NETWORKS,
    "RiskSensitiveHalfCheetah-v0": _HALF_CHEETAH_NETWORKS,
}
"""The networks of Chua et al. (2018) by task, and how they are trained, for `PETSAgent` and `EnsembleDynamics`."""


def _published(env_id: str) -> MappingProxyType[str, Any]:
    is_cheetah = "HalfCheetah" in env_id
    planning = {
        "num_candidates": 500 if is_cheetah else 400,
        "num_elites": 50 if is_cheetah else 40,
        "num_iterations": 5,
        "horizon": 30 if is_cheetah else 25,
        "actions_per_plan": 1,
        "num_particles": 20,
    }
    return MappingProxyType({**NETWORKS[env_id], **planning})


PETS = MappingProxyType({env_id: _published(env_id) for env_id in NETWORKS})
"""The settings of Chua et al. (2018), for `PETSAgent`: networks, their training, and planning."""

COMPARISON_PETS = MappingProxyType(
    {env_id: MappingProxyType({**networks, **PAPER[env_id]}) for env_id, networks in NETWORKS.items()}
)
"""`PETSAgent` as in the comparison of Gadd et al.: PETS's networks, their planning, and one particle per network."""

COMPARISON_GP = MappingProxyType(
    {env_id: MappingProxyType({**settings, "num_inducing": 200}) for env_id, settings in PAPER.items()}
)
"""`GPMPCAgent` as in the comparison of Gadd et al.: their planning and number of inducing points."""


def for_mixture(of_deep_gp: Mapping[str, Any], of_ensemble: Mapping[str, Any]) -> Mapping[str, Any]:
    """Settings of a `DGPMPCAgent`, or of its model, and of an ensemble as those of a mixture of both models.

    What is no setting of the deep Gaussian process, such as the planner's, stays as it is.
    """
    known = settings_of(DeepGPDynamics)
    mixed = {of_member("deep-gp", name) if name in known else name: value for name, value in of_deep_gp.items()}
    return mixed | {of_member("ensemble", name): value for name, value in of_ensemble.items()}


def mixture_settings_for(env_id: str) -> Mapping[str, Any]:
    """Settings of `MixtureMPCAgent` for a task: those of `settings_for`, and PETS's networks, as far as there are any.

    Args:
        env_id: as in `settings_for`.
    """
    # Networks have fresh noise at each call, with which L-BFGS does not climb.
    climbs = settings_for(env_id).get("planner") == "gradient"
    return for_mixture(settings_for(env_id, "cem" if climbs else None), NETWORKS.get(_with_version(env_id), {}))


POLICY_SEARCH = MappingProxyType(
    {
        "ModCartPole-v0": MappingProxyType({"exploration": "held", "search_horizon": 75}),
        "SwingUpCartPole-v0": MappingProxyType({"exploration": "held", "search_horizon": 75}),
    }
)
"""Settings of `MCPILCOAgent`, `DeepPILCOAgent` and `PILCOAgent` that spare time: they search by the first three of
these tasks' eight seconds, in which a pole can be swung up. Nothing was measured with them."""


def policy_search_settings_for(env_id: str) -> Mapping[str, Any]:
    """Settings of `MCPILCOAgent`, `DeepPILCOAgent` and `PILCOAgent` for a task, none if it has no preset.

    Args:
        env_id: as in `settings_for`.
    """
    return POLICY_SEARCH.get(_with_version(env_id), {})
