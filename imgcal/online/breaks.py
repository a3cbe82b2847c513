"""Did a camera move while snapshots were taken? A test for a break in a series of snapshots that were fitted together.

Every snapshot pulls at every camera. While nothing moves, the pulls on a camera are noise, whatever part of the series
they come from. Where a camera moved between two snapshots, those before pull one way and those after pull the other,
also where the fit has left the later ones out as outliers. The score (Lagrange multiplier) test asks how improbable the
difference is, without another fit: for each camera and each place in the series where it may have happened.

`imgcal.estimation.change_points` tests the same idea in another way. A window is asked at every snapshot, within
milliseconds and with a few labels: here the other cameras are taken as known, and a camera turns or shifts, no more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import Estimate
from imgcal.geometry import RigidTransform
from imgcal.types import CameraRig, Observations

FARTHEST = 6.0
"""Standard deviations at which a residual is clipped: a few wrong labels look like no move of the camera."""
MEDIAN = 5.348
"""Of chi-squared with six degrees of freedom."""
LEAST_LABELS = 3
"""On either side of a break."""


@dataclass(frozen=True)
class Series:
    """Labelled snapshots and a fit of all of them."""

    rig: CameraRig
    rig_from_object: RigidTransform  # (S,)
    points: NDArray[np.float64]  # (N, 3) mm
    residual: NDArray[np.float64]  # (S, C, N, 2) px, predicted minus observed, of all labels
    sigma: NDArray[np.float64]  # (S, C, N) px
    labels: NDArray[np.bool_]  # (S, C, N), those that the fit left out included
    prior_std: NDArray[np.float64]  # (C, 6) prior standard deviation of rotation (rad) and position (mm)
    offset: NDArray[np.float64]  # (C, 6) difference from the factory values, rotation and position


def series_of(fit: Estimate, labels: Observations, radius: Tensor | None) -> Series:
    """Collect what the test needs.

    Args:
        fit: without batch axes.
        labels: (S, C, N) of the fitted snapshots, those that the fit left out included.
        radius: (N,) mm of spherical fiducials.
    """
    residual = fit.residual
    if not torch.equal(fit.problem.root_weight[0] > 0, labels.seen):  # the fit knows no residuals of what it left out
        points = fit.rig_from_object.apply(fit.points_object)
        residual = fit.rig.expand(len(labels.uv)).project(points, radius).uv - labels.uv
    prior_std = fit.problem.prior_std[0, :, :6]
    return Series(
        rig=fit.rig,
        rig_from_object=fit.rig_from_object,
        points=fit.points_object.numpy(),
        residual=residual.numpy(),
        sigma=labels.sigma.numpy(),
        labels=labels.seen.numpy(),
        prior_std=prior_std.numpy(),
        offset=(fit.solution.state.offset[0, :, :6] * prior_std).numpy(),
    )


@dataclass(frozen=True)
class Breaks:
    """The test's answers; `statistic[k - 1, c]` asks whether camera c moved between snapshots k - 1 and k."""

    statistic: NDArray[np.float64]  # (S - 1, C) chi-squared with six degrees of freedom where nothing moved

    def most_significant(self) -> tuple[int, int, float]:
        """Number of the first snapshot after the clearest break, camera, and statistic."""
        row, camera = np.unravel_index(int(self.statistic.argmax()), self.statistic.shape)
        return int(row) + 1, int(camera), float(self.statistic[row, camera])

    def excess(self, most: float) -> float:
        """How much larger than by noise alone the test is, in spite of one camera that may have moved."""
        others = np.delete(self.statistic, self.most_significant()[1], axis=1)
        return min(most, float(np.median(others[others > 0])) / MEDIAN) if (others > 0).any() else 1.0


def find_breaks(series: Series) -> Breaks:
    """Test all cameras at all places.

    The other cameras are taken as known, which makes the statistic smaller than it could be, never larger: residuals of
    a fit know of all of its parameters.
    """
    pull, weight = _reduced(series)
    count = np.cumsum(series.labels.sum(2), axis=0)  # (S, C)
    prior = np.where(series.prior_std > 0, series.prior_std, 1e-9) ** -2.0
    before, pulled = np.cumsum(weight, axis=0)[:-1], np.cumsum(pull, axis=0)[:-1]
    after, pulled_after = weight.sum(0) - before, pull.sum(0) - pulled
    before = before + prior[:, :, None] * np.eye(6)
    total = before + after
    # As if the camera had been fitted to all labels, clipped: the fit left some of them out.
    everything = pull.sum(0) + prior * series.offset
    share = np.linalg.solve(total, np.broadcast_to(everything[..., None], (*pulled.shape, 1)))
    score = pulled_after - (after @ share)[..., 0]
    variance = after - after @ np.linalg.solve(total, after)
    variance = 0.5 * (variance + variance.swapaxes(-1, -2))
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", variance), 1e-30))
    normal = variance / (scale[..., :, None] * scale[..., None, :])
    # Directions of which the later snapshots say next to nothing do not take part.
    values, vectors = np.linalg.eigh(normal)
    along = np.einsum("...ij,...i->...j", vectors, score / scale)
    statistic = np.where(values > 1e-6, along**2 / np.maximum(values, 1e-6), 0.0).sum(-1)
    enough = (count[:-1] >= LEAST_LABELS) & (count[-1] - count[:-1] >= LEAST_LABELS)
    return Breaks(np.where(enough, statistic, 0.0))


def information(series: Series) -> NDArray[np.float64]:
    """Inverse covariance (C, 6, 6) of each camera's rotation (rad, left) and position (mm), the others being known."""
    prior = np.where(series.prior_std > 0, series.prior_std, 1e-9) ** -2.0
    return _reduced(series)[1].sum(0) + prior[:, :, None] * np.eye(6)


def _reduced(series: Series) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pull (S, C, 6) on each camera's rotation and position and its weight (S, C, 6, 6), the object's pose let free."""
    by_camera, by_pose = _jacobians(series)  # (S, C, N, 2, 6)
    seen = series.labels[..., None]
    residual = np.where(seen, series.residual / series.sigma[..., None], 0.0)
    length = np.linalg.norm(residual, axis=-1, keepdims=True)
    residual = residual * np.minimum(1.0, FARTHEST / np.maximum(length, 1e-30))
    root = np.where(series.labels, 1 / series.sigma, 0.0)[..., None, None]
    shape = (*series.labels.shape[:2], -1, 6)
    a, b = (by_camera * root).reshape(shape), (by_pose * root).reshape(shape)
    r = residual.reshape(*shape[:2], -1, 1)
    at, bt = a.swapaxes(-1, -2), b.swapaxes(-1, -2)
    pose = (bt @ b).sum(1, keepdims=True)  # (S, 1, 6, 6)
    pose = pose * (1 + 1e-9 * np.eye(6)) + 1e-30 * np.eye(6)
    coupling = at @ b  # (S, C, 6, 6)
    carried = np.linalg.solve(pose, coupling.swapaxes(-1, -2)).swapaxes(-1, -2)
    pull = at @ r - carried @ (bt @ r).sum(1, keepdims=True)
    weight = at @ a - carried @ coupling.swapaxes(-1, -2)
    return pull[..., 0], 0.5 * (weight + weight.swapaxes(-1, -2))


def _jacobians(series: Series) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivative (S, C, N, 2, 6) of pixels by a camera's rotation (left) and position, and by the object's pose.

    Distortion is left out: it changes the weight of a pixel by some per cent.
    """
    rotation = series.rig.cam_from_rig.rotation.numpy()[None, :, None]  # (1, C, 1, 3, 3)
    poses = series.rig_from_object
    rotated = (series.points @ poses.rotation.numpy().swapaxes(-1, -2))[:, None]  # (S, 1, N, 3)
    at = rotated + poses.translation.numpy()[:, None, None]
    point = (rotation @ (at - series.rig.positions.numpy()[None, :, None])[..., None])[..., 0]  # (S, C, N, 3)
    depth = np.maximum(point[..., 2], 1.0)
    slope = np.zeros((*point.shape[:-1], 2, 3))
    focal = series.rig.focal_length.numpy()[None, :, None]
    for axis in range(2):
        slope[..., axis, axis] = focal[..., axis] / depth
        slope[..., axis, 2] = -focal[..., axis] * point[..., axis] / depth**2
    back = slope @ rotation
    arm = at - at.mean(2, keepdims=True)
    by_camera = np.concatenate((np.cross(point[..., None, :], slope), -back), axis=-1)
    by_pose = np.concatenate((np.cross(np.broadcast_to(arm, point.shape)[..., None, :], back), back), axis=-1)
    return by_camera, by_pose
