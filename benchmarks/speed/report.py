"""The tables of `python -m benchmarks.speed`: times, and the ratios that matter, of one run."""

from typing import Any

from benchmarks.report import markdown
from benchmarks.rows import Row, find
from benchmarks.speed.cases import NUM_CANDIDATES, NUM_FEATURES, NUM_INDUCING, NUM_PARTICLES

EXTRA = (
    "cpu_ms", "chains", "varied", "value", "extra_memory_mb", "seconds_to_compile", "product_gflops",
    "large_product_gflops", "by",
)  # fmt: skip
"""What some rows have besides their times."""


def ratio(rows: list[Row], slow: Row, fast: Row) -> str:
    """How many times longer the median of one row is than that of another."""
    above, below = find(rows, **slow), find(rows, **fast)
    return f"{above['p50_ms'] / below['p50_ms']:.1f}" if above and below else markdown.NOTHING


def ratios(rows: list[Row]) -> list[str]:
    """The comparisons of the issue of speed, per case, threads and refresh, at the largest number of layers."""
    lines = []
    keys = sorted({(r["threads"], r["case"]) for r in rows if r.get("case") and r["worker"] == "plans"})
    for threads, case in keys:
        depth = max(r["L"] for r in rows if r.get("case") == case and r["worker"] == "plans" and r["L"])
        for refresh in ("step", "plan"):
            at = {"threads": threads, "case": case}
            ours = at | {"what": "plan", "L": depth, "how": f"pathwise, {refresh}"}
            step = at | {"what": "rollout step", "L": depth, "how": f"pathwise, {refresh}"}
            training = at | {"what": "training iteration", "L": depth}
            lines.append([
                case, str(depth), refresh, str(threads),
                ratio(rows, at | {"what": "plan", "L": depth, "how": "joint"}, ours),
                ratio(rows, at | {"what": "plan", "L": depth, "how": "PETS, float32"}, ours),
                ratio(rows, at | {"what": "plan", "L": depth, "how": "PETS, bfloat16 inside"}, ours),
                ratio(rows, at | {"what": "rollout step", "L": depth, "how": "GPyTorch"}, step),
                ratio(rows, training | {"how": "GPyTorch"}, training | {"how": "this package"}),
                ratio(rows, ours, at | {"what": "bare arithmetic of a plan", "L": depth}),
            ])  # fmt: skip
    header = [
        "task", "L", "refresh", "threads", "`joint` / plan", "PETS / plan", "PETS in bfloat16 / plan",
        "GPyTorch / rollout step", "GPyTorch / training iteration", "plan / bare arithmetic in PyTorch",
    ]  # fmt: skip
    return markdown.table(header, lines)


def times(rows: list[Row], worker: str) -> list[str]:
    """All times of one worker."""
    extra = [key for key in EXTRA if any(key in row for row in rows if row["worker"] == worker)]
    lines = []
    for row in rows:
        if row["worker"] != worker:
            continue
        cells = [row["case"], str(row["threads"]), row["what"], _cell(row.get("L")), _cell(row.get("how"))]
        cells += [_cell(row["p50_ms"]), _cell(row.get("p95_ms")), *(_cell(row.get(key)) for key in extra)]
        lines.append(cells)
    return markdown.table(["task", "threads", "what", "L", "how", "p50 ms", "p95 ms", *extra], lines)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return (
        f"{value:.3g}"
        if isinstance(value, float) and value < 10
        else f"{value:.0f}"
        if isinstance(value, float)
        else str(value)
    )


def document(facts: Row, rows: list[Row]) -> str:
    """`speed.md`."""
    repeats = sorted({row["repeats"] for row in rows if row["repeats"] > 1})
    text = [
        f"Made by `{facts['command']}`; medians of at least {min(repeats, default=1)} repeats after a warm-up, "
        f"K = {NUM_CANDIDATES}, P = {NUM_PARTICLES}, M = {NUM_INDUCING}, F = {NUM_FEATURES}, Matern-3/2; one process "
        "at a time. "
        f"{facts['processor']}, {facts['cores']} cores, load {facts['load_average_1_min_before']:.1f} before and "
        f"{facts['load_average_1_min_after']:.1f} after; PyTorch {facts['versions']['torch']}, "
        f"revision {facts['revision']}. More versions in `speed.json`.",
        "",
        "How many times longer the others take, by medians (a training iteration moves several chains, GPyTorch's one "
        "model; the last column: this package's plan in units of the bare products, square roots, exponentials and "
        "cosines in PyTorch):",
        "",
        *ratios(rows),
        "",
    ]
    titles = {
        "plans": "Plans and rollout steps",
        "pets": "Plans by PETS",
        "training": "Training",
        "parts": "Where a plan's time goes",
        "inductor": "By `torch.compile` instead",
        "scaling": "Scaling",
        "knobs": "One setting changed at a time",
    }
    for worker, title in titles.items():
        if any(row["worker"] == worker for row in rows):
            text += [f"## {title}", "", *times(rows, worker), ""]
    return "\n".join(text)
