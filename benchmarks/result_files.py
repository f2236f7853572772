"""The result file of a run: what a method did on a task with a seed. The runner writes it, the report reads it.

The files of all runs are in one folder, whichever suite asked for them, so that a run of two suites is done once.
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, TypeVar, runtime_checkable

from gym_dgpmpc.checkpoints.files import replace_text
from gym_dgpmpc.errors import DGPMPCError

SCHEMA = 1

Actions = Literal["random", "planned", "policy"]


class ResultError(DGPMPCError, ValueError):
    """A file is damaged or is not a result of this package, or a folder has no results."""


class Episode(NamedTuple):
    """One episode of a run."""

    actions: Actions
    """"random" if its first actions were random, "planned" by a planner, "policy" of a model-free method."""
    episode_return: float
    steps: int
    total_steps: int
    """Environment steps of the run up to the episode's end, the random ones included."""
    seconds: float
    """Wall-clock time of the episode, training included."""
    success: bool | None = None
    """Whether the goal was reached in the last step; None for tasks that do not say so in ``info["is_success"]``."""
    cpu_seconds: float | None = None
    """Time on the processor in ``seconds``; None in older files."""
    training_iterations: int | None = None
    """Iterations of the training before it, in the method's own count (PPO's are epochs); None in older files."""


class RunKey(NamedTuple):
    """Identifies a run; there is one file for each key."""

    method: str
    """The name in a report, such as "DGP-MPC L=2 matern32", "PETS TSinf", "GP-MM", "SAC" or "true dynamics"."""
    task: str
    """Id of the environment, and after a colon any change to it: "Pendulum-v1:learned reward"."""
    seed: int

    @property
    def file_name(self) -> str:
        """A name of letters, digits, dots, dashes and equals signs, which is valid on every system."""
        plain = [re.sub(r"[^A-Za-z0-9.=-]+", "-", part) for part in (self.task, self.method)]
        return f"{'_'.join(plain)}_seed{self.seed}.json"


@dataclass(frozen=True)
class RunResult:
    """What happened in a run, and how it was made.

    Attributes:
        key: method, task and seed.
        episodes: in the order in which they were played.
        settings: every argument of the method.
        milliseconds_per_action: wall-clock time of choosing an action, averaged over the run; None if not measured.
        started: time in ISO 8601, UTC.
        command: the command that made the run.
        revision: commit of this package's source, with "-dirty" if it was changed; "unknown" without one.
        versions: versions of Python and the packages used.
        machine: system, processor, cores, threads.
        num_steps: for methods without a model, the environment steps of training, those after the last finished
            episode included; None for other methods, and in older files.
    """

    key: RunKey
    episodes: tuple[Episode, ...]
    settings: Mapping[str, Any]
    milliseconds_per_action: float | None
    started: str
    command: str
    revision: str
    versions: Mapping[str, str]
    machine: Mapping[str, Any]
    num_steps: int | None = None

    @property
    def counted(self) -> tuple[Episode, ...]:
        """The episodes that count for the method: all but those of random actions."""
        return tuple(episode for episode in self.episodes if episode.actions != "random")

    def write(self, folder: Path) -> Path:
        """Write the file of this run in ``folder``, whole or not at all.

        Raises:
            ValueError: a number is not finite.
            OSError: it cannot be written.
        """
        content = {"schema": SCHEMA, **asdict(self), "key": self.key._asdict()}
        content["episodes"] = [episode._asdict() for episode in self.episodes]
        path = folder / self.key.file_name
        replace_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")
        return path

    @classmethod
    def read(cls, path: Path) -> "RunResult":
        """The result in a file.

        Raises:
            ResultError: the file is not a result of a run, or has another schema.
            OSError: it cannot be read.
        """

        def parse(content: dict[str, Any]) -> RunResult:
            key = RunKey(**content.pop("key"))
            episodes = tuple(Episode(**episode) for episode in content.pop("episodes"))
            return cls(key=key, episodes=episodes, **content)

        return read_file(path, SCHEMA, parse, "a result of a run")


Result = TypeVar("Result", bound="HasKey")


@runtime_checkable
class HasKey(Protocol):
    """The content of a result file."""

    @property
    def key(self) -> Any:
        """Identifies the result; its ``file_name`` is the name of the file."""


def read_file(path: Path, schema: int, parse: Callable[[dict[str, Any]], Result], what: str) -> Result:
    """The result in a JSON file, which states its schema and is named after its key.

    Args:
        path: path of the file.
        schema: the schema that is expected.
        parse: makes the result from the rest of the file.
        what: the kind of result, for the error.

    Raises:
        ResultError: the file is not such a result, has another schema, or has the name of another result.
        OSError: it cannot be read.
    """
    try:
        content = json.loads(path.read_text())
        found = content.pop("schema")
        if found != schema:
            raise ValueError(f"expected schema {schema}, got {found}")
        result = parse(content)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ResultError(f"{path} is not {what}: {type(error).__name__}: {error}") from error
    if path.name != result.key.file_name:
        raise ResultError(f"{path} holds the result {result.key.file_name}: expected a file of that name")
    return result


def read_results(folder: Path) -> list[RunResult]:
    """All results in a folder, sorted by task, method and seed.

    Raises:
        ResultError: a file is damaged, or there are no files.
    """
    results = [RunResult.read(path) for path in folder.glob("*_seed*.json")]
    if not results:
        raise ResultError(f"{folder} has no results of runs: expected files *_seed*.json")
    return sorted(results, key=lambda result: (result.key.task, result.key.method, result.key.seed))
