"""How the markers of a capture look, and where their light is, whatever their shape."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from imgcal.association import fit_snapshot_poses
from imgcal.detection import DetectionOptions, Frame
from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform
from imgcal.networks import Expectation, cut_patches
from imgcal.types import PATCH_SIZE, CalibrationObject, CameraRig, Observations

ALIKE, LEAST_LIGHT = 0.5, 0.4
"""Correlation with the usual look of the capture's markers, and part of their usual light, from which one is seen."""
SNAPSHOTS_LOOKED_AT = 20
"""Snapshots that tell how markers usually look."""
POORLY_MEASURED = 1.0
"""Pixels, median distance of labels from their projections: from here on, labels move to the centres of light."""
ON_LIGHT = 2.0
"""Patch pixels from the light within which a label is on it."""
LEAST_MEASURED = 6
"""Markers of a snapshot that determine its pose."""


@dataclass(frozen=True)
class Look:
    """How the markers of a capture look, whatever their shape."""

    patch: Tensor  # (24, 24) light of the usual marker, without its mean
    light: float  # how strongly it shows: `_patches` of it

    @torch.no_grad()
    def shows(
        self, frames: Mapping[str, Frame | None], rig: CameraRig, expected: Expectation, detection: DetectionOptions
    ) -> Tensor:
        """Tell which of the expected fiducials (1, C, N) look like the others: (C, N) bool."""
        patches, light = _patches(frames, rig, expected, detection)
        alike = (patches * self.patch).sum((-1, -2)) / (light * self.patch.norm()).clamp(min=1e-9)
        return (alike > ALIKE) & (light > LEAST_LIGHT * self.light) & expected.visible[0]


def usual_look(
    frames: Callable[[int], Mapping[str, Frame | None]],
    snapshots: Sequence[int],
    rig: CameraRig,
    obj: CalibrationObject,
    poses: RigidTransform,
    detection: DetectionOptions,
) -> Look | None:
    """Find out how most markers look, at their projections in some of the snapshots with poses (S,).

    Returns:
        None where they look like nothing that recurs.
    """
    every = max(len(snapshots) // SNAPSHOTS_LOOKED_AT, 1)
    patches, light = [], []
    for row in range(0, len(snapshots), every):
        expected = Expectation.of(rig, obj, poses[row : row + 1])
        own, strength = _patches(frames(snapshots[row]), rig, expected, detection)
        kept = expected.visible[0] & (strength > 0)
        patches.append(own[kept])
        light.append(strength[kept])
    all_patches, all_light = torch.cat(patches), torch.cat(light)
    if not len(all_light):
        return None
    # The median pixel by pixel: a marker that is hidden, or another one beside it, does not show in it.
    usual = (all_patches / all_light[:, None, None]).median(0).values
    usual = usual - usual.mean()
    alike = (all_patches * usual).sum((-1, -2)) / (all_light * usual.norm()).clamp(min=1e-9)
    if float(alike.median()) < ALIKE:
        return None
    return Look(usual, float(all_light.median()))


def _patches(
    frames: Mapping[str, Frame | None], rig: CameraRig, expected: Expectation, detection: DetectionOptions
) -> tuple[Tensor, Tensor]:
    """Cut patches around expected fiducials (1, C, N): less their mean (C, N, 24, 24), and the norm of that (C, N)."""
    radius = expected.radius[0].clamp(0.5, 64)
    patches, _ = cut_patches(
        frames, rig.camera_names, expected.uv[0], radius, inverted=detection.polarity == "dark"
    )  # fmt: skip
    patches = patches - patches.flatten(2).nanmean(-1)[..., None, None]
    patches = patches.nan_to_num()
    return patches, patches.flatten(2).norm(dim=-1)


def fit_to_light(
    frames: Callable[[int], Mapping[str, Frame | None]],
    snapshots: Sequence[int],
    rig: CameraRig,
    obj: CalibrationObject,
    labels: tuple[Observations, RigidTransform],
    detection: DetectionOptions,
    options: EstimationOptions,
) -> tuple[Observations, RigidTransform]:
    """Move labels to the centre of the light that they are on, where detectors measure badly, as they do on bars.

    Args:
        frames: maps the index of a snapshot to its frames.
        snapshots: S indices.
        rig: stays fixed.
        obj: the object.
        labels: of the detector (S, C, N), and the poses (S,) that they determine.
        detection: options with which blobs were found.
        options: of the solver.

    Returns:
        Labels and poses; the given ones if they fit the rig well, or no worse than the centres.
    """
    distance = _median_distance(rig, obj, *labels)
    if distance < POORLY_MEASURED:
        return labels
    given, poses = labels
    centres = given.uv.clone()
    for row, snapshot in enumerate(snapshots):
        radius = Expectation.of(rig, obj, poses[row : row + 1]).radius[0].clamp(0.5, 64)
        centres[row] = find_centres_of_light(
            frames(snapshot), rig.camera_names, given.uv[row], radius, given.seen[row], detection
        )
    seen = given.seen & centres.isfinite().all(-1)
    if bool((seen.flatten(1).sum(1) < LEAST_MEASURED).any()):
        return labels
    measured = replace(given, uv=centres.nan_to_num(), sigma=torch.ones_like(given.sigma), seen=seen)
    poses, fits = fit_snapshot_poses(measured, rig, obj, poses, options)
    closer = bool(fits.all()) and _median_distance(rig, obj, measured, poses) < distance
    return (measured, poses) if closer else labels


def _median_distance(rig: CameraRig, obj: CalibrationObject, labels: Observations, poses: RigidTransform) -> float:
    """Median distance (px) of labels (S, C, N) from their projections."""
    projected = rig.expand(len(labels.seen)).project_values(poses.apply(obj.points.to(labels.uv)), obj.radius).uv
    return float((projected - labels.uv).norm(dim=-1)[labels.seen].median())


def find_centres_of_light(
    frames: Mapping[str, Frame | None],
    names: tuple[str, ...],
    uv: Tensor,
    radius: Tensor,
    seen: Tensor,
    detection: DetectionOptions,
) -> Tensor:
    """Find the centroid of the connected light at each label, whatever its shape.

    Args:
        frames: of the snapshot.
        names: of the C cameras.
        uv: (C, N, 2) pixels, labels.
        radius: (C, N) pixels, expected.
        seen: (C, N) bool, existing labels.
        detection: options with which blobs were found.

    Returns:
        Places (C, N, 2) in pixels; NaN where there is no label, or no light within `ON_LIGHT` of it.
    """
    patches, placement = cut_patches(frames, names, uv, radius, inverted=detection.polarity == "dark")
    places, centres = placement.to_crop(uv[..., None, :])[..., 0, :].numpy(), np.full((*uv.shape[:-1], 1, 2), np.nan)
    for camera, fiducial in seen.nonzero().tolist():
        patch = patches[camera, fiducial].nan_to_num(float(patches[camera, fiducial].nanmedian())).numpy()
        light = patch - np.median(patch)
        _, part, box, _ = cv2.connectedComponentsWithStats((light > light.max() / 2).astype(np.uint8), connectivity=8)
        row, column = np.nonzero(part)
        far = np.hypot(column - places[camera, fiducial, 0], row - places[camera, fiducial, 1])
        if not len(far) or not far.min() < ON_LIGHT:
            continue
        number = part[row[far.argmin()], column[far.argmin()]]
        left, top, width, height, _ = box[number]
        if min(left, top) == 0 or max(left + width, top + height) == PATCH_SIZE:
            continue  # part of it is outside
        own = part == number
        column, row = np.flatnonzero(own) % PATCH_SIZE, np.flatnonzero(own) // PATCH_SIZE
        centres[camera, fiducial, 0] = np.stack((column, row)) @ light[own] / light[own].sum()
    return placement.to_image(torch.from_numpy(centres))[..., 0, :]
