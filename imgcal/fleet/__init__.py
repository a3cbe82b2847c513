"""Many rigs at once: captures of a fleet recalibrated by an existing engine, and what they teach."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
