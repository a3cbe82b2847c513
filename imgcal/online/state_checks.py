"""Checks of rigs, objects, poses, beliefs and blobs from a state file: their arrays must be consistent."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from imgcal.geometry import RigidTransform
from imgcal.monitoring import RigBelief
from imgcal.types import (
    CalibrationObject,
    CameraRig,
    Detections,
    Observations,
    check_object,
    check_rig,
)


def _require(right: bool, found: str) -> None:
    if not right:
        raise ValueError(f"found {found}")


def _check_object(obj: CalibrationObject) -> None:
    _require(sum(part.num_fiducials for part in obj.each) == obj.num_fiducials, "parts of another object")
    check_object(obj)


def _check_transform(pose: RigidTransform) -> None:
    rotation, translation = pose.rotation, pose.translation
    _require(rotation.shape[-2:] == (3, 3) and rotation.shape[:-1] == translation.shape, "no pose")


def _check_belief(belief: RigBelief) -> None:
    count, width, wide = belief.rig.num_cameras, belief.rig.num_parameters, len(belief.factor)
    own = len(belief.object_offset)
    _require(tuple(belief.unit.shape) == (count, width), "units of other cameras")
    _require(own == (0 if belief.obj.exact else 3 * belief.obj.num_fiducials + 1), "an offset of another object")
    for name in ("factor", "information"):
        matrix = getattr(belief, name)
        _require(tuple(matrix.shape) == (wide, wide) and wide == count * width + own, f"{name} of another rig")
        good = matrix.isfinite().all() and (matrix.diagonal() > 0).all()
        _require(bool(good), f"{name} that is not finite and positive")
    parts = belief.arrays.parts
    _require(all(len(part) == count and np.isfinite(part).all() for part in parts), "arrays of another rig")


def _check_observations(seen: Observations) -> None:
    shape = seen.seen.shape
    _require(seen.seen.dtype == torch.bool and len(shape) == 3, "no observations")
    _require(seen.uv.shape == (*shape, 2) and seen.sigma.shape == shape, "observations of several shapes")


def _check_detections(blobs: Detections) -> None:
    count = len(blobs.camera)
    columns = (blobs.sigma, blobs.snapshot, blobs.fiducial, blobs.radius, blobs.flags)
    _require(
        blobs.uv.shape == (count, 2) and all(part.shape == (count,) for part in columns), "blobs of several counts"
    )
    known = ((blobs.camera >= 0) & (blobs.camera < len(blobs.camera_names))).all() and (blobs.fiducial >= -1).all()
    _require(bool(known), "blobs of no camera")


CHECKS: dict[type, Callable[[Any], None]] = {
    CameraRig: check_rig,
    CalibrationObject: _check_object,
    RigidTransform: _check_transform,
    RigBelief: _check_belief,
    Observations: _check_observations,
    Detections: _check_detections,
}
"""Check to run on a value after reading; raises `ValueError` or `InputError`."""
