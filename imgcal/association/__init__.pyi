from .ambiguities import lattice_shifts
from .assignment import distances_to_nearest, mutual_nearest
from .identification import bootstrap, identify, track
from .options import PipelineOptions
from .orientation import oriented
from .result import Identity, IdentityOptions, Status
from .series import (
    Follower,
    Labelled,
    Progress,
    SnapshotIdentity,
    label,
    matched_to_rig,
    observations_of,
    to_observations,
    without_snapshots,
)

__all__ = [
    "Follower",
    "Identity",
    "IdentityOptions",
    "Labelled",
    "PipelineOptions",
    "Progress",
    "SnapshotIdentity",
    "Status",
    "bootstrap",
    "distances_to_nearest",
    "identify",
    "label",
    "lattice_shifts",
    "matched_to_rig",
    "mutual_nearest",
    "observations_of",
    "oriented",
    "to_observations",
    "track",
    "without_snapshots",
]
