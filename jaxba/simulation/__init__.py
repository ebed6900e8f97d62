"""Surveys with known truth: blocks of observations (`jaxba.synthetic`), flights, painted ground, rendered photos.

`import jaxba.simulation` loads nothing else: a name loads its module when it is first used (PEP 562).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
