"""Benchmarks: methods side by side on the same tasks, one result file per run, and reports from such files."""
