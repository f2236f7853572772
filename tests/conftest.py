"""Under the tests, every jaxtyping annotation of the package is checked at each call; in production they are free.

The hook has to be installed before anything imports the package, and this file is what pytest imports first.
"""

import typing
from collections.abc import Iterator

import torch
from beartype import beartype
from jaxtyping import install_import_hook


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


install_import_hook("gym_dgpmpc", f"{__name__}.typechecked")

torch.set_num_threads(1)  # the same sums in the same order on every machine, and no fight over cores
