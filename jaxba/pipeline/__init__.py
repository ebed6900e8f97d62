"""From photos to a georeferenced cloud: one module a stage, wired by `_stages.py` and run by `_runner.py`."""
