"""Refinement after the network: MAP on its points, robust or not, or render-and-compare on its images."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
