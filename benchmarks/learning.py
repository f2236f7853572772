"""Learning curves over layers and seeds: `python -m benchmarks.learning`.

Each run is one `dgpmpc train` in its own process of one thread. A run's folder goes on after its last finished
episode, so the same command after an interruption loses at most one episode per run. When a run ends its raw results
(`episodes.csv`, `settings.json`) are copied to `--results`, and the table and figure there are made anew.
"""

import argparse
import csv
import json
import shutil
import statistics
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

PAPER = {
    "ModCartPole-v0": {("matern32", 1): 95.97, ("matern32", 2): 140.81, ("matern32", 3): 149.81},
    "BiasedReacher-v0": {
        ("matern32", 1): -45.09, ("matern32", 2): -44.39, ("matern32", 3): -44.68, ("matern12", 1): -39.89,
    },
    "RiskSensitiveHalfCheetah-v0": {("matern32", 2): 1540.0, ("matern32", 3): 1680.0},
}  # fmt: skip
"""Average episode return over 10 seeds in table 2 of the paper, by environment, kernel and layers."""

CEILING = {"ModCartPole-v0": 176.0, "BiasedReacher-v0": -32.0, "RiskSensitiveHalfCheetah-v0": 6500.0}
"""About what the same planner earns per episode with the true dynamics."""


class Run(NamedTuple):
    """One cell of the table with one seed."""

    environment: str
    kernel: str
    num_layers: int
    seed: int

    @property
    def name(self) -> str:
        return f"{self.environment}_{self.kernel}_L{self.num_layers}_seed{self.seed}"

    def command(self, folder: Path, episodes: int) -> list[str]:
        options = {
            "--layers": self.num_layers, "--kernel": self.kernel, "--seed": self.seed, "--episodes": episodes,
            "--threads": 1, "--out": folder / self.name,
        }  # fmt: skip
        flat = [str(part) for option in options.items() for part in option]
        return [sys.executable, "-m", "gym_dgpmpc", "train", self.environment, *flat, "--no-video", "--no-progress"]


def perform(run: Run, folder: Path, results: Path, episodes: int) -> bool:
    """Do the run, or what is left of it, unless its results are there already; say whether it ended well."""
    if (results / f"{run.name}.csv").exists():
        return True
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"{run.name}.log").open("a") as log:
        code = subprocess.run(run.command(folder, episodes), stdout=log, stderr=subprocess.STDOUT).returncode
    if code:
        print(f"{run.name} failed with exit code {code}; see {log.name}", file=sys.stderr)
        return False
    results.mkdir(parents=True, exist_ok=True)
    settings = json.loads((folder / run.name / "settings.json").read_text()) | {"commit": commit()}
    (results / f"{run.name}.json").write_text(json.dumps(settings, indent=2) + "\n")
    shutil.copyfile(folder / run.name / "episodes.csv", results / f"{run.name}.csv")
    print(f"{run.name}: mean {statistics.mean(returns_of(results, run)):.2f}", flush=True)
    return True


def commit() -> str:
    """The revision of the package that ran, marked if the package differs from it; results do not count."""
    here = Path(__file__).parents[1]

    def git(*arguments: str) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(["git", "-C", str(here), *arguments], capture_output=True, text=True, check=False)

    revision = git("rev-parse", "HEAD").stdout.strip() or "unknown"
    return revision + ("-dirty" if git("diff", "--quiet", "HEAD", "--", "gym_dgpmpc").returncode else "")


def returns_of(results: Path, run: Run) -> list[float]:
    """Returns of the controlled episodes; the random first episode is not the agent's doing and not counted."""
    with (results / f"{run.name}.csv").open(newline="") as file:
        return [float(row["episode_return"]) for row in csv.DictReader(file) if row["actions"] == "planned"]


def finished(results: Path) -> dict[tuple[str, str, int], dict[int, list[float]]]:
    """Returns by (environment, kernel, layers) and seed, of all results there are."""
    table: dict[tuple[str, str, int], dict[int, list[float]]] = {}
    for file in sorted(results.glob("*_seed*.csv")):
        environment, kernel, layers, seed = file.stem.split("_")
        run = Run(environment, kernel, int(layers[1:]), int(seed.removeprefix("seed")))
        table.setdefault(run[:3], {})[run.seed] = returns_of(results, run)
    return table


def summarise(results: Path, command: str) -> None:
    """Write `table.md` and one learning-curve figure per environment."""
    table = finished(results)
    lines = [
        "Mean over the controlled episodes of a run, then mean and standard deviation over seeds.",
        f"Made by `{command}`; raw results, settings and versions per run are beside this file.",
        "",
        "| environment | kernel | L | seeds | episodes | mean return | std over seeds | last 5 episodes | paper |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for (environment, kernel, layers), by_seed in sorted(table.items()):
        means = [statistics.mean(returns) for returns in by_seed.values()]
        spread = f"{statistics.stdev(means):.2f}" if len(means) > 1 else "one seed"
        last = statistics.mean(statistics.mean(returns[-5:]) for returns in by_seed.values())
        paper = PAPER.get(environment, {}).get((kernel, layers), "")
        seeds, episodes = ", ".join(map(str, sorted(by_seed))), min(map(len, by_seed.values()))
        lines.append(
            f"| {environment} | {kernel} | {layers} | {seeds} | {episodes} | {statistics.mean(means):.2f} | {spread} "
            f"| {last:.2f} | {paper} |"
        )
    (results / "table.md").write_text("\n".join(lines) + "\n")
    for environment in {key[0] for key in table}:
        plot({key[1:]: runs for key, runs in table.items() if key[0] == environment}, environment, results)


def plot(curves: dict[tuple[str, int], dict[int, list[float]]], environment: str, results: Path) -> None:
    """Returns by episode: each seed thin, the mean over seeds thick."""
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    for index, ((kernel, layers), by_seed) in enumerate(sorted(curves.items())):
        colour = f"C{index}"
        for returns in by_seed.values():
            axes.plot(range(1, len(returns) + 1), returns, color=colour, alpha=0.3, linewidth=0.8)
        mean = [statistics.mean(values) for values in zip(*by_seed.values(), strict=False)]
        label = f"L = {layers}, {kernel} ({len(by_seed)} seeds)"
        axes.plot(range(1, len(mean) + 1), mean, color=colour, linewidth=2.0, label=label)
    if environment in CEILING:
        axes.axhline(CEILING[environment], color="black", linestyle=":", label="planner with the true dynamics, about")
    axes.set(xlabel="controlled episode", ylabel="return", title=environment)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize="small")
    figure.savefig(results / f"{environment}.png", dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.learning", description=__doc__)
    parser.add_argument("--env", default="ModCartPole-v0", help="id of the environment")
    parser.add_argument("--kernels", nargs="+", default=["matern32"])
    parser.add_argument("--layers", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--episodes", type=int, default=15, help="controlled episodes of a run")
    parser.add_argument("--processes", type=int, default=2, help="runs at the same time, one thread each")
    parser.add_argument("--folder", type=Path, default=Path("runs/learning"), help="where runs go on")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/learning"))
    parser.add_argument("--report", action="store_true", help="only make table and figure from what there is")
    arguments = parser.parse_args()
    command = f"python -m benchmarks.learning {' '.join(a for a in sys.argv[1:] if a != '--report')}".strip()
    ended_well = True
    if not arguments.report:
        # Seeds outermost, so that an interrupted benchmark has every setting with some seeds.
        runs = [
            Run(arguments.env, kernel, layers, seed)
            for seed, kernel, layers in product(arguments.seeds, arguments.kernels, arguments.layers)
        ]
        with ThreadPoolExecutor(arguments.processes) as pool:
            ended = pool.map(lambda run: perform(run, arguments.folder, arguments.results, arguments.episodes), runs)
            ended_well = all(list(ended))
    if arguments.results.exists():
        summarise(arguments.results, command)
    sys.exit(0 if ended_well else 1)


if __name__ == "__main__":
    main()
