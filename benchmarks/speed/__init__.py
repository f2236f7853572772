"""What planning and training cost, beside other methods in the same run: `python -m benchmarks.speed`."""
