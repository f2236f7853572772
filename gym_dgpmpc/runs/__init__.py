"""Training runs, each with a folder of its own: its settings, results, agent and pictures.

`training.py` runs an agent; `folder.py` keeps its results, and lets a killed run go on. `recording.py`, `figures.py`
and `rendering.py` make the pictures; `looking.py` logs what can be seen inside an agent while it learns;
`provenance.py` records versions and machine. The command line and the benchmarks are made of these, and nothing in the
rooms above knows this one.
"""

from gym_dgpmpc.runs.figures import Forecast, observation_labels, plot_learning_curve, plot_prediction_fan
from gym_dgpmpc.runs.looking import LookInside

__all__ = ["Forecast", "LookInside", "observation_labels", "plot_learning_curve", "plot_prediction_fan"]
