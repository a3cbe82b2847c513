"""Value types: rigs, objects, observations and network predictions; and the plausible ranges of values."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
