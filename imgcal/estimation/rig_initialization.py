"""Initial rig from nothing but labelled images of one object that was carried around: no factory calibration.

Each camera sees the object in some pose, which relates every pair of cameras that see it together. A tree of pairs
brings all cameras into one frame. A robust joint fit frees focal lengths first and then the rest of the lens. The
object gives the scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation.map_estimate import Estimate, EstimationOptions, estimate
from imgcal.estimation.pose_initialization import initial_pose
from imgcal.estimation.pose_support import LEAST_BREADTH, breadth
from imgcal.estimation.relative_poses import as_transforms, relate, tree
from imgcal.geometry import RigidTransform
from imgcal.messages import name_cameras
from imgcal.types import CalibrationObject, CameraRig, Observations, RigPrior

LEAST_FIDUCIALS = 4
"""Smallest number in one image for a pose from that image alone."""
ROUGH_SIGMA = 3.0
"""Pixels: standard deviation of an observation while the lens is wrong."""
FINE_SIGMA = 0.5
"""Pixels: standard deviation of an observation in the final fit."""
CAPPED = 30.0
"""Pixels at which reprojection errors are clipped when poses are compared."""
K3 = 14
"""Index of the third radial coefficient among a camera's parameters."""
ORDINARY_K3 = 0.02
"""Standard deviation of k3 about its given value, usually zero."""


@dataclass(frozen=True)
class ColdStart:
    """A rig computed from the data alone."""

    rig: CameraRig  # in the frame of its first camera
    rig_from_object: RigidTransform  # (S,), of every given snapshot
    posed: NDArray[np.bool_]  # (S,) whether the pose is known
    kept: NDArray[np.bool_]  # (S, C, N) labels that fit
    spread: float  # px, robust spread of the residuals


def cold_start(observations: Observations, cameras: CameraRig, obj: CalibrationObject) -> ColdStart:
    """Estimate the cameras' poses and lenses, starting only from rough focal lengths.

    Args:
        observations: (S, C, N); some labels may be wrong.
        cameras: image sizes, lenses as far as they are known, and a prior that says how far; poses are ignored.
        obj: the calibration object.

    Raises:
        RefusedError: cameras share no snapshots with the others, or the fit does not converge.

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import simulate_volume
        >>> rig, wand = imgcal.load_rig("room10").select([0, 2, 5]), imgcal.load_object("wand4")
        >>> truth = simulate_volume(rig, wand, 30, torch.Generator().manual_seed(0), None)
        >>> observations = Observations(truth.uv, torch.full(truth.uv.shape[:-1], 0.1).double(), truth.visible)
        >>> found = cold_start(observations, rig, wand)
        >>> apart = (found.rig.positions[1] - found.rig.positions[0]).norm()
        >>> abs(float(apart - (rig.positions[1] - rig.positions[0]).norm())) < 5  # mm
        True
    """
    nowhere = RigidTransform.identity(cameras.num_cameras, dtype=torch.float64)
    cameras = replace(cameras.to(torch.float64), cam_from_rig=nowhere)
    cam_from_object, known = single_camera_poses(observations, cameras, obj)
    require_connected([c for c in range(cameras.num_cameras) if not known[:, c].any()], cameras)
    pairs = relate(cam_from_object, known, obj.points.double().numpy(), np.random.default_rng(0))
    groups, chained = tree(pairs, cameras.num_cameras)
    require_connected([camera for group in groups[1:] for camera in group], cameras)
    rig = replace(cameras, cam_from_rig=as_transforms(chained))
    rows = np.flatnonzero(known.any(1))
    some = Observations(observations.uv[rows], observations.sigma[rows], observations.seen[rows])
    some, turned = _unify_labels(some, rig, cam_from_object[rows], known[rows], obj)
    fit, kept = _fit_jointly(some, rig, turned, known[rows], obj)
    count = len(observations.seen)
    posed, all_kept = np.zeros(count, dtype=bool), np.zeros(observations.seen.shape, dtype=bool)
    posed[rows], all_kept[rows] = True, kept
    poses = _identities(count)
    poses.rotation[rows], poses.translation[rows] = fit.rig_from_object.rotation, fit.rig_from_object.translation
    first = RigidTransform(fit.rig.cam_from_rig.rotation[:1], fit.rig.cam_from_rig.translation[:1])
    placed = replace(fit.rig, cam_from_rig=fit.rig.cam_from_rig @ first.inverse(), prior=cameras.prior)
    return ColdStart(placed, first @ poses, posed, all_kept, robust_std(fit.residual[torch.from_numpy(kept)]))


def single_camera_poses(
    observations: Observations, cameras: CameraRig, obj: CalibrationObject
) -> tuple[RigidTransform, NDArray[np.bool_]]:
    """Estimate the object's pose in each image separately: cam_from_object (S, C), and (S, C) bool where known."""
    snapshots, count = observations.seen.shape[:2]
    known = _find_posable(observations.seen.numpy(), obj)
    poses = _identities(snapshots, count)
    for camera in range(count):
        rows = torch.from_numpy(np.flatnonzero(known[:, camera]))
        if len(rows):
            part = Observations(
                *(t[rows][:, [camera]] for t in (observations.uv, observations.sigma, observations.seen))
            )
            alone = replace(cameras.select([camera]), cam_from_rig=RigidTransform.identity(1, dtype=torch.float64))
            found = initial_pose(part, alone, obj)
            poses.rotation[rows, camera], poses.translation[rows, camera] = found.rotation, found.translation
    return poses, known


def _unify_labels(
    observations: Observations,
    rig: CameraRig,
    cam_from_object: RigidTransform,
    known: NDArray[np.bool_],
    obj: CalibrationObject,
) -> tuple[Observations, RigidTransform]:
    """Make all cameras use the same one of a symmetric object's equivalent labellings.

    Each image is turned to agree with the first camera that knows the pose.
    """
    motions = obj.symmetries
    if len(motions) == 1:
        return observations, cam_from_object
    turns = RigidTransform(
        torch.from_numpy(np.stack([m.rotation for m in motions])),
        torch.from_numpy(np.stack([m.translation for m in motions])),
    )
    several = cam_from_object[:, :, None] @ turns  # (S, C, M)
    in_rig = rig.cam_from_rig.rotation.mT[None, :, None] @ several.rotation
    first = torch.from_numpy(known.argmax(1))
    leader = in_rig[torch.arange(len(first)), first, 0]  # (S, 3, 3)
    choice = (in_rig * leader[:, None, None]).sum((-1, -2)).argmax(-1)  # (S, C): the nearest symmetry
    order = torch.from_numpy(np.stack([m.permutation for m in motions]))[choice]  # (S, C, N)
    uv = observations.uv.gather(2, order[..., None].expand_as(observations.uv))
    s, c = torch.meshgrid(torch.arange(choice.shape[0]), torch.arange(choice.shape[1]), indexing="ij")
    return Observations(uv, observations.sigma.gather(2, order), observations.seen.gather(2, order)), several[
        s, c, choice
    ]


def require_connected(alone: Sequence[int], cameras: CameraRig) -> None:
    """Raise `RefusedError` if some cameras have nothing in common with the others."""
    if alone:
        raise RefusedError(
            f"start without a factory calibration: {name_cameras([cameras.camera_names[c] for c in alone])} cannot be "
            "placed relative to the others: carry the whole object through the view shared with other cameras"
        )


def _find_posable(seen: NDArray[np.bool_], obj: CalibrationObject) -> NDArray[np.bool_]:
    """Find images (S, C) with enough labels for a pose: four fiducials that are not collinear."""
    points = obj.points.double().numpy()
    parts, which = np.unique(seen.reshape(-1, seen.shape[-1]), axis=0, return_inverse=True)
    good = [part.sum() >= LEAST_FIDUCIALS and breadth(points[part]) > LEAST_BREADTH * breadth(points) for part in parts]
    return np.array(good)[which.reshape(-1)].reshape(seen.shape[:2])


def _fit_jointly(
    observations: Observations,
    rig: CameraRig,
    cam_from_object: RigidTransform,
    known: NDArray[np.bool_],
    obj: CalibrationObject,
) -> tuple[Estimate, NDArray[np.bool_]]:
    """Fit all cameras and poses together, focal lengths first; also return the labels (S, C, N) of the fit.

    The cameras' poses are practically free. Only the camera nearest to the origin stays fixed.
    """
    std = (rig.prior or RigPrior()).std(rig)
    apart = float(torch.cdist(rig.positions, rig.positions).max()) + float(
        cam_from_object.translation.norm(dim=-1).max()
    )
    std[:, 0:3], std[:, 3:6] = 1.0, apart
    fixed_camera = int(rig.cam_from_rig.translation.norm(dim=-1).argmin())
    std[fixed_camera, :6] = 0.0
    std = ordinary_lens(std)
    lens_fixed = std.clone()
    lens_fixed[:, 8:] = 0.0
    seen, start, fit = observations.seen, rig, None
    for noise, spread in ((ROUGH_SIGMA, lens_fixed), (ROUGH_SIGMA, std), (FINE_SIGMA, std)):
        poses = best_poses(observations, seen, start, cam_from_object, known, obj, fit)
        part = Observations(observations.uv, torch.full_like(observations.sigma, noise), seen)
        options = EstimationOptions(loss="cauchy", max_iterations=60)
        fit = estimate(part, rig, obj.as_exact(), poses, prior_std=spread, initial_rig=start, options=options)
        start = fit.rig
    assert fit is not None
    return fit, seen.numpy()


def best_poses(
    observations: Observations,
    seen: Tensor,
    rig: CameraRig,
    cam_from_object: RigidTransform,
    known: NDArray[np.bool_],
    obj: CalibrationObject,
    latest: Estimate | None,
) -> RigidTransform:
    """Choose the best pose of each snapshot among single cameras' poses, a joint one, and the latest fit."""
    rig_from_cam = rig.cam_from_rig.inverse()
    guesses = RigidTransform(rig_from_cam.rotation[None], rig_from_cam.translation[None]) @ cam_from_object  # (S, C)
    together = initial_pose(observations, rig, obj)
    more = [together] if latest is None else [together, latest.rig_from_object]
    guesses = RigidTransform(
        torch.cat((guesses.rotation, *(pose.rotation[:, None] for pose in more)), dim=1),
        torch.cat((guesses.translation, *(pose.translation[:, None] for pose in more)), dim=1),
    )
    valid = torch.from_numpy(np.concatenate((known, np.ones((len(known), len(more)), dtype=bool)), axis=1))
    points = guesses.apply(obj.points.to(torch.float64))  # (S, G, N, 3)
    uv = rig.expand(*valid.shape).project(points).uv
    off = (uv - observations.uv[:, None]).norm(dim=-1).nan_to_num(CAPPED).clamp_max(CAPPED)  # (S, G, C, N)
    cost = torch.where(seen[:, None], off, 0.0).sum((-1, -2))
    return guesses[torch.arange(len(valid)), torch.where(valid, cost, torch.inf).argmin(1)]


def _identities(*batch: int) -> RigidTransform:
    """Identity transforms, to be overwritten."""
    return RigidTransform(torch.eye(3, dtype=torch.float64).repeat(*batch, 1, 1), torch.zeros(*batch, 3).double())


def ordinary_lens(std: Tensor) -> Tensor:
    """Narrow the prior of k3: views of a carried object hardly constrain it, and it ruins the image's corners.

    Args:
        std: (C, K) of the parameters.
    """
    narrow = std.clone()
    narrow[:, K3] = std[:, K3].clamp_max(ORDINARY_K3)
    return narrow


def robust_std(residual: Tensor) -> float:
    """Robust standard deviation of residuals (M, 2), per axis: from the median of their lengths."""
    return float(residual.norm(dim=-1).median()) / 1.1774
