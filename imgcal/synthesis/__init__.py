"""Synthetic data: drifted rigs, poses, captures with known truth, faults in them, colour-coded images."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
