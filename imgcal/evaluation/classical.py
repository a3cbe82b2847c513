"""What others would use: OpenCV camera by camera, scipy's least squares. One rig at a time, on the CPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from imgcal.errors import InputError
from imgcal.estimation import Problem, State, initial_pose, initial_state, make_problem, pose_at, retract, rig_at
from imgcal.types import CalibrationObject, CameraRig, Observations, Prediction, pack21, unpack21

Array = NDArray[np.float64]
Intrinsics = tuple[Array, Array]  # camera matrix (3, 3), distortion (5,)

LENS = "brown_conrady"  # what `pnp` and `calibrate_cameras` know
LEAST_POINTS = 4
STEP = 1e-6  # of numerical derivatives, whitened units
MOST_EVALUATIONS = 60  # of least squares: outliers can keep it busy without end


def pnp(uv: Tensor, seen: Tensor, factory: CameraRig, obj: CalibrationObject, otherwise: Prediction) -> Prediction:
    """Find every camera's pose on its own, with factory intrinsics: SQPnP, then Levenberg-Marquardt on pixels.

    Args:
        uv: (B, C, N, 2) pixels.
        seen: (B, C, N) bool.
        factory: the factory rig, without batch axes.
        obj: N fiducials.
        otherwise: (B,) taken for cameras that see fewer than four fiducials, or where OpenCV fails.
    """
    points = _numpy(obj.points)
    lenses = [_intrinsics(factory, camera) for camera in range(factory.num_cameras)]

    def solve(camera: int, uv: Array, seen: NDArray[np.bool_]) -> _Camera | None:
        matrix, distortion = lenses[camera]
        pose = _solve_pnp(points[seen], uv[seen], matrix, distortion)
        return None if pose is None else _Camera(matrix, distortion, *pose)

    return _camera_by_camera(solve, uv, seen, factory, otherwise)


def calibrate_cameras(
    uv: Tensor, seen: Tensor, factory: CameraRig, obj: CalibrationObject, otherwise: Prediction
) -> Prediction:
    """Calibrate every camera on its own with OpenCV, from its factory intrinsics; arguments as for `pnp`.

    One snapshot of eight points gives 16 equations for 15 unknowns, and OpenCV has no prior. Where fewer points are
    seen, values are held at the factory's until there are as many equations: k3, k2 and p1, p2; k1; principal point.
    """
    points = _numpy(obj.points)
    lenses = [_intrinsics(factory, camera) for camera in range(factory.num_cameras)]
    run: Any = cv2.calibrateCamera  # its stubs know half of what it takes
    sizes = [(int(width), int(height)) for width, height in factory.image_size.tolist()]

    def solve(camera: int, uv: Array, seen: NDArray[np.bool_]) -> _Camera | None:
        flags = _flags(int(seen.sum()))
        if flags is None:
            return None
        shown = [points[seen].astype(np.float32)], [uv[seen].astype(np.float32)]
        start = [value.copy() for value in lenses[camera]]
        try:
            _, matrix, distortion, turns, shifts = run(*shown, sizes[camera], *start, flags=flags)
        except cv2.error:
            return None
        found = _Camera(_array(matrix), _array(distortion).ravel()[:5], _rotation_matrix(turns[0]), _array(shifts[0]))
        return found if found.usable else None

    return _camera_by_camera(solve, uv, seen, factory, otherwise)


def _flags(points: int) -> int | None:
    """What OpenCV must hold fixed, so that there are no more unknowns than equations; None = it cannot be done."""
    if points < LEAST_POINTS:
        return None
    flags = cv2.CALIB_USE_INTRINSIC_GUESS
    if points < 8:  # 15 unknowns
        flags |= cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_TANGENT_DIST
    if points < 6:  # 11 unknowns
        flags |= cv2.CALIB_FIX_K1
    if points < 5:  # 10 unknowns
        flags |= cv2.CALIB_FIX_PRINCIPAL_POINT
    return flags


def _camera_by_camera(
    solve: Callable[[int, Array, NDArray[np.bool_]], _Camera | None],
    uv: Tensor,
    seen: Tensor,
    factory: CameraRig,
    otherwise: Prediction,
) -> Prediction:
    """Solve for every camera of every rig; `solve(camera, uv (N, 2), seen (N,))` returns None where it cannot."""
    cameras = pack21(otherwise.cameras_from_object).clone()
    places, flags = _numpy(uv), seen.cpu().numpy()
    for row in range(len(uv)):
        for camera in range(factory.num_cameras):
            found = solve(camera, places[row, camera], flags[row, camera])
            if found is not None:
                cameras[row, camera] = torch.from_numpy(found.numbers)
    return Prediction.from_cameras(unpack21(cameras, factory), factory)


def _solve_pnp(points: Array, uv: Array, matrix: Array, distortion: Array) -> tuple[Array, Array] | None:
    """Rotation (3, 3) and translation (3,) of cam_from_object, or None."""
    if len(points) < LEAST_POINTS:
        return None
    try:
        found, turn, shift = cv2.solvePnP(points, uv, matrix, distortion, flags=cv2.SOLVEPNP_SQPNP)
        if not found:
            return None
        refined = cv2.solvePnPRefineLM(points, uv, matrix, distortion, turn.copy(), shift.copy())
        # Outliers can make the refinement diverge.
        turn, shift = min((turn, shift), refined, key=lambda pose: _misfit(points, uv, matrix, distortion, *pose))
    except cv2.error:
        return None
    return _rotation_matrix(turn), _array(shift).ravel()


def _misfit(points: Array, uv: Array, matrix: Array, distortion: Array, turn: Any, shift: Any) -> float:
    """Sum of squared pixel errors; infinite where it is not finite."""
    error = float(np.square(cv2.projectPoints(points, turn, shift, matrix, distortion)[0][:, 0] - uv).sum())
    return error if np.isfinite(error) else float("inf")


def _rotation_matrix(turn: Any) -> Array:
    return _array(cv2.Rodrigues(turn)[0])


def _array(values: Any) -> Array:
    return np.asarray(values, dtype=np.float64)


def _intrinsics(rig: CameraRig, camera: int) -> Intrinsics:
    if rig.lens_models[camera] != LENS:
        found = f"camera {rig.camera_names[camera]} with the lens model {rig.lens_models[camera]}"
        raise InputError(f"OpenCV's methods: found {found}, expected {LENS} lenses")
    fx, fy = rig.focal_length[camera].tolist()
    cx, cy = rig.principal_point[camera].tolist()
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return matrix, _numpy(rig.distortion[camera])


def _numpy(tensor: Tensor) -> Array:
    return tensor.detach().cpu().double().numpy()


def bundle_adjustment(
    observations: Observations, factory: CameraRig, obj: CalibrationObject, prior_std: Tensor
) -> Prediction:
    """Minimize the MAP cost with squared loss by scipy's least_squares (MINPACK), numerical derivatives.

    Args:
        observations: (B, 1, C, N).
        factory: the factory rig, without batch axes; where the search starts, with a pose by PnP.
        obj: N fiducials.
        prior_std: (C, K) standard deviation of each factory value.
    """
    found = []
    for row in range(len(observations.uv)):
        one = Observations(
            *(value[row : row + 1] for value in (observations.uv, observations.sigma, observations.seen))
        )
        problem = make_problem(one, factory, obj, prior_std)
        state = _least_squares(problem, initial_state(problem, initial_pose(one, factory, obj), None))
        found.append(Prediction(rig_at(problem, state.offset), pose_at(problem, state)[:, 0]))
    return Prediction.cat(found)


def _least_squares(problem: Problem, start: State) -> State:
    """Minimize the cost of one rig with one snapshot."""
    cameras = problem.uv.shape[2]
    split = problem.prior_std[0].numel()

    def at(x: Tensor) -> State:
        """States (R,) at steps (R, K C + 6)."""
        return retract(problem, start, x[:, :split].unflatten(1, (cameras, -1)), x[:, None, split:])

    def residuals(x: Tensor) -> Tensor:
        state = at(x)
        points = pose_at(problem, state).apply(problem.points + problem.centroid)[:, 0]  # (R, N, 3)
        radius = None if problem.radius_squared is None else problem.radius_squared.sqrt()
        uv = rig_at(problem, state.offset).project(points, radius).uv
        whitened = (uv.mT - problem.uv[:, 0]) * problem.root_weight[:, 0].unsqueeze(-2)
        return torch.cat((whitened.flatten(1), state.offset.flatten(1)), dim=1)

    def residual(x: Array) -> Array:
        return _numpy(residuals(torch.from_numpy(x)[None])[0])

    def jacobian(x: Array) -> Array:
        """All forward differences at once, as one batch."""
        steps = torch.from_numpy(x) + STEP * torch.eye(len(x), dtype=torch.float64)
        values = residuals(torch.cat((torch.from_numpy(x)[None], steps)))
        return _numpy((values[1:] - values[:1]).mT / STEP)

    solution = least_squares(residual, np.zeros(split + 6), jac=jacobian, method="lm", max_nfev=MOST_EVALUATIONS)
    return at(torch.from_numpy(solution.x)[None])


class _Camera:
    """One camera in the object's frame, as OpenCV gives it."""

    def __init__(self, matrix: Array, distortion: Array, rotation: Array, translation: Array) -> None:
        focal, principal = (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2])
        self.numbers = np.concatenate((rotation.ravel(), translation.ravel(), focal, principal, distortion.ravel()))

    @property
    def usable(self) -> bool:
        """Tell whether the numbers are finite and the focal lengths positive."""
        return bool(np.isfinite(self.numbers).all() and (self.numbers[12:14] > 0).all())
