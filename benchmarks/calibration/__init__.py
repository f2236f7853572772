"""How well models know what they do not know, on recorded episodes: `python -m benchmarks.calibration`."""
