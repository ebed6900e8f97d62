"""Flights judged before they are flown: what a plan would give, where it is weak, and where control helps most.

`import jaxba.design` loads nothing else: a name loads its module when it is first used (PEP 562).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
