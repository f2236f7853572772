"""How well models know what they do not know, on recorded episodes: `python -m benchmarks.calibration`.

Every model is trained on 1, 2 and 4 episodes of a learning run, and forecasts 1 to 40 steps of episodes that it has not
seen, on the run's policy and off it. Writes a file of rows, one for each seed, for every task and model, and
`calibration.md`, the means over seeds. What is in a file already is not measured again; several commands may run beside
each other if their tasks or models differ.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks import RESULTS
from benchmarks.calibration.episodes import DATA, SEEDS, TASKS
from benchmarks.calibration.measure import TESTED_AFTER, measure
from benchmarks.calibration.models import MODELS
from benchmarks.calibration.tables import all_scores, beside_rivals
from benchmarks.rows import command
from gym_dgpmpc.checkpoints.files import replace_text


def rows_file(task: str, model: str) -> str:
    return f"{task}_{model.replace(', ', '-').replace(' ', '-')}.json"


def every_row(results: Path) -> list[dict[str, Any]]:
    """Of all tasks and models, in the order of `TASKS` and `MODELS`."""
    files = [results / rows_file(task, name) for task in TASKS for name in MODELS]
    return [row for file in files if file.exists() for row in json.loads(file.read_text())["rows"]]


def page(rows: list[dict[str, Any]]) -> str:
    """All tables, and what made them."""
    commands = ", ".join(f"`{each}`" for each in dict.fromkeys(row["command"] for row in rows))
    return "\n".join([f"Made by {commands}.", "", *beside_rivals(rows), "", *all_scores(rows)]) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration", description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=list(MODELS), metavar="MODEL")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--episodes", nargs="+", type=int, default=list(TESTED_AFTER))
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--results", type=Path, default=RESULTS / "calibration")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.results.mkdir(parents=True, exist_ok=True)
    about = {"command": command("calibration"), "torch": torch.__version__}
    for seed in arguments.seeds:
        for task in arguments.tasks:
            for name in arguments.models:
                file = arguments.results / rows_file(task, name)
                rows = json.loads(file.read_text())["rows"] if file.exists() else []
                if {row["episodes"] for row in rows if row["seed"] == seed} >= set(arguments.episodes):
                    continue
                started = time.time()
                found = measure(MODELS[name], task, seed, tuple(arguments.episodes), arguments.data)
                # In place of what a command for fewer episodes left of this seed.
                rows = [row for row in rows if row["seed"] != seed] + [{"model": name} | row | about for row in found]
                replace_text(file, json.dumps({"rows": rows}, indent=1) + "\n")
                print(f"{task}, seed {seed}, {name}: {time.time() - started:.0f} s", flush=True)
    shown = page(every_row(arguments.results))
    replace_text(arguments.results / "calibration.md", shown)
    print(shown)


if __name__ == "__main__":
    main()
