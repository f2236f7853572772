"""From result files to numbers, with runs whose numbers are known; what cannot be a run is refused by name."""

import json
from itertools import chain

import numpy as np
import pytest

from benchmarks import paper
from benchmarks.report import scores
from benchmarks.result_files import ResultError
from benchmarks.tasks import TASKS
from tests.benchmarks.made_up import grouped, run


def test_runs_of_a_folder_by_task_and_method(tmp_path):
    wanted = grouped(
        run("A", [1.0], task="ModCartPole-v0"), run("A", [1.0], task="BiasedReacher-v0", seed=1),
        run("B", [1.0], task="BiasedReacher-v0"), run("A", [1.0], task="Acrobot"),
    )  # fmt: skip
    for result in chain(*(of_method for methods in wanted.values() for of_method in methods.values())):
        result.write(tmp_path)
    found = scores.load_runs(tmp_path)
    assert found == wanted
    assert list(found) == ["ModCartPole-v0", "BiasedReacher-v0", "Acrobot"]  # the paper's first


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda c: c["episodes"][1].update(episode_return=None), "episode 2 has episode_return None"),
        (lambda c: c["episodes"][0].update(episode_return=float("nan")), "episode 1 has episode_return nan"),
        (lambda c: c["episodes"][1].update(actions="guessed"), "episode 2 has actions 'guessed'"),
        (lambda c: c["episodes"][1].update(seconds="3"), "episode 2 has seconds '3'"),
        (lambda c: c["episodes"][1].update(steps=0), "episode 2 has steps 0 of 200"),
        (lambda c: c["episodes"][1].update(total_steps=50), "episode 2 of 100 steps ends at step 50"),
        (lambda c: c["episodes"][1].update(success="yes"), "episode 2 has success 'yes'"),
        (lambda c: c["episodes"].pop(), ""),
        (lambda c: c.update(milliseconds_per_action="fast"), "milliseconds_per_action are 'fast'"),
        (lambda c: c.update(versions=["numpy"]), r"versions are \['numpy'\]"),
    ],
)
def test_what_no_run_can_have_done_is_refused_by_name(unchecked, tmp_path, damage, why):
    path = run("A", [2.0], random=1.0).write(tmp_path)
    content = json.loads(path.read_text())
    damage(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ResultError, match=rf"Pendulum-v1_A_seed0\.json.*{why}"):
        scores.load_runs(tmp_path)


def test_no_folder(tmp_path):
    with pytest.raises(ResultError, match="nowhere"):
        scores.load_runs(tmp_path / "nowhere")


def test_settings_in_names():
    assert scores.setting_of("DGP-MPC L=12 matern32") == ("matern32", 12)
    assert scores.setting_of("DGP-MPC L=2 matern32 refresh=plan") is None
    assert scores.setting_of("PETS TS1") is None


def test_reference_is_chosen_by_its_runs_and_not_by_its_returns():
    one, two, three = (f"DGP-MPC L={layers} rbf" for layers in (1, 2, 3))
    study = grouped(
        run(one, [9.0], task="a"), run(one, [9.0], task="b"), run(two, [1.0], task="a"), run(two, [1.0], task="b"),
        run(two, [1.0], task="b", seed=1), run(three, [9.0], task="c"), run(one, [9.0], task="c"),
        run("SAC", [9.0], task="d"),
    )  # fmt: skip
    # one has the most tasks, although two has as many runs; where it is, it stands.
    assert scores.reference_of(study) == {"a": one, "b": one, "c": one}
    assert scores.reference_of(study, two) == {"a": two, "b": two, "c": one}
    for name in ("DGP", "SAC", "DGP-MPC L=4 rbf"):
        with pytest.raises(ValueError, match=f"{one}, {two}, {three}.*'{name}'"):
            scores.reference_of(study, name)
    with pytest.raises(ValueError, match="'SAC'"):
        scores.reference_of({"d": study["d"]}, "SAC")
    # As many tasks and runs: the deeper one.
    assert scores.reference_of({"c": study["c"]}) == {"c": three}


def test_compared_methods_stand_in_a_fixed_order():
    methods = ["zebra", "SAC", "DGP-MPC L=1 rbf", "true dynamics", "DGP-MPC L=2 rbf", "PETS TSinf", "ant"]
    assert scores.compared(methods, "DGP-MPC L=2 rbf") == ["DGP-MPC L=2 rbf", "PETS TSinf", "SAC", "ant", "zebra"]
    assert scores.compared(["SAC"], None) == ["SAC"]


def test_equal_steps_are_those_of_the_shortest_run_but_the_ceiling():
    runs = grouped(
        run("A", [1.0, 2.0, 3.0]), run("A", [1.0, 2.0], seed=1, random=0.0), run("B", [1.0] * 30),
        run("true dynamics", [9.0]),
    )["Pendulum-v1"]  # fmt: skip
    assert scores.common_steps(runs) == 300
    assert scores.common_steps({"true dynamics": runs["true dynamics"]}) == 100
    np.testing.assert_array_equal(scores.mean_returns(runs["A"], 300), [2.0, 1.5])
    np.testing.assert_array_equal(scores.mean_returns(runs["A"], 200), [1.5, 1.0])
    np.testing.assert_array_equal(scores.mean_returns(runs["A"], 100), [1.0, np.nan])  # the random one never counts
    np.testing.assert_array_equal(scores.best_returns(runs["A"], 200), [2.0, 1.0])
    np.testing.assert_array_equal(scores.first_returns(runs["A"], 2), [1.5, 1.5])
    assert scores.ranked(runs) == ["A", "B", "true dynamics"]


def test_success_rates():
    some = run("A", [0.0] * 4, success=[True, False, True, True])
    np.testing.assert_array_equal(scores.success_rates([some]), [0.75])
    np.testing.assert_array_equal(scores.success_rates([some], 200), [0.5])
    assert scores.success_rates([some, run("A", [0.0])]) is None


def test_steps_until_a_return():
    some = run("A", [1.0, 5.0, 3.0], random=10.0)  # a random episode reaches nothing
    assert scores.steps_until(some, 5.0) == (300, True)
    assert scores.steps_until(some, 5.5) == (400, False)


def test_scale_goes_from_random_actions_to_the_ceiling():
    runs = grouped(
        run("A", [1.0], random=-4.0), run("B", [1.0], random=-6.0), run("true dynamics", [8.0, 10.0]),
        run("true dynamics", [11.0], seed=1),
    )["Pendulum-v1"]  # fmt: skip
    assert scores.scale_of("Pendulum-v1", runs) == (-5.0, 10.0)
    assert scores.scale_of("Pendulum-v1", {"A": runs["A"]}) is None
    assert scores.scale_of("Pendulum-v1", {"true dynamics": runs["true dynamics"]}) is None
    assert scores.scale_of("Pendulum-v1", {"true dynamics": [run("true dynamics", [1.0], random=2.0)]}) is None


def test_the_reachers_scale_begins_with_doing_nothing():
    """Recomputed here: the mean of the fifteen episodes after the first, which no seed changes."""
    task = TASKS["BiasedReacher-v0"]
    env, returns = task.make(), []
    for _ in range(16):
        env.reset(seed=None if returns else 3)
        steps = (env.step(np.zeros(env.action_space.shape, np.float32)) for _ in range(task.episode_steps))
        returns.append(sum(reward for _, reward, *_ in steps))
    assert task.idle_return == pytest.approx(np.mean(returns[1:]), abs=1e-3)
    runs = grouped(run("A", [-40.0], random=-1400.0), run("true dynamics", [-30.0]))["Pendulum-v1"]
    assert scores.scale_of("BiasedReacher-v0", runs) == (task.idle_return, -30.0)


def test_threshold_comes_from_the_first_source_that_has_one():
    plain = {"A": [run("A", [1.0])]}
    scaled = {"A": [run("A", [1.0], random=0.0)], "true dynamics": [run("true dynamics", [100.0])]}
    assert scores.threshold_of("ModCartPole-v0", plain, {"ModCartPole-v0": 3.0}) == (3.0, "as given", False)
    assert scores.threshold_of("ModCartPole-v0", plain, {}).value == 149.81
    assert scores.threshold_of("BiasedReacher-v0", plain, {}).value == -39.89
    assert scores.threshold_of("InvertedPendulum-v5", scaled, {}).value == 950.0
    assert scores.threshold_of("Pendulum-v1", scaled, {}).value == pytest.approx(90.0)
    assert scores.threshold_of("Pendulum-v1", scaled, {}).is_scaled
    assert not scores.threshold_of("InvertedPendulum-v5", scaled, {}).is_scaled
    assert scores.threshold_of("Pendulum-v1:learned reward", scaled, {}).value == pytest.approx(90.0)
    assert scores.threshold_of("Pendulum-v1", plain, {}) is None


@pytest.mark.parametrize(
    ("task", "means", "deviations"),
    [
        ("ModCartPole-v0", 1505.62, 94.54),
        ("BiasedReacher-v0", -539.7, 35.67),
        ("RiskSensitiveHalfCheetah-v0", 13941.0, 1184.7),
    ],
)
def test_the_papers_table_adds_up(task, means, deviations):
    """To sums that were taken from the paper's table, apart from the numbers here."""
    cells = paper.AVERAGE_RETURN[task]
    assert set(cells) == {(kernel, layers) for kernel in paper.KERNELS for layers in paper.LAYERS}
    assert sum(cell.mean for cell in cells.values()) == pytest.approx(means)
    assert sum(cell.deviation for cell in cells.values()) == pytest.approx(deviations)
