"""Renderers: pixels, colours and visibility in, images out. A leaf package that knows no camera."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
