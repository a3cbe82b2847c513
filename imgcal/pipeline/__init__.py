"""From frames or blobs to a recalibrated rig, and the checks that it must pass."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
