from .checkpoint import (
    Checkpoint,
    load_checkpoint,
    load_network,
    read_subject,
    save_checkpoint,
    warm_start,
)
from .config import PRESETS, Images, NetworkConfig, NetworkSpec, PaperImages, PaperPoints, without_pretrained
from .factory import build, build_network
from .images import ImageNetwork, PaperImageNetwork
from .infrared import Evidence, InfraredConfig, InfraredNetwork, Queries, normalized
from .infrared_checkpoint import InfraredCheckpoint, load_infrared
from .network import Network
from .parameterization import Parameterization
from .points import PaperPointNetwork, PointNetwork
from .randomness import drawing_from
from .soft_positions import find_soft_positions
from .subject import check_object, check_rig

__all__ = [
    "PRESETS",
    "Checkpoint",
    "Evidence",
    "ImageNetwork",
    "Images",
    "InfraredCheckpoint",
    "InfraredConfig",
    "InfraredNetwork",
    "Network",
    "NetworkConfig",
    "NetworkSpec",
    "PaperImageNetwork",
    "PaperImages",
    "PaperPointNetwork",
    "PaperPoints",
    "Parameterization",
    "PointNetwork",
    "Queries",
    "build",
    "build_network",
    "check_object",
    "check_rig",
    "drawing_from",
    "find_soft_positions",
    "load_checkpoint",
    "load_infrared",
    "load_network",
    "normalized",
    "read_subject",
    "save_checkpoint",
    "warm_start",
    "without_pretrained",
]
