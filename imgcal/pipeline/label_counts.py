"""Count how much of what each camera saw, and should have seen, the rest of the rig can explain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imgcal.association import Associations, merging_distance
from imgcal.geometry import RigidTransform
from imgcal.medians import median_of_known
from imgcal.types import CalibrationObject, CameraRig

MARGIN = 0.05
"""Margin at the image border, as a share of its size: a camera that has drifted may miss what should be there."""

DOUBTFUL = 0.25
"""Share of a camera's view of the object in the wrong place that is reported: partly hidden markers and false blobs
beside them leave a tenth in good captures."""

LEAST_FOUND, LEAST_SHARE = 4, 0.4
"""Number of a camera's fitting labels, and their share of the fiducials in view, that show that the pattern was found:
this many never fit by chance in any frame."""

WHOLE = 0.7
"""Share of the fiducials in view with a fitting label at which the other blobs of a frame are not the object."""

PLACED = 3.0
"""Maximum distance (px) between a fiducial and an unlabelled blob that is counted as its image: too few others in view,
or a merger, may have prevented the label."""

Counts = NDArray[np.int64]


@dataclass(frozen=True)
class LabelCounts:
    """Numbers of blobs and fiducials, by snapshot (all S) and camera (C)."""

    blobs: Counts  # (S, C) found
    usable: Counts  # (S, C) those not merged, at the border or masked
    labelled: Counts  # (S, C) blobs with a fiducial
    kept: Counts  # (S, C) labels that fit
    placed: Counts  # (S, C) unlabelled blobs where unlabelled fiducials should be, including merged ones
    expected: Counts  # (S, C) fiducials in view of the factory camera, given the object's pose
    found: NDArray[np.bool_]  # (S, C) the pattern was searched for in the frame itself, and found
    crowd: Counts  # (S, C) usual number of false blobs, which do not count

    @property
    def outliers(self) -> Counts:
        """Labels that do not fit: (S, C)."""
        return self.labelled - self.kept

    @property
    def unexplained(self) -> Counts:
        """Blobs that may be fiducials in view, but are not where these should be: (S, C).

        False blobs next to a completely found object do not count against a camera, nor do hidden fiducials: the count
        is limited by both the spare blobs and the missing fiducials. If the pattern was found in the frame itself,
        fiducials are missing because they are hidden, so false blobs elsewhere cannot be them. If it was searched for
        in vain, only blobs beyond the usual number of false ones may be the object. The same holds for blobs alone if
        that camera has shown the whole object in another snapshot: the extra blobs there also appear when the object is
        hidden.
        """
        spare = np.maximum(self.usable - self.crowd, 0)
        explained = self.kept + self.placed
        return np.where(self.found, 0, np.maximum(np.minimum(self.expected, spare) - explained, 0))


def count_labels(
    labelled: Associations, kept: NDArray[np.bool_], poses: RigidTransform, factory: CameraRig, obj: CalibrationObject,
    rig: CameraRig | None = None,
) -> LabelCounts:  # fmt: skip
    """Count blobs, labels and fiducials.

    Args:
        labelled: all snapshots, S.
        kept: (U, C, N) labels that fit, in the used snapshots.
        poses: (U,) rig_from_object of the used snapshots.
        factory: the rig that defines what is in view: wrong labels have not affected it.
        obj: N fiducials.
        rig: as estimated; None = not yet, and unlabelled blobs count as being in the wrong place.
    """
    labelled = replace(labelled, detections=labelled.repeat_unlabelled(obj))
    detections, used = labelled.detections, labelled.used
    shape = (len(labelled.snapshots), factory.num_cameras)

    def count(rows: NDArray[np.bool_]) -> Counts:
        cell = detections.snapshot[rows] * shape[1] + detections.camera[rows]
        return np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape)

    points = poses.apply(obj.points.to(factory.focal_length))
    projection = factory.expand(len(used)).project_values(points, obj.radius)
    visible = projection.visible.numpy() & labelled.columns(obj)
    inside = is_well_inside(projection.uv.numpy(), factory) & visible
    fitting, expected = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    fitting[used], expected[used] = kept.sum(-1), inside.sum(-1)
    usable = count(detections.usable)
    spare = np.maximum(usable - fitting, 0)
    whole = (fitting >= _least_of_whole(labelled, obj)) & (fitting >= WHOLE * np.minimum(expected, usable))
    looked = np.array([snapshot.found_by != "classical" for snapshot in labelled.snapshots], dtype=bool)
    return LabelCounts(
        blobs=count(np.ones(len(detections), dtype=bool)),
        usable=usable,
        labelled=count(detections.fiducial >= 0),
        kept=fitting,
        placed=np.zeros_like(fitting) if rig is None else _count_placed(labelled, poses, rig, obj),
        expected=expected,
        found=looked[:, None] & (fitting >= np.maximum(LEAST_FOUND, LEAST_SHARE * expected)),
        crowd=np.where(looked[:, None], _usual_false_blobs(spare), _usual_extra_blobs(spare, whole)),
    )


def is_well_inside(uv: NDArray[np.float64], rig: CameraRig) -> NDArray[np.bool_]:
    """Tell which pixels (*B, C, N, 2) are so far from the image border that a drifted camera shows them, too."""
    size = rig.image_size.numpy()[:, None]
    return np.asarray(((uv > MARGIN * size) & (uv < (1 - MARGIN) * size)).all(-1))


def _least_of_whole(labelled: Associations, obj: CalibrationObject) -> Counts:
    """Minimum number of labels for the whole object to be in view (S, 1): all of a stick's; one alone shows nothing."""
    size = np.array([obj.each[snapshot.part].num_fiducials for snapshot in labelled.snapshots], dtype=np.int64)
    return np.where(size > 1, np.minimum(size, LEAST_FOUND), LEAST_FOUND)[:, None]


def _count_placed(labelled: Associations, poses: RigidTransform, rig: CameraRig, obj: CalibrationObject) -> Counts:
    """Count unlabelled blobs at the images of unlabelled fiducials, single or merged: (S, C)."""
    detections, used = labelled.detections, labelled.used
    counts = np.zeros((len(labelled.snapshots), rig.num_cameras), dtype=np.int64)
    row = np.full(len(labelled.snapshots), -1)
    row[used] = np.arange(len(used))
    snapshot = row[detections.snapshot]
    blobs = np.flatnonzero((detections.fiducial < 0) & (snapshot >= 0) & detections.usable)
    if not len(blobs):
        return counts
    points = poses.apply(obj.points.to(rig.focal_length))
    image = rig.expand(len(points)).project_values(points, obj.radius)
    places, open_ = image.uv.numpy(), image.visible.numpy() & labelled.columns(obj)
    labels = np.flatnonzero((detections.fiducial >= 0) & (snapshot >= 0))
    open_[snapshot[labels], detections.camera[labels], detections.fiducial[labels]] = False
    blobs = blobs[open_[snapshot[blobs], detections.camera[blobs]].any(-1)]
    for blob, reach in zip(blobs, merging_distance(labelled, blobs), strict=True):
        s, c = snapshot[blob], detections.camera[blob]
        away = np.where(open_[s, c], np.hypot(*(places[s, c] - detections.uv[blob]).T), np.inf)
        merged = np.flatnonzero(away < reach)
        mine = merged if len(merged) > 1 else np.flatnonzero(away < PLACED)
        open_[s, c, mine] = False
        counts[used[s], c] += len(mine) > 0
    return counts


def _usual_false_blobs(false: Counts) -> Counts:
    """Number of false blobs (S, C) that is normal in a frame of each snapshot: (S, 1)."""
    usual = median_of_known(false.T)[:, None]
    return np.floor(usual + 2 * np.sqrt(usual)).astype(np.int64)


def _usual_extra_blobs(false: Counts, whole: NDArray[np.bool_]) -> Counts:
    """Usual number of blobs (S, C) per camera beside the `whole` object (S, C): (C,); 0 = it never was whole."""
    usual = median_of_known(np.where(whole, false, np.nan)[:, whole.any(0)])
    counts = np.zeros(whole.shape[1], dtype=np.int64)
    counts[whole.any(0)] = np.floor(usual)
    return counts
