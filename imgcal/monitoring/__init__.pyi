from .case import SHAPE, ClockSlip, ObjectChange
from .change_test import CHANGES, ChangeTest, change_of_errors, pixel_changes, spread_of
from .clock_slip import image_of
from .cusum import Cusum, cusum_threshold
from .measurement_update import absorb
from .object_motion import ObjectMotion
from .pending_change import Change
from .posterior import belief_of, calibration_of, posterior_of
from .recent_snapshots import RecentSnapshots
from .rig_belief import MeasurementUpdate, RigBelief, age_belief, widened
from .rig_filter import RigFilter
from .rig_monitor import MonitorUpdate, RigMonitor
from .shaking import shared_shifts
from .snapshot_information import SnapshotInformation

__all__ = [
    "CHANGES",
    "SHAPE",
    "Change",
    "ChangeTest",
    "ClockSlip",
    "Cusum",
    "MeasurementUpdate",
    "MonitorUpdate",
    "ObjectChange",
    "ObjectMotion",
    "RecentSnapshots",
    "RigBelief",
    "RigFilter",
    "RigMonitor",
    "SnapshotInformation",
    "absorb",
    "age_belief",
    "belief_of",
    "calibration_of",
    "change_of_errors",
    "cusum_threshold",
    "image_of",
    "pixel_changes",
    "posterior_of",
    "shared_shifts",
    "spread_of",
    "widened",
]
