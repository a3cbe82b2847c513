"""Labels from the images themselves, for frames in which blob detection fails: a proposer locates each fiducial.

A proposal alone is never accepted. Its measurements become blobs beside the detector's, its labels are dropped, and
identification is run at its pose with all the usual tests: symmetric orientations, shifts of a lattice, false blobs,
chance. Labels on which identification and the proposer differ are removed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from imgcal.association.identification import track
from imgcal.association.identity import Identity, IdentityOptions
from imgcal.detection import DetectionOptions, Frame
from imgcal.geometry import RigidTransform
from imgcal.types import BlobFlag, CalibrationObject, CameraRig, Detections

SAME_BLOB = 1.5
"""Maximum distance (px), beyond three standard deviations, between a detector's blob and the same proposed fiducial."""
FARTHEST = 6.0  # px: upper limit of the same, so that no proposal hides blobs that contradict it
DOUBTED = 1.0
"""Pixels: so large a proposed sigma suggests a partly hidden marker; a blob of the visible part does not show that."""
AGREED = 0.1
"""Difference (px), beyond its own three sigma, between a blob and a proposal that leaves the blob's sigma unchanged."""
LEAST_SHARE = 0.3
"""Minimum explained share of the visible fiducials: lower than for blobs alone, since false blobs stand for the hidden
ones, and the proposal's margin already excludes chance."""
LEAST_AGREEMENT = 0.8
"""Minimum share of the labels found by identification near the proposed pose that the proposer also gave."""


@dataclass(frozen=True)
class Snapshot:
    """Input of a proposer."""

    frames: Mapping[str, Frame | None]  # camera name -> (H, W); None or absent = the camera has no frame
    blobs: Detections  # the detector's blobs, cameras as in the rig; may be empty
    rig: CameraRig  # the best known rig, float64, without batch axes
    obj: CalibrationObject
    prior_std: Tensor  # (C, K) standard deviations of the rig's values
    candidates: tuple[RigidTransform, ...] = ()  # approximate candidates of rig_from_object, most probable first
    detection: DetectionOptions = DetectionOptions()  # polarity, bit depth
    masks: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)  # camera -> (H, W), True = ignore


@dataclass(frozen=True)
class Proposal:
    """A proposer's fiducials in one snapshot, or its reason to decline."""

    detections: Detections  # of this snapshot, cameras as in the rig; each row with its fiducial and sigma
    rig_from_object: RigidTransform | None
    margin: float  # log odds against the best distinct labelling (other pose, rotation, shift, or chance)
    reason: str = ""  # reason to decline; empty = a proposal
    otherwise: Callable[[], Proposal] | None = None  # the next proposal, to judge where this one is refused
    found_by: str = ""  # the proposer, where it is another one than was asked

    @classmethod
    def decline(cls, snapshot: Snapshot, reason: str, margin: float = 0.0) -> Proposal:
        """Make a proposal without fiducials, for a reason."""
        return cls(snapshot.blobs.select(np.zeros(len(snapshot.blobs), dtype=bool)), None, margin, reason)


class Proposer(Protocol):
    """Finds fiducials in frames, for example a matched filter or a network."""

    @property
    def name(self) -> str:
        """Name in results."""

    def propose(self, snapshot: Snapshot) -> Proposal:
        """Process one snapshot."""


@dataclass(frozen=True)
class Sight:
    """A proposer with the frames of a capture."""

    proposer: Proposer
    frames: Callable[[int], Mapping[str, Frame | None]]  # number of a snapshot -> camera name -> frame
    where_blobs_fail: bool  # use it only for snapshots that blobs do not decide
    detection: DetectionOptions = DetectionOptions()
    masks: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)


def judge(
    proposal: Proposal,
    snapshot: Snapshot,
    options: IdentityOptions,
    *,
    error: float,
    pose_known: bool,
) -> tuple[Identity, Detections]:
    """Judge a proposal by the rules for blobs.

    Args:
        proposal: the proposed fiducials.
        snapshot: its input; the blobs in it count for and against.
        options: how certain the result must be.
        error: px, error of a centre beyond its own sigma.
        pose_known: the proposed pose is, at least nearly, that of an earlier snapshot.

    Returns:
        The decision, and the blobs that its labels refer to: the detector's, and the proposed ones.
    """
    blobs, proposed = merge_proposal(proposal.detections, snapshot.blobs)
    nothing = np.full(len(blobs), -1, dtype=np.int64)
    refused = Identity(nothing, None, None, "refused", 0, proposal.margin, proposal.reason)
    if proposal.reason or proposal.rig_from_object is None:
        return refused, blobs
    if proposal.margin < options.least_margin:
        reason = f"the images tell the object from others by a margin of only {proposal.margin:.1f}, expected "
        return replace(refused, reason=f"{reason}{options.least_margin:.0f}"), blobs
    options = replace(options, least_share=min(options.least_share, LEAST_SHARE))
    widened = replace(blobs, sigma=np.hypot(blobs.sigma, error), fiducial=nothing)
    found = track(
        widened, snapshot.rig, snapshot.obj, snapshot.prior_std, proposal.rig_from_object, options,
        pose_known=pose_known,
    )  # fmt: skip
    if not found.accepted:
        return found, blobs
    given = found.labels >= 0
    agreed = given & (found.labels == proposed)
    if agreed.sum() < LEAST_AGREEMENT * given.sum():
        reason = f"labels: blobs agree with {agreed.sum()} of the {given.sum()} that the images propose"
        return replace(refused, reason=reason), blobs
    labels = np.where(agreed | (proposed < 0), found.labels, -1)
    return replace(found, labels=labels, margin=min(found.margin, proposal.margin)), blobs


def merge_proposal(proposed: Detections, blobs: Detections) -> tuple[Detections, NDArray[np.int64]]:
    """Merge proposed fiducials with the detector's blobs; if both are at one place, keep the more accurate one.

    Returns:
        Blobs (M,) of one snapshot without labels, and the fiducial proposed for each (M,), -1 = none.
    """
    keep_blob, keep_ours = np.ones(len(blobs), dtype=bool), np.ones(len(proposed), dtype=bool)
    sigma = blobs.sigma.copy()
    fiducial = np.full(len(blobs), -1, dtype=np.int64)
    for camera in np.unique(proposed.camera).tolist():
        theirs, ours = np.flatnonzero(blobs.camera == camera), np.flatnonzero(proposed.camera == camera)
        if len(theirs) == 0:
            continue
        distance, nearest = cKDTree(blobs.uv[theirs]).query(proposed.uv[ours])
        rows = theirs[nearest]
        reach = SAME_BLOB + 3 * np.hypot(proposed.sigma[ours], blobs.sigma[rows])
        one = distance < np.minimum(reach, FARTHEST)
        better = (blobs.sigma[rows] <= proposed.sigma[ours]) & blobs.usable[rows] & (proposed.sigma[ours] < DOUBTED)
        # A merged blob near two fiducials is neither of them.
        alone = np.bincount(rows[one], minlength=len(blobs))[rows] == 1
        taken = one & better & alone
        # If they disagree, part of the marker may be hidden: increase the sigma by their difference.
        apart = taken & (distance > AGREED + 3 * blobs.sigma[rows])
        sigma[rows[apart]] = np.hypot(sigma[rows[apart]], distance[apart])
        keep_ours[ours[taken]] = False
        fiducial[rows[taken]] = proposed.fiducial[ours[taken]]
        keep_blob[rows[one & ~taken]] = False
    first, second = replace(blobs, sigma=sigma).select(keep_blob), proposed.select(keep_ours)
    labels = np.concatenate((fiducial[keep_blob], second.fiducial))
    columns = ("uv", "sigma", "camera", "snapshot", "radius", "flags")
    values: dict[str, Any] = {name: np.concatenate((getattr(first, name), getattr(second, name))) for name in columns}
    return replace(blobs, **values, fiducial=np.full(len(labels), -1, dtype=np.int64)), labels


def proposal_rows(
    uv: NDArray[np.float64],
    sigma: NDArray[np.float64],
    seen: NDArray[np.bool_],
    radius: NDArray[np.float64],
    like: Detections,
) -> Detections:
    """Make the rows of a proposal from dense arrays.

    Args:
        uv: (C, N, 2) pixels.
        sigma: (C, N) pixels, one standard deviation of each axis.
        seen: (C, N) which fiducials are proposed.
        radius: (C, N) pixels, nan = unknown.
        like: blobs of the same snapshot.
    """
    camera, fiducial = np.nonzero(seen)
    number = like.snapshot[0] if len(like) else 0
    return replace(
        like,
        uv=uv[seen],
        sigma=sigma[seen],
        camera=camera,
        snapshot=np.full(len(camera), number, dtype=np.int64),
        fiducial=fiducial,
        radius=radius[seen],
        flags=np.full(len(camera), int(BlobFlag.NONE), dtype=np.uint8),
    )
