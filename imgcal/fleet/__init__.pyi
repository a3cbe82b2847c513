from .dataset import Dataset
from .drift_information import KINDS, DriftInformation, parameter_units
from .engine import Done, Engine, Lost
from .fleet_summary import KindOfRig, refusals, rig_kinds
from .job import Settings
from .learnt_prior import LearntPrior, OutlierCamera, Spread, Trend, learn_prior, outlier_cameras
from .manifest import HOURS, Item, Manifest, write_manifest
from .run import FleetCount, recalibrate_fleet
from .work_items import Mapper, StoredResults, workers

__all__ = [
    "HOURS",
    "KINDS",
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
    "Mapper",
    "OutlierCamera",
    "Settings",
    "Spread",
    "StoredResults",
    "Trend",
    "learn_prior",
    "outlier_cameras",
    "parameter_units",
    "recalibrate_fleet",
    "refusals",
    "rig_kinds",
    "workers",
    "write_manifest",
]
