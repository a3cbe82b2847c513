from .dataset import Dataset
from .drift_information import KINDS, DriftInformation, unit_of
from .engine import Done, Engine, Lost
from .job import STATUSES, Settings
from .learnt_prior import LearntPrior, OutlierCamera, Spread, Trend, learn_prior, outlier_cameras, standardized_offsets
from .lessons import KindOfRig, kinds_of_rigs, refusals
from .manifest import Item, Manifest, write_manifest
from .mapping import Kept, Mapped, workers
from .run import FleetCount, recalibrate_fleet

__all__ = [
    "KINDS",
    "STATUSES",
    "Dataset",
    "Done",
    "DriftInformation",
    "Engine",
    "FleetCount",
    "Item",
    "Kept",
    "KindOfRig",
    "LearntPrior",
    "Lost",
    "Manifest",
    "Mapped",
    "OutlierCamera",
    "Settings",
    "Spread",
    "Trend",
    "kinds_of_rigs",
    "learn_prior",
    "outlier_cameras",
    "recalibrate_fleet",
    "refusals",
    "standardized_offsets",
    "unit_of",
    "workers",
    "write_manifest",
]
