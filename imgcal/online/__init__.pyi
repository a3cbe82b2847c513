from .recalibrator import Recalibrator
from .warmup import warm_up

__all__ = [
    "Recalibrator",
    "warm_up",
]
