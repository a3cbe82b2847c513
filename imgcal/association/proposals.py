"""Labels that come from the images themselves, where blobs fail: a proposer says where it sees each fiducial.

A proposal is never believed by itself. What it measured becomes blobs beside those of the detector, its labels are
forgotten, and identity decides anew at its pose, against all that it always asks: symmetric turns, shifts of a lattice,
false blobs, chance. What identity labels otherwise than the proposer is dropped.
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
from imgcal.association.result import Identity, IdentityOptions
from imgcal.detection import DetectionOptions, Frame
from imgcal.geometry import RigidTransform
from imgcal.types import BlobFlag, CalibrationObject, CameraRig, Detections

SAME_BLOB = 1.5
"""Pixels within which a blob of the detector and a proposed fiducial are one, beyond three standard deviations."""
FARTHEST = 6.0  # px: the same at most, so that no proposal hides blobs that contradict it
DOUBTED = 1.0
"""Pixels: as large a proposed sigma says that part of the marker may be hidden, which a blob of the rest cannot say."""
AGREED = 0.1
"""Pixels, beyond its own three sigma, by which a blob may differ from a proposal and be as well measured as it says."""
LEAST_SHARE = 0.3
"""Explained part of what could be seen: less than of blobs alone, since false blobs stand for those that are hidden,
and the proposal's margin has told the object from chance already."""
LEAST_AGREEMENT = 0.8
"""Share of the labels that identity gives near the proposed pose which the proposer must have given, too."""


@dataclass(frozen=True)
class Snapshot:
    """What a proposer may look at."""

    frames: Mapping[str, Frame | None]  # camera name -> (H, W); None or absent = the camera has no frame
    blobs: Detections  # what the detector found, cameras as in the rig; may be empty
    rig: CameraRig  # the best that is known, float64, without batch axes
    obj: CalibrationObject
    prior_std: Tensor  # (C, K) how far the rig's values may be off
    candidates: tuple[RigidTransform, ...] = ()  # rig_from_object that may hold, roughly, the likeliest first
    detection: DetectionOptions = DetectionOptions()  # polarity, bit depth
    masks: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)  # camera -> (H, W), where not to look


@dataclass(frozen=True)
class Proposal:
    """Where a proposer sees the fiducials of one snapshot; one that declines says why."""

    detections: Detections  # of this snapshot, cameras as in the rig; each row with its fiducial and sigma
    rig_from_object: RigidTransform | None
    margin: float  # natural log of the odds against the best distinct labelling (other pose, turn, shift, or chance)
    reason: str = ""  # why it declines; empty = it does not
    otherwise: Callable[[], Proposal] | None = None  # what another proposer says, asked where this one is refused
    found_by: str = ""  # who proposes, where that is another one than was asked

    @classmethod
    def decline(cls, snapshot: Snapshot, reason: str, margin: float = 0.0) -> Proposal:
        """Say that nothing can be proposed."""
        return cls(snapshot.blobs.select(np.zeros(len(snapshot.blobs), dtype=bool)), None, margin, reason)


class Proposer(Protocol):
    """Something that finds fiducials in frames: a matched filter, a network."""

    @property
    def name(self) -> str:
        """What results call it."""

    def propose(self, snapshot: Snapshot) -> Proposal:
        """Look at one snapshot."""


@dataclass(frozen=True)
class Sight:
    """A proposer with the frames of a capture."""

    proposer: Proposer
    frames: Callable[[int], Mapping[str, Frame | None]]  # number of a snapshot -> camera name -> frame
    where_blobs_fail: bool  # asked only for snapshots of which blobs decide nothing
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
    """Decide about a proposal by the rules that hold for blobs.

    Args:
        proposal: where fiducials are said to be.
        snapshot: what was looked at; its blobs count for and against.
        options: how sure to be.
        error: px, what a centre may be off beyond its own sigma.
        pose_known: the proposed pose is that of an earlier snapshot, or nearly.

    Returns:
        The decision, and the blobs that its labels are of: the detector's, and those that were proposed.
    """
    blobs, proposed = merge_proposal(proposal.detections, snapshot.blobs)
    nothing = np.full(len(blobs), -1, dtype=np.int64)
    refused = Identity(nothing, None, None, "refused", 0, proposal.margin, proposal.reason)
    if proposal.reason or proposal.rig_from_object is None:
        return refused, blobs
    if proposal.margin < options.least_margin:
        reason = f"the images tell the object from others by a margin of {proposal.margin:.1f} only, expected "
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
        reason = f"labels: blobs agree with {agreed.sum()} of {given.sum()} that the images propose"
        return replace(refused, reason=reason), blobs
    labels = np.where(agreed | (proposed < 0), found.labels, -1)
    return replace(found, labels=labels, margin=min(found.margin, proposal.margin)), blobs


def merge_proposal(proposed: Detections, blobs: Detections) -> tuple[Detections, NDArray[np.int64]]:
    """Put proposed fiducials among the detector's blobs; where both are at one place, the better measured one stays.

    Returns:
        Blobs (M,) of one snapshot without labels, and the fiducial that was proposed for each (M,), -1 = none.
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
        # Where the two disagree, part of the marker may be hidden: neither is known better than by what they differ.
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
        seen: (C, N) what is proposed.
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
