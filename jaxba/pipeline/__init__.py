"""From photos to a georeferenced cloud: one module a stage, wired by `_stages.py` and run by `_runner.py`.

`import jaxba.pipeline` loads nothing else: a worker that runs one stage loads that stage alone (PEP 562).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
