"""A short form of `make fault-test`."""

import gc
import os

import pytest

from tests.faults import cases, files, kills, outcomes, soak, writes

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="runs are forked, which this system cannot do")


@needs_fork
def test_kills_lose_nothing(tmp_path):
    rows = kills.run_kills(tmp_path, 3)
    assert sum(count for row in rows for count in row[1].values()) == 3
    assert kills.summary(rows)[1] == []


@pytest.mark.filterwarnings("ignore:.*damaged")
def test_cut_writes_leave_the_checkpoint_before(tmp_path):
    counts, lost = writes.run_cuts(tmp_path, 3)
    assert len(counts) == 6
    assert min(counts.values()) >= 9
    assert lost == []


@needs_fork
def test_full_disks_and_read_only_folders(tmp_path):
    assert writes.run_full_disk(tmp_path, 8)[2] == []
    assert writes.run_read_only(tmp_path) == (4, [])


@needs_fork
def test_hostile_files(tmp_path):
    number, counts, wrong = files.run_hostile(tmp_path)
    assert number >= 70
    assert sum(counts.values()) == number
    assert wrong == []


@needs_fork
def test_mutated_files(tmp_path):
    counts, wrong = files.run_mutations(tmp_path, 60)
    assert sum(counts.values()) == 60
    assert counts["CheckpointError"] > 20
    assert wrong == []


def test_hard_data():
    counts, wrong = cases.run_cases(25)
    assert wrong == []
    assert sum(counts.values()) == 25


@pytest.mark.filterwarnings("ignore")
def test_generated_environments(unchecked):
    counts, wrong = outcomes.run_worlds(30)
    assert wrong == []
    assert sum(counts.values()) == 30


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("world", outcomes.ONCE_WRONG, ids=range(len(outcomes.ONCE_WRONG)))
def test_environments_in_which_something_else_came_out_once(world, unchecked):
    assert outcomes.outcome(world)


def test_memory_and_time_stay(tmp_path, monkeypatch):
    monkeypatch.setattr(soak, "ALLOWED_SLOWDOWN", 4.0)  # of few steps, on a machine that does other things too
    gc.collect()
    found, wrong = soak.run_soak(tmp_path, 24)
    assert found["episodes"] == 24
    assert wrong == []


class TestTheInstruments:
    """They notice what they are there for."""

    def test_code_that_runs_is_noticed(self):
        noted = files.run_in_child(lambda: _events(lambda: os.putenv("THE_FILE_RAN_CODE", "1")))
        assert noted == ["os.putenv(b'THE_FILE_RAN_CODE', b'1')"]

    def test_memory_that_is_taken_is_noticed(self):
        found = files.run_in_child(lambda: bytes(3 << 30) and "had it")
        assert found["wrong"] == ["the process that read the files ended with status 256"]

    def test_a_different_run_is_noticed(self, tmp_path):
        for name, seed in (("one", 0), ("other", 1)):
            files.DGPMPCAgent("ToyPush-v0", seed=seed, **files.TINY).learn(12).save(tmp_path / name)
        found = kills.checkpoint_differences(tmp_path / "one", tmp_path / "other")
        assert "transitions: action" in found
        assert "random: fit" in found

    def test_an_action_out_of_bounds_is_noticed(self):
        case = cases.Case(*[None] * 3, low=cases.np.zeros(1), high=cases.np.ones(1), reward_scale=1.0, settings={})
        for action in (1.5, float("nan")):
            with pytest.raises(AssertionError):
                cases.check_action(case, cases.np.array([action]))


def _events(work):
    noted = files.watch_for_code()
    work()
    return noted
