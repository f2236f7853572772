"""Benchmarks of `gym_dgpmpc`, which are in the repository and not in the installed package.

- `commands` are `dgpmpc bench` and `dgpmpc report`;
- `suites` lists what is run: `methods` on `tasks`, each a `run`; `paper` holds the published numbers;
- `jobs` and `executors` do the work, on this machine or on a cluster, and `listing` says what is left to do;
- `result_files` reads and writes what runs leave, and `report` makes tables and figures of it;
- `contact` is the study of a cart that hits the end of its rail, `speed` what plans and training cost;
- `calibration`, `defaults`, `noise`, `planners`, `real_time` and `fingerprint` are small studies of their own:
  `python -m benchmarks.NAME`.
"""

from pathlib import Path

RESULTS = Path(__file__).parent / "results"
"""The results that are in the repository, one folder per study."""

WORK = Path(__file__).parents[1] / "runs" / "bench"
"""Where unfinished runs of `dgpmpc bench` keep their state."""
