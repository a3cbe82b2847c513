from .case import SHAPE, ClockSlip, ObjectChange
from .change_test import CHANGES, ChangeTest, Comparison, OwnTest, camera_change_errors, change_std, pixel_changes
from .clock_slip import project_fiducials
from .cusum import Cusum, cusum_threshold
from .far_turns import far_turned_cameras
from .measurement_update import absorb
from .object_motion import ObjectMotion
from .pending_change import Change
from .posterior import belief_from_posterior, calibration_posterior, make_posterior
from .recent_snapshots import RecentSnapshots
from .resting import LEAST_MOTION, REST_SIGMAS, count_independent, show_the_same
from .rig_belief import MeasurementUpdate, RigBelief, age_belief, widen
from .rig_filter import RigFilter
from .rig_monitor import MonitorUpdate, RigMonitor
from .shaking import shared_shifts
from .snapshot_information import SnapshotInformation

__all__ = [
    "CHANGES",
    "LEAST_MOTION",
    "REST_SIGMAS",
    "SHAPE",
    "Change",
    "ChangeTest",
    "ClockSlip",
    "Comparison",
    "Cusum",
    "MeasurementUpdate",
    "MonitorUpdate",
    "ObjectChange",
    "ObjectMotion",
    "OwnTest",
    "RecentSnapshots",
    "RigBelief",
    "RigFilter",
    "RigMonitor",
    "SnapshotInformation",
    "absorb",
    "age_belief",
    "belief_from_posterior",
    "calibration_posterior",
    "camera_change_errors",
    "change_std",
    "count_independent",
    "cusum_threshold",
    "far_turned_cameras",
    "make_posterior",
    "pixel_changes",
    "project_fiducials",
    "shared_shifts",
    "show_the_same",
    "widen",
]
