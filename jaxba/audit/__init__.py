"""Other programs' results audited: their own claims, a new adjustment with honest weights, and what is wrong.

`import jaxba.audit` loads no jax: a name loads its module when it is first used (PEP 562).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
