"""`python -m tests.mutation`: `map` says which tests run which lines, `run` tries mutants, `report` counts them.

`run` forks a process for each mutant, gives it the mutant's code in memory, and runs the tests that run the mutated
line, quick ones first, until one fails. What is known of a mutant is a line of `build/mutation/results.jsonl`, and is
not tried again while its file stays the same.
"""

import argparse
import ast
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path

from tests.mutation.mutants import PACKAGES, ROOT, mutants_of
from tests.mutation.plugin import Loop, Recorder, Selection, first_failure, replace_code, replace_source

RESULTS = ROOT / "build" / "mutation"
TESTS = [f"tests/{folder}" for folder in (*PACKAGES, "test_settings.py")]
PYTEST = ("-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", "--rootdir", str(ROOT))
LIBRARIES = (
    *("torch", "torch._dynamo", "numpy", "scipy.cluster.vq", "scipy.integrate", "scipy.linalg", "scipy.stats"),
    *("gymnasium", "mujoco", "stable_baselines3", "matplotlib.figure", "pytest", "hypothesis.extra.numpy", "beartype"),
)


def record_map(tests):
    """Lines and seconds of every test, to `map.json`."""
    import coverage
    import pytest

    measured = coverage.Coverage(data_file=None, source=[str(ROOT / "gym_dgpmpc")], config_file=False)
    recorder = Recorder(measured)
    measured.start()
    pytest.main([option for option in PYTEST if option != "-x"] + tests, plugins=[recorder])
    measured.stop()
    data, lines = measured.get_data(), {}
    for path in data.measured_files():
        by_line = data.contexts_by_lineno(path)
        lines[str(Path(path).relative_to(ROOT))] = {line: [c for c in names if c] for line, names in by_line.items()}
    seconds = {name: value for name, value in recorder.seconds.items() if name not in recorder.failed}
    _write("map.json", _merged(_read("map.json", {"seconds": {}, "lines": {}}), {"seconds": seconds, "lines": lines}))
    print(f"{len(seconds)} tests of {sum(seconds.values()):.0f} s; did not pass and are left out: {recorder.failed}")


def _merged(old, new):
    """Both maps in one, what is new of a test in place of what was known of it."""
    ran = set(new["seconds"])
    lines = {
        module: {int(line): {*names} - ran for line, names in known.items()} for module, known in old["lines"].items()
    }
    for module, known in new["lines"].items():
        for line, names in known.items():
            lines.setdefault(module, {}).setdefault(int(line), set()).update(names)
    listed = {module: {line: sorted(names) for line, names in known.items()} for module, known in lines.items()}
    return {"seconds": old["seconds"] | new["seconds"], "lines": listed}


def tests_for(mutant, recorded):
    """The tests that run the mutated line (or read defaults), quick ones first, as far as the budget goes."""
    lines = {int(line): names for line, names in recorded["lines"].get(mutant.module, {}).items()}
    names = {name for line in _lines_that_show(mutant) for name in lines.get(line, ())}
    names |= {"tests/test_settings.py"} if runs_at_import(mutant) else set()
    seconds, slowest = recorded["seconds"], defaultdict(float)
    for test in seconds:
        slowest[_file_of(test)] = max(slowest[_file_of(test)], seconds[test])
    covering = [test for test in seconds if test in names or _file_of(test) in names]
    chosen, total = [], 0.0
    # What the tests of a file share is made by whichever comes first, so a quick one of a slow file may not be quick.
    for test in sorted(covering, key=lambda test: seconds[test] + slowest[_file_of(test)] / 4):
        total += seconds[test]
        if total > recorded["budget"] and chosen:
            break
        chosen.append(test)
    return chosen


def _file_of(test):
    return test.partition("::")[0]


def runs_at_import(mutant):
    """Whether the mutated place is outside of every function's body, or a decorator."""
    return mutant.operator == "RemoveDecorator" or len(_lines_that_show(mutant)) == 10**6 or _is_header(mutant)


def _is_header(mutant):
    return mutant.line not in _lines_that_show(mutant)


def _lines_that_show(mutant):
    """Lines of the mutated statement; where it runs at import, those of its function (a default) or of the file."""
    tree = ast.parse((ROOT / mutant.module).read_text())
    statements = [node for node in ast.walk(tree) if isinstance(node, ast.stmt | ast.ExceptHandler)]
    around = [node for node in statements if _first(node) <= mutant.line <= node.end_lineno]
    statement = max(around, key=_first)
    if not any(isinstance(node, ast.FunctionDef) for node in around):
        return range(10**6)
    if isinstance(statement, ast.FunctionDef):
        return range(statement.body[0].lineno, statement.end_lineno + 1)
    body = getattr(statement, "body", None)  # of a loop or a branch, which is not shown by what is in it
    return range(statement.lineno, body[0].lineno if body else statement.end_lineno + 1)


def _first(statement):
    return min([statement.lineno, *(d.lineno for d in getattr(statement, "decorator_list", ()))])


def run(mutants, processes, budget):
    """Try them, each in a process of its own, and keep what came out.

    What runs at import needs the package to be imported anew. For all others it is imported and the tests are collected
    once, and each process has the functions' code replaced.
    """
    import pytest

    sys.dont_write_bytecode = True
    for name in LIBRARIES:
        __import__(name)
    recorded = _read("map.json") | {"budget": budget}
    import_time = [mutant for mutant in mutants if runs_at_import(mutant)]
    try_all(import_time, recorded, processes, _import_and_test)
    others = [mutant for mutant in mutants if mutant not in import_time]
    files = sorted({_file_of(test) for mutant in others for test in tests_for(mutant, recorded)})
    if files:
        loop = Loop(lambda items: try_all(others, recorded, processes, partial(_replace_and_test, items)))
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
            pytest.main([*PYTEST, "--capture=no", *files], plugins=[loop])


def try_all(mutants, recorded, processes, attempt):
    """Fork for each mutant; a process writes its verdict, or is stopped after eight times what its tests take."""
    waiting, running = list(reversed(mutants)), {}
    while waiting or running:
        while waiting and len(running) < processes:
            mutant, folder = waiting.pop(), Path(tempfile.mkdtemp())
            tests = tests_for(mutant, recorded)
            limit = 60.0 + 8.0 * sum(recorded["seconds"][test] for test in tests)
            pid = os.fork()
            if pid == 0:
                os.setpgid(0, 0)
                try:
                    _be_alone(folder)
                    (folder / "verdict").write_text(attempt(mutant, tests) if tests else "survived")
                finally:
                    os._exit(0)  # whatever happened: what follows is the parent's
            running[pid] = mutant, folder, time.monotonic(), limit, len(tests)
        time.sleep(0.02)
        for pid, (mutant, folder, start, limit, number) in list(running.items()):
            seconds, late = time.monotonic() - start, time.monotonic() - start > limit
            if late:
                os.killpg(pid, signal.SIGKILL)
            ended, status = os.waitpid(pid, 0 if late else os.WNOHANG)
            if ended:
                verdict = folder / "verdict"
                crashed = "killed by the time limit" if late else f"killed by a crash, status {status}"
                otherwise = crashed if late or os.WIFSIGNALED(status) else "not tried: the runner failed"
                keep(mutant, verdict.read_text() if verdict.exists() else otherwise, number, seconds)
                shutil.rmtree(folder)
                del running[pid]


def _be_alone(folder):
    """No output, and temporary files where they are removed."""
    os.environ["TMPDIR"] = tempfile.tempdir = str(folder)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)


def _import_and_test(mutant, tests):
    import pytest

    replace_source(mutant.module, mutant.source())
    for some in filter(None, (tests[:20], tests[20:])):  # first those of a few files, for collecting takes its time too
        selection = Selection(some)
        status = pytest.main([*PYTEST, *sorted({_file_of(test) for test in some})], plugins=[selection])
        if status in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED):
            return f"not tried: {status}"
        if status != pytest.ExitCode.OK:
            return f"killed by {selection.failed or 'an error at import'}"
    return "survived"


def _replace_and_test(items, mutant, tests):
    replace_code(mutant.module, mutant.source())
    return f"killed by {failed}" if (failed := first_failure([items[test] for test in tests])) else "survived"


def keep(mutant, outcome, number, seconds):
    """Add a line to the results."""
    line = {"name": mutant.name, "package": mutant.package, "change": mutant.change(), "outcome": outcome}
    RESULTS.mkdir(parents=True, exist_ok=True)
    with (RESULTS / "results.jsonl").open("a") as file:
        file.write(json.dumps(line | {"tests": number, "seconds": round(seconds, 1)}, ensure_ascii=False) + "\n")
    if outcome == "survived":
        print(f"survived {number} tests: {mutant.name}\n    {line['change']}", file=sys.stderr, flush=True)


def kept():
    """What came out, by the mutant's name."""
    path = RESULTS / "results.jsonl"
    lines = map(json.loads, path.read_text().splitlines()) if path.exists() else ()
    return {line["name"]: line for line in lines}


def sampled(package, number, seed):
    """So many of a package's mutants, drawn without replacement; all of them in that order if ``number`` is 0."""
    mutants = mutants_of(package)
    random.Random(f"{package} {seed}").shuffle(mutants)
    return mutants[: number or None]


def report(mutants):
    """A table of the share that is killed by package, with Wilson's interval of 95 %, and the survivors."""
    results, survivors = kept(), []
    print("| package | mutants | tried | killed | share | 95 % interval |\n|---|---|---|---|---|---|")
    counts = defaultdict(list)
    for mutant in mutants:
        if results.get(mutant.name, {"outcome": "not tried"})["outcome"].startswith(("killed", "survived")):
            survived = not results[mutant.name]["outcome"].startswith("killed")
            counts[mutant.package].append(not survived)
            survivors += [results[mutant.name]] if survived else []
    for package in (*counts, None):
        killed = [each for name in counts if package in (name, None) for each in counts[name]]
        number = sum(len(mutants_of(p)) for p in (counts if package is None else [package]))
        low, high = wilson(sum(killed), len(killed))
        share = sum(killed) / len(killed)
        print(
            f"| {package or 'together'} | {number} | {len(killed)} | {sum(killed)} "
            f"| {share:.1%} | {low:.1%} to {high:.1%} |"
        )
    for line in survivors:
        print(f"- `{line['name'].rpartition(':')[0]}` ({line['tests']} tests)\n      {line['change']}")


def wilson(killed, tried):
    """Wilson's interval of 95 % for a share (Brown, Cai and DasGupta 2001)."""
    z = 1.96
    middle, spread = killed + z * z / 2, z * (killed * (tried - killed) / tried + z * z / 4) ** 0.5
    return (middle - spread) / (tried + z * z), (middle + spread) / (tried + z * z)


def _read(name, otherwise=None):
    path = RESULTS / name
    return otherwise if otherwise is not None and not path.exists() else json.loads(path.read_text())


def _write(name, value):
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / name).write_text(json.dumps(value))


def main():
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("map", "list", "run", "report"))
    parser.add_argument("--packages", nargs="+", default=PACKAGES, choices=PACKAGES)
    parser.add_argument("--sample", type=int, default=0, help="mutants per package, drawn without replacement; 0: all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--budget", type=float, default=60.0, help="seconds of tests that a mutant must survive")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="of `map`")
    parser.add_argument("--again", action="store_true", help="try survivors once more")
    asked = parser.parse_args()
    if asked.what == "map":
        return record_map(asked.tests)
    mutants = [mutant for package in asked.packages for mutant in sampled(package, asked.sample, asked.seed)]
    if asked.what == "report":
        return report(mutants)
    if asked.what == "list":
        print("\n".join(f"{mutant.name}\n    {mutant.change()}" for mutant in mutants))
        return print(Counter(mutant.package for mutant in mutants))
    final = ("killed",) if asked.again else ("killed", "survived")
    known = {name for name, line in kept().items() if line["outcome"].startswith(final)}
    random.Random(asked.seed).shuffle(mutants)
    return run([mutant for mutant in mutants if mutant.name not in known], asked.processes, asked.budget)


if __name__ == "__main__":
    main()
