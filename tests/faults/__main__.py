"""`python -m tests.faults`: all faults at full size, two sections at a time; prints and keeps a table.

What is kept grows with every section that ends; `--only` runs some of them and leaves the results of the others. With
`--quick` every section is tried at a small size and nothing is kept.
"""

import argparse
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from gym_dgpmpc.checkpoints.files import replace_text

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results" / "reliability"
PACKAGES = ("gymnasium", "hypothesis", "mujoco", "numpy", "safetensors", "scipy", "stable-baselines3", "torch")


def kills(folder, quick):
    from tests.faults.kills import run_kills, summary

    return summary(run_kills(folder, 6 if quick else 100))


def cuts(folder, quick):
    from tests.faults.writes import run_cuts

    counts, lost = run_cuts(folder, 4 if quick else 40)
    told = ", ".join(f"{count} in the {kind}" for kind, count in counts.items())
    return f"{sum(counts.values())} writes cut by a kill, cut by an error, or torn on disk ({told})", lost


def disk(folder, quick):
    from tests.faults.writes import run_full_disk, run_read_only

    how, number, lost = run_full_disk(folder, 20 if quick else 200)
    attempts, more = run_read_only(folder)
    return f"{number} writes to {how} with less and less room; {attempts} to folders that refuse", [*lost, *more]


def mutations(folder, quick):
    from tests.faults.files import MEMORY_BOUND, run_mutations

    counts, wrong = run_mutations(folder, 200 if quick else 10_000)
    told = ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
    return f"{sum(counts.values())} mutated files ({told}); at most {MEMORY_BOUND >> 20} MB allocated for each", wrong


def hostile(folder, quick):
    from tests.faults.files import run_hostile

    number, counts, wrong = run_hostile(folder)
    return f"{number} hostile files ({', '.join(f'{name} {count}' for name, count in sorted(counts.items()))})", wrong


def cases(folder, quick):
    from tests.faults.cases import run_cases

    counts, wrong = run_cases(50 if quick else 10_000)
    told = ", ".join(f"{name}: {count}" for name, count in sorted(counts.items(), key=lambda item: -item[1]))
    return f"{sum(counts.values())} cases of data through learning, drawing, planning, predicting ({told})", wrong


def worlds(folder, quick):
    from tests.faults.outcomes import run_worlds

    counts, wrong = run_worlds(50 if quick else 10_000)
    told = ", ".join(f"{name}: {count}" for name, count in sorted(counts.items(), key=lambda item: -item[1]))
    return f"{sum(counts.values())} environments through learning, predicting, saving, loading ({told})", wrong


def soak(folder, quick):
    from tests.faults.soak import run_soak

    found, wrong = run_soak(folder, 60 if quick else 2_000)
    return "; ".join(f"{name} {value}" for name, value in found.items()), wrong


SECTIONS = {
    "kills": (kills, "SIGKILL at random moments; each run must end as the whole one, bit for bit"),
    "cuts": (cuts, "writes of a checkpoint cut short; the one before must load"),
    "disk": (disk, "full disk, read-only folders; the one before must stay whole"),
    "mutations": (mutations, "mutated checkpoints; only named errors, no code, bounded memory"),
    "hostile": (hostile, "hostile checkpoints; only named errors, no code, bounded memory"),
    "cases": (cases, "hard data; a finite action in bounds or a named error"),
    "worlds": (worlds, "environments of every kind; what they returned is stored, or a named error"),
    "soak": (soak, "many episodes; steady memory and time"),
}


def run_section(name, quick):
    """Run one section in a process of its own: {"tried", "lost", "minutes"}."""
    command = [sys.executable, "-m", "tests.faults", "--section", name, *(["--quick"] if quick else [])]
    started = time.time()
    result = subprocess.run(command, capture_output=True, text=True)
    minutes = (time.time() - started) / 60
    try:
        found = json.loads(result.stdout.splitlines()[-1])
    except (IndexError, ValueError):
        found = {"tried": "nothing: the section failed", "lost": [result.stderr[-2000:]]}
    print(f"{name}: {found['tried']}; lost: {found['lost'] or 'nothing'}; {minutes:.1f} minutes", flush=True)
    return {**found, "minutes": round(minutes, 1)}


def table(found):
    lines = ["| what | tried | lost | minutes | revision |", "|---|---|---|---|---|"]
    for name, section in found.items():
        lost = "nothing" if not section["lost"] else "; ".join(section["lost"])
        cells = (SECTIONS[name][1], section["tried"], lost, section["minutes"], section.get("revision", ""))
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__.split(";")[0])
    parser.add_argument("--quick", action="store_true", help="small sizes; results are not kept")
    parser.add_argument("--section", choices=SECTIONS, help="run this one alone, in this process, and print JSON")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS), help="run these sections alone")
    arguments = parser.parse_args()
    if arguments.section:
        import torch

        torch.set_num_threads(1)
        with tempfile.TemporaryDirectory() as folder:
            tried, lost = SECTIONS[arguments.section][0](Path(folder), arguments.quick)
        print(json.dumps({"tried": tried, "lost": lost}))
        return 0
    # The longest first.
    order = sorted(
        arguments.only, key=("worlds", "cases", "kills", "soak", "mutations", "cuts", "hostile", "disk").index
    )
    with ThreadPoolExecutor(2) as pool:
        running = {pool.submit(run_section, name, arguments.quick): name for name in order}
        found = {}
        for ended in as_completed(running):
            found[running[ended]] = ended.result()
            if not arguments.quick:
                keep(running[ended], ended.result())
    print(f"\n{table({name: found[name] for name in SECTIONS if name in found})}")
    return int(any(section["lost"] for section in found.values()))


def keep(name, section):
    """Add a section's results to the table, with the revision and the versions that they were made with."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    file = RESULTS / "faults.json"
    kept = json.loads(file.read_text()) if file.exists() else {}
    revision = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    kept[name] = {
        **section,
        "revision": revision or "unknown",
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "versions": {package: importlib.metadata.version(package) for package in PACKAGES},
    }
    replace_text(file, json.dumps(kept, indent=1) + "\n")
    kept = {name: kept[name] for name in SECTIONS if name in kept}
    facts = "; ".join(sorted({_told_versions(section) for section in kept.values()}))
    missing = ", ".join(name for name in SECTIONS if name not in kept)
    text = f"# Faults injected, and what was lost\n\nMade by `make fault-test`, with {facts}.\n\n{table(kept)}"
    replace_text(RESULTS / "faults.md", text + (f"\nNot run yet: {missing}.\n" if missing else ""))


def _told_versions(section):
    versions = ", ".join(f"{name} {version}" for name, version in section["versions"].items())
    return f"Python {section['python']}, {versions}, on {section['system']}"


if __name__ == "__main__":
    sys.exit(main())
