"""Training runs, each with a folder of its own: its settings, results, agent and pictures.

`training.py` runs an agent, `folder.py` keeps what comes of it and goes on after a kill; `recording.py`, `figures.py` and
`rendering.py` make the pictures, `provenance.py` says with which versions and on which machine. The command line and the
benchmarks are made of these; nothing above this room knows of it.
"""

from gym_dgpmpc.runs.figures import Forecast, observation_labels, plot_learning_curve, plot_prediction_fan

__all__ = ["Forecast", "observation_labels", "plot_learning_curve", "plot_prediction_fan"]
