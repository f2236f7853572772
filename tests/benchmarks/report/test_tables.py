"""Tables of runs whose numbers can be worked out by hand."""

import pytest

from benchmarks.report import tables
from benchmarks.report.markdown import cell, estimate, number, table
from benchmarks.report.scores import Threshold
from benchmarks.report.statistics import Estimate
from tests.benchmarks.made_up import grouped, run

OWN = "DGP-MPC L=2 matern32"


def cells(lines: list[str]) -> dict[str, list[str]]:
    """The rows' cells by the first of them, the header under its own."""
    rows = [[text.strip() for text in line.strip("| ").split(" | ")] for line in lines if not line.startswith("|---")]
    return {row[0]: row[1:] for row in rows}


def test_numbers():
    assert [number(x) for x in (1234.56, -154.04, 0.126, None, float("nan"))] == ["1,235", "−154.0", "0.13", "–", "–"]
    assert estimate(Estimate(1.0, -2.0, 3.0)) == "1.00 [−2.00, 3.00]"
    assert estimate(Estimate(1.0)) == "1.00"
    assert estimate(Estimate(-0.0321, -0.05, 0.1), decimals=3) == "−0.032 [−0.050, 0.100]"
    assert cell("a | b\nc") == "a \\| b c"
    with pytest.raises(ValueError, match=r"\['x'\]"):
        table(["a", "b"], [["x"]])


def test_paper_table():
    full, short = [154.0] * 15, [150.0] * 3
    study = grouped(
        run(OWN, [*full, 1000.0], task="ModCartPole-v0", random=-1e6),  # only 15 count, and not the random one
        run(OWN, [100.0] * 15, task="ModCartPole-v0", seed=1),
        run("DGP-MPC L=3 matern32", short, task="ModCartPole-v0"),
        run(f"{OWN} refresh=plan", full, task="ModCartPole-v0"),
        run(OWN, full, task="Pendulum-v1"),
    )
    (row,) = [line for line in tables.paper_table(study) if "Matérn-3/2" in line]
    assert row == (
        "| ModCartPole-v0 | Matérn-3/2 | – | 95.97 ± 15.59 | **127.0** ± 38.18 (2 seeds) | 140.81 ± 4.35 "
        "| **150.0** (1 seed, 3 of 15 episodes) | 149.81 ± 3.76 |"
    )
    assert len(tables.paper_table(study)) == 3
    assert tables.paper_table(grouped(run(OWN, full))) == []


def test_comparison_at_equal_steps():
    runs = grouped(
        run(OWN, [1.0, 3.0], random=-50.0), run(OWN, [3.0, 5.0], seed=1, random=-50.0),
        run("SAC", [0.0, 1.0, 2.0] + [100.0] * 20), run("true dynamics", [9.0] * 5),
        run("true dynamics", [7.0], seed=1),
    )["Pendulum-v1"]  # fmt: skip
    found = cells(tables.comparison_table(runs))
    assert list(found)[1:] == [OWN, "SAC", "*true dynamics* (all its episodes)"]
    assert found[OWN] == [
        "2", "2", "3.00 [2.00, 4.00]", "3.00 [2.00, 4.00]", "1.41", "2.00 … 4.00", "4.00 [3.00, 5.00]",
    ]  # fmt: skip
    assert found["SAC"] == ["1", "3", "1.00", "1.00", "–", "1.00 … 1.00", "2.00"]
    assert found["*true dynamics* (all its episodes)"][:3] == ["2", "1 to 5", "8.00 [7.00, 9.00]"]
    ends = cells(tables.end_table(runs))
    assert ends["SAC"] == ["2,300", "100.0", "100.0"]
    assert ends[OWN][0] == "300"


def test_a_method_without_an_episode_by_then_is_left_out():
    runs = grouped(run(OWN, [1.0], steps=10), run("SAC", [1.0], steps=1000))["Pendulum-v1"]
    assert list(cells(tables.comparison_table(runs)))[1:] == [OWN]
    assert tables.improvement_table(runs, OWN) == []
    assert tables.improvement_table(runs, "SAC") == []


def test_improvement():
    values = {OWN: [4.0, 5.0, 6.0], "PETS TS1": [1.0, 2.0, 3.0], "SAC": [4.5, 5.5]}
    runs = [run(method, [v], seed=i, task=t) for method, vs in values.items() for i, v in enumerate(vs) for t in "ab"]
    study = grouped(*runs, run("GP-MM", [9.0], task="a"))
    found = cells(tables.improvement_table(study["a"], OWN))
    assert found["Y"][0] == f"P({OWN} > Y)"
    assert found["PETS TS1"] == ["1.00 [1.00, 1.00]", "3 × 3", "0.10"]
    assert found["SAC"][0].startswith("0.50 [") and found["SAC"][1:] == ["3 × 2", "1.00"]
    assert found["GP-MM"] == ["0.00", "3 × 1", "0.50"]
    overall = cells(tables.overall_improvement_table(study, {"a": OWN, "b": OWN}))
    assert overall["PETS TS1"] == ["1.00 [1.00, 1.00]", "2"]
    assert "GP-MM" not in overall  # on one task alone
    assert tables.overall_improvement_table({"a": study["a"]}, {"a": OWN}) == []


def test_aggregates_are_over_tasks_that_all_methods_of_a_table_have():
    ceilings = [run("true dynamics", [top], task=task) for task, top in (("a", 10.0), ("b", 100.0), ("c", 1.0))]
    own = [
        run(method, [value], task=task, seed=seed, random=0.0)
        for task, method, worth in (("a", OWN, 1.0), ("b", OWN, 10.0), ("c", "DGP-MPC L=3 rbf", 0.1))
        for seed, value in enumerate((8 * worth, 6 * worth))
    ]
    peers = [
        run(method, [value], task=task, steps=200)
        for method, value, task in (("SAC", 2.0, "a"), ("SAC", 50.0, "b"), ("TD3", 1.0, "c"))
    ]
    study = grouped(*ceilings, *own, *peers, run("SAC", [1.0], task="d"))  # d has no ceiling
    made = tables.aggregate_tables(study, {"a": OWN, "b": OWN, "c": "DGP-MPC L=3 rbf"})
    assert list(made) == [("a", "b", "c"), ("a", "b")]
    assert cells(made["a", "b", "c"])["DGP-MPC"] == ["2, 2, 2", "0.70 [0.63, 0.77]", "0.70 [0.60, 0.80]"]
    assert list(cells(made["a", "b"])) == ["method", "DGP-MPC", "SAC"]
    assert cells(made["a", "b"])["SAC"] == ["1, 1", "0.35", "0.35"]


def test_steps_to_a_threshold():
    runs = grouped(
        run("A", [1.0, 5.0, 9.0]), run("A", [5.0], seed=1), run("A", [1.0] * 8, seed=2), run("B", [0.0] * 40),
        run("true dynamics", [9.0]),
    )["Pendulum-v1"]  # fmt: skip
    found = cells(tables.threshold_table(runs, Threshold(5.0, "as given")))
    assert found["A"] == ["2 of 3", "200", "100 to 200"]
    assert found["B"] == ["0 of 1", "more than 4,000", "–"]
    assert "true dynamics" not in found


def test_success():
    runs = grouped(
        run("A", [0.0] * 8, success=[False] * 4 + [True] * 4), run("A", [0.0] * 8, seed=1, success=[True] * 8),
        run("B", [0.0] * 8),
    )["Pendulum-v1"]  # fmt: skip
    found = cells(tables.success_table(runs))
    assert found["A"] == ["2", "0.75 [0.50, 1.00]", "0.90 [0.80, 1.00]"]
    assert "B" not in found
    assert tables.success_table({"B": runs["B"]}) == []


def test_time():
    runs = grouped(
        run("A", [1.0] * 3, random=0.0, seconds=60.0, milliseconds=4.0, cpu_seconds=30.0, iterations=100),
        run("A", [1.0] * 3, random=0.0, seconds=120.0, seed=1, milliseconds=6.0),
        run("B", [1.0] * 4, milliseconds=None),
        run("C", [1.0] * 2, cpu_seconds=60.0, iterations=7),
        run("C", [1.0] * 2, seed=1, cpu_seconds=90.0, iterations=8),
    )["Pendulum-v1"]  # fmt: skip
    found = cells(tables.time_table(runs))
    assert found["A"] == ["2", "6.00 (4.00 to 8.00)", "2.00", "400.0", "900.0", "5.00 (4.00 to 6.00)"]
    assert found["B"] == ["1", "4.00", "not measured", "not measured", "600.0", "not measured"]
    assert found["C"][2:4] == ["2.50 (2.00 to 3.00)", "15.00 (14.00 to 16.00)"]
