"""Labels of single images of a flat object with few fiducials, a wand: by its shape alone, hundreds of images at once.

Seen from a distance, a plane's image is an affine image: three blobs taken for three fiducials say where the others
must be. What passes is posed, and must fit far better than any other labelling of the image.
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
"""Fiducials of an object that is labelled here."""
MOST_ALONE = 12
"""Blobs in an image that is looked at."""
AFFINE = 0.15
"""How far a blob may be from where an affine image has its fiducial, in parts of the object's image."""
FITS = 0.015
"""RMS residual of a labelling with a pose, in the same parts: noise, and what the lens bends."""
CLEARLY, RIVAL = 3.0, 0.01
"""Times the residual, and the residual, which every other labelling must have at least."""
FOCAL_FACTORS = (0.85, 0.92, 1.0, 1.08, 1.17)
"""Focal lengths that are tried, in parts of the one given."""
LEAST_USUAL, USUAL_SIZE = 3, 2.5
"""Images that say how large the object looks, and the factor to either side that is as usual."""
SAME_SIZE = 1.25
"""Ratio of the radii of two markers of one object in one image, at most."""
LEAST_RATIO = 0.1
"""Of the breadth of an image of the object to its length: narrower ones say too little."""

Floats = NDArray[np.float64]


def is_small_planar(obj: CalibrationObject) -> bool:
    """Tell whether an object is one for `label_by_shape`."""
    return obj.num_fiducials <= MOST_FLAT and obj.planar


def label_by_shape(
    images: list[Floats], camera: CameraRig, obj: CalibrationObject, radii: list[Floats] | None = None
) -> list[NDArray[np.int64] | None]:
    """Label images of one camera.

    Args:
        images: blobs of each, (M, 2) pixels.
        camera: a rig of one camera; the focal length may be off by some ten percent.
        obj: flat, few fiducials, all of which an image must show.
        radii: (M,) pixels, of the blobs of each image, nan where unknown: those of one object are alike.

    Returns:
        For each image the fiducial of each blob, (M,), -1 = none; None where the image does not say.

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
    if len(chosen) >= LEAST_USUAL:  # what is found says how large the object looks, and what else is no rival
        usual = np.abs(np.log(size / np.median(size[chosen]))) < np.log(USUAL_SIZE)
        chosen = _decide(np.where(usual, residual, np.inf), image)
    for row in chosen.tolist():
        labels = np.full(len(images[image[row]]), -1)
        labels[rows[row]] = np.arange(obj.num_fiducials)
        answers[image[row]] = labels
    return answers


def _decide(residual: Floats, image: NDArray[np.int64]) -> NDArray[np.int64]:
    """Choose for each image (K,) the labelling with the smallest residual (K,), if no other comes near: their rows."""
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
    """Labellings (K, N) under which blobs (M, 2) look like an affine image of the object: the blob of each fiducial."""
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
