from .config import PRESETS, Images, NetworkConfig, PaperImages, PaperPoints
from .factory import build
from .images import ImageNetwork, PaperImageNetwork
from .parameterization import Parameterization
from .points import PaperPointNetwork, PointNetwork
from .refiner import IterativeRefiner

__all__ = [
    "PRESETS",
    "ImageNetwork",
    "Images",
    "IterativeRefiner",
    "NetworkConfig",
    "PaperImageNetwork",
    "PaperImages",
    "PaperPointNetwork",
    "PaperPoints",
    "Parameterization",
    "PointNetwork",
    "build",
]
