"""Networks: point and image variants, the paper's and ours, as presets."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
