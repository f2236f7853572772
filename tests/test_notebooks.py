"""The notebooks run, at a tiny size, and are kept without outputs."""

import json
import re

import matplotlib.pyplot as plt
import pytest

from gym_dgpmpc.planning import registry
from tests.package_page import CLONE
from tests.test_examples import TINY

NOTEBOOKS = sorted((CLONE / "examples" / "notebooks").glob("*.ipynb"))

SIZES = {
    "own_plant": {"AGENT": TINY, "LOGGED_EPISODES": 1, "EPISODES": 1, "EPISODE_STEPS": 12},
    "reading_a_run": {"AGENT": TINY, "EPISODES": 1, "EPISODE_STEPS": 24, "HORIZON": 4},
    "own_planner_and_model": {"EPISODES": 1, "EPISODE_STEPS": 20, "NUM_CANDIDATES": 5, "HORIZON": 2},
    "comparing_methods": {"AGENT": TINY, "EPISODES": 1, "EPISODE_STEPS": 20, "SEEDS": (1, 2)},
}
"""In place of what each notebook's cell "parameters" says."""


def cells(notebook, kind):
    return [cell for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == kind]


def test_there_are_four():
    assert [notebook.stem for notebook in NOTEBOOKS] == sorted(SIZES)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_a_notebook_has_no_outputs_and_its_links_lead_somewhere(notebook):
    for cell in cells(notebook, "code"):
        assert cell["outputs"] == [] and cell["execution_count"] is None
    for cell in cells(notebook, "markdown"):
        for target in re.findall(r"\]\(([^)#]+)", "".join(cell["source"])):
            assert (notebook.parent / target).exists(), target


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_a_notebook_runs(notebook, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "PLANNERS", dict(registry.PLANNERS))
    plt.switch_backend("Agg")
    parameters, *others = cells(notebook, "code")
    assert parameters["metadata"]["tags"] == ["parameters"]
    names: dict[str, object] = {}
    exec("".join(parameters["source"]), names)
    unknown = set(SIZES[notebook.stem]) - set(names)
    assert not unknown
    names |= SIZES[notebook.stem]
    for cell in others:
        exec(compile("".join(cell["source"]), notebook.name, "exec"), names)
    plt.close("all")
