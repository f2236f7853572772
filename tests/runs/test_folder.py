"""The folder of a run: which run may go on in it, what --overwrite deletes, and rows that survive being written."""

import json

import pytest

from gym_dgpmpc.runs.folder import LOGS, PICTURES, SETTINGS_FILE, EpisodeRow, RunFolder, RunFolderError, read_rows

SETTINGS = {"environment": "ToyPush-v0", "seed": 0}
ROWS = [EpisodeRow(1, "planned", -0.125, 12, 12, 2.5, 1.25)]


@pytest.fixture
def finished(tmp_path):
    """A folder with every file of a run that has ended; nobody reads its agent here."""
    folder = RunFolder(tmp_path, SETTINGS)
    folder.write_settings()
    folder.write_rows(ROWS)
    folder.close()
    for name in ("agent.zip", "agent.previous.zip", *PICTURES):
        (tmp_path / name).touch()
    (tmp_path / LOGS).mkdir()
    return tmp_path


def test_goes_on_with_the_same_settings(finished):
    before = json.loads((finished / SETTINGS_FILE).read_text())
    folder = RunFolder(finished, SETTINGS)
    assert folder.goes_on
    folder.write_settings(episodes=2)
    after = folder.read_settings()
    assert after["settings"] == SETTINGS
    assert after["started"] == before["started"]
    assert after["episodes"] == 2
    assert folder.rows() == ROWS
    folder.close()


def test_refuses_another_runs_folder(finished):
    for _ in range(2):  # a refusal lets go of the folder
        with pytest.raises(RunFolderError, match=r"seed was 0, now 1.*--overwrite"):
            RunFolder(finished, SETTINGS | {"seed": 1})
    assert RunFolder(finished, SETTINGS | {"steps": 3}, defaults={"steps": 3}).goes_on


def test_refuses_a_folder_whose_settings_cannot_be_read(finished):
    (finished / SETTINGS_FILE).write_text("[]")
    with pytest.raises(RunFolderError, match=SETTINGS_FILE):
        RunFolder(finished, SETTINGS)


def test_overwrites_only_when_asked(finished):
    (finished / "notes.txt").write_text("mine")
    folder = RunFolder(finished, {"seed": 1}, overwrite=True)
    assert not folder.goes_on
    assert sorted(path.name for path in finished.iterdir()) == [".lock", ".lock-holder.json", "notes.txt"]
    folder.close()


@pytest.mark.parametrize("success", [True, False, None])
def test_what_is_written_of_an_episode_is_read_again(tmp_path, success):
    rows = [
        EpisodeRow(1, "planned", -0.125, 12, 12, 2.5, 1.25, success, 2.25, 300),
        EpisodeRow(2, "planned", -0.125, 12, 24, 2.5, 1.25, success),
    ]
    folder = RunFolder(tmp_path, SETTINGS)
    folder.write_rows(rows)
    folder.close()
    assert read_rows(tmp_path / "episodes.csv") == rows


def test_episodes_of_an_older_version_are_read(tmp_path):
    path = tmp_path / "episodes.csv"
    assert read_rows(path) == []
    path.write_text("episode,actions,episode_return,steps,total_steps,seconds\n1,random,-0.5,12,12,0.25\n")
    assert read_rows(path) == [EpisodeRow(1, "random", -0.5, 12, 12, 0.25, 0.0, None)]
