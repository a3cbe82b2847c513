from .clock_offsets import ClockOffsets
from .events import EVENT_KINDS, ChangeKind, Event, EventKind
from .foreign_object import ForeignObject
from .image_quality import ImageQuality
from .keeper import RigKeeper
from .keeper_file import KeeperFile
from .light_points import LightPoints
from .light_tracks import LightTracks
from .object_pose import ObjectPose
from .rig_state import CameraHealth, RigState
from .sequential_test import SequentialTest
from .warmup import warm_up

__all__ = [
    "EVENT_KINDS",
    "CameraHealth",
    "ChangeKind",
    "ClockOffsets",
    "Event",
    "EventKind",
    "ForeignObject",
    "ImageQuality",
    "KeeperFile",
    "LightPoints",
    "LightTracks",
    "ObjectPose",
    "RigKeeper",
    "RigState",
    "SequentialTest",
    "warm_up",
]
