"""Bars on the terminal: how far a training is, below the steps; nothing of the kind in a log file."""

import io
import re
import time

import pytest
from rich.console import Console

from gym_dgpmpc.agents import bars
from gym_dgpmpc.types import ReportsProgress
from tests.agents.point_mass import KnownPointMass, LinearModel, agent

SHOWN_AFTER = 0.05


class Slow(LinearModel):
    """A model whose training takes as long as a bar needs to be seen."""

    def fit(self, data, generator):
        time.sleep(0.5)
        return super().fit(data, generator)


class Reporting(Slow):
    """One that says how far it is."""

    on_progress = None

    def fit(self, data, generator):
        for done, loss in ((0, 2.5), (3, 0.25)):
            self.on_progress(done, 10, loss)
        return super().fit(data, generator)


@pytest.fixture
def drawn(monkeypatch):
    """What is drawn, on a terminal unless the test says otherwise."""
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=100, legacy_windows=False)
    monkeypatch.setattr(bars, "get_console", lambda: console)
    monkeypatch.setattr(bars, "SHOWN_AFTER", SHOWN_AFTER)
    return file


def without_colours(text):
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)


def test_a_training_is_shown_below_the_steps(drawn):
    model = Reporting()
    learner = agent(dynamics=model).learn(11, progress_bar=True)
    text = without_colours(drawn.getvalue())
    assert re.search(r"steps .* 10/11 .*\r?\n?training .* 3/10 .* loss 0\.25", text)
    assert "11/11" in text
    assert model.on_progress is None
    values = learner.logger.name_to_value
    assert (values["train/first_loss"], values["train/last_loss"]) == (2.5, 0.25)


def test_a_model_that_does_not_report_has_a_bar_without_numbers(drawn):
    learner = agent(dynamics=Slow()).learn(11, progress_bar=True)
    assert re.search(r"training .* 0/\?", without_colours(drawn.getvalue()))
    assert "train/first_loss" not in learner.logger.name_to_value


def test_a_quick_training_has_none(drawn):
    agent().learn(11, progress_bar=True)
    assert "11/11" in without_colours(drawn.getvalue())
    assert "training" not in drawn.getvalue()


def test_who_wants_no_bar_sees_none(drawn, capsys):
    learner = agent(dynamics=Reporting()).learn(11)
    assert drawn.getvalue() == "".join(capsys.readouterr()) == ""
    assert learner.logger.name_to_value["train/last_loss"] == 0.25


@pytest.mark.parametrize("terminal", [False, True], ids=["log file", "dumb terminal"])
@pytest.mark.parametrize("steps", [11, 0])
def test_what_can_only_print_gets_no_control_characters(steps, terminal, monkeypatch):
    file = io.StringIO()
    console = Console(file=file, width=100, force_terminal=terminal, _environ={"TERM": "dumb", "NO_COLOR": "1"})
    monkeypatch.setattr(bars, "get_console", lambda: console)
    monkeypatch.setattr(bars, "SHOWN_AFTER", SHOWN_AFTER)
    learner = agent(dynamics=Reporting())
    learner.learn(steps, progress_bar=True)
    text = file.getvalue()
    assert "\x1b" not in text
    assert "\r" not in text
    assert len(text.strip().splitlines()) == 1 if steps else text == ""


def test_a_notebook_without_widgets_is_like_a_log_file(monkeypatch, recwarn, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as kernels do
    monkeypatch.setattr(bars, "get_console", lambda: Console(force_jupyter=True))
    monkeypatch.setattr(bars.importlib.util, "find_spec", lambda name: None)
    agent().learn(11, progress_bar=True)
    (line,) = capsys.readouterr().out.splitlines()
    assert "11/11" in line
    assert not [warning for warning in recwarn if "ipywidgets" in str(warning.message)]


def test_an_error_gives_the_terminal_back(drawn):
    """Its cursor is hidden while a bar is drawn."""
    learner = agent(KnownPointMass(fail_at=4, failure=RuntimeError("broken")))
    with pytest.raises(RuntimeError, match="broken"):
        learner.learn(11, progress_bar=True)
    hidden, shown = "\x1b[?25l", "\x1b[?25h"
    assert drawn.getvalue().rfind(shown) > drawn.getvalue().rfind(hidden) >= 0


def test_a_listener_of_the_models_own_is_kept(drawn):
    heard = []
    model = Reporting()
    model.on_progress = lambda *told: heard.append(told)
    listener = model.on_progress
    agent(dynamics=model).learn(11)
    assert isinstance(model, ReportsProgress)
    assert model.on_progress is listener
    assert heard == [(0, 10, 2.5), (3, 10, 0.25)]
