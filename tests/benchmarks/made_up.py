"""Runs whose statistics are known in closed form."""

from collections.abc import Sequence

from benchmarks.result_files import Episode, RunKey, RunResult


def run(
    method: str,
    returns: Sequence[float],
    *,
    task: str = "Pendulum-v1",
    seed: int = 0,
    steps: int | Sequence[int] = 100,
    random: float | None = None,
    seconds: float = 60.0,
    success: Sequence[bool] | None = None,
    revision: str = "abc",
    command: str = "dgpmpc bench some --seeds 0",
    versions: dict[str, str] | None = None,
    milliseconds: float | None = 5.0,
    cpu_seconds: float | None = None,
    iterations: int | None = None,
) -> RunResult:
    """One run of episodes with these returns, after a random one of ``random`` if that is given."""
    lengths = [steps] * len(returns) if isinstance(steps, int) else list(steps)
    episodes, total = [], 0
    if random is not None:
        total += lengths[0]
        episodes.append(Episode("random", random, lengths[0], total, seconds, None, cpu_seconds, iterations))
    for index, (value, length) in enumerate(zip(returns, lengths, strict=True)):
        total += length
        succeeded = None if success is None else success[index]
        episodes.append(Episode("planned", value, length, total, seconds, succeeded, cpu_seconds, iterations))
    return RunResult(
        RunKey(method, task, seed), tuple(episodes), {"horizon": 30}, milliseconds,
        f"2026-01-0{seed + 1}T00:00:00+00:00", command, revision,
        versions or {"python": "3.11", "numpy": "2.0"}, {"cores": 2},
    )  # fmt: skip


def grouped(*results: RunResult) -> dict[str, dict[str, list[RunResult]]]:
    """By task and method, as `load_runs` gives them."""
    study: dict[str, dict[str, list[RunResult]]] = {}
    for result in results:
        study.setdefault(result.key.task, {}).setdefault(result.key.method, []).append(result)
    return study
