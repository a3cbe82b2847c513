"""Candidate poses of planar objects with so many fiducials that not all triples can be tried.

Seen from a distance, a plane's image is an affine image. Whitened (shifted and stretched to zero mean and unit
covariance) blobs and fiducials therefore differ by a rotation only, so one angle is all there is to search.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from imgcal.association.blobs import PaddedBlobs
from imgcal.association.hypotheses import Poses
from imgcal.types import CalibrationObject, CameraRig

Floats = NDArray[np.float64]

ANGLES = 180  # angles to try; half a step moves the rim of the pattern by 1/60 of its width
GROWN = 12  # number of best angles to refine to homographies


def planar_poses(blobs: PaddedBlobs, rig: CameraRig, camera: int, obj: CalibrationObject) -> Poses:
    """Find poses under which one camera's blobs look like a mostly visible planar object.

    Args:
        blobs: the snapshot.
        rig: factory rig.
        camera: index of the camera.
        obj: a planar object.

    Returns:
        Poses that explain different sets of blobs, possibly none; a lattice has several.
    """
    focal = float(rig.focal_length[camera].mean())
    count = blobs.count[camera]
    ordinary = _ordinary(blobs.radius[camera, :count])
    seen = _drop_strays(blobs.ideal[camera, :count][ordinary].astype(np.float64) / focal)
    points = obj.points.double().cpu().numpy()
    centroid = points.mean(0)
    axes = np.linalg.svd(points - centroid)[2]
    axes[2] = np.cross(axes[0], axes[1])
    flat = (points - centroid) @ axes[:2].T
    tree = cKDTree(seen)
    homographies = []
    for turn in (1.0, -1.0):  # the front of the plane, and its back
        for angle in _best_angles(_whiten(flat * [1, turn])[0], _whiten(seen)[0]):
            homography = _grow(flat, tree, _affinity(flat * [1, turn], seen, angle) @ np.diag([1, turn, 1]))
            if homography is not None:
                homographies.append(homography)
    poses = [_pose(homography) for homography in homographies]
    cam_from_rig, offset = rig.cam_from_rig.rotation[camera].numpy(), rig.cam_from_rig.translation[camera].numpy()
    rotation = np.array([cam_from_rig.T @ r @ axes for r, _ in poses]).reshape(-1, 3, 3)
    centre = np.array([cam_from_rig.T @ (t - offset) for _, t in poses]).reshape(-1, 3)
    return Poses(rotation, centre - rotation @ centroid)


def _ordinary(radius: Floats) -> NDArray[np.bool_]:
    """Mark blobs of about the usual radius, or of unknown radius."""
    if np.isnan(radius).all():
        return np.ones(len(radius), dtype=bool)
    ratio = radius / np.nanmedian(radius)
    return np.isnan(radius) | ((ratio > 0.6) & (ratio < 1.7))


def _drop_strays(points: Floats) -> Floats:
    """Repeatedly remove points far from the bulk: a whitened square extends to the square root of 6."""
    for _ in range(5):
        white = _whiten(points)[0]
        points = points[(white * white).sum(1) < 2.7**2]
    return points


def _whiten(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Return whitened points (N, 2), their mean (2,) and the root of their covariance (2, 2)."""
    mean = points.mean(0)
    values, vectors = np.linalg.eigh(np.cov((points - mean).T))
    root = (vectors * np.sqrt(values)) @ vectors.T
    return (points - mean) @ np.linalg.inv(root), mean, root


def _rotation(angle: float) -> Floats:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _best_angles(pattern: Floats, seen: Floats) -> Floats:
    """Angles that best align the whitened pattern with the whitened blobs."""
    angles: Floats = np.linspace(0, 2 * np.pi, ANGLES, endpoint=False, dtype=np.float64)
    turned = np.concatenate([pattern @ _rotation(angle).T for angle in angles])
    distance = cKDTree(seen).query(turned)[0].reshape(ANGLES, -1)
    misfit = np.minimum(distance, 0.3).mean(1)
    return angles[np.argsort(misfit)[:GROWN]]


def _affinity(pattern: Floats, seen: Floats, angle: float) -> Floats:
    """The affine map (3, 3) from pattern to blobs, for a rotation of the whitened pattern."""
    _, mean, root = _whiten(pattern)
    _, seen_mean, seen_root = _whiten(seen)
    result = np.eye(3)
    result[:2, :2] = seen_root @ _rotation(angle) @ np.linalg.inv(root)
    result[:2, 2] = seen_mean - result[:2, :2] @ mean
    return result


def _grow(flat: Floats, tree: cKDTree, homography: Floats) -> Floats | None:
    """Pair each fiducial with the nearest blob and fit again; None if most have no blob of their own."""
    spacing = float(np.median(tree.query(tree.data, k=2)[0][:, 1]))
    for reach in (1.0, 0.8, 0.6, 0.5, 0.4, 0.3, 0.3, 0.3):
        image = np.c_[flat, np.ones(len(flat))] @ homography.T
        distance, blob = tree.query(image[:, :2] / image[:, 2:])
        paired = distance < reach * spacing
        if paired.sum() < 0.5 * len(flat) or len(np.unique(blob[paired])) < 0.5 * len(flat):
            return None
        homography = _fit_homography(flat[paired], np.asarray(tree.data)[blob[paired]])
    return homography


def _fit_homography(source: Floats, target: Floats) -> Floats:
    """Direct linear transform (N >= 4 points), in whitened coordinates."""
    a, mean_a, root_a = _whiten(source)
    b, mean_b, root_b = _whiten(target)
    one, zero = np.c_[a, np.ones(len(a))], np.zeros((len(a), 3))
    rows = np.concatenate((np.c_[one, zero, -b[:, :1] * one], np.c_[zero, one, -b[:, 1:] * one]))
    inner = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3)
    left, right = np.eye(3), np.eye(3)
    left[:2, :2], left[:2, 2] = root_b, mean_b
    right[:2, :2] = np.linalg.inv(root_a)
    right[:2, 2] = -right[:2, :2] @ mean_a
    result = left @ inner @ right
    return result / result[2, 2]


def _pose(homography: Floats) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) of a plane z = 0 from its image on the z = 1 plane.

    Source: Zhang 2000, "A Flexible New Technique for Camera Calibration", section 3.1.
    """
    scale = np.sqrt(np.linalg.norm(homography[:, 0]) * np.linalg.norm(homography[:, 1]))
    x, y, translation = (homography / scale).T
    u, _, vh = np.linalg.svd(np.stack((x, y, np.cross(x, y)), axis=1))
    return u @ np.diag([1, 1, np.linalg.det(u @ vh)]) @ vh, translation
