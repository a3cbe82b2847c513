"""Renderers: from pixels, colours and visibility to images. A leaf package without camera models."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
