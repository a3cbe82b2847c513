"""Does a place of a camera explain the blobs in which the others' object could not be found?

A camera that has moved still shows the object, elsewhere in its image: one other place of the camera explains all those
snapshots, however the object moves. Reflections beside a hidden object do not follow it. And if a single place explains
the snapshots that fit as well as those that do not, only the labels were wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import Associations, Lights, align_camera, undistort
from imgcal.geometry import RigidTransform
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior

NEAR = 5.0
"""Pixels, largest distance of a blob from its fiducial once the camera has been aligned within its prior."""
COARSE = 0.01
"""The same if the factory camera is only turned, relative to the image width: its lens is off, too."""
LEAST_SHARE = 0.5
"""Minimum share of the possible fiducials of a snapshot with a blob, and of the snapshots that a place explains."""
LEAST_PLACES = 5
"""Minimum number of distinct directions with a blob: two of them fit some turn of the camera by chance."""
APART = 4.0
"""Distance of distinct directions, in multiples of the largest distance of a blob."""
DRAWN, TRIED = 50_000, 300
"""Pairs of directions that are drawn, and those as far apart as their blobs that are tried."""
MOST_ROWS = 60
"""Maximum number of snapshots in which a turn is looked for."""

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class CameraView:
    """The usable blobs of one camera in U snapshots, and where the rest of the rig finds the fiducials."""

    blobs: Detections  # of this camera; `snapshot` counts the rows, 0 to U - 1
    points: Array  # (U, N, 3) mm in the rig's frame
    present: Bools  # (U, N) fiducials that the row is about
    factory: CameraRig
    camera: int

    @staticmethod
    def of(
        labelled: Associations, poses: RigidTransform, factory: CameraRig, obj: CalibrationObject, camera: int
    ) -> CameraView:
        """Look at the used snapshots, U.

        Args:
            labelled: all snapshots.
            poses: (U,) rig_from_object of the used ones.
            factory: the factory calibration.
            obj: N fiducials.
            camera: index of the camera.
        """
        row = np.full(len(labelled.snapshots), -1)
        row[labelled.used] = np.arange(len(labelled.used))
        table = labelled.repeat_unlabelled(obj)
        table = table.select((table.camera == camera) & table.usable & (row[table.snapshot] >= 0))
        names = tuple(labelled.snapshots[s].name for s in labelled.used)
        blobs = replace(table, snapshot=row[table.snapshot], snapshot_names=names)
        points = poses.apply(obj.points.to(factory.focal_length)).numpy()
        return CameraView(blobs, points, labelled.columns(obj)[:, 0], factory.to(torch.float64), camera)

    def one_place_explains(self, *parts: NDArray[np.int64]) -> bool:
        """Tell whether one place, within the prior, explains most of each part of the rows."""
        rows = np.concatenate(parts)
        inside, _ = self._project(self.factory)
        row, fiducial = np.nonzero(inside & np.isin(np.arange(len(inside)), rows)[:, None])
        if not len(row) or not np.isin(self.blobs.snapshot, rows).any():
            return False
        blank = np.zeros(len(row))
        lights = Lights(np.full((len(row), 1), -1), row, self.points[row, fiducial], blank, blank)
        blobs, std = self.blobs.select(np.isin(self.blobs.snapshot, rows)), (self.factory.prior or RigPrior())
        placed = align_camera(blobs, self.factory, std.std(self.factory), self.factory, self.camera, lights)
        inside, uv = self._project(placed)
        away = np.linalg.norm(self._uv[:, None] - uv[:, :, None], axis=-1)  # (U, N, M)
        away[~inside] = np.inf
        explained = self._is_explained(away < NEAR, inside.sum(1))
        return all(bool(len(part)) and explained[part].mean() >= LEAST_SHARE for part in parts)

    def some_turn_explains(self, rows: NDArray[np.int64], seed: int = 0) -> bool:
        """Tell whether the camera, turned somehow, or its image mirrored, shows the object in most of the rows."""
        rows = rows[self._is_blob[rows].any(1)]
        rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_ROWS)).astype(int)]
        if not len(rows):
            return False
        focal, width = self.factory.focal_length[self.camera].mean().item(), self.factory.image_size[self.camera, 0]
        gate = COARSE * float(width) / focal  # rad
        seen, is_blob, present = self._rays[rows], self._is_blob[rows], self.present[rows]
        rotation, position = self.factory.cam_from_rig.rotation[self.camera], self.factory.positions[self.camera]
        there = (self.points[rows] - position.numpy()) @ rotation.numpy().T
        there /= np.linalg.norm(there, axis=-1, keepdims=True)
        row, fiducial, blob = np.nonzero(present[:, :, None] & is_blob[:, None])
        turns = _turns(there[row, fiducial], seen[row, blob], gate, np.random.default_rng(seed))
        best, most = None, -1
        for turn in turns:
            fits = ((there @ turn.T) @ seen.swapaxes(1, 2) > np.cos(gate)) & present[:, :, None] & is_blob[:, None]
            if (count := int(fits.any(2).sum())) > most:
                best, most = fits, count
        if best is None:
            return False
        explained = _is_explained(best, present.sum(1), is_blob.sum(1))
        shown = there[best.any(2)]
        return bool(explained.mean() >= LEAST_SHARE) and _count_distinct(shown, APART * gate) >= LEAST_PLACES

    @cached_property
    def _numbers(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Bools]:
        """Row and number of each blob there, and which numbers are in use (U, M)."""
        order = np.argsort(self.blobs.snapshot, kind="stable")
        row = self.blobs.snapshot[order]
        count = np.bincount(row, minlength=len(self.points))
        number = np.empty(len(row), dtype=np.int64)
        number[order] = np.arange(len(row)) - (np.cumsum(count) - count)[row]
        return self.blobs.snapshot, number, np.arange(max(int(count.max()), 1)) < count[:, None]

    @property
    def _is_blob(self) -> Bools:
        return self._numbers[2]

    @cached_property
    def _uv(self) -> Array:
        """Blobs by row: (U, M, 2) px, far away where there is none."""
        row, number, used = self._numbers
        uv = np.full((*used.shape, 2), -1e9)
        uv[row, number] = self.blobs.uv
        return uv

    @cached_property
    def _rays(self) -> Array:
        """Directions of the blobs in the camera's frame: (U, M, 3)."""
        row, number, used = self._numbers
        ideal = undistort(self.blobs.uv, self.blobs.camera, self.factory).astype(np.float64)
        focal = self.factory.focal_length[self.camera].mean().item()
        ray = np.column_stack((np.nan_to_num(ideal) / focal, np.ones(len(ideal))))
        rays = np.zeros((*used.shape, 3))
        rays[row, number] = ray / np.linalg.norm(ray, axis=1, keepdims=True)
        return rays

    def _project(self, rig: CameraRig) -> tuple[Bools, Array]:
        """Fiducials in view (U, N) of a place, and their images (U, N, 2) px."""
        place = rig.select([self.camera])
        uv = place.expand(len(self.points)).project_values(torch.from_numpy(self.points), None).uv[:, 0].numpy()
        inside = (uv > 0) & (uv < place.image_size[0].numpy())
        return inside.all(-1) & self.present, np.where(np.isfinite(uv), uv, 1e9)

    def _is_explained(self, fits: Bools, in_view: NDArray[np.int64]) -> Bools:
        return _is_explained(fits, in_view, self._is_blob.sum(1))


def _is_explained(fits: Bools, in_view: NDArray[np.int64], blobs: NDArray[np.int64]) -> Bools:
    """Tell in which rows enough of the fiducials that may be seen have a blob: (U,), from pairs that fit (U, N, M)."""
    count = np.minimum(fits.any(2).sum(1), fits.any(1).sum(1))
    return (count > 0) & (count >= LEAST_SHARE * np.minimum(in_view, blobs))


def _turns(there: Array, seen: Array, gate: float, rng: np.random.Generator) -> Array:
    """Rotations and reflections (K, 3, 3) that take two directions (P, 3) near those of their blobs (P, 3)."""
    one, other = rng.integers(0, len(there), (2, DRAWN))
    angle, same = (np.arccos(np.clip((rays[one] * rays[other]).sum(1), -1, 1)) for rays in (there, seen))
    good = np.flatnonzero((angle > APART * gate) & (np.abs(angle - same) < gate))[:TRIED]
    frames = []
    for rays in (there, seen):
        middle, across = rays[one[good]] + rays[other[good]], rays[one[good]] - rays[other[good]]
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        frames.append(np.stack((middle, across, np.cross(middle, across)), axis=-1))
    back = frames[0].swapaxes(1, 2)
    return np.concatenate((frames[1] @ back, (frames[1] * [1, 1, -1]) @ back))


def _count_distinct(rays: Array, apart: float) -> int:
    """Number of directions (P, 3) that are all farther apart than an angle."""
    count = 0
    while len(rays):
        rays, count = rays[rays @ rays[0] < np.cos(apart)], count + 1
    return count
