"""How much of what each camera saw, and of what it should have seen, the rest of the rig can explain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imgcal.association import Associations, merging_distance
from imgcal.geometry import RigidTransform
from imgcal.types import CalibrationObject, CameraRig

MARGIN = 0.05
"""Of the image's width and height, from its border: as far a camera that has drifted may miss what it should see."""

DOUBTFUL = 0.25
"""Share of what a camera sees of the object that is not where it should be, from which on it is said: partly hidden
markers and false blobs beside them leave a tenth in good captures."""

LEAST_FOUND, LEAST_SHARE = 4, 0.4
"""Labels of one camera that fit, and their share of the fiducials in view, from which on the pattern was found: so
many do not fit a rig and each other by chance, whatever else the frame shows."""

WHOLE = 0.7
"""Share of the fiducials in view with a label that fits, from which on what else a frame shows is not the object."""

PLACED = 3.0
"""Pixels from where the rig sees a fiducial, up to which a blob without a label is taken for it: it may have none
because too few others are in view, or because they have merged."""

Counts = NDArray[np.int64]


@dataclass(frozen=True)
class LabelCounts:
    """Blobs and fiducials counted by snapshot (all of them, S) and camera (C)."""

    blobs: Counts  # (S, C) found
    usable: Counts  # (S, C) of these, not merged, at the border or masked
    labelled: Counts  # (S, C) blobs with a fiducial
    kept: Counts  # (S, C) labels that fit
    placed: Counts  # (S, C) blobs without a label that are where fiducials without one should be, merged ones included
    expected: Counts  # (S, C) fiducials in view of the factory camera, given where the rest of the rig sees the object
    found: NDArray[np.bool_]  # (S, C) the pattern was looked for in the frame itself, and is there
    crowd: Counts  # (S, C) false blobs as usual: as many are no witness

    @property
    def outliers(self) -> Counts:
        """Labels that do not fit: (S, C)."""
        return self.labelled - self.kept

    @property
    def unexplained(self) -> Counts:
        """Blobs that may be fiducials in view, and are not where these should be: (S, C).

        False blobs beside fiducials that were all found are no witness against a camera, nor are fiducials in view that
        are hidden: each counts as far as there is something of the other. Where the pattern was found in the frame
        itself, fiducials are missing because they are hidden: false blobs elsewhere are not what they would be. Where
        it was looked for in vain, only blobs beyond the usual number of false ones may be the object. The same where
        blobs alone decide, if that camera has shown the object in another snapshot: what it showed besides, it shows
        where the object is hidden.
        """
        spare = np.maximum(self.usable - self.crowd, 0)
        explained = self.kept + self.placed
        return np.where(self.found, 0, np.maximum(np.minimum(self.expected, spare) - explained, 0))


def count_labels(
    labelled: Associations, kept: NDArray[np.bool_], poses: RigidTransform, factory: CameraRig, obj: CalibrationObject,
    rig: CameraRig | None = None,
) -> LabelCounts:  # fmt: skip
    """Count.

    Args:
        labelled: all snapshots, S.
        kept: (U, C, N) labels that fit, of the used snapshots.
        poses: (U,) rig_from_object of the used snapshots.
        factory: the rig that says what is in view: it has not been spoilt by wrong labels.
        obj: N fiducials.
        rig: as estimated; None = not yet, and what has no label counts as being elsewhere.
    """
    labelled = replace(labelled, detections=labelled.repeated(obj))
    detections, used = labelled.detections, labelled.used
    shape = (len(labelled.snapshots), factory.num_cameras)

    def count(rows: NDArray[np.bool_]) -> Counts:
        cell = detections.snapshot[rows] * shape[1] + detections.camera[rows]
        return np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape)

    points = poses.apply(obj.points.to(factory.focal_length))
    projection = factory.expand(len(used)).project_values(points, obj.radius)
    size = factory.image_size.numpy()[:, None]
    uv = projection.uv.numpy()
    visible = projection.visible.numpy() & labelled.columns(obj)
    inside = ((uv > MARGIN * size) & (uv < (1 - MARGIN) * size)).all(-1) & visible
    fitting, expected = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    fitting[used], expected[used] = kept.sum(-1), inside.sum(-1)
    usable = count(detections.usable)
    spare = np.maximum(usable - fitting, 0)
    whole = (fitting >= LEAST_FOUND) & (fitting >= WHOLE * np.minimum(expected, usable))
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


def _count_placed(labelled: Associations, poses: RigidTransform, rig: CameraRig, obj: CalibrationObject) -> Counts:
    """Count blobs without a label that are where fiducials without one are seen, alone or several in one: (S, C)."""
    detections, used = labelled.detections, labelled.used
    points = poses.apply(obj.points.to(rig.focal_length))
    image = rig.expand(len(points)).project_values(points, obj.radius)
    places, open_ = image.uv.numpy(), image.visible.numpy() & labelled.columns(obj)
    row = np.full(len(labelled.snapshots), -1)
    row[used] = np.arange(len(used))
    snapshot = row[detections.snapshot]
    labels = np.flatnonzero((detections.fiducial >= 0) & (snapshot >= 0))
    open_[snapshot[labels], detections.camera[labels], detections.fiducial[labels]] = False
    counts = np.zeros((len(labelled.snapshots), rig.num_cameras), dtype=np.int64)
    blobs = np.flatnonzero((detections.fiducial < 0) & (snapshot >= 0) & detections.usable)
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
    """How many false blobs (S, C) a frame of a snapshot may well have: (S, 1)."""
    usual = np.median(false, axis=1, keepdims=True)
    return np.floor(usual + 2 * np.sqrt(usual)).astype(np.int64)


def _usual_extra_blobs(false: Counts, whole: NDArray[np.bool_]) -> Counts:
    """How many blobs (S, C) each camera usually has besides the `whole` object (S, C): (C,); 0 = it never was."""
    usual = np.nanmedian(np.where(whole, false, np.nan)[:, whole.any(0)], axis=0)
    counts = np.zeros(whole.shape[1], dtype=np.int64)
    counts[whole.any(0)] = np.floor(usual)
    return counts
