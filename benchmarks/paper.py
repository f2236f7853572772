"""The paper's own numbers, to stand beside those of runs."""

from collections.abc import Mapping
from typing import NamedTuple


class Published(NamedTuple):
    """One cell of the paper's table."""

    mean: float
    deviation: float
    """Standard deviation over the trials of a trial's average."""


TRIALS = 10
"""Independent trials of each cell."""

EPISODES: Mapping[str, int] = {"ModCartPole-v0": 15, "BiasedReacher-v0": 15, "RiskSensitiveHalfCheetah-v0": 10}
"""Episodes that a trial's average is over, by task: all that are played after a random one."""

VARIANCE_EPISODES = 10
"""Episodes that the averages of the paper's variance figure are over, for every task."""

KERNELS: Mapping[str, str] = {
    "rbf": "squared exponential",
    "matern52": "Matérn-5/2",
    "matern32": "Matérn-3/2",
    "matern12": "Matérn-1/2",
}
"""The paper's names of this package's kernels, in its table's order."""

LAYERS = (1, 2, 3)

AVERAGE_RETURN: Mapping[str, Mapping[tuple[str, int], Published]] = {
    "ModCartPole-v0": {
        ("rbf", 1): Published(90.71, 15.43), ("rbf", 2): Published(132.73, 7.10), ("rbf", 3): Published(147.53, 4.01),
        ("matern52", 1): Published(85.38, 15.38), ("matern52", 2): Published(133.36, 6.61),
        ("matern52", 3): Published(141.34, 3.39),
        ("matern32", 1): Published(95.97, 15.59), ("matern32", 2): Published(140.81, 4.35),
        ("matern32", 3): Published(149.81, 3.76),
        ("matern12", 1): Published(98.33, 9.80), ("matern12", 2): Published(141.98, 4.86),
        ("matern12", 3): Published(147.67, 4.26),
    },
    "BiasedReacher-v0": {
        ("rbf", 1): Published(-50.88, 3.81), ("rbf", 2): Published(-44.62, 2.78), ("rbf", 3): Published(-49.04, 6.38),
        ("matern52", 1): Published(-47.42, 3.57), ("matern52", 2): Published(-46.74, 3.97),
        ("matern52", 3): Published(-44.85, 2.37),
        ("matern32", 1): Published(-45.09, 3.53), ("matern32", 2): Published(-44.39, 1.90),
        ("matern32", 3): Published(-44.68, 3.14),
        ("matern12", 1): Published(-39.89, 0.57), ("matern12", 2): Published(-40.82, 1.26),
        ("matern12", 3): Published(-41.28, 2.39),
    },
    "RiskSensitiveHalfCheetah-v0": {
        ("rbf", 1): Published(359.0, 124.5), ("rbf", 2): Published(1256.0, 133.5), ("rbf", 3): Published(1498.0, 70.4),
        ("matern52", 1): Published(474.0, 123.9), ("matern52", 2): Published(1603.0, 42.7),
        ("matern52", 3): Published(1612.0, 112.4),
        ("matern32", 1): Published(671.0, 83.9), ("matern32", 2): Published(1540.0, 139.5),
        ("matern32", 3): Published(1680.0, 83.3),
        ("matern12", 1): Published(584.0, 68.0), ("matern12", 2): Published(1264.0, 85.9),
        ("matern12", 3): Published(1400.0, 116.7),
    },
}  # fmt: skip
"""Average episode return by task, kernel and number of layers: the paper's table of kernels and depths."""
