"""Predict every fiducial with its uncertainty from a fit, and compare it with every blob."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from imgcal.association.blobs import PaddedBlobs
from imgcal.estimation import Problem, levenberg_marquardt_cpu
from imgcal.geometry import NEAREST_DEPTH, kernels, lens_codes, lens_kernels
from renderers.compiling import njit

THRESHOLD = 3.0
"""Threshold of the fits' Cauchy loss, in standard deviations."""


@dataclass(frozen=True)
class Innovations:
    """How well each blob fits each fiducial, predicted from all labels except the fiducial's own."""

    squared: NDArray[np.float64]  # (K, C, N, M) squared distance from the prediction, normalized by its covariance
    log_det: NDArray[np.float64]  # (K, C, N) log determinant of that covariance, blob noise included, px^4
    own: NDArray[np.float64]  # (K, C, N) `squared` of the fiducial's own blob, inf = no label
    residual: NDArray[np.float64]  # (K, C, N) squared distance px^2 from the fit that includes the label
    freedom: NDArray[np.float64]  # (K, C, N) degrees of freedom of the label's residual: 0 to 2
    uv: NDArray[np.float64]  # (K, C, N, 2) px, predictions
    complexity: NDArray[np.float64]  # (K,) log determinant ratio of posterior and prior precision

    def select(self, rows: NDArray[np.int64]) -> Innovations:
        """Keep the given labellings, without a copy if it is a single one."""
        chosen = one_or_some(rows)
        return Innovations(*(getattr(self, field.name)[chosen] for field in fields(self)))


def one_or_some(rows: NDArray[np.int64]) -> slice | NDArray[np.int64]:
    """Index for rows of an array: for a single row a slice, to avoid a copy of many megabytes."""
    return slice(rows[0], rows[0] + 1) if len(rows) == 1 else rows


@dataclass(frozen=True)
class SharedValues:
    """What the predictions of all fits share: the factory rig, its prior and the object."""

    rotation: NDArray[np.float64]  # (C, 3, 3) cam_from_rig
    position: NDArray[np.float64]  # (C, 3) mm
    focal_length: NDArray[np.float64]  # (C, 2) px
    principal_point: NDArray[np.float64]  # (C, 2) px
    distortion: NDArray[np.float64]  # (C, D)
    prior_std: NDArray[np.float64]  # (C, K)
    points: NDArray[np.float64]  # (N, 3) mm, fiducials relative to their centroid
    radius_squared: NDArray[np.float64]  # (N,) mm^2
    lenses: NDArray[np.int64] | None  # (C,) see `lens_codes`

    @classmethod
    def of(cls, problem: Problem) -> SharedValues:
        """Take the values of a problem whose rigs are all the same."""
        factory, points, squared = problem.factory, problem.points, problem.radius_squared
        lens = (factory.focal_length, factory.principal_point, factory.distortion)
        rig = (factory.cam_from_rig.rotation, levenberg_marquardt_cpu.camera_positions(factory), *lens)
        rotation, position, focal_length, principal_point, distortion, prior_std = (
            np.ascontiguousarray(tensor[0].numpy()) for tensor in (*rig, problem.prior_std)
        )
        return cls(
            rotation, position, focal_length, principal_point, distortion, prior_std,
            np.ascontiguousarray(points.numpy()),
            np.zeros(len(points)) if squared is None else squared.numpy(),
            lens_codes(factory.lens_model, *factory.distortion.shape[-2:]),
        )  # fmt: skip

    @cached_property
    def arrays(self) -> tuple[np.ndarray | None, ...]:
        """All but the object's, in the order of `_compare`."""
        rig = (self.rotation, self.position, self.focal_length, self.principal_point, self.distortion)
        return (*rig, self.prior_std, self.radius_squared, self.lenses)


def innovations(
    blobs: PaddedBlobs,
    labels: NDArray[np.int64],
    sigma: NDArray[np.float64],
    shared: SharedValues,
    fitted: Sequence[levenberg_marquardt_cpu.SnapshotFit],
) -> Innovations:
    """Compare predictions with blobs.

    Args:
        blobs: the snapshot.
        labels: (K, C, N) labels of the fit: blob of each fiducial, -1 = none.
        sigma: (K,) px, noise of blob centres beyond their own sigmas.
        shared: of the problem of the fits.
        fitted: K fits.
    """
    count, cameras, fiducials = labels.shape
    noise, typical = blobs.noise
    labels = np.ascontiguousarray(labels)
    shape = (count, cameras, fiducials)
    # Uninitialized: filled completely below, and may be many megabytes.
    squared, log_det, own = np.empty((*shape, blobs.uv.shape[1])), np.zeros(shape), np.full(shape, np.inf)
    residual, freedom, uv = np.zeros(shape), np.zeros(shape), np.zeros((*shape, 2))
    complexity = np.full(count, np.inf)
    for k, one in enumerate(fitted):
        if not np.isfinite(one.cost):
            squared[k] = np.inf
            continue
        # Lower factors of the blocks of the cameras, the couplings and the pose: see schur.reduce.
        factors = one.camera.copy(), one.coupling.copy(), one.pose.copy()
        complexity[k] = _factorize(*factors)
        if np.isfinite(complexity[k]):
            _compare(
                (one.offset * shared.prior_std, np.ascontiguousarray(shared.points @ one.rotation.T), one.centre),
                shared.arrays,
                factors,
                (blobs.uv, noise, typical, blobs.count, labels[k], sigma[k] ** 2),
                (squared[k], log_det[k], own[k], residual[k], freedom[k], uv[k]),
            )
        else:
            squared[k] = np.inf
    return Innovations(squared, log_det, own, residual, freedom, uv, complexity)


def find_contested(labels: NDArray[np.int64], found: Innovations, undecided: float) -> NDArray[np.bool_]:
    """Mark labels (K, C, N) whose blob fits another fiducial about as well, alone or in exchange for its blob.

    Args:
        labels: (K, C, N) labels of the fit: blob of each fiducial, -1 = none.
        found: from `innovations`.
        undecided: difference of squared normalized innovations below which two pairings are indistinguishable.
    """
    result = np.zeros(labels.shape, dtype=bool)
    _contest(labels, found.squared, found.log_det, found.own, undecided, result)
    return result


@njit(cache=True)
def _contest(labels, squared, log_det, own, undecided, result):
    for k in range(len(labels)):
        for c in range(labels.shape[1]):
            mine = labels[k, c]
            for i in range(len(mine)):
                if mine[i] < 0:
                    continue
                for j in range(len(mine)):
                    change = squared[k, c, j, mine[i]] + log_det[k, c, j] - own[k, c, i] - log_det[k, c, i]
                    if mine[j] >= 0:  # in exchange
                        change += squared[k, c, i, mine[j]] + log_det[k, c, i] - own[k, c, j] - log_det[k, c, j]
                    if i != j and change < undecided:
                        result[k, c, i] = True
                        break


@njit(cache=True, fastmath=kernels.FAST)
def _factorize(blocks, coupling, kept):
    """Factorize the arrow matrix in place; return its log determinant, inf if it is not positive definite."""
    log_det = 0.0
    for c in range(len(blocks)):
        if not kernels.cholesky(blocks[c]):
            return np.inf
        size = blocks.shape[1]
        for i in range(size):
            log_det += 2 * np.log(blocks[c, i, i])
            for j in range(6):
                for k in range(i):
                    coupling[c, i, j] -= blocks[c, i, k] * coupling[c, k, j]
                coupling[c, i, j] /= blocks[c, i, i]
        for i in range(6):
            for j in range(6):
                for k in range(blocks.shape[1]):
                    kept[i, j] -= coupling[c, k, i] * coupling[c, k, j]
    if not kernels.cholesky(kept):
        return np.inf
    for i in range(6):
        log_det += 2 * np.log(kept[i, i])
    return log_det


@njit(cache=True, fastmath=kernels.FAST)
def _compare(fitted, shared, factors, blobs, outputs):
    """Fill in the outputs for one labelling.

    Args:
        fitted: the cameras' steps from the factory rig, the object, turned, and its position.
        shared: see `SharedValues.arrays`.
        factors: factors of the arrow matrix; see `_factorize`.
        blobs: their places, noise, typical noise, number, labels, and noise beyond their own.
        outputs: as in `Innovations`.
    """
    step, rotated, centre = fitted
    rotation0, positions, focal_lengths, principal_points, coefficients, prior_std, radius_squared, lenses = shared
    eliminated, whitened, kept = factors
    blob_uv, blob_noise, typical_noise, blob_count, labels, extra = blobs
    squared, log_det, own, residual, freedom, uv = outputs
    free = 10 + lens_kernels.width_of(lenses, coefficients)
    rows, parts = np.empty((2, free + 6)), np.empty((2, free + 6))
    rotation, exponential, left = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    unit = max(1.0, np.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2))
    for c in range(len(rotation0)):
        position, focal = positions[c] + step[c, 3:6], focal_lengths[c] + step[c, 6:8]
        principal, distortion = principal_points[c] + step[c, 8:10], coefficients[c] + step[c, 10:]
        kernels.exponential(step[c, :3], exponential, left)
        kernels.multiply(exponential, rotation0[c], rotation)
        for n in range(len(rotated)):
            _rows(
                rotated[n], rotation, left, centre, position,
                focal, principal, lenses, c, distortion, prior_std[c], radius_squared[n], unit, rows, uv[c, n],
            )  # fmt: skip
            uu, uv_, vv = _whiten(rows, eliminated[c], whitened[c], kept, parts)
            label = labels[c, n]
            noise = (blob_noise[c, label] if label >= 0 else typical_noise) + extra
            at_u, at_v = uv[c, n, 0], uv[c, n, 1]
            residual[c, n], freedom[c, n], own[c, n] = 0.0, 0.0, np.inf
            if label >= 0:
                # Leaving the label out turns the prediction's covariance H into (W - H)^-1 W H and its error e into
                # (W - H)^-1 W e, where W is the noise divided by the weight that the robust loss gave the label.
                eu, ev = at_u - blob_uv[c, label, 0], at_v - blob_uv[c, label, 1]
                residual[c, n] = eu * eu + ev * ev
                weighted = noise + residual[c, n] / THRESHOLD**2
                freedom[c, n] = max(2 - (uu + vv) / weighted, 0.0)
                a, b, d = weighted - uu, -uv_, weighted - vv
                det = a * d - b * b
                if not (a > 0 and d > 0 and det > 1e-9 * weighted * weighted):
                    # Only the label itself determines the fiducial's place.
                    a, b, d, det = 1e-4 * weighted, 0.0, 1e-4 * weighted, 1e-8 * weighted * weighted
                scale = weighted / det
                at_u = blob_uv[c, label, 0] + scale * (d * eu - b * ev)
                at_v = blob_uv[c, label, 1] + scale * (a * ev - b * eu)
                uu, uv_, vv = scale * d - 1, -scale * b, scale * a - 1
                uu, uv_, vv = weighted * uu + noise, weighted * uv_, weighted * vv + noise
            else:
                uu, vv = uu + noise, vv + noise
            det = max(uu * vv - uv_ * uv_, 1e-12 * uu * vv)
            log_det[c, n] = np.log(det)
            for m in range(squared.shape[2]):
                if m >= blob_count[c]:
                    squared[c, n, m] = np.inf
                    continue
                x, y = blob_uv[c, m, 0] - at_u, blob_uv[c, m, 1] - at_v
                squared[c, n, m] = (vv * x * x - 2 * uv_ * x * y + uu * y * y) / det
            if label >= 0:
                own[c, n] = squared[c, n, label]


@njit(cache=True, fastmath=kernels.FAST)
def _rows(
    rotated, rotation, left, centre, position, focal, principal, lenses, camera, distortion, prior_std, radius_squared,
    unit, rows, uv,
):  # fmt: skip
    """Fill in the Jacobian (2, K + 6) of a pixel by K whitened camera and 6 pose parameters, and the pixel.

    Equal to that of the fit (`linearization_cpu.linearize_rig`) to the last digit: if a label alone determines a
    parameter, the result is the difference of two almost equal numbers.
    """
    ax, ay, az = rotated[0], rotated[1], rotated[2]
    ox, oy, oz = ax + centre[0] - position[0], ay + centre[1] - position[1], az + centre[2] - position[2]
    px = rotation[0, 0] * ox + rotation[0, 1] * oy + rotation[0, 2] * oz
    py = rotation[1, 0] * ox + rotation[1, 1] * oy + rotation[1, 2] * oz
    pz = rotation[2, 0] * ox + rotation[2, 1] * oy + rotation[2, 2] * oz
    free = len(prior_std)
    per_depth, log_slope, x, y, rr, xd, yd, jxx, jxy, jyy = lens_kernels.image_of(
        lenses, camera, px, py, max(pz, NEAREST_DEPTH), radius_squared, distortion
    )
    lens_kernels.by_coefficients(lenses, camera, x, y, rr, distortion, focal[0], focal[1], 10, rows)
    uv[0], uv[1] = focal[0] * xd + principal[0], focal[1] * yd + principal[1]
    for r in range(2):
        along_x, along_y = (jxx, jxy) if r == 0 else (jxy, jyy)
        sx, sy = focal[r] * per_depth * along_x, focal[r] * per_depth * along_y
        sz = focal[r] * log_slope * (along_x * x + along_y * y)
        tx, ty, tz = py * sz - pz * sy, pz * sx - px * sz, px * sy - py * sx
        bx = sx * rotation[0, 0] + sy * rotation[1, 0] + sz * rotation[2, 0]
        by = sx * rotation[0, 1] + sy * rotation[1, 1] + sz * rotation[2, 1]
        bz = sx * rotation[0, 2] + sy * rotation[1, 2] + sz * rotation[2, 2]
        for i in range(3):
            rows[r, i] = (tx * left[0, i] + ty * left[1, i] + tz * left[2, i]) * prior_std[i]
        rows[r, 3], rows[r, 4], rows[r, 5] = -bx * prior_std[3], -by * prior_std[4], -bz * prior_std[5]
        rows[r, free], rows[r, free + 1], rows[r, free + 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        rows[r, free + 3], rows[r, free + 4], rows[r, free + 5] = bx * unit, by * unit, bz * unit
    for r in range(2):
        along = xd if r == 0 else yd
        rows[r, 6 + r], rows[r, 7 - r] = along * prior_std[6 + r], 0.0
        rows[r, 8 + r], rows[r, 9 - r] = prior_std[8 + r], 0.0
        for i in range(free - 10):
            rows[r, 10 + i] *= prior_std[10 + i]


@njit(cache=True, fastmath=kernels.FAST)
def _whiten(rows, eliminated, whitened, kept, parts):
    """Apply the inverse of the arrow matrix's triangular factor; return the covariance parts @ parts.T: uu, uv, vv."""
    free = len(eliminated)
    for r in range(2):
        for i in range(free):
            value = rows[r, i]
            for j in range(i):
                value -= eliminated[i, j] * parts[r, j]
            parts[r, i] = value / eliminated[i, i]
        for i in range(6):
            value = rows[r, free + i]
            for j in range(free):
                value -= whitened[j, i] * parts[r, j]
            for j in range(i):
                value -= kept[i, j] * parts[r, free + j]
            parts[r, free + i] = value / kept[i, i]
    uu, uv, vv = 0.0, 0.0, 0.0
    for i in range(free + 6):
        uu += parts[0, i] * parts[0, i]
        uv += parts[0, i] * parts[1, i]
        vv += parts[1, i] * parts[1, i]
    return uu, uv, vv
