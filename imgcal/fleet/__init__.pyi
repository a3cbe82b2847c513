from .dataset import Dataset
from .drift_information import KINDS, DriftInformation, unit_of
from .engine import Done, Engine, Lost
from .job import STATUSES, Settings
from .learnt_prior import LearntPrior, OutlierCamera, Spread, Trend, learn_prior, standardized_offsets
from .lessons import KindOfRig, kinds_of_rigs, refusals
from .manifest import Item, Manifest, write_manifest
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
    "KindOfRig",
    "LearntPrior",
    "Lost",
    "Manifest",
    "OutlierCamera",
    "Settings",
    "Spread",
    "Trend",
    "kinds_of_rigs",
    "learn_prior",
    "recalibrate_fleet",
    "refusals",
    "standardized_offsets",
    "unit_of",
    "write_manifest",
]
