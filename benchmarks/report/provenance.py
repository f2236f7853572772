"""What runs were made with: every table and figure of a report says which seeds, commands, revisions and versions."""

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from benchmarks.report.markdown import NOTHING, cell, table
from benchmarks.report.scores import Runs
from benchmarks.result_files import RunResult
from gym_dgpmpc.runs.provenance import OPTIONAL

SECTION = "What the runs were made with"


class Origin(NamedTuple):
    """Source and surroundings of a run; runs of the same origin share a letter in the report."""

    revision: str
    versions: tuple[tuple[str, str], ...]
    machine: tuple[tuple[str, str], ...]

    @classmethod
    def of(cls, result: RunResult) -> "Origin":
        return cls(result.revision, _sorted(result.versions), _sorted(result.machine))


class Origins:
    """Letters for the origins of a set of runs, in the order in which they are met."""

    def __init__(self, study: Mapping[str, Runs]) -> None:
        self._runs: dict[Origin, list[RunResult]] = {}
        for runs in study.values():
            for result in itertools.chain(*runs.values()):
                self._runs.setdefault(Origin.of(result), []).append(result)
        self._letters = {origin: _letters(place) for place, origin in enumerate(self._runs)}

    def caption(self, study: Mapping[str, Runs]) -> str:
        """Seeds and origins of the runs behind a table or figure, and whether their revisions or versions differ."""
        met = {Origin.of(result) for runs in study.values() for result in itertools.chain(*runs.values())}
        origins = [origin for origin in self._letters if origin in met]
        letters = ", ".join(self._letters[origin] for origin in origins)
        text = f"{_seeds(study)} Made with [{letters}](#{SECTION.lower().replace(' ', '-')})."
        return text + (" **Their revisions or versions differ.**" if _differing(origins) else "")

    def lines(self) -> list[str]:
        """The section that says what each letter stands for."""
        shared = set.intersection(*(set(origin.versions) | set(origin.machine) for origin in self._runs))
        rows = []
        for origin, results in self._runs.items():
            started = sorted({result.started[:10] for result in results})
            rows.append([
                self._letters[origin], str(len(results)), _commands(results), f"`{cell(origin.revision)}`",
                pairs(pair for pair in (*origin.versions, *origin.machine) if pair not in shared) or NOTHING,
                " to ".join(dict.fromkeys((started[0], started[-1]))),
            ])  # fmt: skip
        differing = _differing(list(self._letters))
        return [
            f"## {SECTION}",
            "",
            f"Not the same in all runs: {differing}." if differing else "All runs have the same revision and versions.",
            *([f"The same in all: {pairs(sorted(shared))}."] if shared else []),
            "Each run's own command, with its seed and all its settings, is in its file.",
            "",
            *table(["", "runs", "commands", "revision", "other versions or machine", "started"], rows),
        ]


def _commands(results: Sequence[RunResult]) -> str:
    """The commands without their options, and how many runs each made: "`dgpmpc bench table …` (36)"."""
    heads = Counter(re.split(r"\s--", result.command)[0] for result in results)
    options = {re.split(r"\s--", result.command)[0] for result in results if re.search(r"\s--", result.command)}
    return ", ".join(f"`{cell(head)}{' …' if head in options else ''}` ({count})" for head, count in heads.items())


def _seeds(study: Mapping[str, Runs]) -> str:
    """ "Seeds 0, 1, 2.", and where methods have others, "Seeds 0, 1, 2 (of GP-MM, GP-DS: 0; of PETS TS1: 0, 1)."

    Tasks whose methods have the same seeds are named together: "Seeds 0 on A, B; 0, 1 on C."
    """
    tasks: dict[str, list[str]] = {}
    for task, runs in study.items():
        tasks.setdefault(_seeds_of_task(runs), []).append(task)
    if len(tasks) == 1:
        return f"Seeds {next(iter(tasks))}."
    return "Seeds " + "; ".join(f"{seeds} on {', '.join(named)}" for seeds, named in tasks.items()) + "."


def _seeds_of_task(runs: Runs) -> str:
    methods: dict[str, list[str]] = {}
    for method, results in runs.items():
        methods.setdefault(", ".join(str(result.key.seed) for result in results), []).append(method)
    usual = max(methods, key=lambda seeds: len(methods[seeds]))
    others = "; ".join(f"of {', '.join(named)}: {seeds}" for seeds, named in methods.items() if seeds != usual)
    return usual + (f" ({others})" if others else "")


def _differing(origins: list[Origin]) -> str:
    """What is not the same in all of them: "revision, numpy (2.2.6, 2.4.6)".

    An optional package that is missing from some does not count as a difference: it was not installed, or the file is
    from before optional packages were recorded.
    """
    found = ["revisions"] if len({origin.revision for origin in origins}) > 1 else []
    for package in sorted({name for origin in origins for name, _ in origin.versions}):
        versions = sorted({dict(origin.versions).get(package, "none") for origin in origins})
        if package in OPTIONAL and "none" in versions:
            versions.remove("none")
        found += [f"{package} ({', '.join(versions)})"] if len(versions) > 1 else []
    return ", ".join(found)


def _sorted(values: Mapping[str, object]) -> tuple[tuple[str, str], ...]:
    return tuple(sorted((str(name), str(value)) for name, value in values.items()))


def pairs(values: Iterable[tuple[str, object]]) -> str:
    """ "cores 2, python 3.11", for a cell of a table."""
    return cell(", ".join(f"{name} {value}" for name, value in values))


def _letters(number: int) -> str:
    """A to Z, then AA and so on, as spreadsheets name their columns."""
    head, last = divmod(number, 26)
    return (_letters(head - 1) if head else "") + chr(ord("A") + last)
