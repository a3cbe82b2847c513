from .ambiguities import lattice_shifts
from .assignment import distances_to_nearest, mutual_nearest
from .identification import identify, relocalize, track
from .options import PipelineOptions
from .orientation import oriented
from .result import Identity, IdentityOptions, Status
from .series import (
    Associations,
    Progress,
    SnapshotIdentity,
    Tracker,
    associate,
    matched_to_rig,
    observations_of,
    to_observations,
    without_snapshots,
)

__all__ = [
    "Associations",
    "Identity",
    "IdentityOptions",
    "PipelineOptions",
    "Progress",
    "SnapshotIdentity",
    "Status",
    "Tracker",
    "associate",
    "distances_to_nearest",
    "identify",
    "lattice_shifts",
    "matched_to_rig",
    "mutual_nearest",
    "observations_of",
    "oriented",
    "relocalize",
    "to_observations",
    "track",
    "without_snapshots",
]
