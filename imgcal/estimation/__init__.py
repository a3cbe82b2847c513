"""Batched maximum a posteriori estimation of rigs, with covariance and gradients."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
