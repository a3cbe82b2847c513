"""One snapshot's blobs as dense arrays, and the errors of predictions that the prior allows."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry import lens_codes, lens_kernels
from imgcal.medians import median
from imgcal.types import CameraRig, Detections
from renderers.compiling import njit

FAR = 1e6
"""Pixel coordinate of padding: beyond any gate."""


@dataclass(frozen=True)
class PaddedBlobs:
    """Usable blobs of one snapshot, padded to the same number in every camera."""

    uv: NDArray[np.float64]  # (C, M, 2) pixels, FAR where padded
    ideal: NDArray[np.float32]  # (C, M, 2) pixels from the principal point, distortion removed, FAR where padded
    sigma: NDArray[np.float64]  # (C, M) pixels
    radius: NDArray[np.float64]  # (C, M) pixels, nan = unknown
    row: NDArray[np.int64]  # (C, M) row of the detections, -1 where padded
    count: NDArray[np.int64]  # (C,)
    rows: int  # rows of the detections, usable or not

    @cached_property
    def noise(self) -> tuple[NDArray[np.float64], float]:
        """Variance of each blob's place (C, M) px^2, and the typical one."""
        variance, valid = self.sigma**2, self.row >= 0
        return variance, median(variance[valid]) if valid.any() else 0.0

    @cached_property
    def left_to_right(self) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """The blobs of each camera by u: `ideal` (C, M, 2) in this order, and the number of each (C, M)."""
        order = np.argsort(self.ideal[..., 0], axis=1, kind="stable")
        return np.take_along_axis(self.ideal, order[..., None], axis=1), order

    def select_camera(self, camera: int) -> PaddedBlobs:
        """Keep one camera; labels keep their numbers."""
        one = [camera]
        kept = (self.uv[one], self.ideal[one], self.sigma[one], self.radius[one], self.row[one], self.count[one])
        return PaddedBlobs(*kept, self.rows)

    def to_rows(self, labels: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert blob indices of fiducials (C, N) into fiducials of detection rows (rows,)."""
        result = np.full(self.rows, -1, dtype=np.int64)
        camera, fiducial = np.nonzero(labels >= 0)
        result[self.row[camera, labels[camera, fiducial]]] = fiducial
        return result


def gather(detections: Detections, rig: CameraRig) -> PaddedBlobs:
    """Collect a snapshot's usable blobs that the lens can show; of several at exactly the same place, the first.

    Args:
        detections: blobs of one snapshot; its cameras are the rig's, in the rig's order.
        rig: factory rig without batch axes.

    Raises:
        InputError: more than one snapshot, or cameras that are not the rig's.
    """
    if tuple(detections.camera_names) != tuple(rig.camera_names):
        raise InputError(
            f"detections of cameras {detections.camera_names}: expected {rig.camera_names} of rig {rig.name}"
        )
    if len(np.unique(detections.snapshot)) > 1:
        raise InputError("identity: found blobs of several snapshots, expected those of one")
    rows = np.flatnonzero(detections.usable)
    places = np.column_stack((detections.camera[rows], detections.uv[rows]))
    by_place = np.lexsort(places.T)  # np.unique takes several times as long
    repeated = (places[by_place[1:]] == places[by_place[:-1]]).all(1)
    rows = np.delete(rows, by_place[1:][repeated])
    ideal = undistort(detections.uv[rows], detections.camera[rows], rig)
    finite = np.isfinite(ideal).all(-1)  # a poorly determined lens may not reach this place
    rows, ideal = rows[finite], ideal[finite]
    order = np.argsort(detections.camera[rows], kind="stable")
    rows, ideal = rows[order], ideal[order]
    camera = detections.camera[rows]
    count = np.bincount(camera, minlength=rig.num_cameras)
    at = camera, np.arange(len(rows)) - (np.cumsum(count) - count)[camera]
    shape = (rig.num_cameras, max(int(count.max()), 1))
    padded = PaddedBlobs(
        np.full((*shape, 2), FAR), np.full((*shape, 2), FAR, dtype=np.float32), np.ones(shape),
        np.full(shape, np.nan), np.full(shape, -1), count, len(detections),
    )  # fmt: skip
    padded.uv[at], padded.ideal[at], padded.row[at] = detections.uv[rows], ideal, rows
    padded.sigma[at], padded.radius[at] = detections.sigma[rows], detections.radius[rows]
    return padded


def undistort(uv: NDArray[np.float64], camera: NDArray[np.int64], rig: CameraRig) -> NDArray[np.float32]:
    """Pixels (R, 2) from the principal point, without distortion; not finite where the lens cannot show a place."""
    ideal = np.empty((len(uv), 2), dtype=np.float32)
    lens = (rig.focal_length.numpy(), rig.principal_point.numpy(), rig.distortion.numpy())
    _undistort(uv, camera, *lens, lens_codes(rig.lens_model, *rig.distortion.shape), ideal)
    return ideal


@njit(cache=True)
def _undistort(uv, camera, focal, principal, distortion, lenses, ideal):
    """Fill pixels (R, 2) from the principal point, without distortion; see `PaddedBlobs.ideal`."""
    for r in range(len(uv)):
        c = camera[r]
        xd, yd = (uv[r, 0] - principal[c, 0]) / focal[c, 0], (uv[r, 1] - principal[c, 1]) / focal[c, 1]
        x, y = lens_kernels.undistort(lenses, c, xd, yd, distortion[c])
        mean = (focal[c, 0] + focal[c, 1]) / 2
        ideal[r, 0], ideal[r, 1] = mean * x, mean * y


@dataclass(frozen=True)
class PatternPrior:
    """The factory prior, reduced to a pattern's shift in the image and its deformation."""

    shift: NDArray[np.float64]  # (C,) pixels, one standard deviation of a pattern's place in the image
    shape: float  # relative: one standard deviation of distances within a pattern


@dataclass(frozen=True)
class PriorSpread:
    """Variances that the factory prior gives the place of an object at any distance; see `at`."""

    focal: NDArray[np.float64]  # (C,) px
    image: NDArray[np.float64]  # (C,) px^2, principal point and rotation: a pattern's shift
    travel: NDArray[np.float64]  # (C,) mm^2, position
    deformation: NDArray[np.float64]  # (C,) relative: focal length, rotation and principal point

    @classmethod
    def of(cls, std: Tensor, rig: CameraRig) -> PriorSpread:
        """Reduce standard deviations (C, K) of a rig's parameters."""
        variance, focal = std.numpy() ** 2, rig.focal_length.numpy().mean(-1)
        turn, travel, scale, principal = (
            variance[:, part].mean(1) for part in (slice(3), slice(3, 6), slice(6, 8), slice(8, 10))
        )
        return cls(focal, principal + focal**2 * turn, travel, (scale + principal) / focal**2 + turn)

    def at(self, distance: float) -> PatternPrior:
        """The prior of a pattern at this distance (mm) from the cameras."""
        travel = self.travel / distance**2
        shift, shape = np.sqrt(self.image + self.focal**2 * travel), np.sqrt((self.deformation + travel).max())
        return PatternPrior(shift, float(shape))


def pattern_prior(std: Tensor, rig: CameraRig, distance: float) -> PatternPrior:
    """Reduce the prior to these two numbers.

    Args:
        std: (C, K) prior standard deviation of each camera's parameters.
        rig: factory rig.
        distance: mm, approximate distance from the cameras to the object.
    """
    return PriorSpread.of(std, rig).at(distance)
