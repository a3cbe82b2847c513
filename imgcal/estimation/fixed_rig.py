"""The object's pose with a fixed rig: six parameters, in one compiled call."""

# Compiled functions take their types from their arguments.
# ruff: noqa: ANN001, ANN202
# mypy: allow-untyped-defs, no-check-untyped-defs

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import levenberg_marquardt_cpu
from imgcal.estimation.linearization import Problem
from imgcal.estimation.linearization_cpu import linearize_rig
from imgcal.estimation.map_estimate import EstimationOptions
from imgcal.geometry import RigidTransform, kernels, require_shapes
from imgcal.types import CameraRig, Observations, check_rig_shapes
from renderers.compiling import njit

MOST_STEPS = 40
TOLERANCE = 1e-4
"""Expected decrease of the cost at which to stop: half a squared standard deviation."""


@dataclass(frozen=True)
class FixedRigFit:
    """The most probable pose of an object, given the rig."""

    rig_from_object: RigidTransform  # (1,)
    residual: NDArray[np.float64]  # (C, N, 2) pixels, predicted minus observed; zero where not seen


def fit_pose(
    observations: Observations,
    rig: CameraRig,
    points: Tensor,
    radius: Tensor | None,
    rig_from_object: RigidTransform,
    options: EstimationOptions = EstimationOptions(loss="cauchy"),
) -> FixedRigFit:
    """Estimate the object's pose.

    Args:
        observations: (1, C, N), on the CPU.
        rig: without batch axes; stays fixed.
        points: (N, 3) mm, the fiducials.
        radius: (N,) mm of spherical fiducials.
        rig_from_object: (1,) first guess.
        options: loss and threshold.

    Raises:
        InputError: shapes that do not fit together.
        RefusedError: the observations do not determine the pose.

    Examples:
        >>> import imgcal
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> there = RigidTransform.identity(dtype=torch.float64).reshape(1)
        >>> there = RigidTransform(there.rotation, torch.tensor([[3.0, -5.0, rig.working_distance]]).double())
        >>> image = rig.project(there.apply(obj.points)[0])
        >>> sigma = torch.full_like(image.depth, 0.1)[None]
        >>> seen = Observations(image.uv[None], sigma, image.visible[None])
        >>> guess = RigidTransform(there.rotation, there.translation + 20.0)
        >>> found = fit_pose(seen, rig, obj.points, None, guess)
        >>> torch.allclose(found.rig_from_object.translation, there.translation, atol=1e-4)
        True
    """
    check_rig_shapes(rig)
    expected = (1, rig.num_cameras, len(points))
    given = (("seen", observations.seen, expected), ("uv", observations.uv, (*expected, 2)))
    require_shapes("observations", (*given, ("sigma", observations.sigma, expected)))
    seen = observations.seen.numpy()
    uv = np.ascontiguousarray(np.where(seen[..., None], observations.uv.numpy(), 0.0).swapaxes(-1, -2), np.float64)
    weight = np.where(seen, 1 / np.where(seen, observations.sigma.numpy(), 1.0), 0.0)
    weight = np.ascontiguousarray(weight, np.float64)
    points = points.double()
    centroid = points.mean(0)
    fixed_std = rig.focal_length.new_zeros(rig.num_cameras, 10 + rig.distortion.shape[-1]).double()
    problem = Problem(
        torch.from_numpy(uv)[None], torch.from_numpy(weight)[None], points - centroid, centroid,
        None if radius is None else radius.double().square(), rig, fixed_std,
    )  # fmt: skip
    rotation = rig_from_object.rotation.detach().double().reshape(1, 3, 3).numpy()
    centre = rig_from_object.translation.detach().double().reshape(1, 3).numpy() + rotation @ centroid.numpy()
    turned = rig.cam_from_rig.rotation.detach().double().contiguous().numpy()
    position = -(turned.swapaxes(-1, -2) @ rig.cam_from_rig.translation.detach().double().numpy()[..., None])[..., 0]
    values = (value.double().contiguous().numpy() for value in (rig.focal_length, rig.principal_point, rig.distortion))
    given = (
        *levenberg_marquardt_cpu.shared_arrays(problem),
        uv,
        weight,
        turned,
        position,
        *values,
        fixed_std.numpy(),
        np.empty(0),
    )
    poses = (np.stack((rotation, rotation)), np.stack((centre, centre)))
    (_, cameras, _, fiducials), free = uv.shape, fixed_std.shape[1]
    blocks = (
        np.empty((2, cameras, free, free)), np.empty((2, 1, 6, free * cameras)), np.empty((2, 1, 6, 6)),
        np.empty((2, 0, free * cameras)), np.empty((2, cameras, free)), np.empty((2, 1, 6)), np.empty((2, 0)),
        np.empty((2, 1, cameras, 2, fiducials)),
    )  # fmt: skip
    loss = (levenberg_marquardt_cpu.LOSS_CODES[options.loss], float(options.threshold))
    best = _fit_pose(given, np.zeros((cameras, free)), poses, blocks, *loss)
    if best < 0:
        raise RefusedError("estimation: the observations do not determine the object's pose")
    rotation, centre = poses[0][best], poses[1][best]
    pose = RigidTransform(torch.from_numpy(rotation), torch.from_numpy(centre - rotation @ centroid.numpy()))
    return FixedRigFit(pose, np.where(seen[0, ..., None], blocks[7][best, 0].swapaxes(-1, -2), 0.0))


@njit(cache=True, fastmath=kernels.FAST)
def _fit_pose(given, offset, poses, blocks, loss, threshold):
    """Run Levenberg-Marquardt on a pose. Returns the row of the best state, or -1 where the pose is not determined."""
    rotation, centre = poses
    camera, coupling, pose, border, camera_gradient, pose_gradient, own_gradient, residual = blocks
    own, steady, cameras_first = np.empty(0), np.empty((0, 0)), np.bool_(False)  # no literal: that is a type of its own
    lower, step, turn, left = np.empty((6, 6)), np.empty(6), np.empty((3, 3)), np.empty((3, 3))
    damping, best, cost, gain = 0.0, 0, np.inf, np.inf
    for tried in range(MOST_STEPS + 1):
        t = 1 - best if tried else 0
        row = (
            camera[t], coupling[t], pose[t], border[t], camera_gradient[t], pose_gradient[t], own_gradient[t],
            residual[t],
        )  # fmt: skip
        trial = linearize_rig(given, (offset, rotation[t], centre[t], own), row, cameras_first, loss, threshold, steady)
        if tried:
            if trial <= cost:
                best, cost = t, trial
                if gain <= TOLERANCE and damping <= 1e-3:
                    return best
                damping = 0.0 if damping <= 1e-6 else damping / 8
            else:
                if gain <= TOLERANCE * 1e-3:
                    return best
                damping = max(8 * damping, 1e-4)
        else:
            cost = trial
        b, t = best, 1 - best
        for i in range(6):
            for j in range(i + 1):
                lower[i, j] = pose[b, 0, i, j]
            lower[i, i] *= 1 + damping
            step[i] = -pose_gradient[b, 0, i]
        if not kernels.cholesky(lower):
            return -1
        kernels.cholesky_solve(lower, step)
        gain = 0.0
        for i in range(6):
            gain -= 0.5 * step[i] * pose_gradient[b, 0, i]
        away = max(1.0, np.sqrt(centre[b, 0, 0] ** 2 + centre[b, 0, 1] ** 2 + centre[b, 0, 2] ** 2))
        for i in range(3):
            centre[t, 0, i] = centre[b, 0, i] + step[3 + i] * away
        kernels.exponential(step, turn, left)
        kernels.multiply(turn, rotation[b, 0], rotation[t, 0])
    return best
