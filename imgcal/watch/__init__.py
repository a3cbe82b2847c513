"""Rigs that are watched while they run: exposures come in, snapshots are made of them, what is found goes out."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
