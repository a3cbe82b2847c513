from .config import PRESETS, Images, NetworkConfig, PaperImages, PaperPoints
from .factory import build
from .images import ImageNetwork, PaperImageNetwork
from .parameterization import Decoder
from .points import PaperPointNetwork, PointNetwork
from .refiner import Trunk

__all__ = [
    "PRESETS",
    "Decoder",
    "ImageNetwork",
    "Images",
    "NetworkConfig",
    "PaperImageNetwork",
    "PaperImages",
    "PaperPointNetwork",
    "PaperPoints",
    "PointNetwork",
    "Trunk",
    "build",
]
