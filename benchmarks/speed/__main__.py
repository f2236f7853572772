"""`python -m benchmarks.speed`: plans and training at the sizes of the paper's three tasks, beside their peers.

Each worker is a process of its own, so that its threads and its peak memory are its own. Writes `speed.json` and
`speed.md`. Needs GPyTorch (`pip install -c constraints.txt -e ".[bench]"`). Compare figures of one run only, and of an
idle machine.
"""

import argparse
import json
import os
import subprocess
import sys
from itertools import product
from pathlib import Path

import torch

from benchmarks import RESULTS
from benchmarks.rows import command
from benchmarks.speed.cases import CASES
from benchmarks.speed.measure import WORKERS
from benchmarks.speed.report import document
from gym_dgpmpc.checkpoints.files import replace_text
from gym_dgpmpc.dynamics.deep_gp import compiled_rollout
from gym_dgpmpc.runs.provenance import processor, revision, versions


def work(arguments: argparse.Namespace) -> None:
    """One worker: its rows, as JSON, one a line."""
    torch.set_num_threads(arguments.threads[0])
    case = next(case for case in CASES if case.name == arguments.cases[0])
    compiled_rollout.is_available()
    for num_layers in arguments.layers:
        about = {"case": case.name, "threads": arguments.threads[0], "worker": arguments.worker, "L": num_layers}
        for row in WORKERS[arguments.worker](case, num_layers, arguments.repeats):
            print(json.dumps(about | row))


def main() -> None:
    names = [case.name for case in CASES]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed", description=__doc__)
    parser.add_argument("--cases", nargs="+", choices=names, default=names)
    parser.add_argument("--parts", nargs="+", choices=list(WORKERS), default=list(WORKERS), help="what to measure")
    parser.add_argument("--layers", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--results", type=Path, default=RESULTS / "speed")
    parser.add_argument("--worker", choices=list(WORKERS), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        work(arguments)
        return
    rows, load = [], os.getloadavg()[0]
    deepest, first = max(arguments.layers), arguments.threads[0]
    for threads, name, part, layers in product(arguments.threads, arguments.cases, arguments.parts, arguments.layers):
        wanted = {
            "pets": layers == deepest,  # these networks have layers of their own
            "inductor": layers == deepest and threads == first,
            **dict.fromkeys(
                ("scaling", "knobs"), (threads, name) == (first, arguments.cases[0]) and layers == min(2, deepest)
            ),
        }
        # More threads are compared where most is to be done.
        if not wanted.get(part, threads == first or layers == deepest):
            continue
        worker = [
            sys.executable, "-m", "benchmarks.speed", "--worker", part, "--cases", name, "--layers", str(layers),
            "--threads", str(threads), "--repeats", str(arguments.repeats),
        ]  # fmt: skip
        environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
        output = subprocess.run(worker, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
        rows += [json.loads(line) for line in output.splitlines() if line.startswith("{")]
        print(f"{name}, L = {layers}, {threads} thread(s): {part}", file=sys.stderr, flush=True)
    facts = {
        "command": command("speed"),
        "processor": processor(),
        "cores": os.cpu_count(),
        "load_average_1_min_before": load,
        "load_average_1_min_after": os.getloadavg()[0],
        "compiled": compiled_rollout.is_available(),
        "revision": revision(),
        "versions": versions(),
    }
    replace_text(arguments.results / "speed.json", json.dumps(facts | {"rows": rows}, indent=1) + "\n")
    text = document(facts, rows)
    replace_text(arguments.results / "speed.md", text)
    print(text)


if __name__ == "__main__":
    main()
