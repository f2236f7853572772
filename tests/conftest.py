"""Under the tests, every jaxtyping annotation of the package is checked at each call; in production they are free.

The hook has to be installed before anything imports the package, and this file is what pytest imports first.
"""

import sys
import typing
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import pytest
import torch
from beartype import beartype


def typechecked(function):
    """beartype, which refuses to decorate where an annotation names a Protocol that isinstance cannot test."""
    for hint in getattr(function, "__annotations__", {}).values():
        for part in _parts(hint):
            if getattr(part, "_is_protocol", False) and not getattr(part, "_is_runtime_protocol", False):
                typing.runtime_checkable(part)
    return beartype(function)


def _parts(hint: object) -> Iterator[object]:
    """The hint itself and whatever it is made of: RewardFn in RewardFn | None."""
    yield hint
    for argument in typing.get_args(hint):
        yield from _parts(argument)


sys.path.insert(0, str(Path(__file__).parents[1]))  # tests.oracles, however pytest was started
jaxtyping.install_import_hook("gym_dgpmpc", f"{__name__}.typechecked")

torch.set_num_threads(1)  # the same sums in the same order on every machine, and no fight over cores


@pytest.fixture
def unchecked(monkeypatch):
    """Annotations unchecked, as in production, to see the package's own error for an argument of the wrong shape."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
