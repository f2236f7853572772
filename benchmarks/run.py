"""One run of a method on a task with a seed: it leaves one result file, and continues where it was killed.

Agents that plan continue from the newest checkpoint in the run's own folder. Methods without a model take seconds to
minutes and start again.
"""

import json
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.jobs import Folders
from benchmarks.methods import METHODS, ModelFreeMethod, PlanningMethod, Settings, random_steps
from benchmarks.result_files import Actions, Episode, RunKey, RunResult
from benchmarks.tasks import Task
from gym_dgpmpc.errors import DGPMPCError, RunInUseError
from gym_dgpmpc.planning import PLANNERS
from gym_dgpmpc.runs.folder import EPISODES_FILE, EpisodeRow, RunFolder, read_rows
from gym_dgpmpc.runs.provenance import machine, revision, versions
from gym_dgpmpc.runs.recording import EpisodeRecorder
from gym_dgpmpc.runs.training import TrainingRun, step_limit

CHECKPOINT_EVERY = 250
"""Steps between checkpoints within an episode: the paper's half-cheetah has 1000 an episode, which may take hours."""

LOCK_SECONDS = 10.0
"""How long to wait for a run's folder: the system may still hold its lock for a process that was killed."""


class OtherRunError(DGPMPCError, ValueError):
    """A result file holds a run with other settings than those that are asked for."""


@dataclass(frozen=True)
class Run:
    """A `Job` that runs a method on a task.

    Attributes:
        method: name of the method, a key of `METHODS`.
        task: the task.
        seed: decides everything random.
        episodes: episodes to play, not counting random ones.
        times: for methods without a model: they get this many times the steps of a planning agent.
        steps_of: for methods without a model: the planning method whose steps on this task with this seed are meant.
            They are read from its result; without one, its episodes count as if none ended early.
        asked: settings in place of the method's own.
        command: the command that makes this run.

    Raises:
        ValueError: a method does not exist.
    """

    method: str
    task: Task
    seed: int
    episodes: int
    times: int = 1
    steps_of: str | None = None
    asked: Mapping[str, Any] = field(default_factory=dict)
    command: str = "Run(...).perform(...)"

    def __post_init__(self) -> None:
        for name in filter(None, (self.method, self.steps_of)):
            if name not in METHODS:
                raise ValueError(f"there is no method {name!r}: expected one of {', '.join(METHODS)}")

    @property
    def key(self) -> RunKey:
        """Identifies the run in its result file."""
        return RunKey(self.method, self.task.name, self.seed)

    @property
    def name(self) -> str:
        """Shown to the user, on one line."""
        return f"{self.task.name} | {self.method} | seed {self.seed}"

    @property
    def file_name(self) -> str:
        """Name of the result file."""
        return self.key.file_name

    @property
    def settings(self) -> Settings:
        """Every argument of the method."""
        return METHODS[self.method].settings(self.task, **self.asked)

    def _own_settings(self, made_with: Mapping[str, Any]) -> Settings:
        """The method's on this task, by the planner that ``made_with`` names, if any: no other one's settings count."""
        planner = {name: value for name, value in made_with.items() if name == "planner" and value in PLANNERS}
        return METHODS[self.method].settings(self.task, **planner)

    @property
    def max_steps(self) -> int:
        """Environment steps after which the run ends, in however many episodes."""
        if METHODS[self.method].is_model_free:
            return self.times * (random_steps(self.task) + self.episodes * self.task.episode_steps)
        at_random = self.settings.get("learning_starts") or self.task.episode_steps
        return at_random + self.episodes * self.task.episode_steps

    def steps_wanted(self, results: Path) -> int:
        """`max_steps`, or fewer if the run of ``steps_of`` in the folder took fewer."""
        if self.steps_of is None:
            return self.max_steps
        path = results / RunKey(self.steps_of, self.task.name, self.seed).file_name
        if not path.exists():
            return self.max_steps
        return min(self.max_steps, self.times * RunResult.read(path).episodes[-1].total_steps)

    def is_finished(self, results: Path) -> bool:
        """Whether the folder holds this run, with at least as many episodes or steps.

        Raises:
            ResultError: the file is damaged.
            OtherRunError: it holds a run with other settings.
        """
        path = results / self.file_name
        if not path.exists():
            return False
        result = RunResult.read(path)
        self._refuse_other_settings(result, path)
        if len(result.counted) >= self.episodes and not METHODS[self.method].is_model_free:
            return True
        if result.num_steps is not None:
            return result.num_steps >= self.steps_wanted(results)
        last = result.episodes[-1].total_steps if result.episodes else 0
        # Older files do not say for how many steps was trained, and leave out an episode that was cut off at the end.
        return last > self.steps_wanted(results) - self.task.episode_steps

    def _refuse_other_settings(self, result: RunResult, path: Path) -> None:
        """Compare all settings; one that the file does not name counts as the method's own.

        Raises:
            OtherRunError: some settings differ; the message names them.
        """
        wanted = _as_in_files(self.settings)
        made_with = _as_in_files(self._own_settings(result.settings)) | dict(result.settings)
        differing = [
            f"{name} was {made_with[name]}, now {wanted.get(name, 'there is no such setting')}"
            for name in sorted(made_with)
            if name not in wanted or made_with[name] != wanted[name]
        ]
        if differing:
            raise OtherRunError(
                f"{path} holds a run with other settings ({'; '.join(differing)}): choose another folder for the "
                "results, or delete that file"
            )

    def episodes_so_far(self, work: Path) -> int:
        """The number of planned episodes that an unfinished run has already finished."""
        rows = read_rows(self._folder(work) / EPISODES_FILE)
        return sum(row.actions != "random" for row in rows)

    def perform(self, folders: Folders) -> str:
        """Start or continue the run, write the result, and return a summary.

        Raises:
            DGPMPCError: planning, training or the environment failed.
            RunFolderError: the folder for unfinished runs holds this run with other settings.
            RunInUseError: another process is running it.
        """
        method = METHODS[self.method]
        if isinstance(method, PlanningMethod):
            result = self._plan(method, folders)
        else:
            result = self._learn_without_model(method, self.steps_wanted(folders.results))
        result.write(folders.results)
        returns = [episode.episode_return for episode in result.counted]
        minutes = sum(episode.seconds for episode in result.episodes) / 60
        mean = f"mean return {sum(returns) / len(returns):.2f} of " if returns else ""
        return f"{mean}{len(returns)} episodes, {minutes:.1f} minutes"

    def _folder(self, work: Path) -> Path:
        return work / Path(self.file_name).stem

    def _plan(self, method: PlanningMethod, folders: Folders) -> RunResult:
        settings = self.settings
        identity = {"environment": self.task.name, "method": self.method, **settings, "seed": self.seed}
        advice = f"choose another folder for unfinished runs, or delete {self._folder(folders.work)}"
        before = self._own_settings(settings)  # what a run counts as that is older than a setting
        open_folder = partial(RunFolder, self._folder(folders.work), identity, defaults=before, otherwise=advice)
        with closing(self.task.make()) as env, closing(_patiently(open_folder)) as folder:
            run = TrainingRun(
                folder,
                env,
                partial(method.make, settings=settings, seed=self.seed),
                num_episodes=self.episodes,
                total_timesteps=step_limit(self.episodes, self.task.episode_steps, settings.get("learning_starts")),
                checkpoint_every=CHECKPOINT_EVERY,
                results_only=True,
            )
            if not run.is_complete:
                folder.write_settings(episodes=self.episodes, command=self.command)
                run.train(progress_bar=False)
            rows, facts = folder.rows(), folder.read_settings()
            folder.checkpoints.previous.unlink(missing_ok=True)  # one is enough to learn on from
        planned = [row for row in rows if row.actions == "planned"]
        steps = sum(row.steps for row in planned)
        return RunResult(
            key=self.key,
            episodes=tuple(_episode(row) for row in rows),
            settings=settings,
            milliseconds_per_action=1e3 * sum(row.planning_seconds for row in planned) / steps if steps else None,
            command=self.command,
            **{name: facts[name] for name in ("started", "revision", "versions", "machine")},
        )

    def _learn_without_model(self, method: ModelFreeMethod, num_steps: int) -> RunResult:
        settings, started = self.settings, datetime.now(timezone.utc)
        with closing(EpisodeRecorder(self.task.make(model_free=True))) as env:
            model = method.make(env, settings, self.seed)
            watch = _Stopwatch()
            setattr(model.policy, method.acts_by, watch.around(getattr(model.policy, method.acts_by)))
            episodes = _EpisodeList(env, settings.get("learning_starts", 0))
            model.learn(num_steps, callback=episodes)
        return RunResult(
            key=self.key,
            episodes=tuple(episodes.found),
            settings=settings,
            num_steps=model.num_timesteps,
            milliseconds_per_action=1e3 * watch.seconds / watch.calls if watch.calls else None,
            started=started.isoformat(timespec="seconds"),
            command=self.command,
            revision=revision(),
            versions=versions(),
            machine=machine(),
        )


def _as_in_files(settings: Settings) -> Settings:
    """Settings as a file gives them back: tuples are lists."""
    read: Settings = json.loads(json.dumps(settings))
    return read


def _episode(row: EpisodeRow) -> Episode:
    actions: Actions = "planned" if row.actions == "planned" else "random"
    costs = row.cpu_seconds, row.training_iterations
    return Episode(actions, row.episode_return, row.steps, row.total_steps, row.seconds, row.success, *costs)


def _patiently(open_folder: Callable[[], RunFolder]) -> RunFolder:
    """Open the folder as soon as no other process holds it.

    Raises:
        RunInUseError: another process holds it for longer than `LOCK_SECONDS`.
    """
    deadline = time.monotonic() + LOCK_SECONDS
    while True:
        try:
            return open_folder()
        except RunInUseError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


class _Stopwatch:
    """Adds up the time that calls of a function take."""

    def __init__(self) -> None:
        self.calls, self.seconds = 0, 0.0

    def around(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, timed."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            started = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.calls += 1
                self.seconds += time.perf_counter() - started

        return timed


class _EpisodeList(BaseCallback):
    """Records each episode of a method without a model as it ends.

    Args:
        recorder: the wrapper around the environment.
        num_random: number of random steps at first.
    """

    def __init__(self, recorder: EpisodeRecorder, num_random: int):
        super().__init__()
        self.recorder, self.num_random = recorder, num_random
        self.found: list[Episode] = []
        self._since, self._cpu_since, self._updates = time.perf_counter(), time.process_time(), 0

    def _on_step(self) -> bool:
        if not self.locals["dones"][0]:
            return True
        episode, success = self.recorder.last, self.locals["infos"][0].get("is_success")
        assert episode is not None
        now, cpu_now, updates = time.perf_counter(), time.process_time(), int(getattr(self.model, "_n_updates", 0))
        self.found.append(
            Episode(
                actions="random" if self.num_timesteps - len(episode.rewards) < self.num_random else "policy",
                episode_return=float(episode.rewards.sum()),
                steps=len(episode.rewards),
                total_steps=self.num_timesteps,
                seconds=round(now - self._since, 3),
                success=None if success is None else bool(success),
                cpu_seconds=round(cpu_now - self._cpu_since, 3),
                training_iterations=updates - self._updates,
            )
        )
        self._since, self._cpu_since, self._updates = now, cpu_now, updates
        return True
