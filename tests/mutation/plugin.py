"""What pytest does differently in a mutation run: see which test runs which lines, or run some tests on a mutant."""

import gc
import importlib.machinery
import time
import types
from functools import cache
from pathlib import Path

import pytest

from tests.mutation.mutants import ROOT


class Recorder:
    """Records each test's duration and the lines of the package that it runs.

    A fixture of a file or class is set up for whichever test comes first, so what set-up runs counts for all tests of
    the file.
    """

    def __init__(self, coverage):
        self.coverage, self.seconds, self.failed = coverage, {}, set()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item):
        self.coverage.switch_context(item.nodeid.partition("::")[0])
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        self.coverage.switch_context(item.nodeid)
        start = time.process_time()
        try:
            return (yield)
        finally:
            self.seconds[item.nodeid] = time.process_time() - start

    def pytest_runtest_logreport(self, report):
        if report.outcome != "passed":
            self.failed.add(report.nodeid)


class Selection:
    """Runs the tests that are named, in that order, and remembers which one failed."""

    def __init__(self, tests):
        self.place = {name: place for place, name in enumerate(tests)}
        self.failed = None

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        items[:] = sorted((i for i in items if i.nodeid in self.place), key=lambda item: self.place[item.nodeid])

    def pytest_runtest_logreport(self, report):
        if report.failed:
            self.failed = report.nodeid


class Loop:
    """Calls a function with all tests by their names, once they are collected, instead of running them."""

    def __init__(self, call):
        self.call = call

    def pytest_runtestloop(self, session):
        _functions()  # once for all processes
        self.call({item.nodeid: item for item in session.items})
        return True


class _Failures:
    """Remembers a test that failed, in set-up, call or tear-down."""

    failed = None

    def pytest_runtest_logreport(self, report):
        if report.failed:
            self.failed = report.nodeid


def first_failure(items):
    """Run collected tests in this order until one fails; its name, or None."""
    failures = _Failures()
    items[0].config.pluginmanager.register(failures)
    for item, following in zip(items, [*items[1:], None], strict=True):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if failures.failed:
            return failures.failed
    return None


def replace_code(module: str, source: str) -> None:
    """Give every function of the imported file ``module`` the code that it has in ``source``.

    Decorators and closures keep the function itself, so whoever calls it calls the new code. The lines of both files
    are the same.
    """
    codes = _codes(compile(source, str(ROOT / module), "exec"))
    for function in _functions().get(str(ROOT / module), ()):
        same_name = [code for code in codes if code.co_qualname == function.__code__.co_qualname]
        if same_name:
            line = function.__code__.co_firstlineno
            function.__code__ = min(same_name, key=lambda code: abs(code.co_firstlineno - line))


def _codes(code):
    inner = [const for const in code.co_consts if isinstance(const, types.CodeType)]
    return inner + [each for const in inner for each in _codes(const)]


@cache
def _functions():
    """Every function of the package that there is, by file."""
    by_file = {}
    for function in gc.get_objects():
        if type(function) is types.FunctionType:
            by_file.setdefault(function.__code__.co_filename, []).append(function)
    return by_file


def replace_source(module: str, source: str) -> None:
    """Let the file ``module`` be imported as if it held ``source``; nothing is written."""
    path = str(ROOT / module)
    original = importlib.machinery.SourceFileLoader.get_data

    def get_data(loader, name):
        if name == path:
            return source.encode()
        if Path(name).suffix == ".pyc" and Path(name).name.startswith(f"{Path(path).stem}.") and loader.path == path:
            raise FileNotFoundError(name)  # the compiled form of what the file really holds
        return original(loader, name)

    importlib.machinery.SourceFileLoader.get_data = get_data
