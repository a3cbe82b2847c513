"""Label single images of a small flat object, such as a wand, by its shape alone; hundreds of images at once.

Seen from a distance, a plane's image is an affine image: three blobs matched to three fiducials predict the others.
Candidates that pass get a pose, and must fit far better than any other labelling of the image.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import initial_pose
from imgcal.types import CalibrationObject, CameraRig, Observations

MOST_FLAT = 6
"""Maximum number of fiducials of an object to label here."""
MOST_ALONE = 12
"""Maximum number of blobs in an image."""
AFFINE = 0.15
"""Maximum distance of a blob from the affine prediction, as a share of the object's image."""
FITS = 0.015
"""Maximum RMS residual of a labelling with a pose, in the same unit: noise, and lens distortion."""
CLEARLY, RIVAL = 3.0, 0.01
"""Minimum ratio to the best residual, and minimum residual, of every other labelling."""
FOCAL_FACTORS = (0.85, 0.92, 1.0, 1.08, 1.17)
"""Focal lengths to try, relative to the given one."""
LEAST_USUAL, USUAL_SIZE = 3, 2.5
"""Number of images that define the object's usual apparent size, and the maximum factor of deviation from it."""
SAME_SIZE = 1.25
"""Maximum ratio of the radii of two markers of one object in an image."""
LEAST_RATIO = 0.1
"""Minimum ratio of breadth to length of an object's image: narrower ones are not informative."""

Floats = NDArray[np.float64]


def is_small_planar(obj: CalibrationObject) -> bool:
    """Tell whether `label_by_shape` can handle an object."""
    return obj.num_fiducials <= MOST_FLAT and obj.planar


def label_by_shape(
    images: list[Floats], camera: CameraRig, obj: CalibrationObject, radii: list[Floats] | None = None
) -> list[NDArray[np.int64] | None]:
    """Label images of one camera.

    Args:
        images: blobs of each, (M, 2) pixels.
        camera: a rig of one camera; the focal length may be off by about ten percent.
        obj: flat, with few fiducials; an image must show all of them.
        radii: (M,) pixels, of the blobs of each image, nan = unknown: those of one object are alike.

    Returns:
        For each image, the fiducial of each blob, (M,), -1 = none; None if the image is ambiguous.

    Examples:
        >>> import imgcal
        >>> camera, wand = imgcal.load_rig("room10").select([0]), imgcal.load_object("wand4")
        >>> seen = camera.project(wand.points + wand.points.new_tensor((300.0, 0.0, 1000.0))).uv[0].numpy()
        >>> label_by_shape([seen[[2, 0, 3, 1]]], camera, wand)
        [array([2, 0, 3, 1])]
    """
    flat, base = _plane_coordinates(obj)
    focal, centre = camera.focal_length[0].numpy(), camera.principal_point[0].numpy()
    candidates, which = [], []
    for number, blobs in enumerate(images):
        if obj.num_fiducials <= len(blobs) <= MOST_ALONE:
            found = _candidates((blobs - centre) / focal, flat, base)
            if radii is not None:
                sizes = radii[number][found]
                found = found[~(sizes.max(1, initial=0.0) > SAME_SIZE * sizes.min(1, initial=np.inf))]
            candidates += list(found)
            which += [number] * len(found)
    answers: list[NDArray[np.int64] | None] = [None] * len(images)
    if not candidates:
        return answers
    rows, image = np.array(candidates), np.array(which)  # (K, N) blob of each fiducial
    uv = torch.from_numpy(np.stack([images[i][row] for i, row in zip(which, rows, strict=True)]))[:, None]
    size = (uv - uv.mean(2, keepdim=True)).square().sum(-1).mean((1, 2)).sqrt().numpy()
    residual = np.min([_misfit(uv, camera, factor, obj) for factor in FOCAL_FACTORS], axis=0) / size
    chosen = _decide(residual, image)
    if len(chosen) >= LEAST_USUAL:  # these define the object's usual size; other sizes are not rivals
        usual = np.abs(np.log(size / np.median(size[chosen]))) < np.log(USUAL_SIZE)
        chosen = _decide(np.where(usual, residual, np.inf), image)
    for row in chosen.tolist():
        labels = np.full(len(images[image[row]]), -1)
        labels[rows[row]] = np.arange(obj.num_fiducials)
        answers[image[row]] = labels
    return answers


def _decide(residual: Floats, image: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of the labellings (K,) with an image's smallest residual, for images without a close rival."""
    chosen = []
    for number in np.unique(image):
        mine = np.flatnonzero(image == number)
        order = mine[np.argsort(residual[mine])]
        best = residual[order[0]]
        if best <= FITS and (len(order) == 1 or residual[order[1]] >= max(CLEARLY * best, RIVAL)):
            chosen.append(order[0])
    return np.array(chosen, dtype=np.int64)


def _misfit(uv: Tensor, camera: CameraRig, factor: float, obj: CalibrationObject) -> Floats:
    """RMS residual of labellings uv (K, 1, N, 2) pixels, each with its best pose: (K,)."""
    seen = torch.ones(uv.shape[:-1], dtype=torch.bool)
    camera = replace(camera, focal_length=factor * camera.focal_length)
    poses = initial_pose(Observations(uv, seen.double(), seen), camera, obj)
    predicted = camera.expand(len(uv)).project(poses.apply(obj.points.double())).uv
    off = (predicted - uv).square().sum(-1).mean((1, 2)).sqrt()
    return np.asarray(off.nan_to_num(torch.inf))


def _plane_coordinates(obj: CalibrationObject) -> tuple[Floats, tuple[int, int, int]]:
    """Coordinates in the object's plane (N, 2), and the three fiducials that span the largest triangle."""
    points = obj.points.double().numpy()
    flat = (points - points.mean(0)) @ np.linalg.svd(points - points.mean(0))[2][:2].T
    base = max(combinations(range(len(flat)), 3), key=lambda triple: abs(_area(flat[list(triple)])))
    return flat, base


def _candidates(xy: Floats, flat: Floats, base: tuple[int, int, int]) -> NDArray[np.int64]:
    """Labellings (K, N), the blob of each fiducial, under which blobs (M, 2) are an affine image of the object."""
    triples = np.array(list(permutations(range(len(xy)), 3)))
    corners = xy[triples]  # (T, 3, 2)
    away = np.linalg.norm(corners - corners.mean(1, keepdims=True), axis=-1).mean(1)
    area = np.abs(np.linalg.det(np.diff(corners, axis=1)))
    wide = area > LEAST_RATIO * away**2
    triples, corners, away = triples[wide], corners[wide], away[wide]
    share = np.c_[flat, np.ones(len(flat))] @ np.linalg.inv(np.c_[flat[list(base)], np.ones(3)])  # (N, 3)
    there = np.einsum("nb,tbk->tnk", share, corners)
    distance = np.linalg.norm(there[:, :, None] - xy, axis=-1)  # (T, N, M)
    nearest = distance.argmin(-1)
    fits = distance.min(-1).max(1) < AFFINE * away
    ordered = np.sort(nearest, axis=1)
    different = (np.diff(ordered, axis=1) > 0).all(1)
    return nearest[fits & different]


def _area(corners: Floats) -> float:
    return float(np.linalg.det(np.diff(corners, axis=0)))
