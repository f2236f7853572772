"""Under the tests, every jaxtyping annotation of both packages is checked at each call; in production they are free.

The hook has to be installed before anything imports the package, and this file is what pytest imports first.
"""

import sys
from pathlib import Path

import jaxtyping
import pytest
import torch
from beartype import BeartypeConf, beartype
from matplotlib.figure import Figure

typechecked = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float, as in Python's own typing

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests.oracles, however pytest was started
jaxtyping.install_import_hook(["gym_dgpmpc", "benchmarks"], f"{__name__}.typechecked")

torch.set_num_threads(1)  # the same sums in the same order on every machine, and no fight over cores


@pytest.fixture
def unchecked(monkeypatch):
    """Annotations unchecked, as in production, to see the package's own error for an argument of the wrong shape."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were saved, to look into."""
    saved = []
    original = Figure.savefig

    def savefig(figure, *args, **kwargs):
        saved.append(figure)
        original(figure, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", savefig)
    return saved
