"""Files to types and back: `tile.npz` (all that a problem holds) and BAL text; files that appear whole or not at all.

`import jaxba.io` loads no jax, so that a program that only writes files stays light: a name loads its module when it is
first used (PEP 562).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
