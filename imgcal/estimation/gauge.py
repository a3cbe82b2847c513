"""Alignment of two estimates of one rig, which may differ by a motion of the whole rig that no image shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from imgcal.estimation import EstimationOptions, estimate
from imgcal.geometry import RigidTransform
from imgcal.types import CalibrationObject, CameraRig, Observations

GAUGE_TOLERANCE = 0.1
"""Pixels: tolerated difference between two estimates before a camera counts as moved."""


def align(rig: CameraRig, reference: CameraRig, points_reference: Tensor, cameras: Sequence[int]) -> CameraRig:
    """Move a whole rig so that some of its cameras see given points where those of a reference see them.

    The alignment matches images near the object, not positions and rotations: an estimate knows the images well, but
    positions and rotations only in combination. A selected camera that disagrees with the others has little influence.

    Args:
        rig: without batch axes.
        reference: the same cameras.
        points_reference: (M, 3) mm in the reference's frame, where the object was.
        cameras: indices of the cameras that have not moved.

    Returns:
        The rig in the reference's frame; `rig` itself where the cameras see too little.
    """
    chosen = list(cameras)
    if not chosen:
        return rig
    there = reference.select(chosen).project(points_reference)
    seen = there.visible
    if int(seen.sum()) < 4:
        return rig
    observations = Observations(there.uv[None], torch.full_like(there.uv[None, ..., 0], GAUGE_TOLERANCE), seen[None])
    cloud = CalibrationObject(points_reference, torch.ones_like(points_reference))
    start = RigidTransform.identity(1, dtype=points_reference.dtype)
    fixed_std = torch.zeros(len(chosen), rig.num_parameters, dtype=points_reference.dtype)
    fit = estimate(
        observations, rig.select(chosen), cloud, start, prior_std=fixed_std, options=EstimationOptions(loss="cauchy")
    )
    rig_from_reference = fit.rig_from_object[0]
    cam_from_rig = rig.cam_from_rig
    return replace(
        rig,
        cam_from_rig=cam_from_rig
        @ RigidTransform(rig_from_reference.rotation[None], rig_from_reference.translation[None]),
    )
