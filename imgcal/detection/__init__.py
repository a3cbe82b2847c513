"""Blobs in captured frames: OpenCV detects them, and a fitted ellipse measures them."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
