"""imgcal: recalibration of infrared multi-camera rigs from images of a known calibration object.

Public names are listed in `__init__.pyi`, here and in every subpackage, and are imported on first use, so that
`import imgcal` does not wait for PyTorch.
"""

from importlib.metadata import PackageNotFoundError, version

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)

try:
    __version__ = version("imgcal")
except PackageNotFoundError:  # a checkout that is not installed
    __version__ = "0.0.0"
