"""What runs were made with: every table and figure of a report says which seeds, commands, revisions and versions."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from gym_dgpmpc.bench.markdown import cell, table
from gym_dgpmpc.bench.results import RunResult
from gym_dgpmpc.bench.scores import Runs

SECTION = "What the runs were made with"


class Origin(NamedTuple):
    """What runs have in common that one command made in one place."""

    command: str
    revision: str
    versions: tuple[tuple[str, str], ...]
    machine: tuple[tuple[str, str], ...]

    @classmethod
    def of(cls, result: RunResult) -> "Origin":
        return cls(result.command, result.revision, _sorted(result.versions), _sorted(result.machine))


class Origins:
    """Letters for the origins of a set of runs, in the order in which they are met."""

    def __init__(self, study: Mapping[str, Runs]) -> None:
        results = [result for runs in study.values() for of_method in runs.values() for result in of_method]
        self._letters: dict[Origin, str] = {}
        for result in results:
            self._letters.setdefault(Origin.of(result), _letters(len(self._letters)))
        self._results = results

    def caption(self, runs: Runs) -> str:
        """Seeds and origins of the runs behind a table or figure, and whether their revisions or versions differ."""
        results = [result for of_method in runs.values() for result in of_method]
        origins = sorted({Origin.of(result) for result in results}, key=self._order)
        letters = ", ".join(self._letters[origin] for origin in origins)
        anchor = SECTION.lower().replace(" ", "-")
        text = f"{_seeds(runs)} Made with [{letters}](#{anchor})."
        return text + (" **Their revisions or versions differ.**" if _differing(origins) else "")

    def lines(self) -> list[str]:
        """The section that says what each letter stands for."""
        rows = []
        for origin, letter in self._letters.items():
            runs = sum(Origin.of(result) == origin for result in self._results)
            started = sorted(result.started for result in self._results if Origin.of(result) == origin)
            rows.append(
                [
                    letter, str(runs), f"`{cell(origin.command)}`", f"`{cell(origin.revision)}`",
                    _pairs(origin.versions), _pairs(origin.machine), f"{started[0][:10]} to {started[-1][:10]}",
                ]
            )  # fmt: skip
        differing = _differing(list(self._letters))
        return [
            f"## {SECTION}",
            "",
            f"Not the same in all runs: {differing}." if differing else "All runs have the same revision and versions.",
            "",
            *table(["", "runs", "command", "revision", "versions", "machine", "started"], rows),
        ]

    def _order(self, origin: Origin) -> int:
        return list(self._letters).index(origin)


def _seeds(runs: Runs) -> str:
    """ "Seeds 0, 1, 2." or, where methods have others, "Seeds 0, 1, 2; PETS TS1: 0, 1." """
    by_method = {method: ", ".join(str(r.key.seed) for r in results) for method, results in runs.items()}
    texts = list(by_method.values())
    usual = max(texts, key=texts.count)
    others = "; ".join(f"{method}: {text}" for method, text in by_method.items() if text != usual)
    return f"Seeds {usual}" + (f"; {others}" if others else "") + "."


def _differing(origins: list[Origin]) -> str:
    """What is not the same in all of them: "revision, numpy (2.2.6, 2.4.6)"."""
    found = ["revisions"] if len({origin.revision for origin in origins}) > 1 else []
    for package in sorted({name for origin in origins for name, _ in origin.versions}):
        versions = sorted({dict(origin.versions).get(package, "none") for origin in origins})
        found += [f"{package} ({', '.join(versions)})"] if len(versions) > 1 else []
    return ", ".join(found)


def _sorted(values: Mapping[str, object]) -> tuple[tuple[str, str], ...]:
    return tuple(sorted((str(name), str(value)) for name, value in values.items()))


def _pairs(values: Iterable[tuple[str, str]]) -> str:
    return cell(", ".join(f"{name} {value}" for name, value in values))


def _letters(number: int) -> str:
    """A to Z, then AA and so on, as spreadsheets name their columns."""
    head, last = divmod(number, 26)
    return (_letters(head - 1) if head else "") + chr(ord("A") + last)
