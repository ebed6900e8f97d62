"""Resumable work: a store with keys and checksums, a lock, worker processes, parameters, the project folder.

It knows no stage. `import jaxba.engine` loads nothing else: a name loads its module when it is first used (PEP 562).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
