from .alone import is_few_and_flat, labels_by_shape
from .ambiguities import lattice_shifts, near_turns
from .assignment import distances_to_nearest, mutual_nearest
from .blobs import pattern_prior, undistorted
from .identification import identify, relocalize, track
from .lights import Lights, align_camera, align_rig, associate_lights, background_rows, image_error, predicted_misses
from .merging import drop_merged, find_merged, merging_distance
from .options import PipelineOptions
from .orientation import oriented
from .proposals import Proposal, Proposer, Sight, Snapshot, judge, rows_of
from .result import Identity, IdentityOptions, Status
from .series import (
    Associations,
    Progress,
    associate,
    matched_to_rig,
    observations_of,
    without_snapshots,
)
from .tracker import SnapshotIdentity, Tracker, to_observations

__all__ = [
    "Associations",
    "Identity",
    "IdentityOptions",
    "Lights",
    "PipelineOptions",
    "Progress",
    "Proposal",
    "Proposer",
    "Sight",
    "Snapshot",
    "SnapshotIdentity",
    "Status",
    "Tracker",
    "align_camera",
    "align_rig",
    "associate",
    "associate_lights",
    "background_rows",
    "distances_to_nearest",
    "drop_merged",
    "find_merged",
    "identify",
    "image_error",
    "is_few_and_flat",
    "judge",
    "labels_by_shape",
    "lattice_shifts",
    "matched_to_rig",
    "merging_distance",
    "mutual_nearest",
    "near_turns",
    "observations_of",
    "oriented",
    "pattern_prior",
    "predicted_misses",
    "relocalize",
    "rows_of",
    "to_observations",
    "track",
    "undistorted",
    "without_snapshots",
]
