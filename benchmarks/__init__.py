"""Benchmarks: `python -m benchmarks.run` prints every table of the README."""
