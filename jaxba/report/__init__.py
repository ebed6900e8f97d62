"""What is said of a run: findings, summary, status, pictures, diagnosis, verification of the exports.

`import jaxba.report` loads nothing else: a name loads its module when it is first used (PEP 562).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
