"""How far a camera has moved between two calibrations of a rig, and how surely."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import EstimationOptions, estimate
from imgcal.online.breaks import information, series_of
from imgcal.pipeline import Calibration
from imgcal.types import CameraRig, Kind, MovedCamera, Observations


def measured_move(
    before: CameraRig, known: NDArray[np.float64], after: Calibration, camera: int, snapshot: str, wide: Tensor
) -> tuple[MovedCamera, float]:
    """Measure a camera's move: its rotation and position alone are fitted to what it saw afterwards.

    A few snapshots can hardly tell a turn from a shift that moves the image as much. What is reported is the one that
    explains more by itself; its standard deviation supposes that there was no other, and that the other cameras are
    known.

    Args:
        before: the rig before the move.
        known: (6, 6) how well the camera's rotation (rad) and position (mm) were known: inverse covariance.
        after: with what it saw afterwards, and nothing older.
        camera: its number.
        snapshot: name of the first one after the move.
        wide: (6,) standard deviations of rotation (rad) and position (mm) that it may have moved.

    Returns:
        The move, and the chi-squared (six degrees of freedom) that standing still would have.
    """
    rows = after.observations.seen[:, camera].any(-1).nonzero().flatten()
    given = Observations(*(getattr(after.observations, name)[rows] for name in ("uv", "sigma", "seen")))
    prior_std = torch.zeros_like(after.estimate.problem.prior_std[0])
    prior_std[camera, :6] = wide
    obj = replace(after.obj, points=after.points_object, tolerance=None, scale_tolerance=0.0)
    robust = EstimationOptions(loss="cauchy")
    fit = estimate(given, before, obj, after.rig_from_object[rows], prior_std=prior_std, options=robust)
    change = (fit.solution.state.offset[0, camera, :6] * wide).numpy()
    found = information(series_of(fit, given, obj.radius))[camera]
    weight = np.linalg.inv(np.linalg.inv(known) + np.linalg.inv(found))
    pull = weight @ change
    turned, shifted = (_alone(weight[part, part], pull[part]) for part in (slice(0, 3), slice(3, 6)))
    kind: Kind = "rotation" if turned[2] >= shifted[2] else "position"
    size, sigma, _ = turned if kind == "rotation" else shifted
    unit = math.degrees(1.0) if kind == "rotation" else 1.0
    move = MovedCamera(after.rig.camera_names[camera], snapshot, kind, size * unit, sigma * unit)
    return move, float(change @ pull)


def _alone(weight: NDArray[np.float64], pull: NDArray[np.float64]) -> tuple[float, float, float]:
    """Length of a change that is the only one, its standard deviation, and the chi-squared that it explains."""
    covariance = np.linalg.inv(weight)
    change = covariance @ pull
    size = float(np.linalg.norm(change))
    along = change / max(size, 1e-30)
    return size, float(np.sqrt(along @ covariance @ along)), float(pull @ change)
