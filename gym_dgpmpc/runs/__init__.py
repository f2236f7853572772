"""Reporting: figures and videos of what an agent learned, and runs that keep their results in a folder."""

from gym_dgpmpc.runs.figures import Forecast, observation_labels, plot_learning_curve, plot_prediction_fan

__all__ = ["Forecast", "observation_labels", "plot_learning_curve", "plot_prediction_fan"]
