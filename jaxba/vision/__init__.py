"""Photos to arrays: decoding, tags, features, matches, two-view geometry.

`import jaxba.vision` loads neither OpenCV nor jax: a name loads its module when it is first used (PEP 562).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
