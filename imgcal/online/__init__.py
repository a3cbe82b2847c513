"""Recalibration while a rig runs: recent snapshots, cameras that move, and cameras that are found again."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
