"""Initial rig from one point moved in front of cameras with only roughly known focal lengths.

An essential matrix relates two cameras that see the point together, up to scale. All others are placed one after the
other, by resection on the triangulated points. A robust joint fit frees focal lengths first and then the rest of the
lens. Nothing determines the scale, so two cameras are put at a chosen distance.

Source: Hartley and Zisserman, "Multiple View Geometry", chapters 9 and 18; for the order Snavely, Seitz and Szeliski,
"Photo Tourism", 2006.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation.map_estimate import EstimationOptions, estimate
from imgcal.estimation.rig_initialization import FINE_SIGMA, ROUGH_SIGMA, ordinary_lens, require_connected, robust_std
from imgcal.geometry import RigidTransform, undistort
from imgcal.types import CalibrationObject, CameraRig, Observations, RigPrior

Array = NDArray[np.float64]

FOCALS = (1.0, 0.85, 1.18, 0.72, 1.4)
"""Factors on the rough focal lengths to try."""
CONSISTENT = 4.0
"""px: largest distance of a blob from its epipolar line or its reprojection while cameras are placed."""
LEAST_COMMON = 16
"""Smallest number of points that two cameras share, or that a new camera shares with those already placed."""
LEAST_ANGLE = 0.06
"""rad: smallest median angle between the rays of the initial pair of cameras."""
MOST_USED = 600
"""Most snapshots in the joint fits: those that most cameras see, evenly over the capture."""
WIDE_ROTATION = 0.5  # rad, standard deviation of the prior about a rig that was chained together
APART = 1000.0
"""mm: distance of two cameras of a rig without scale."""


@dataclass(frozen=True)
class PointStart:
    """A rig computed from points alone, up to scale."""

    rig: CameraRig  # in the frame of `move_to_pair_frame`
    pair: tuple[int, int]  # cameras that are 1000 mm apart
    spread: float  # px, robust spread of the residuals


def cold_start_from_points(
    observations: Observations, cameras: CameraRig, pair: tuple[int, int] | None = None
) -> PointStart:
    """Estimate the cameras' poses, up to scale, and their lenses, starting only from rough focal lengths.

    Args:
        observations: (S, C, 1) of one point; some may be false.
        cameras: image sizes, lenses as far as they are known, and a prior that says how far, float64; poses are
            ignored.
        pair: the cameras that are put 1000 mm apart; None = the first, and the one that is farthest from it.

    Raises:
        RefusedError: two cameras or fewer, or cameras that share too few points with the others.

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import simulate_volume
        >>> rig = imgcal.load_rig("room10").select([0, 2, 5, 7])
        >>> light = CalibrationObject.unknown()
        >>> truth = simulate_volume(rig, light, 150, torch.Generator().manual_seed(0), None)
        >>> seen = Observations(truth.uv, torch.full(truth.uv.shape[:-1], 0.1).double(), truth.visible)
        >>> found = cold_start_from_points(seen, rig, (0, 1)).rig
        >>> ratio = (found.positions[2] - found.positions[0]).norm() / 1000
        >>> expected = (rig.positions[2] - rig.positions[0]).norm() / (rig.positions[1] - rig.positions[0]).norm()
        >>> abs(float(ratio / expected - 1)) < 0.01
        True
    """
    if cameras.num_cameras < 3:
        raise RefusedError(
            f"start without a factory calibration: found {cameras.num_cameras} cameras, expected at least 3: "
            "points in two cameras do not determine a rig"
        )
    uv, seen = observations.uv[:, :, 0].double().numpy(), observations.seen[:, :, 0].numpy()
    best: PointStart | None = None
    for factor in FOCALS:
        rays = _rays(uv, seen, cameras, factor)
        placed = _chain_cameras(rays, seen, cameras.focal_length.mean(1).numpy() * factor)
        if placed is None:
            continue
        rig = replace(cameras, focal_length=factor * cameras.focal_length, cam_from_rig=placed)
        found = _fit_jointly(observations, move_to_pair_frame(rig, pair), cameras)
        if found is not None and (best is None or found.spread < best.spread):
            best = found
        if best is not None and best.spread < FINE_SIGMA:
            break
    if best is None:
        common = [int((seen[:, [c]] & np.delete(seen, c, 1)).any(1).sum()) for c in range(cameras.num_cameras)]
        require_connected([c for c, count in enumerate(common) if count < LEAST_COMMON], cameras)
        raise RefusedError(
            "start without a factory calibration: no two cameras see enough common points from different directions: "
            "carry the light through all that neighbouring cameras see"
        )
    return best


def move_to_pair_frame(rig: CameraRig, pair: tuple[int, int] | None) -> tuple[CameraRig, tuple[int, int]]:
    """Move and scale a rig so that one camera is at the origin, and another one 1000 mm away along x.

    Returns:
        The rig and the pair: as given, or the first camera and the one that is farthest from it.
    """
    positions = rig.positions
    first, second = pair or (0, int((positions - positions[0]).norm(dim=-1).argmax()))
    way = positions[second] - positions[first]
    along = way / way.norm()
    down = rig.cam_from_rig.rotation[first, 1]  # the new y is as close as possible to the first camera's
    across = torch.linalg.cross(along, down)
    across = across / across.norm()
    turn = torch.stack((along, torch.linalg.cross(across, along), across))  # new_from_rig
    moved = (APART / way.norm()) * (positions - positions[first]) @ turn.mT
    rotation = rig.cam_from_rig.rotation @ turn.mT
    placed = RigidTransform(rotation, -(rotation @ moved[..., None])[..., 0])
    return replace(rig, cam_from_rig=placed), (first, second)


def prior_of_pair(rig: CameraRig, pair: tuple[int, int], prior: RigPrior, rotation: float, position: float) -> Tensor:
    """Prior standard deviations (C, K) in the frame of a pair: the first camera's pose and the distance are fixed.

    Args:
        rig: in the frame of the pair.
        pair: the two cameras.
        prior: of the lenses.
        rotation: rad, of all other cameras.
        position: mm, of all other cameras.
    """
    std = ordinary_lens(replace(prior, rotation=rotation, position=position).std(rig))
    std[pair[0], :6] = 0.0
    std[pair[1], 3] = 0.0  # to first order, this fixes the distance
    return std


def _rays(uv: Array, seen: NDArray[np.bool_], cameras: CameraRig, factor: float) -> Array:
    """Undistorted coordinates (S, C, 2) on the plane z = 1."""
    xy = (torch.from_numpy(uv) - cameras.principal_point) / (factor * cameras.focal_length)
    straight, _ = undistort(xy.movedim(0, 1), cameras.distortion, cameras.lens_model)
    return np.where(seen[..., None], straight.movedim(0, 1).numpy(), 0.0)


def _chain_cameras(rays: Array, seen: NDArray[np.bool_], focal: Array) -> RigidTransform | None:
    """Place all cameras, one after the other; None = some cannot be placed."""
    cameras = len(focal)
    slack = CONSISTENT / float(focal.mean())
    start = _first_pair(rays, seen, slack)
    if start is None:
        return None
    (a, b), rotation, translation = start
    placed: dict[int, tuple[Array, Array]] = {a: (np.eye(3), np.zeros(3)), b: (rotation, translation)}
    while len(placed) < cameras:
        points, known = _triangulate(rays, seen, placed, slack)
        counts = [-1 if c in placed else int((known & seen[:, c]).sum()) for c in range(cameras)]
        camera = int(np.argmax(counts))
        if counts[camera] < LEAST_COMMON:
            return None
        rows = known & seen[:, camera]
        good, vector, shift, inliers = cv2.solvePnPRansac(
            points[rows], rays[rows, camera], np.eye(3), np.zeros(4), reprojectionError=3 * slack,
            iterationsCount=300, flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
        if not good or inliers is None or len(inliers) < LEAST_COMMON:
            return None
        placed[camera] = np.asarray(cv2.Rodrigues(vector)[0], np.float64), np.asarray(shift[:, 0], np.float64)
    order = range(cameras)
    turns, shifts = np.stack([placed[c][0] for c in order]), np.stack([placed[c][1] for c in order])
    return RigidTransform(torch.from_numpy(turns), torch.from_numpy(shifts))


def _first_pair(rays: Array, seen: NDArray[np.bool_], slack: float) -> tuple[tuple[int, int], Array, Array] | None:
    """Choose an initial pair of cameras with many common points and a wide baseline."""
    best: tuple[tuple[int, int], Array, Array] | None = None
    worth, cameras = 0.0, seen.shape[1]
    for a in range(cameras):
        for b in range(a + 1, cameras):
            rows = seen[:, a] & seen[:, b]
            if rows.sum() < LEAST_COMMON:
                continue
            one, two = np.ascontiguousarray(rays[rows, a]), np.ascontiguousarray(rays[rows, b])
            matrix, mask = cv2.findEssentialMat(one, two, np.eye(3), cv2.RANSAC, 0.999, slack)
            if matrix is None or matrix.shape != (3, 3):
                continue
            count, rotation, translation, mask = cv2.recoverPose(matrix, one, two, np.eye(3), mask=mask)
            if count < LEAST_COMMON:
                continue
            inside = mask.ravel() > 0
            d1 = np.column_stack((one, np.ones(len(one)))) @ rotation.T
            d2 = np.column_stack((two, np.ones(len(two))))
            cosine = (d1 * d2).sum(1) / np.linalg.norm(d1, axis=1) / np.linalg.norm(d2, axis=1)
            angle = float(np.median(np.arccos(np.clip(cosine[inside], -1, 1))))
            value = count * min(np.sin(angle), 0.5) * count / len(one)
            if angle > LEAST_ANGLE and value > worth:
                found = np.asarray(rotation, np.float64), np.asarray(translation[:, 0], np.float64)
                best, worth = ((a, b), *found), value
    return best


def _triangulate(
    rays: Array, seen: NDArray[np.bool_], placed: dict[int, tuple[Array, Array]], slack: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Triangulate points (S, 3) from the rays of the placed cameras; (S,) bool which are valid."""
    information, target = np.zeros((len(rays), 3, 3)), np.zeros((len(rays), 3))
    for camera, (rotation, translation) in placed.items():
        d = np.column_stack((rays[:, camera], np.ones(len(rays)))) @ rotation
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        across = (np.eye(3) - d[:, :, None] * d[:, None]) * seen[:, camera, None, None]
        information += across
        target += across @ (-rotation.T @ translation)
    known = seen[:, list(placed)].sum(1) >= 2
    known &= np.linalg.det(information) > 1e-4
    points = np.zeros((len(rays), 3))
    points[known] = np.linalg.solve(information[known], target[known][..., None])[..., 0]
    for camera, (rotation, translation) in placed.items():
        there = points @ rotation.T + translation
        off = np.linalg.norm(there[:, :2] - rays[:, camera] * there[:, 2:], axis=1)
        known &= ~seen[:, camera] | ((there[:, 2] > 0) & (off < 3 * slack * np.abs(there[:, 2])))
    return points, known


def _fit_jointly(
    observations: Observations, start: tuple[CameraRig, tuple[int, int]], cameras: CameraRig
) -> PointStart | None:
    """Fit all cameras and points together, focal lengths first and then everything."""
    rig, pair = start
    rows = _select_moments(observations.seen[:, :, 0])
    some = Observations(observations.uv[rows], observations.sigma[rows], observations.seen[rows])
    light, fit = CalibrationObject(torch.zeros(1, 3).double(), torch.ones(1, 3).double(), name="light"), None
    position = 0.5 * float(torch.cdist(rig.positions, rig.positions).max())
    prior = cameras.prior or RigPrior()
    given = replace(rig, focal_length=cameras.focal_length)  # the centre of the prior
    std = prior_of_pair(given, pair, prior, WIDE_ROTATION, position)
    lens_fixed = std.clone()
    lens_fixed[:, 8:] = 0.0
    poses = None
    for noise, spread in ((ROUGH_SIGMA, lens_fixed), (ROUGH_SIGMA, std), (FINE_SIGMA, std)):
        part = replace(some, sigma=torch.full_like(some.sigma, noise))
        options = EstimationOptions(loss="cauchy", max_iterations=60)
        fit = estimate(part, given, light, poses, prior_std=spread, initial_rig=rig, options=options)
        rig, poses = fit.rig, fit.rig_from_object
    assert fit is not None
    placed, _ = move_to_pair_frame(fit.rig, pair)
    return PointStart(
        replace(placed, prior=cameras.prior), pair, robust_std(fit.residual[fit.problem.root_weight[0] > 0])
    )


def _select_moments(seen: Tensor) -> Tensor:
    """Snapshots (U,) that at least two cameras see; if there are many, those that most see, evenly over time."""
    count = seen.sum(1)
    rows = (count >= 2).nonzero().flatten()
    if len(rows) <= MOST_USED:
        return rows
    parts: Sequence[Tensor] = torch.tensor_split(rows, MOST_USED)
    return torch.stack([part[count[part].argmax()] for part in parts])
