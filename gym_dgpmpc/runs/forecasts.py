"""Forecasts of a run's last planned episode in a file, so that their figure can be drawn again in any format."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gym_dgpmpc.checkpoints.files import replace_file
from gym_dgpmpc.runs.figures import Forecast


class KeptForecasts(NamedTuple):
    """All that a prediction fan is drawn from."""

    forecasts: Sequence[Forecast]
    labels: Sequence[str]
    """Of each number of the observation, with its unit."""
    episode: int
    """The episode that they were made in; counts from 1."""
    step_seconds: float | None = None
    """Duration of an environment step, if it is known."""

    def write(self, path: Path) -> None:
        """Write the file, an npz of numbers and texts.

        Raises:
            OSError: it cannot be written; an old file is untouched.
        """
        arrays = {"labels": np.array(self.labels, dtype=str), "episode": np.array(self.episode)}
        arrays["start_steps"] = np.array([forecast.start_step for forecast in self.forecasts], dtype=np.int64)
        if self.step_seconds is not None:
            arrays["step_seconds"] = np.array(self.step_seconds)
        for index, forecast in enumerate(self.forecasts):
            arrays |= {f"predicted_{index}": forecast.predicted, f"observed_{index}": forecast.observed}
        replace_file(path, lambda file: np.savez_compressed(file, allow_pickle=False, **arrays))

    @classmethod
    def read(cls, path: Path) -> "KeptForecasts":
        """What `write` wrote.

        Raises:
            ValueError: the file is something else.
            OSError: it cannot be read.
        """
        try:
            with np.load(path, allow_pickle=False) as arrays:
                forecasts = [
                    Forecast(int(start), arrays[f"predicted_{index}"], arrays[f"observed_{index}"])
                    for index, start in enumerate(arrays["start_steps"])
                ]
                step_seconds = float(arrays["step_seconds"]) if "step_seconds" in arrays else None
                return cls(forecasts, arrays["labels"].tolist(), int(arrays["episode"]), step_seconds)
        except OSError:
            raise
        except Exception as error:  # what NumPy and zipfile raise for damaged bytes is not limited to their own
            raise ValueError(f"{path} does not hold the forecasts of a run: {error!r}") from error
