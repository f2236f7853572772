"""`python -m gym_dgpmpc.zoo COMMAND ...`: the RL Zoo's commands (`rl_zoo3`), which then know this package's agents.

    python -m gym_dgpmpc.zoo train --algo dgp-mpc --env ModCartPole-v0
    python -m gym_dgpmpc.zoo enjoy --algo dgp-mpc --env ModCartPole-v0 -f logs

Agents are called as in `dgpmpc train --agent`, with "pets" and "gp-mpc" besides. Their hyperparameters are the presets
of the task, unless a file is given (``--conf-file``); ``-optimize`` searches those of `SEARCHED` with Optuna.
"""

import runpy
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import MappingProxyType, ModuleType, SimpleNamespace
from typing import Any, Protocol, runtime_checkable

import gymnasium
from stable_baselines3.common.vec_env import VecEnv

from gym_dgpmpc.agents import GPMPCAgent, MPCAgent, PETSAgent, presets
from gym_dgpmpc.cli.options import AGENTS, Trained, value_given
from gym_dgpmpc.cli.request import DEFAULT_EPISODES
from gym_dgpmpc.envs.registration import ENVIRONMENTS
from gym_dgpmpc.extras import how_to_install
from gym_dgpmpc.policy_search.controller import MomentSearchController, PolicySearchController

COMMANDS = {
    **{name: f"rl_zoo3.{name}" for name in ("train", "enjoy", "record_video", "push_to_hub", "load_from_hub")},
    **{name: f"rl_zoo3.plots.{name}" for name in ("all_plots", "plot_train", "plot_from_file")},
}
"""The zoo's commands, with the module of each."""


def _of_table(table: Mapping[str, Mapping[str, Any]], env_id: str) -> Mapping[str, Any]:
    return table.get(env_id, {})


ALGORITHMS: Mapping[str, Trained] = MappingProxyType(
    {
        **AGENTS,
        "pets": Trained(PETSAgent, partial(_of_table, presets.PETS)),
        "gp-mpc": Trained(GPMPCAgent, partial(_of_table, presets.COMPARISON_GP)),
    }
)
"""What ``--algo`` may name beside the algorithms of Stable-Baselines3 and sb3-contrib."""

DEFAULT_TIMESTEPS = 3_000
"""Of a task that is not known here, or does not say how long an episode is."""


@runtime_checkable
class Trial(Protocol):
    """What is used of an `optuna.Trial`."""

    def suggest_int(self, name: str, low: int, high: int, *, log: bool = False) -> int:
        """An integer from ``low`` to ``high``."""

    def suggest_categorical(self, name: str, choices: Sequence[str]) -> str:
        """One of ``choices``."""


SEARCHED: Mapping[str, Callable[[Trial, str], Any]] = MappingProxyType(
    {
        "horizon": lambda trial, name: trial.suggest_int(name, 8, 40, log=True),
        "num_iterations": lambda trial, name: trial.suggest_int(name, 3, 10),
        "num_particles": lambda trial, name: trial.suggest_int(name, 3, 15, log=True),
        "exploration": lambda trial, name: trial.suggest_categorical(name, ["uniform", "held", "coloured"]),
        "num_layers": lambda trial, name: trial.suggest_int(name, 1, 3),
        "kernel": lambda trial, name: trial.suggest_categorical(name, ["matern12", "matern32", "matern52", "rbf"]),
        "num_inducing": lambda trial, name: trial.suggest_int(name, 50, 200, log=True),
        "search_steps": lambda trial, name: trial.suggest_int(name, 50, 400, log=True),
        "num_centres": lambda trial, name: trial.suggest_int(name, 20, 200, log=True),
    }
)
"""Settings that ``-optimize`` searches where an agent has them: which matter most, and what a trial takes of each."""

OF_THE_PLANNER = frozenset({"horizon", "num_iterations", "num_particles"})
"""Settings that do nothing where a policy acts that is searched."""


def hyperparameters(algorithm: str) -> dict[str, dict[str, Any]]:
    """By task, what the zoo reads: an agent's presets, the policy's name, and how many steps to learn.

    "default" is the zoo's name for every other task.

    Args:
        algorithm: a name of `ALGORITHMS`.
    """
    tasks = (*ENVIRONMENTS, *presets.STOCK, "default")
    return {task: {**ALGORITHMS[algorithm].settings_for(task), **_run(task)} for task in tasks}


def _run(env_id: str) -> dict[str, Any]:
    """What does not depend on the agent. Episodes are as many as `dgpmpc train` plays, after a random one."""
    spec = gymnasium.registry.get(env_id)
    length = spec.max_episode_steps if spec else None
    steps = DEFAULT_TIMESTEPS if length is None else (1 + DEFAULT_EPISODES) * length
    return {"policy": "MPCPolicy", "n_timesteps": steps}


def sample(algorithm: str, trial: Trial, *_: Any) -> dict[str, Any]:
    """Hyperparameters of a trial, as the zoo asks for them; further arguments are of no use here."""
    agent_class = ALGORITHMS[algorithm].agent_class
    names = {**agent_class.own_settings(), **agent_class.part_settings()}.keys() & SEARCHED.keys()
    if issubclass(agent_class.controller_class, PolicySearchController):
        names -= OF_THE_PLANNER
    if agent_class.controller_class is MomentSearchController:
        names -= {"kernel"}  # whose moments are those of RBF kernels
    return {name: suggest(trial, name) for name, suggest in SEARCHED.items() if name in names}


def _conf(algorithm: str) -> str:
    """The module that the zoo reads an agent's hyperparameters from."""
    return f"{__package__}.zoo_{algorithm}"


def register() -> None:
    """Add agents, their hyperparameters and what Optuna searches of them to the zoo.

    Raises:
        ModuleNotFoundError: `rl_zoo3` is not installed.
    """
    from rl_zoo3 import ALGOS
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    for name, algorithm in ALGORITHMS.items():
        ALGOS[name] = algorithm.agent_class
        HYPERPARAMS_SAMPLER[name] = partial(sample, name)
        HYPERPARAMS_CONVERTER[name] = dict
        module = ModuleType(_conf(name))
        vars(module)["hyperparams"] = hyperparameters(name)
        sys.modules[module.__name__] = module


def _enjoy_with_environments() -> None:
    """Let `enjoy`, which loads agents without an environment, load ours with the one that it has made: they plan by
    its reward."""
    import rl_zoo3

    made: list[VecEnv] = []
    make = rl_zoo3.create_test_env

    def remembered(*args: Any, **kwargs: Any) -> VecEnv:
        made.append(make(*args, **kwargs))
        return made[-1]

    def loaded(agent_class: type[MPCAgent], path: str, **kwargs: Any) -> MPCAgent:
        return agent_class.load(path, made[-1], **kwargs)

    rl_zoo3.create_test_env = remembered
    for name, algorithm in ALGORITHMS.items():
        rl_zoo3.ALGOS[name] = SimpleNamespace(load=partial(loaded, algorithm.agent_class))


def with_presets(command: str, arguments: Sequence[str]) -> list[str]:
    """The arguments of a command, before them the presets of an agent of ours: a file that is named later wins."""
    algorithm = value_given("--algo", arguments) or ""
    is_ours = command == "train" and algorithm in ALGORITHMS
    return ["--conf-file", _conf(algorithm), *arguments] if is_ours else list(arguments)


def main() -> None:
    """Run a command of the zoo."""
    command, *arguments = sys.argv[1:] or ["--help"]
    if command not in COMMANDS:
        wrong = "" if command in ("-h", "--help") else f"There is no command {command!r}. "
        print(f"{wrong}usage: python -m gym_dgpmpc.zoo {{{','.join(COMMANDS)}}} ...", file=sys.stderr)
        print("Its agents (--algo), beside those of the RL Zoo: " + ", ".join(ALGORITHMS), file=sys.stderr)
        sys.exit(2 if wrong else 0)
    try:
        register()
    except ModuleNotFoundError as error:
        sys.exit(f"error: {error.name} is not installed, which the RL Zoo's commands need: {how_to_install('rl_zoo3')}")
    if command == "enjoy":
        _enjoy_with_environments()
    sys.argv = [f"{sys.argv[0]} {command}", *with_presets(command, arguments)]
    runpy.run_module(COMMANDS[command], run_name="__main__")


if __name__ == "__main__":
    main()
