"""Value types: rigs, objects, what cameras have seen, what networks predict; and which values are plausible."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
