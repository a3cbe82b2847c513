"""Detect cameras whose frames are of other moments than the rest's: a lost or repeated frame, or a late start.

The rest of the rig gives the object's pose in every snapshot. A camera has slipped if its blobs, under a calibration of
its own, fit the pose of an earlier or later snapshot but not the current one. A bumped camera does not do that.
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
from imgcal.pipeline.units import require_solvable
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations, RigPrior

SLIPS = (-2, -1, 1, 2)
"""Numbers of snapshots by which a camera may be early or late."""
LEAST_SNAPSHOTS = 3
"""Minimum number of labelled snapshots that support a slip."""
BETTER = 5.0
"""Minimum ratio of the RMS without a slip to that of the best slip."""
LEAST_BETTER = 1.0
"""Minimum improvement (px): a slow object does not show which moment it was."""
MOST_ASKED = 2
"""Maximum number of cameras to test."""
SIGMA = 0.5
"""Pixels, the same for all labels: moments differ by much more."""
WINDOW = 40
"""Number of snapshots before and after the first doubtful one to use."""
MOST_STARTS = 12
"""Number of snapshots tried first as the start of a slip; then those around the best one."""
MOST_FIDUCIALS = 24
"""Number of a large object's fiducials that suffices to tell moments apart."""

Calibrated = Callable[[Detections], tuple[list[int], RigidTransform]]


@dataclass(frozen=True)
class LateCamera:
    """A camera whose frames are of another moment."""

    camera: str
    snapshot: str  # the first such snapshot
    by: int  # +1 = its frame shows what the others see one snapshot later: a frame was lost

    def __str__(self) -> str:
        """Describe it in words."""
        count, when = abs(self.by), "later" if self.by > 0 else "earlier"
        many = f"{count} snapshots" if count > 1 else "one snapshot"
        cause = "lost" if self.by > 0 else "repeated, or it started late"
        return (
            f"camera {self.camera}: from snapshot {self.snapshot} on, its frames show what the other cameras see "
            f"{many} {when}: a frame was {cause}"
        )


def timing_motion(uv: Tensor, seen: Tensor, before: NDArray[np.int64]) -> Tensor:
    """Residual image shift if a camera were late by one snapshot, and rotated to compensate: (C,) pixels.

    A steady motion shifts all images of a late camera alike, as a rotation of the camera does; only changes of the
    motion distinguish them.

    Args:
        uv: (S, C, N, 2) pixels.
        seen: (S, C, N) bool.
        before: (S,) number of the same object's row one snapshot earlier, -1 = there is none.
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
    """Choose cameras that often disagree with the others about the object, and those reported to have moved.

    Args:
        counts: of all snapshots and cameras.
        names: of the cameras.
        moved: cameras reported to have moved, and the snapshot of the move.

    Returns:
        By camera, the number of the first snapshot that differs.
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
    """Test whether one camera has slipped.

    Args:
        detections: blobs of all cameras.
        rig: the factory calibration, at least three cameras.
        obj: the calibration object.
        camera: its number.
        around: the first snapshot in which it differs.
        calibrated: calibrates the others: from their blobs to the used snapshots and the object's poses in them.

    Returns:
        The slip found; None if there is none, or the data cannot tell.
    """
    if rig.num_cameras < 3:
        return None
    first, end = max(around - WINDOW, 0), min(around + WINDOW, len(detections.snapshot_names))
    part = detections.of_snapshots(first, end)
    own = part.camera == camera
    chosen = torch.linspace(0, obj.num_fiducials - 1, min(obj.num_fiducials, MOST_FIDUCIALS)).long().unique()
    try:
        with require_solvable():
            used, poses = calibrated(part.select(~own))
        seen_alone = _label_camera(part.select(own), rig.select([camera]), obj, used, poses)
        view = _View(rig.select([camera]), obj.points.double()[chosen], poses, *(x[:, chosen] for x in seen_alone))
        found = _slip(view)
    except RefusedError:  # the others, or this camera, do not see enough
        return None
    if found is None:
        return None
    start, by = found
    return LateCamera(rig.camera_names[camera], part.snapshot_names[used[start]], by)


@dataclass(frozen=True)
class _View:
    """A camera's own labels, and the object's poses by the others."""

    single: CameraRig  # the factory camera alone
    points: Tensor  # (N, 3) mm
    poses: RigidTransform  # (U,)
    uv: Tensor  # (U, N, 2)
    seen: Tensor  # (U, N)

    def rms(self, start: int, by: int) -> float:
        """RMS length (px) of the camera's own fit if, from `start` on, it shows what happened `by` snapshots later."""
        number = np.arange(len(self.uv))
        source = np.where(number >= start, number + by, number)
        valid = np.flatnonzero(self.seen.any(-1).numpy() & (source >= 0) & (source < len(number)))
        poses = self.poses[torch.as_tensor(source[valid])]
        fit = _fit(self.uv[valid], self.seen[valid], self.single, self.points, poses)
        return float(fit.rms)


def _slip(view: _View) -> tuple[int, int] | None:
    """Find where and by how much a camera has slipped, if a slip, and nothing else, explains what it saw."""
    labelled = np.flatnonzero(view.seen.any(-1).numpy())
    if len(labelled) < 2 * LEAST_SNAPSHOTS:
        return None
    steady = view.rms(0, 0)
    # Only with the right start do the labels before and after it fit one calibration of the camera.
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
    """Label one camera's blobs by themselves, near the object's poses by the others: uv (U, N, 2), seen (U, N).

    Labels of the input are used if there are any.
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
    """Fit one camera to known poses of the object: all fiducials of all snapshots form one static object in the rig."""
    points = poses.apply(points_object).flatten(0, 1)
    cloud = CalibrationObject(points, torch.ones_like(points))
    seen = seen.flatten()
    sigma = torch.full((1, 1, len(seen)), SIGMA, dtype=torch.float64)
    observations = Observations(uv.flatten(0, 1)[None, None], sigma, seen[None, None])
    prior = (single.prior or RigPrior()).std(single).clone()
    prior[:, :6] = 0.0  # the pose of the point cloud determines the camera's
    return estimate(observations, single, cloud, RigidTransform.identity(1, dtype=torch.float64), prior_std=prior)
