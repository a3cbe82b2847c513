"""The report: one self-contained HTML page that shows a recalibration."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
