"""Training of the networks: experiment files, checkpoints, and the engine (`imgcal.training.engine.train`)."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
