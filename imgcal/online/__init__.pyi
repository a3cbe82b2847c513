from .recalibrator import Recalibrator
from .warmup import warm_up, warm_up_fits

__all__ = [
    "Recalibrator",
    "warm_up",
    "warm_up_fits",
]
