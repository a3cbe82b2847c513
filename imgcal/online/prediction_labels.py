"""Label a snapshot from the previous one: near the predictions, or again after a camera has moved."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from torch import Tensor

from imgcal.association import PipelineOptions, distances_to_nearest, merging_reach, mutual_nearest, track
from imgcal.geometry import RigidTransform
from imgcal.medians import median, median_of_known
from imgcal.types import CalibrationObject, CameraRig, Detections
from renderers.compiling import njit

TOO_NEAR = 0.6
"""Distance (px) below which two predictions are too close to tell their blobs apart."""
MARGIN = 0.03
"""Margin at the image border, as a share of the image size, in which predicted fiducials may be out of view."""
LEAST_EXPLAINED = 1 / 3
"""Share of the object's visible fiducials that must be labelled."""
LEAST_SIGHT = 0.6
"""Number of possible fiducials, as a share of the fiducials in view, for a camera to see the object."""
LEAST_BLOBS = 3
"""Minimum number of blobs for a camera to see the object at all."""
IN_PLACE, LEAST_IN_PLACE = 1.0, 2
"""Distance (px) within which a blob lies where a fiducial is predicted, and the number of such blobs, beside the share
`LEAST_EXPLAINED`, that show that a camera stands where it stood, labelled or not: a wand seen end-on merges into too
few blobs for labels."""
TURNS = (0.02, 0.1, 0.4)
"""Radians, one standard deviation per axis: possible rotations of a camera in the search for it."""


def near_prediction(blobs: Detections, predicted: NDArray[np.float64]) -> NDArray[np.int64]:
    """Fiducial (M,) whose prediction (C, N, 2) is nearest to each blob; -1 unless this is mutual and near enough.

    Near enough is a quarter of the distance between predictions: a pattern that has moved less keeps its labels.
    Fiducials with nearly coinciding predictions get no blob.
    """
    labels = np.full(len(blobs), -1, dtype=np.int64)
    predicted = np.ascontiguousarray(predicted)  # in another order, kernels would be compiled again
    gaps = distances_to_nearest(predicted)
    reach = 0.25 * median(gaps)
    order = np.lexsort((blobs.uv[:, 0], blobs.camera))
    ends = np.searchsorted(blobs.camera[order], np.arange(len(predicted) + 1))
    found = np.empty(len(blobs), dtype=np.int64)
    _label_nearest(predicted, gaps < TOO_NEAR, blobs.uv[order], ends, reach, found)
    labels[order] = found
    return labels


@njit(cache=True)
def _label_nearest(predicted, crowded, uv, ends, reach, labels):
    """Write the fiducial of each blob (M,); those of camera c are the rows from ends[c] to ends[c + 1] of uv (M, 2)."""
    found = np.empty(predicted.shape[1], np.int64)
    for m in range(len(labels)):
        labels[m] = -1
    for c in range(len(predicted)):
        first = ends[c]
        mutual_nearest(predicted[c], uv[first : ends[c + 1]], reach, found)
        for n in range(len(found)):
            if found[n] >= 0 and not crowded[c, n]:
                labels[first + found[n]] = n


def spare_blobs(blobs: Detections, cameras: int) -> NDArray[np.int64]:
    """Count the blobs without a label in each camera: (C,)."""
    return np.bincount(blobs.camera[blobs.fiducial < 0], minlength=cameras)


def find_displaced_cameras(
    blobs: Detections, usual: NDArray[np.float64], rig: CameraRig, obj: CalibrationObject, pose: RigidTransform
) -> NDArray[np.bool_]:
    """Find cameras that see a possible object, but hardly any of it where the rig predicts it: (C,) bool.

    A camera that sees nothing, or no more false blobs than usual, does not count.

    Args:
        blobs: of one snapshot, labelled.
        usual: (C,) usual number of unlabelled blobs of a camera.
        rig: as last estimated.
        obj: the calibration object.
        pose: rig_from_object of this snapshot.
    """
    labelled = np.bincount(blobs.camera[blobs.fiducial >= 0], minlength=rig.num_cameras)
    spare = np.maximum(spare_blobs(blobs, rig.num_cameras) - usual, 0)
    if not ((spare >= LEAST_BLOBS) & (labelled <= LEAST_EXPLAINED * (labelled + spare))).any():
        return np.zeros(rig.num_cameras, dtype=bool)  # whatever is in view
    expected = _predict(rig, obj, pose)[1].sum(-1)
    unexplained = np.minimum(expected - labelled, spare)
    few = labelled <= LEAST_EXPLAINED * (labelled + unexplained)
    return np.asarray(few & (unexplained >= np.maximum(LEAST_BLOBS, LEAST_SIGHT * expected)))


def may_stand(blobs: Detections, camera: int, rig: CameraRig, obj: CalibrationObject, pose: RigidTransform) -> bool:
    """Tell whether a camera need not have moved although the object has no labels in it.

    Blobs lie where the rig predicts the object, or its markers merge into too few blobs, like those of a wand seen
    end-on.

    Args:
        blobs: of one snapshot.
        camera: its number; it has blobs.
        rig: as last estimated.
        obj: the calibration object.
        pose: rig_from_object of this snapshot.
    """
    own, (uv, inside) = blobs.select(blobs.camera == camera), _predict(rig.select([camera]), obj, pose)
    places = uv[inside]
    in_place = int((cdist(own.uv, places) < IN_PLACE).any(1).sum())
    if in_place >= max(LEAST_IN_PLACE, LEAST_EXPLAINED * len(places)):
        return True
    near = cdist(places, places) < merging_reach(median_of_known(own.radius))
    apart = int((near.sum(1) == 1).sum())
    return apart < LEAST_BLOBS <= len(places)


def _predict(
    rig: CameraRig, obj: CalibrationObject, pose: RigidTransform
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Predicted images (C, N, 2) px of the fiducials, and which of them (C, N) are surely in view."""
    projection = rig.project(pose.apply(obj.points), obj.radius)
    size = rig.image_size.numpy()[:, None]
    uv = projection.uv.numpy()
    return uv, ((uv > MARGIN * size) & (uv < (1 - MARGIN) * size)).all(-1) & projection.visible.numpy()


def relabel_moved_camera(
    blobs: Detections,
    camera: int,
    rig: CameraRig,
    obj: CalibrationObject,
    pose: RigidTransform,
    std: Tensor,
    options: PipelineOptions,
) -> Detections | None:
    """Label the blobs of a camera that has moved, given the object's pose by the other cameras; None = not possible.

    Args:
        blobs: of one snapshot, labelled by the other cameras.
        camera: its number.
        rig: as last estimated.
        obj: the calibration object.
        pose: rig_from_object by the other cameras.
        std: (C, K) uncertainty of the rig.
        options: how certain labels must be.
    """
    rows = np.flatnonzero(blobs.camera == camera)
    alone = blobs.select(rows)
    alone = replace(
        alone,
        camera=np.zeros_like(alone.camera),
        sigma=np.hypot(alone.sigma, options.identity_error),
        fiducial=np.full(len(rows), -1, dtype=np.int64),
        camera_names=(rig.camera_names[camera],),
    )
    for turn in TURNS:
        wide = widen_poses(std, rig, [camera], pose, obj, turn)[[camera]]
        found = track(alone, rig.select([camera]), obj, wide, pose, options.identity)
        if found.accepted:
            fiducial = blobs.fiducial.copy()
            fiducial[rows] = found.labels
            return replace(blobs, fiducial=fiducial)
    return None


def widen_poses(
    std: Tensor, rig: CameraRig, cameras: list[int], pose: RigidTransform, obj: CalibrationObject, turn: float
) -> Tensor:
    """Allow cameras a rotation (rad), and a shift that moves the object's image by as much: (C, K)."""
    std = std.clone()
    centre = pose.apply(obj.points).mean(0)
    for camera in cameras:
        distance = float((rig.positions[camera] - centre).norm())
        std[camera, :3] = std[camera, :3].clamp_min(turn)
        std[camera, 3:6] = std[camera, 3:6].clamp_min(turn * distance)
    return std
