from .bags import Bag
from .earlier_run import EarlierRun, Known, Progress
from .event_log import EventLog, forget_after
from .exposures import CameraBlobs, Exposure, FileStamp, Item, Source, Unreadable, check_exposure
from .folder import Folder
from .hook import Hook
from .json_lines import JsonLines
from .lab_streaming import LabStreaming
from .learning import (
    ADAPTED,
    ADAPTED_CARD,
    CANDIDATE,
    DATASET,
    LEARNING,
    LOWEST,
    SUBJECTS,
    Learning,
    LearningPlan,
    LearningTask,
    Moment,
    Outcome,
    adapted_networks,
    receive,
    run_networks,
    send,
)
from .loop import EVENTS, Keeper, Page, Watch
from .marker_files import MarkerFile
from .metrics import Metrics, Tally
from .open_igt_link import OpenIGTLink, listening_address
from .pose_files import PoseFile, forget_rows
from .pose_zeromq import PosePublisher
from .poses import PoseRecord, Poses, PoseSink
from .qualisys import Qualisys
from .recordings import BlobTable, Videos, holds_videos
from .refusal_causes import RefusalCauses
from .rig_files import CURRENT, STATE, RigFiles, put_aside
from .source_reader import SourceReader
from .synchronization import COUNTS, Synchronizer, TimedSnapshot
from .timing import Timing
from .zeromq import ZeroMQ

__all__ = [
    "ADAPTED",
    "ADAPTED_CARD",
    "CANDIDATE",
    "COUNTS",
    "CURRENT",
    "DATASET",
    "EVENTS",
    "LEARNING",
    "LOWEST",
    "STATE",
    "SUBJECTS",
    "Bag",
    "BlobTable",
    "CameraBlobs",
    "EarlierRun",
    "EventLog",
    "Exposure",
    "FileStamp",
    "Folder",
    "Hook",
    "Item",
    "JsonLines",
    "Keeper",
    "Known",
    "LabStreaming",
    "Learning",
    "LearningPlan",
    "LearningTask",
    "MarkerFile",
    "Metrics",
    "Moment",
    "OpenIGTLink",
    "Outcome",
    "Page",
    "PoseFile",
    "PosePublisher",
    "PoseRecord",
    "PoseSink",
    "Poses",
    "Progress",
    "Qualisys",
    "RefusalCauses",
    "RigFiles",
    "Source",
    "SourceReader",
    "Synchronizer",
    "Tally",
    "TimedSnapshot",
    "Timing",
    "Unreadable",
    "Videos",
    "Watch",
    "ZeroMQ",
    "adapted_networks",
    "check_exposure",
    "forget_after",
    "forget_rows",
    "holds_videos",
    "listening_address",
    "put_aside",
    "receive",
    "run_networks",
    "send",
]
