"""Training of the networks: experiment files, and the engine (`imgcal.training.train`)."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
