"""Running rigs: exposures come in, are combined into snapshots, and results go out."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
