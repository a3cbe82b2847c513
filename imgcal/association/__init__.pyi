from .ambiguities import lattice_shifts, near_symmetries
from .assignment import distances_to_nearest, mutual_nearest
from .blobs import pattern_prior, undistort
from .identification import identify, relocalize, track
from .identity import Identity, IdentityOptions, PipelineOptions, Status, orient
from .lights import Lights, align_camera, align_rig, associate_lights, background_rows, image_error, predicted_misses
from .merging import drop_merged, find_merged, merging_distance, merging_reach
from .proposals import Proposal, Proposer, Sight, Snapshot, judge, proposal_rows
from .series import (
    Associations,
    Progress,
    accepted_observations,
    associate,
    drop_snapshots,
    match_to_rig,
)
from .single_image_labels import is_small_planar, label_by_shape
from .snapshot_poses import fit_snapshot_poses, refuse_unfit
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
    "accepted_observations",
    "align_camera",
    "align_rig",
    "associate",
    "associate_lights",
    "background_rows",
    "distances_to_nearest",
    "drop_merged",
    "drop_snapshots",
    "find_merged",
    "fit_snapshot_poses",
    "identify",
    "image_error",
    "is_small_planar",
    "judge",
    "label_by_shape",
    "lattice_shifts",
    "match_to_rig",
    "merging_distance",
    "merging_reach",
    "mutual_nearest",
    "near_symmetries",
    "orient",
    "pattern_prior",
    "predicted_misses",
    "proposal_rows",
    "refuse_unfit",
    "relocalize",
    "to_observations",
    "track",
    "undistort",
]
