"""The whole report: all its files, what it says of where they come from, and the command that writes it."""

import re

import pytest
import typer
from typer.testing import CliRunner

from benchmarks.commands import report
from benchmarks.report.pages import write_report
from benchmarks.report.provenance import Origins
from benchmarks.result_files import ResultError
from tests.benchmarks.made_up import grouped, run
from tests.command_line import is_one_line_error

OWN = "DGP-MPC L=2 matern32"


@pytest.fixture
def folder(tmp_path):
    """Two tasks with other methods and the ceiling, and one that the package's own method was run on alone."""
    results = [
        *(run(OWN, [40.0 + seed, 150.0 + seed], task="ModCartPole-v0", seed=seed, random=-4.0) for seed in range(3)),
        *(run("SAC", [-4.0] * 2 + [90.0 + s] * 20, task="ModCartPole-v0", seed=s, revision="def") for s in range(2)),
        run("DGP-MPC L=3 rbf", [44.0, 155.0], task="ModCartPole-v0", random=-4.0),
        run("true dynamics", [176.0, 176.0], task="ModCartPole-v0"),
        *(run(m, [v] * 3, task="Fetch-v4", seed=s, random=-9.0, success=[False, False, True])
          for s in range(2) for m, v in ((OWN, -2.0 + s), ("SAC", -8.0 - s))),
        run("true dynamics", [-1.0], task="Fetch-v4"),
        run(OWN, [3.0], task="Alone-v0"),
    ]  # fmt: skip
    for result in results:
        result.write(tmp_path / "runs")
    return tmp_path / "runs"


def test_every_figure_and_table(folder, tmp_path):
    files = write_report(folder, tmp_path / "docs" / "results", command="dgpmpc report runs")
    page = files[0].read_text()
    assert files[0] == tmp_path / "docs" / "results.md"
    assert all(file.stat().st_size > 0 for file in files)
    shown = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", page)
    assert [files[0].parent / name for name in shown] == files[1:]  # every link has a file, every file a link
    assert shown == [
        "results/comparison.png", "results/maximum.png", "results/variability.png",
        "results/ModCartPole-v0_learning.png", "results/ModCartPole-v0_settings.png", "results/Alone-v0_learning.png",
        "results/Fetch-v4_learning.png",
    ]  # fmt: skip
    headings = re.findall(r"^#+ (.*)$", page, re.MULTILINE)
    assert headings == [
        "Results", "All methods", "The paper's table", "ModCartPole-v0", "Alone-v0", "Fetch-v4",
        "What the runs were made with",
    ]  # fmt: skip
    assert "Made from 13 result files" in page
    assert "by `dgpmpc report runs`" in page
    for text in (
        f"P({OWN} > Y)", "| Y | P(DGP-MPC > Y) | tasks |", "median (Kaplan–Meier)", "last 5 episodes", "140.81 ± 4.35",
        "0 is what random actions earn", "within 300 environment steps", "reached 149.8",
        "Share of successful episodes",
    ):  # fmt: skip
        assert text in page


def test_every_table_and_figure_says_what_it_was_made_from(folder, tmp_path):
    page = write_report(folder, tmp_path / "out")[0].read_text()
    body, origins = page.split("## What the runs were made with")
    blocks = re.findall(r"^\|---.*$|^!\[.*$", body, re.MULTILINE)
    captions = re.findall(r"Seeds .* Made with \[[A-Z, ]+\]\(#what-the-runs-were-made-with\)\.", body)
    assert len(captions) == len(blocks) > 10
    assert "Not the same in all runs: revisions." in origins
    assert "The same in all: cores 2, numpy 2.0, python 3.11." in origins
    assert re.search(r"^\| A \| 11 \| `dgpmpc bench some …` \(11\) \| `abc` \| – \|", origins, re.M)
    assert re.search(r"^\| B \| 2 \| `dgpmpc bench some …` \(2\) \| `def` \| – \|", origins, re.M)
    cart_pole, alone = body.index("## ModCartPole-v0"), body.index("## Alone-v0")
    assert "**Their revisions or versions differ.**" in body[cart_pole:alone]
    assert "**Their" not in body[alone:]
    assert "Seeds 0, 1 (of true dynamics: 0)." in body[alone:]


@pytest.fixture(scope="module")
def caption_of(tmp_path_factory):
    """What stands under a table or figure that is found by a text, of runs whose seeds tell their methods and tasks."""
    tmp_path = tmp_path_factory.mktemp("captions")
    seeds = {OWN: 1, "DGP-MPC L=3 rbf": 2, "DGP-MPC L=5 rbf": 3, "SAC": 4, "TD3": 5, "true dynamics": 6}
    tasks = {
        "ModCartPole-v0": [*seeds], "BiasedReacher-v0": [OWN, "SAC", "true dynamics"], "Pendulum-v1": [OWN, "TD3"],
        "RiskSensitiveHalfCheetah-v0": ["SAC"], "Fetch-v4": [OWN, "SAC", "true dynamics"],
    }  # fmt: skip
    for number, (task, methods) in enumerate(tasks.items()):
        for method in methods:
            # The slowest has no episode by the time that the others end.
            steps = 1000 if (method, task) == ("TD3", "ModCartPole-v0") else 100
            value = 9.0 if method == "true dynamics" else float(seeds[method])
            run(method, [value, value], task=task, seed=10 * number + seeds[method], steps=steps,
                random=-1.0 if method == OWN else None,
                success=[True, True] if method == "SAC" else None).write(tmp_path / "runs")  # fmt: skip
    page = write_report(tmp_path / "runs", tmp_path / "out", reference=OWN)[0].read_text()

    def find(text, after="# Results"):
        found = page.index(text, page.index(f"{after}\n"))
        return re.search(r"Seeds (.*)\. Made with", page[found:])[1]

    return find


CART_POLE = "## ModCartPole-v0"


@pytest.mark.parametrize(
    ("text", "after", "seeds"),
    [
        # The ceiling is drawn; other settings, and tasks with one method alone, are not.
        ("comparison.png", "# Results", {1, 4, 5, 6, 11, 14, 16, 21, 25, 41, 44, 46}),
        ("maximum.png", "# Results", {1, 4, 5, 6, 11, 14, 16, 21, 25, 41, 44, 46}),
        ("variability.png", "# Results", {1, 4, 5, 6, 11, 14, 16, 21, 25, 41, 44, 46}),
        # Only the reference and what it is compared with on several tasks; no TD3, which is compared on one alone.
        ("P(DGP-MPC > Y)", "# Results", {1, 4, 11, 14, 41, 44}),
        # All that decides the scale of its tasks, and nothing of the others.
        ("seeds by task", "# Results", {1, 2, 3, 4, 5, 6, 11, 14, 16, 41, 44, 46}),
        ("the paper, L = 1", "# Results", {1, 2, 11}),  # which has no five layers
        ("_learning.png", CART_POLE, {1, 4, 5, 6}),
        ("_settings.png", CART_POLE, {1, 2, 3, 6}),
        ("sd over seeds", CART_POLE, {1, 2, 3, 4, 6}),
        (f"P({OWN} > Y)", CART_POLE, {1, 4}),
        ("mean of the last", CART_POLE, {1, 2, 3, 4, 5, 6}),
        ("Kaplan", CART_POLE, {1, 2, 3, 4, 5}),
        ("Kaplan", "## Fetch-v4", {41, 44, 46}),  # whose threshold the ceiling decides
        ("all episodes | last", CART_POLE, {4}),
        ("minutes a run", CART_POLE, {1, 2, 3, 4, 5, 6}),
    ],
)
def test_a_caption_tells_of_the_runs_that_are_shown_or_are_the_scale_and_of_no_others(caption_of, text, after, seeds):
    assert {int(number) for number in re.findall(r"(?<![=\w-])\d+(?!\w)", caption_of(text, after))} == seeds


def test_differing_versions_are_named():
    study = grouped(
        run("A", [1.0], versions={"numpy": "2.0", "torch": "2.3"}), run("B", [1.0], versions={"numpy": "2.1"}),
    )  # fmt: skip
    origins = Origins(study)
    assert "Not the same in all runs: numpy (2.0, 2.1), torch (2.3, none)." in origins.lines()
    assert "The same in all: cores 2." in origins.lines()
    assert [line.split(" | ")[4] for line in origins.lines() if re.match(r"\| [AB] ", line)] == [
        "numpy 2.0, torch 2.3", "numpy 2.1",
    ]  # fmt: skip
    assert origins.caption(study).endswith("**Their revisions or versions differ.**")
    alike = Origins(grouped(run("A", [1.0]), run("B", [1.0])))
    assert "All runs have the same revision and versions." in alike.lines()


def test_a_missing_optional_package_makes_no_difference():
    """Older files do not name any."""
    versions = [{"numpy": "2.0"}, {"numpy": "2.0", "ray": "2.60"}, {"numpy": "2.0", "ray": "2.61"}]
    first, second, third = (run(name, [1.0], versions=found) for name, found in zip("ABC", versions, strict=True))
    origins = Origins(grouped(first, second))
    assert "All runs have the same revision and versions." in origins.lines()
    assert "**" not in origins.caption(grouped(first, second))
    assert any(line.startswith("| B | 1 |") and "| ray 2.60 |" in line for line in origins.lines())
    assert "Not the same in all runs: ray (2.60, 2.61)." in Origins(grouped(first, second, third)).lines()


def test_methods_with_the_same_other_seeds_are_told_together():
    runs = {name: [run(name, [1.0], seed=seed) for seed in seeds]
            for name, seeds in {"A": [0, 1], "B": [0], "C": [0, 1], "D": [2], "E": [0]}.items()}  # fmt: skip
    study = {"Pendulum-v1": runs}
    assert Origins(study).caption(study).startswith("Seeds 0, 1 (of B, E: 0; of D: 2). Made with")
    study |= {"Swimmer-v5": {"A": runs["A"]}, "Ant-v5": runs}
    expected = "Seeds 0, 1 (of B, E: 0; of D: 2) on Pendulum-v1, Ant-v5; 0, 1 on Swimmer-v5. Made with"
    assert Origins(study).caption(study).startswith(expected)


def test_a_command_cannot_break_the_table():
    study = grouped(run("A", [1.0], command="a | b\nc"))
    (row,) = [line for line in Origins(study).lines() if line.startswith("| A ")]
    assert "`a \\| b c` (1)" in row


def test_commands_that_differ_in_their_options_are_told_once():
    study = grouped(
        *(run("A", [1.0], seed=seed, command=f"dgpmpc bench table --seeds {seed}") for seed in range(3)),
        run("B", [1.0], command="python -m benchmarks.other"),
    )
    (row,) = [line for line in Origins(study).lines() if line.startswith("| A ")]
    assert "| 4 | `dgpmpc bench table …` (3), `python -m benchmarks.other` (1) |" in row


def test_the_same_files_give_the_same_report(folder, tmp_path):
    first = write_report(folder, tmp_path / "one" / "out")
    second = write_report(folder, tmp_path / "two" / "out.md", tasks=["ModCartPole-v0", "Alone-v0", "Fetch-v4"])
    assert [file.name for file in first] == [file.name for file in second]
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(first, second, strict=True))


def test_tasks_and_references_can_be_chosen(folder, tmp_path):
    files = write_report(folder, tmp_path / "out", tasks=["ModCartPole-v0"], reference="DGP-MPC L=3 rbf")
    page = files[0].read_text()
    assert "P(DGP-MPC L=3 rbf > Y)" in page
    assert "Fetch-v4" not in page
    with pytest.raises(ResultError, match="Ant-v5"):
        write_report(folder, tmp_path / "out", tasks=["Ant-v5"])
    with pytest.raises(ValueError, match="'SAC'"):
        write_report(folder, tmp_path / "out", reference="SAC")
    with pytest.raises(ValueError, match="Ant-v5"):
        write_report(folder, tmp_path / "out", thresholds={"Ant-v5": 1.0})


def test_the_ceiling_alone_makes_a_report(tmp_path):
    run("true dynamics", [5.0]).write(tmp_path / "runs")
    files = write_report(tmp_path / "runs", tmp_path / "out")
    assert len(files) == 1
    assert "*true dynamics* (all its episodes)" in files[0].read_text()


def test_a_damaged_folder_writes_nothing(folder, tmp_path):
    damaged = folder / "Fetch-v4_SAC_seed0.json"
    damaged.write_text(damaged.read_text()[:-40])
    with pytest.raises(ResultError, match=r"Fetch-v4_SAC_seed0\.json"):
        write_report(folder, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


@pytest.fixture
def command():
    app = typer.Typer()
    app.command()(report)
    return lambda *arguments: CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_command(command, folder, tmp_path):
    out = tmp_path / "out"
    result = command(folder, "--out", out, "--task", "Fetch-v4", "--threshold", "Fetch-v4=-2.5")
    assert result.exit_code == 0, result.output
    assert result.output.split() == [str(out.with_suffix(".md")), "and", "4", "figures", "in", str(out)]
    page = out.with_suffix(".md").read_text()
    assert f"by `dgpmpc report {folder} --out {out} --task Fetch-v4 --threshold Fetch-v4=-2.5`" in page
    assert "first reached −2.50 (as given)" in page


def test_figures_in_other_formats_lie_beside_those_of_the_page(command, folder, tmp_path):
    out = tmp_path / "out"
    result = command(folder, "--out", out, "--task", "Alone-v0", "--format", "png", "--format", "svg")
    assert result.exit_code == 0, result.output
    page = out.with_suffix(".md").read_text()
    assert re.findall(r"!\[[^\]]+\]\(([^)]+)\)", page) == ["out/Alone-v0_learning.png"]
    assert f"--out {out} --task Alone-v0 --format png --format svg`" in page
    assert sorted(path.name for path in out.iterdir()) == ["Alone-v0_learning.png", "Alone-v0_learning.svg"]


@pytest.mark.parametrize("text", ["Fetch-v4", "=1", "Fetch-v4=much", "Fetch-v4=nan"])
def test_command_with_half_a_threshold(command, folder, text):
    result = command(folder, "--threshold", text)
    assert result.exit_code == 2
    assert text in result.output


def test_command_without_results(command, tmp_path):
    result = command(tmp_path, "--out", tmp_path / "out")
    assert is_one_line_error(result, str(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_command_with_a_method_that_was_not_run(command, folder, tmp_path):
    result = command(folder, "--out", tmp_path / "out", "--reference", "PETS")
    assert is_one_line_error(result, "'PETS'", "DGP-MPC L=3 rbf")
