"""Whether a camera's frames are of other moments than those of the rest: a frame was lost or repeated, or all are late.

The rest of the rig says where the object was in every snapshot. A camera whose blobs, under one calibration of its own,
are where the object was a snapshot earlier or later, and not where it is, has slipped; one that was bumped has not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import track
from imgcal.errors import RefusedError
from imgcal.estimation import Estimate, estimate
from imgcal.geometry import RigidTransform
from imgcal.pipeline.label_counts import LabelCounts
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations, RigPrior

SLIPS = (-2, -1, 1, 2)
"""Snapshots by which a camera may be early or late."""
LEAST_SNAPSHOTS = 3
"""Labelled snapshots on which a slip rests."""
BETTER = 5.0
"""Times the RMS of the best slip, that without a slip must have."""
LEAST_BETTER = 1.0
"""Pixels by which it must be better: a slow object does not show which moment it was."""
MOST_ASKED = 2
"""Cameras that are looked at."""
SIGMA = 0.5
"""Pixels, of all labels alike: moments are told apart by much more."""
WINDOW = 40
"""Snapshots before and after the first doubtful one that are looked at."""
MOST_STARTS = 12
"""Snapshots at which a slip may begin that are tried at first; then those around the best."""
MOST_FIDUCIALS = 24
"""Of a large object, that are enough to tell one moment from another."""

Calibrated = Callable[[Detections], tuple[list[int], RigidTransform]]


@dataclass(frozen=True)
class LateCamera:
    """A camera whose frames are of another moment."""

    camera: str
    snapshot: str  # the first one that is
    by: int  # snapshots: +1 = its frame shows what the others see one snapshot later: one was lost before it

    def __str__(self) -> str:
        """Say it in words."""
        count, when = abs(self.by), "later" if self.by > 0 else "earlier"
        many = f"{count} snapshots" if count > 1 else "one snapshot"
        cause = "lost" if self.by > 0 else "repeated, or it started late"
        return (
            f"camera {self.camera}: from snapshot {self.snapshot} on, its frames show what the other cameras see "
            f"{many} {when}: a frame was {cause}"
        )


def timing_motion(uv: Tensor, seen: Tensor, before: NDArray[np.int64]) -> Tensor:
    """How far images would be off if a camera were late by one snapshot, and turned to make up for it: (C,) pixels.

    A steady motion shifts all images of a late camera alike, as a turn of the camera does; only changes of the motion
    tell them apart.

    Args:
        uv: (S, C, N, 2) pixels.
        seen: (S, C, N) bool.
        before: (S,) number of the same object one snapshot earlier, -1 = there is none.
    """
    rows = torch.from_numpy(np.flatnonzero(before >= 0))
    earlier = torch.from_numpy(before)[rows]
    both = seen[rows] & seen[earlier]
    shift = torch.where(both[..., None], uv[rows] - uv[earlier], 0.0).sum(2) / both.sum(2).clamp_min(1)[..., None]
    known = both.any(2)  # (pairs, C)
    count = known.sum(0).clamp_min(1)
    mean = (shift * known[..., None]).sum(0) / count[:, None]
    return ((shift - mean).square().sum(-1) * known).sum(0).div(count).sqrt()


def suspects(counts: LabelCounts, names: tuple[str, ...], moved: Sequence[tuple[str, int]] = ()) -> dict[int, int]:
    """Choose cameras that see the object, and often not where the others have it; those that are said to have moved.

    Args:
        counts: of all snapshots and cameras.
        names: of the cameras.
        moved: cameras that are said to have moved, and the snapshot from which on.

    Returns:
        By camera, the number of the snapshot from which on it differs.
    """
    differs = (counts.unexplained > counts.kept) & (2 * counts.unexplained >= counts.expected)
    number = differs.sum(0)
    found = {names.index(name): snapshot for name, snapshot in moved if name in names}
    for camera in np.argsort(-number).tolist():
        if number[camera] >= 2 and number[camera] > 2 * np.median(number):
            found.setdefault(camera, int(differs[:, camera].argmax()))
    return dict(list(found.items())[:MOST_ASKED])


def find_late_camera(
    detections: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    camera: int,
    around: int,
    calibrated: Calibrated,
) -> LateCamera | None:
    """Ask whether one camera has slipped.

    Args:
        detections: blobs of all cameras.
        rig: the factory calibration, at least three cameras.
        obj: the calibration object.
        camera: its number.
        around: the first snapshot in which it differs.
        calibrated: what the others say: from their blobs to the used snapshots and the object's poses in these.

    Returns:
        What has happened to it; None where nothing has, or nobody can say.
    """
    if rig.num_cameras < 3:
        return None
    first, end = max(around - WINDOW, 0), min(around + WINDOW, len(detections.snapshot_names))
    part = detections.of_snapshots(first, end)
    own = part.camera == camera
    chosen = torch.linspace(0, obj.num_fiducials - 1, min(obj.num_fiducials, MOST_FIDUCIALS)).long().unique()
    try:
        used, poses = calibrated(part.select(~own))
        seen_alone = _label_camera(part.select(own), rig.select([camera]), obj, used, poses)
        view = _View(rig.select([camera]), obj.points.double()[chosen], poses, *(x[:, chosen] for x in seen_alone))
        found = _slip(view)
    except RefusedError:  # of the others, or of this camera, not enough is seen
        return None
    if found is None:
        return None
    start, by = found
    return LateCamera(rig.camera_names[camera], part.snapshot_names[used[start]], by)


@dataclass(frozen=True)
class _View:
    """What one camera saw, labelled by itself, and where the others had the object."""

    single: CameraRig  # the factory camera alone
    points: Tensor  # (N, 3) mm
    poses: RigidTransform  # (U,)
    uv: Tensor  # (U, N, 2)
    seen: Tensor  # (U, N)

    def rms(self, start: int, by: int) -> float:
        """RMS length (px) of the camera, fitted by itself, where from `start` on it shows what was `by` later."""
        number = np.arange(len(self.uv))
        source = np.where(number >= start, number + by, number)
        valid = np.flatnonzero(self.seen.any(-1).numpy() & (source >= 0) & (source < len(number)))
        poses = self.poses[torch.as_tensor(source[valid])]
        fit = _fit(self.uv[valid], self.seen[valid], self.single, self.points, poses)
        return float(fit.rms)


def _slip(view: _View) -> tuple[int, int] | None:
    """Find where and by how much a camera has slipped, if that explains what it saw, and nothing else does."""
    labelled = np.flatnonzero(view.seen.any(-1).numpy())
    if len(labelled) < 2 * LEAST_SNAPSHOTS:
        return None
    steady = view.rms(0, 0)
    # The labels on either side of where it began fit one calibration of the camera only at the right place.
    inner = labelled[LEAST_SNAPSHOTS : 1 - LEAST_SNAPSHOTS]
    coarse = inner[np.unique(np.linspace(0, len(inner) - 1, min(len(inner), MOST_STARTS)).round().astype(int))]
    tried = {(start, slip): view.rms(start, slip) for slip in SLIPS for start in [0, *coarse.tolist()]}
    start, slip = min(tried, key=lambda place: tried[place])
    reach = len(inner) // MOST_STARTS + 1
    close = inner[np.abs(np.searchsorted(inner, start) - np.arange(len(inner))) <= reach] if start else inner[:0]
    tried |= {(s, slip): view.rms(s, slip) for s in close.tolist() if (s, slip) not in tried}
    place = min(tried, key=lambda place: tried[place])
    if steady < BETTER * tried[place] or steady < tried[place] + LEAST_BETTER:
        return None
    return place


def _label_camera(
    blobs: Detections, single: CameraRig, obj: CalibrationObject, used: list[int], poses: RigidTransform
) -> tuple[Tensor, Tensor]:
    """Label what one camera saw by itself, near where the others had the object: uv (U, N, 2), seen (U, N).

    Labels that the blobs have count where there are any.
    """
    uv = torch.zeros(len(used), obj.num_fiducials, 2, dtype=torch.float64)
    seen = torch.zeros(len(used), obj.num_fiducials, dtype=torch.bool)
    std = (single.prior or RigPrior()).std(single)
    blobs = replace(blobs, camera=np.zeros_like(blobs.camera), camera_names=single.camera_names)
    for row, snapshot in enumerate(used):
        mine = blobs.select((blobs.snapshot == snapshot) & blobs.usable)
        given = np.flatnonzero(mine.fiducial >= 0)
        if len(given):
            uv[row, mine.fiducial[given]] = torch.from_numpy(mine.uv[given])
            seen[row, mine.fiducial[given]] = True
            continue
        if len(mine) < 4:
            continue
        near = [row + slip for slip in (0, *SLIPS) if 0 <= row + slip < len(used)]
        found = [track(mine, single, obj, std, poses[pose]) for pose in near]
        best = max(found, key=lambda identity: identity.explained if identity.accepted else -1.0)
        if best.accepted:
            chosen = np.flatnonzero(best.labels >= 0)
            uv[row, best.labels[chosen]] = torch.from_numpy(mine.uv[chosen])
            seen[row, best.labels[chosen]] = True
    return uv, seen


def _fit(uv: Tensor, seen: Tensor, single: CameraRig, points_object: Tensor, poses: RigidTransform) -> Estimate:
    """Fit one camera to known poses of the object: all fiducials of all snapshots are one still object in the rig."""
    points = poses.apply(points_object).flatten(0, 1)
    cloud = CalibrationObject(points, torch.ones_like(points))
    seen = seen.flatten()
    sigma = torch.full((1, 1, len(seen)), SIGMA, dtype=torch.float64)
    observations = Observations(uv.flatten(0, 1)[None, None], sigma, seen[None, None])
    prior = (single.prior or RigPrior()).std(single).clone()
    prior[:, :6] = 0.0  # the pose of the cloud says where the camera is
    return estimate(observations, single, cloud, RigidTransform.identity(1, dtype=torch.float64), prior_std=prior)
