"""The suites, as data: which methods run on which tasks, for how many episodes and with which seeds."""

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

from benchmarks import RESULTS, paper
from benchmarks.contact.data import CASES
from benchmarks.contact.result_files import ContactKey, ContactSettings
from benchmarks.contact.study import ContactRun
from benchmarks.jobs import Job
from benchmarks.methods import METHODS, PlanningMethod, dgp_mpc
from benchmarks.run import Run
from benchmarks.tasks import TASKS
from gym_dgpmpc.agents import DGPMPCAgent, presets
from gym_dgpmpc.errors import DGPMPCError

PAPER_SEEDS = tuple(range(paper.TRIALS))

BASELINES = ("PETS TS1", "PETS TSinf", "GP-MM", "GP-DS", "SAC", "TD3", "PPO")
FAIR = (
    "PETS TSinf",
    "PETS TSinf to its optimum",
    "GP-MM",
    "GP-MM with noise",
    "GP-DS with noise",
    "SAC",
    "TD3",
    "CrossQ",
    "TQC",
    "PPO",
)
"""Others as published and with the training, or the noise, that serves them best."""
AT_THEIR_BEST = frozenset(
    {
        *(dgp_mpc(layers, "matern32") for layers in (1, 2, 3)),
        "PETS TSinf to its optimum",
        "GP-MM with noise",
        "GP-DS with noise",
    }
)
"""Of the fair suite, the methods that are not there as published: all of them plan and explore alike."""
FAIR_SEEDS = tuple(range(20, 30))
"""Used for reporting alone: nothing was developed on them."""
STOCK_TASKS = {
    "Pendulum-v1": 6,
    "Pendulum-v1:learned reward": 6,
    "InvertedPendulum-v5": 5,
    "InvertedDoublePendulum-v5": 6,
    "Reacher-v5": 10,
    "Swimmer-v5": 10,
    "FetchReachDense-v4": 10,
}
"""Gymnasium's own tasks, and the episodes on each after a random one."""
STOCK_TIMES = 10
"""SAC gets this many times the steps of DGP-MPC."""


class SuiteError(DGPMPCError, ValueError):
    """A suite, or a task or method of it, does not exist."""


class Selection(NamedTuple):
    """The part of a suite that is asked for; None is all of it. Tasks and methods may be patterns, such as "PETS*"."""

    seeds: Sequence[int] | None = None
    tasks: Sequence[str] | None = None
    methods: Sequence[str] | None = None
    episodes: int | None = None


@runtime_checkable
class Suite(Protocol):
    """Jobs that belong together."""

    @property
    def title(self) -> str:
        """A description on one line."""

    @property
    def results(self) -> Path:
        """Default folder of the results; a report is made from a folder."""

    def jobs(self, selection: Selection) -> Sequence[Job]:
        """The jobs that are asked for.

        Raises:
            SuiteError: the suite does not have what is asked for.
        """


class Cell(NamedTuple):
    """A method on a task, with every seed."""

    method: str
    task: str
    episodes: int
    times: int = 1
    steps_of: str | None = None
    """For ``times`` and ``steps_of`` see `Run`."""


@dataclass(frozen=True)
class RunSuite:
    """A suite of runs.

    Attributes:
        name: what the command line calls it.
        title: a description on one line.
        cells: methods on tasks.
        seeds: every cell is run with each of them.
        results: default folder of the results, one for all suites of runs that share runs.
        plan_better: methods that plan and explore by `presets.PLANNING` in place of the paper's way.
    """

    name: str
    title: str
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...] = PAPER_SEEDS
    results: Path = RESULTS / "runs"
    plan_better: frozenset[str] = frozenset()

    def jobs(self, selection: Selection) -> list[Run]:
        """The runs, seeds outermost, so that an interrupted suite has every cell with some seeds.

        Raises:
            SuiteError: a task or a method that is asked for is not in the suite.
        """
        tasks = _chosen("task", [cell.task for cell in self.cells], selection.tasks)
        methods = _chosen("method", [cell.method for cell in self.cells], selection.methods)
        cells = [cell for cell in self.cells if cell.task in tasks and cell.method in methods]
        if not cells:
            raise SuiteError(f"{self.name} has none of the methods {sorted(methods)} on {sorted(tasks)}")
        seeds = self.seeds if selection.seeds is None else selection.seeds
        return [self._run(cell, seed, selection.episodes) for seed in seeds for cell in cells]

    def _run(self, cell: Cell, seed: int, episodes: int | None) -> Run:
        options = ["--tasks", cell.task, "--methods", cell.method, "--seeds", str(seed)]
        options += [] if episodes is None else ["--episodes", str(episodes)]
        task = TASKS[cell.task]
        asked = _better_planning(cell.method, task.preset) if cell.method in self.plan_better else {}
        return Run(
            cell.method,
            task,
            seed,
            cell.episodes if episodes is None else episodes,
            cell.times,
            cell.steps_of,
            asked,
            command=shlex.join(["dgpmpc", "bench", self.name, *options]),
        )


def _better_planning(method: str, task: str) -> Mapping[str, Any]:
    """`presets.PLANNING`; but methods whose draws have fresh noise at each call do not climb by L-BFGS."""
    better: Mapping[str, Any] = presets.PLANNING.get(task, {})
    chosen = METHODS[method]
    draws_functions = isinstance(chosen, PlanningMethod) and chosen.make_agent is DGPMPCAgent
    return {} if better.get("planner") == "gradient" and not draws_functions else better


@dataclass(frozen=True)
class ContactSuite:
    """The contact study: its tasks are its cases, its methods are depths and kernels. It has no episodes."""

    title: str = "deep Gaussian processes that predict a cart at the end of its rail: 4 kernels, L = 1, 2, 3, 3 cases"
    results: Path = RESULTS / "contact"
    settings: ContactSettings = field(default_factory=ContactSettings)

    def jobs(self, selection: Selection) -> list[ContactRun]:
        """The runs, seeds outermost.

        Raises:
            SuiteError: the study does not have a case or a model that is asked for, or episodes are asked for.
        """
        if selection.episodes is not None:
            raise SuiteError(f"the contact study has no episodes, got episodes={selection.episodes}")
        keys = [
            ContactKey(case, kernel, layers, seed)
            for seed in (PAPER_SEEDS if selection.seeds is None else selection.seeds)
            for case in CASES
            for kernel in paper.KERNELS
            for layers in paper.LAYERS
        ]
        tasks = _chosen("task", [key.task for key in keys], selection.tasks)
        methods = _chosen("method", [key.method for key in keys], selection.methods)
        return [ContactRun(key, self.settings) for key in keys if key.task in tasks and key.method in methods]


def _chosen(what: str, names: Iterable[str], asked: Sequence[str] | None) -> set[str]:
    """The names that match one of the patterns; all of them without patterns."""
    there = sorted(set(names))
    if asked is None:
        return set(there)
    for pattern in asked:
        if not any(fnmatchcase(name, pattern) for name in there):
            raise SuiteError(f"there is no {what} {pattern!r} in this suite: expected some of {', '.join(there)}")
    return {name for name in there if any(fnmatchcase(name, pattern) for pattern in asked)}


def _paper(methods: Iterable[str]) -> tuple[Cell, ...]:
    """Methods on the paper's tasks."""
    methods = tuple(methods)
    return tuple(Cell(method, task, episodes) for task, episodes in paper.EPISODES.items() for method in methods)


def _stock() -> tuple[Cell, ...]:
    method = dgp_mpc(2, "matern32")
    planned = [Cell(method, task, episodes) for task, episodes in STOCK_TASKS.items()]
    # SAC does not know the reward function, so a task with a learned one is the same task to it.
    model_free = [
        Cell("SAC", task, episodes, STOCK_TIMES, steps_of=method)
        for task, episodes in STOCK_TASKS.items()
        if ":" not in task
    ]
    return (*planned, *model_free)


_COMPARED = (dgp_mpc(2, "matern32"), dgp_mpc(3, "matern32"), *BASELINES)

_OF_RUNS = (
    RunSuite(
        "table",
        "average episode return by kernel and layers on the paper's three tasks",
        _paper(dgp_mpc(layers, kernel) for kernel in paper.KERNELS for layers in paper.LAYERS),
    ),
    RunSuite(
        "comparison",
        "every method on the paper's three tasks, and the true dynamics as the ceiling",
        _paper((*_COMPARED, "true dynamics")),
    ),
    RunSuite(
        "fair",
        "the paper's tasks with seeds that nothing was developed on, every method trained as long as it needs",
        (
            *_paper((dgp_mpc(2, "matern32"), dgp_mpc(3, "matern32"), *FAIR)),
            Cell(dgp_mpc(1, "matern32"), "BiasedReacher-v0", paper.EPISODES["BiasedReacher-v0"]),
        ),
        seeds=FAIR_SEEDS,
        results=RESULTS / "fair",
        plan_better=AT_THEIR_BEST,
    ),
    RunSuite(
        "variance",
        "how much the average episode return of every method varies over seeds",
        _paper(_COMPARED),
    ),
    RunSuite(
        "unmodified",
        "the cart-pole in the middle of its rail: RBF kernels, and PETS as published",
        (
            *(Cell(dgp_mpc(layers, "rbf"), "SwingUpCartPole-v0", 15) for layers in paper.LAYERS),
            Cell("PETS as published", "SwingUpCartPole-v0", 15),
        ),
    ),
    RunSuite(
        "long-cheetah",
        "the half cheetah beyond small samples",
        tuple(
            Cell(dgp_mpc(layers, "matern32"), "RiskSensitiveHalfCheetah-v0:50 episodes", 50) for layers in paper.LAYERS
        ),
    ),
    RunSuite(
        "stock",
        f"Gymnasium's own tasks, against SAC with {STOCK_TIMES} times the steps",
        _stock(),
        seeds=(0, 1, 2),
    ),
)

SUITES: Mapping[str, Suite] = {**{suite.name: suite for suite in _OF_RUNS}, "contact": ContactSuite()}
"""All suites by name."""


def find_suite(name: str) -> Suite:
    """The suite of that name.

    Raises:
        SuiteError: there is no suite of that name.
    """
    if name not in SUITES:
        raise SuiteError(f"there is no suite {name!r}: expected one of {', '.join(SUITES)}")
    return SUITES[name]
