from .checkpoint import (
    Checkpoint,
    check_object,
    check_rig,
    check_says_rigs,
    load_checkpoint,
    load_network,
    read_subject,
    save_checkpoint,
    warm_start,
)
from .config import (
    PRESETS,
    HueCentroids,
    Images,
    NetworkConfig,
    NetworkSpec,
    PaperImages,
    PaperPoints,
    PooledImages,
    drop_pretrained,
)
from .expected_positions import Expectation, cut_crops, cut_patches
from .export import OPSET, TOLERANCE, Program, load_program, save_exported, save_onnx
from .factory import build, build_network
from .images import HueCentroidNetwork, ImageNetwork, Positions
from .infrared import Evidence, InfraredConfig, InfraredNetwork, Queries, normalize_crops
from .infrared_checkpoint import InfraredCheckpoint, MeasurerCheckpoint, load_infrared, load_measurer
from .label_claims import Claims, claim
from .locator import Located, PositionNetwork
from .measurer import Measured, Measurer, MeasurerConfig
from .network import Network
from .parameterization import Parameterization
from .points import PaperPointNetwork, PointNetwork
from .pooled_images import PaperImageNetwork, PooledImageNetwork
from .randomness import use_generators
from .soft_positions import find_soft_positions
from .tiles import Tiles

__all__ = [
    "OPSET",
    "PRESETS",
    "TOLERANCE",
    "Checkpoint",
    "Claims",
    "Evidence",
    "Expectation",
    "HueCentroidNetwork",
    "HueCentroids",
    "ImageNetwork",
    "Images",
    "InfraredCheckpoint",
    "InfraredConfig",
    "InfraredNetwork",
    "Located",
    "Measured",
    "Measurer",
    "MeasurerCheckpoint",
    "MeasurerConfig",
    "Network",
    "NetworkConfig",
    "NetworkSpec",
    "PaperImageNetwork",
    "PaperImages",
    "PaperPointNetwork",
    "PaperPoints",
    "Parameterization",
    "PointNetwork",
    "PooledImageNetwork",
    "PooledImages",
    "PositionNetwork",
    "Positions",
    "Program",
    "Queries",
    "Tiles",
    "build",
    "build_network",
    "check_object",
    "check_rig",
    "check_says_rigs",
    "claim",
    "cut_crops",
    "cut_patches",
    "drop_pretrained",
    "find_soft_positions",
    "load_checkpoint",
    "load_infrared",
    "load_measurer",
    "load_network",
    "load_program",
    "normalize_crops",
    "read_subject",
    "save_checkpoint",
    "save_exported",
    "save_onnx",
    "use_generators",
    "warm_start",
]
