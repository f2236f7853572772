"""What the command line does with runs that there are: go on without flags, draw again, look inside."""

import json
import shutil
import signal
import subprocess
import sys

import pytest

from gym_dgpmpc.checkpoints.format import read_checkpoint
from gym_dgpmpc.runs.folder import read_rows
from tests.command_line import SMALLEST, dgpmpc, is_one_line_error
from tests.runs.toy import ENV_ID, ToyPush

OPTIONS = ["--planner=mppi", "--temperature=0.7", "--kernel=rbf", "--seed=4", "--checkpoint-every=5", "--no-video"]
OPTIONS += ["--no-progress", "--format=png", "--format=svg"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder in which a run of one planned episode has ended."""
    path = tmp_path_factory.mktemp("trained") / "a"
    sizes = [option for option in SMALLEST if "--iterations" not in option]
    result = dgpmpc("train", ENV_ID, *sizes, *OPTIONS, "--episodes", 1, "--out", path)
    assert result.exit_code == 0, result.output
    return path


@pytest.fixture
def folder(trained, tmp_path, monkeypatch):
    """A copy of it in the present folder, whose name is "a"."""
    shutil.copytree(trained, tmp_path / "a")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "a"


def settings(folder):
    return json.loads((folder / "settings.json").read_text())


def write_settings(folder, content):
    (folder / "settings.json").write_text(json.dumps(content))


# ------------------------------------------------------------------------------------------------------------- resume


def test_a_run_goes_on_without_its_flags(folder):
    before = settings(folder)
    assert "has finished" in dgpmpc("train", "--resume", "a").stdout
    result = dgpmpc("train", "--resume", "a", "--episodes", 2)
    assert result.exit_code == 0, result.output
    assert "a goes on after step 24" in result.stdout
    assert "a/learning_curve.svg" in result.stdout
    after = settings(folder)
    assert after["settings"] == before["settings"]
    assert after["options"] == before["options"] == {
        "env_id": ENV_ID, "threads": 1, "video": False, "look": False, "checkpoint_every": 5, "formats": ["png", "svg"],
    }  # fmt: skip
    assert (before["episodes"], after["episodes"]) == (1, 2)
    assert read_checkpoint("a/agent.zip").config["arguments"]["temperature"] == 0.7


def test_an_interrupted_run_ends_as_if_it_had_not_been(folder, monkeypatch):
    assert dgpmpc("train", "--resume", "a", "--episodes", 3).exit_code == 0
    uninterrupted = [row.episode_return for row in read_rows(folder / "episodes.csv")]
    again = [*OPTIONS, *(option for option in SMALLEST if "--iterations" not in option)]
    step, count = ToyPush.step, iter(range(1000))

    def step_with_signal(self, action):
        if next(count) == 20:  # in the second episode; there are checkpoints every five steps
            signal.raise_signal(signal.SIGINT)
        return step(self, action)

    monkeypatch.setattr(ToyPush, "step", step_with_signal)
    monkeypatch.setattr(ToyPush, "can_replay", True, raising=False)
    result = dgpmpc("train", ENV_ID, *again, "--episodes", 3, "--out", "b")
    assert result.exit_code == 130
    assert "and so does dgpmpc train --resume b" in result.stdout
    result = dgpmpc("train", "--resume", "b")
    assert result.exit_code == 0, result.output
    assert "return of 3 planned episodes" in result.stdout
    assert [row.episode_return for row in read_rows(folder.parent / "b" / "episodes.csv")] == uninterrupted


def test_what_contradicts_the_folder_is_named(folder):
    before = settings(folder)
    result = dgpmpc("train", "--resume", "a", "--layers", 2, "--seed", 5, "--kernel", "rbf")
    assert is_one_line_error(result, "num_layers is 1 there, 2 was given; seed is 4 there, 5 was given")
    assert "kernel" not in result.stderr
    assert is_one_line_error(dgpmpc("train", "ModCartPole-v0", "--resume", "a"), "environment is ToyPush-v0 there")
    assert is_one_line_error(dgpmpc("train", "--resume", "a", "--agent", "mixture"), "agent is dgp-mpc there")
    assert is_one_line_error(dgpmpc("train", "--resume", "a", "--smoothing", 0.2), "mppi", "smoothing")
    for option in (["--overwrite"], ["--out", "b"]):
        assert is_one_line_error(dgpmpc("train", "--resume", "a", *option), "--overwrite")
    assert settings(folder) == before


def test_what_is_the_same_or_is_no_setting_may_be_given_again(folder):
    options = ["--kernel", "rbf", "--threads", 1, "--checkpoint-every", 7, "--format", "pdf", "--timesteps", 30]
    result = dgpmpc("train", ENV_ID, "--resume", "a", *options)
    assert result.exit_code == 0, result.output
    assert "30 environment steps" in result.stdout
    after = settings(folder)
    assert (after["episodes"], after["timesteps"]) == (None, 30)
    assert after["options"]["checkpoint_every"] == 7
    assert after["options"]["formats"] == ["pdf"]
    assert "has finished" in dgpmpc("train", "--resume", "a").stdout


def test_a_folder_of_an_older_version_or_without_a_checkpoint_goes_on(folder):
    content = settings(folder)
    del content["options"], content["settings"]["exploration_beta"]
    write_settings(folder, content)
    result = dgpmpc("train", "--resume", "a", "--episodes", 2, "--no-video")
    assert result.exit_code == 0, result.output
    assert "goes on after step 24" in result.stdout
    for name in ("agent.zip", "agent.previous.zip", "episodes.csv"):
        (folder / name).unlink()
    result = dgpmpc("train", "--resume", "a", "--episodes", 1, "--no-video")
    assert result.exit_code == 0, result.output
    assert "24 environment steps" in result.stdout


def test_what_cannot_be_resumed_is_named(folder):
    assert is_one_line_error(dgpmpc("train"), "ENV_ID", "--resume FOLDER")
    assert is_one_line_error(dgpmpc("train", "--resume", "b"), "expected a folder of `dgpmpc train`", "b/settings.json")
    content = settings(folder)
    write_settings(folder, {**content, "settings": {**content["settings"], "new_setting": 1}})
    assert is_one_line_error(dgpmpc("train", "--resume", "a"), "new_setting")
    write_settings(folder, {"settings": {"method": "SAC"}, "command": "dgpmpc bench fair"})
    assert is_one_line_error(dgpmpc("train", "--resume", "a"), "the command that goes on with it is dgpmpc bench fair")


# --------------------------------------------------------------------------------------------------------------- plot


def test_a_run_is_drawn_again_as_it_was(folder):
    before = {path.name: path.read_bytes() for path in folder.glob("*.svg")}
    assert sorted(before) == ["learning_curve.svg", "prediction_fan.svg"]
    for name in before:
        (folder / name).unlink()
    result = dgpmpc("plot", "a", "--format", "svg")
    assert result.exit_code == 0, result.output
    assert result.stdout.split() == ["a/learning_curve.svg", "a/prediction_fan.svg"]
    assert {path.name: path.read_bytes() for path in folder.glob("*.svg")} == before


def test_several_runs_are_drawn_in_one_chart(folder, drawn):
    for seed in (5, 6):
        shutil.copytree(folder, f"seed{seed}")
        content = settings(folder)
        content["settings"]["seed"] = seed
        write_settings(folder.parent / f"seed{seed}", content)
    result = dgpmpc("plot", "a", "seed5", "seed6", "a", "--format=pdf", "--format=png", "--out=b", "--title=mine")
    assert result.exit_code == 0, result.output
    assert result.stdout.split() == ["b/learning_curves.pdf", "b/learning_curves.png"]
    assert drawn[0].axes[0].get_title() == "mine"
    assert drawn[0].axes[0].get_legend_handles_labels()[1][0].endswith("deviation of 3 seeds")
    assert dgpmpc("plot", "a", "seed5").stdout.split() == ["learning_curves.png"]


def test_plot_says_what_is_wrong(folder):
    assert is_one_line_error(dgpmpc("plot", "a", "b"), "expected a folder of `dgpmpc train`", "b/settings.json")
    (folder / "prediction_fan.npz").write_bytes(b"")
    assert is_one_line_error(dgpmpc("plot", "a"), "prediction_fan.npz")
    assert dgpmpc("plot").exit_code == 2


# ------------------------------------------------------------------------------------------------------------ inspect


def test_a_folder_is_shown_to_a_person(folder):
    result = dgpmpc("inspect", "a")
    assert result.exit_code == 0, result.output
    lines = [" ".join(line.split()) for line in result.stdout.splitlines()]
    for line in (
        f"DGPMPCAgent for {ENV_ID}",
        "observation 2 numbers, float32, -inf to inf",
        "action 1 number, float32, -1 to 1",
        "reward the environment's",
        "termination learned, once an episode has terminated",
        "transitions 24; the last training saw 24 of them",
        "episodes 2 of 12 steps, 0 terminated",
        "* planner mppi (default cem)",
        "* temperature 0.7 (default 0.5)",
        "num_iterations 5",
        "num_chains 5",
    ):
        assert line in lines
    assert any(line.startswith("effective_sample_size ") for line in lines)
    assert any(line.startswith("return of planned mean ") for line in lines)
    assert dgpmpc("inspect", "a/agent.zip").stdout.splitlines()[0] == result.stdout.splitlines()[0]


def test_a_folder_is_shown_to_a_program(folder):
    content = json.loads(dgpmpc("inspect", "a", "--json").stdout, parse_constant=pytest.fail)
    assert content["run"]["num_planned_episodes"] == 1
    assert content["settings"]["kernel"] == {"value": "rbf", "default": "matern32", "differs": True}
    assert "run" not in json.loads(dgpmpc("inspect", "a/agent.zip", "--json").stdout)


def test_inspecting_needs_no_environment(folder):
    """Nor the module that registers it, which another machine may not have."""
    script = (
        "import sys; from gym_dgpmpc.cli import app; app(['inspect', 'a'], standalone_mode=False); "
        "sys.exit('tests.runs.toy' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert f"DGPMPCAgent for {ENV_ID}" in result.stdout


def test_inspect_says_what_is_wrong(folder):
    assert is_one_line_error(dgpmpc("inspect", "b"), "expected a folder of `dgpmpc train` or an agent's file", "b")
    (folder / "agent.zip").write_bytes(b"no agent")
    assert is_one_line_error(dgpmpc("inspect", "a"), "agent.zip")
