"""Blobs that may be several merged markers: a wand seen end-on, or two fiducials behind each other.

Such a blob is round and bright like any other, and has the sigma of a single marker. The labels reveal it: one fiducial
has a blob, and another one, whose image should touch it, has none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from imgcal.association.series import Associations, drop_snapshots
from imgcal.geometry import RigidTransform
from imgcal.types import BlobFlag, CalibrationObject, CameraRig, Detections

BLUR = 2.0
"""Maximum gap (px) between the edges of two discs whose images may merge: blur, and errors of the prediction."""
MOST_REACH = 8.0
"""Maximum distance (px) of markers that may merge, if blobs have no radius and no two blobs were closer."""


def drop_merged(labelled: Associations, poses: RigidTransform, rig: CameraRig, obj: CalibrationObject) -> Associations:
    """Remove the labels of blobs that may be several merged fiducials, and flag these blobs.

    Args:
        labelled: S used snapshots.
        poses: (S,) approximate rig_from_object.
        rig: approximate rig, without batch axes.
        obj: N fiducials.

    Returns:
        The same with fewer labels; snapshots without any label left are refused.

    Raises:
        RefusedError: no snapshot is left.
    """
    detections, used = labelled.detections, np.array(labelled.used)
    points = poses.apply(obj.points.to(rig.focal_length))
    image = rig.expand(len(points)).project_values(points, obj.radius)
    rows = np.flatnonzero((detections.fiducial >= 0) & np.isin(detections.snapshot, used))
    snapshot, camera = np.searchsorted(used, detections.snapshot[rows]), detections.camera[rows]
    hidden = image.visible.numpy() & labelled.columns(obj)
    hidden[snapshot, camera, detections.fiducial[rows]] = False
    doubtful = np.flatnonzero(hidden[snapshot, camera].any(-1))
    if not len(doubtful):
        return labelled
    reach, uv = merging_reach(detections.radius[rows[doubtful]]), image.uv.numpy()
    spacing, where = 2 * reach.max(), (snapshot[doubtful], camera[doubtful])
    frame = np.arange(hidden[..., 0].size).reshape(hidden.shape[:2])  # frames lie side by side in the tree
    tree = cKDTree(np.column_stack((uv[hidden], spacing * frame[hidden.nonzero()[:2]])))
    places = np.column_stack((uv[*where, detections.fiducial[rows[doubtful]]], spacing * frame[where]))
    apart, known = np.full(len(places), np.inf), np.isfinite(places).all(1)
    apart[known], _ = tree.query(places[known], distance_upper_bound=reach.max())
    near = np.flatnonzero(apart < reach)
    if not len(near):
        return labelled
    merged = rows[doubtful[near]]
    merged = merged[apart[near] < merging_distance(labelled, merged)]
    if not len(merged):
        return labelled
    fiducial, flags = detections.fiducial.copy(), detections.flags.copy()
    fiducial[merged], flags[merged] = -1, flags[merged] | np.uint8(BlobFlag.MERGED)
    left = replace(labelled, detections=replace(detections, fiducial=fiducial, flags=flags))
    bare = np.flatnonzero(~np.isin(used, detections.snapshot[np.setdiff1d(rows, merged)]))
    return drop_snapshots(left, bare.tolist()) if len(bare) else left


def find_merged(
    blobs: Detections, seen: NDArray[np.bool_], uv: NDArray[np.float64], visible: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Find fiducials of one snapshot whose blobs may be several merged fiducials.

    Args:
        blobs: labelled.
        seen: (C, N) fiducials that have a blob.
        uv: (C, N, 2) pixels, predictions of all of them.
        visible: (C, N) whether they are in view.

    Returns:
        (C, N) bool.
    """
    cameras, fiducials = (visible & ~seen & seen.any(1, keepdims=True)).nonzero()
    found = np.zeros_like(seen)
    if not len(cameras):
        return found
    reach = np.zeros(seen.shape)
    named = np.flatnonzero(blobs.fiducial >= 0)
    reach[blobs.camera[named], blobs.fiducial[named]] = merging_reach(blobs.radius[named])
    apart = np.linalg.norm(uv[cameras] - uv[cameras, fiducials][:, None], axis=-1)  # (M, N)
    rows, near = (seen[cameras] & (apart < reach[cameras])).nonzero()
    found[cameras[rows], near] = True
    return found


def merging_reach(radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance (px) between two markers of a radius (M,) px, NaN = unknown, below which they may be one blob: (M,)."""
    return np.where(np.isnan(radius), MOST_REACH, 2 * radius + BLUR)


def merging_distance(labelled: Associations, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Distance (px) between two markers below which a blob may be both of them, for M blobs: (M,).

    Markers merge when their discs touch. If a blob's radius is unknown, the smallest distance of two labelled blobs of
    its camera is used.
    """
    detections = labelled.detections
    reach, camera = merging_reach(detections.radius[rows]), detections.camera[rows]
    unknown = np.isnan(detections.radius[rows])
    if unknown.any():
        reach[unknown] = _closest_distances(detections.select(detections.fiducial >= 0), camera.max() + 1)[
            camera[unknown]
        ]
    return reach


def _closest_distances(blobs: Detections, cameras: int) -> NDArray[np.float64]:
    """Smallest distance (px) of two blobs in one frame of each camera (C,), at most `MOST_REACH`."""
    closest = np.full(cameras, MOST_REACH)
    some = blobs.camera < cameras
    uv, camera = blobs.uv[some], blobs.camera[some]
    frame = blobs.snapshot[some] * cameras + camera
    tree = cKDTree(np.column_stack((uv, 2 * MOST_REACH * frame)))  # frames side by side
    first, second = tree.query_pairs(MOST_REACH, output_type="ndarray").T
    np.minimum.at(closest, camera[first], np.linalg.norm(uv[first] - uv[second], axis=-1))
    return closest
