"""Posterior covariance of an estimate: of each camera, of the cameras relative to one another, of the object.

All start from the Laplace approximation: the inverse of the Gauss-Newton information at the minimum, prior included.
Those of the cameras and of the object add a second-order term for the curvature of the posterior: `curvature.py`.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import schur
from imgcal.estimation.curvature import curvature_covariance, whitened_curvature
from imgcal.estimation.levenberg_marquardt import Factorization, Solution, factorize
from imgcal.estimation.linearization import POSE_PARAMETERS, NormalEquations, points_at
from imgcal.estimation.map_estimate import Estimate, equations_at
from imgcal.estimation.robust_losses import NamedLoss
from imgcal.geometry import RigidTransform, cross_matrix, left_jacobian
from imgcal.types import CameraRig

UNDETERMINED = "covariance: the observations do not determine the object's pose in every snapshot"
LEAST_STD = 1e-9
"""Floor of prior standard deviations (rad, mm, pixels, 1) in divisions, for fixed parameters."""


def camera_covariance(estimate: Estimate, curved: bool = True) -> Tensor:
    """Joint covariance of all cameras' parameters.

    Args:
        estimate: the estimate.
        curved: add the second order. Without it, the result is the inverse of the information, inflated by the scatter
            between blocks of snapshots where that was larger.

    Returns:
        (*B, K C, K C) in the units and order of `CameraRig.parameter_names`, camera after camera; rotations are small
        left rotations about the estimated orientation. Includes the gauge: only the prior constrains a motion of the
        whole rig; see `relative_covariance`.

    Raises:
        RefusedError: the information is singular (a snapshot with too few fiducials).
    """
    cameras = estimate.rig.num_cameras
    if estimate.inflation is None:
        covariance = whitened_covariance(estimate.solution)
    else:
        covariance = _inflated_covariance(estimate.solution, estimate.inflation)
    covariance = covariance + _by_modes(estimate)
    if curved:
        covariance = covariance + whitened_curvature(estimate, covariance)
    scale = _unwhitening(estimate).flatten(1, 2)  # (B, K C, K): one block per camera
    blocks = covariance.unflatten(1, (cameras, -1)).unflatten(-1, (cameras, -1))
    per_camera = scale.unflatten(1, (cameras, -1))
    physical = torch.einsum("bcij,bcjdk,bdlk->bcidl", per_camera, blocks, per_camera)
    size = covariance.shape[-1]
    return physical.reshape(*estimate.chi2.shape, size, size)


def _by_modes(estimate: Estimate) -> Tensor:
    """Covariance that the uncertainty of the object's modes and of delays adds to the cameras' whitened offsets."""
    added = estimate.problem.prior_std.new_zeros(())
    for modes in filter(None, (estimate.modes, estimate.delays)):
        follow = modes.follow.flatten(1)
        added = added + (follow.mT @ estimate.mode_covariance(modes).to(follow) @ follow)[None]
    return added


def _inflated_covariance(solution: Solution, inflation: Tensor) -> Tensor:
    """`whitened_covariance` with what the observations contribute enlarged by a factor on each camera (C,).

    The unit priors of cameras and object contribute the square of the covariance, which stays: images that disagree
    more than their noise say nothing about the error of the object's scale.
    """
    factorization = solution.factorization
    if factorization.cameras_first:
        factorization = factorize(solution.equations, cameras_first=False)
    reduced = _determined(factorization)
    size = solution.equations.camera_gradient[0].numel()
    with_object = torch.cholesky_inverse(reduced.kept)[:, :size]  # (B, K C, K C + M)
    by_prior, factor = with_object @ with_object.mT, inflation.repeat_interleave(size // len(inflation))
    return by_prior + factor[:, None] * (with_object[..., :size] - by_prior) * factor


def whitened_covariance(solution: Solution) -> Tensor:
    """Joint covariance of all cameras' whitened offsets: (B, K C, K C), in prior standard deviations.

    Raises:
        RefusedError: the observations do not determine the object's pose in every snapshot.
    """
    equations = solution.equations
    factorization = solution.factorization
    reduced, cameras = _determined(factorization), equations.camera.shape[1]
    if not factorization.cameras_first:
        size = equations.camera_gradient[0].numel()
        return torch.cholesky_inverse(reduced.kept)[:, :size, :size]
    inverse = torch.cholesky_inverse(reduced.eliminated)
    half = torch.linalg.solve_triangular(reduced.eliminated.mT, reduced.whitened, upper=True).flatten(1, 2)
    half_inverse = torch.linalg.solve_triangular(reduced.kept, half.mT, upper=False)
    covariance = half_inverse.mT @ half_inverse
    blocks = covariance.unflatten(1, (cameras, -1)).unflatten(-1, (cameras, -1))
    blocks.diagonal(dim1=1, dim2=3).add_(inverse.permute(0, 2, 3, 1))
    return covariance


def _determined(factorization: Factorization) -> schur.Reduced:
    """Return the reduced equations.

    Raises:
        RefusedError: they are singular.
    """
    if bool(factorization.reduced.failed.any()):
        raise RefusedError(UNDETERMINED)
    return factorization.reduced


def joint_information(estimate: Estimate) -> Tensor:
    """Joint information of the cameras' parameters and of the object's offset, the poses marginalized.

    Args:
        estimate: without batch axes.

    Returns:
        (D, D), D = K C + M: inverse covariance in the units and order of `CameraRig.parameter_names`, camera after
        camera, then of the object's offset in standard deviations of its prior. Fixed parameters have the information
        of `LEAST_STD`. Reduced by the scatter between blocks of snapshots, where that was larger than the noise.

    Raises:
        RefusedError: the information is singular.
    """
    problem, equations = estimate.problem, estimate.solution.equations
    if estimate.inflation is not None:
        equations = _weakened_equations(estimate, estimate.inflation)
    reduced = _determined(factorize(equations, cameras_first=False))
    information = (reduced.kept @ reduced.kept.mT)[0]
    for modes in filter(None, (estimate.modes, estimate.delays)):
        # Woodbury: the uncertainty of the modes reduces the information about the cameras that they affect.
        follow = information.new_zeros(len(modes.offset), len(information))
        of_cameras = modes.follow.flatten(1)
        follow[:, : of_cameras.shape[1]] = of_cameras
        precise = torch.linalg.inv(estimate.mode_covariance(modes))
        across = follow @ information
        information = information - across.mT @ torch.linalg.solve(precise + across @ follow.mT, across)
    by_step = torch.linalg.inv(_unwhitening(_floor_prior_std(estimate, LEAST_STD))[0])  # whitened offsets by parameters
    others = len(information) - problem.prior_std[0].numel()
    whole = torch.block_diag(*by_step, torch.eye(others, dtype=information.dtype))
    return whole.mT @ information @ whole


def _weakened_equations(estimate: Estimate, inflation: Tensor) -> NormalEquations:
    """Normal equations with the labels' standard deviations of each camera enlarged by a factor (C,).

    The labels are reweighted before the poses are eliminated. A joint change of cameras, object and poses that no image
    can show, such as that of scale, then still gets no information. Factors applied after the elimination would give it
    some as soon as they differ between cameras.
    """
    problem, solution = estimate.problem, estimate.solution
    distance = solution.equations.residual.square().sum(-2).sqrt() * problem.root_weight  # (1, S, C, N)
    robust = estimate.loss(distance.square())[1].sqrt()
    weaker = replace(problem, root_weight=problem.root_weight * robust / inflation[:, None])
    return equations_at(weaker, solution.state, NamedLoss("squared"))


def _floor_prior_std(estimate: Estimate, least: float) -> Estimate:
    """Copy an estimate with the prior's standard deviations at least `least`, so that they can be divided by."""
    problem = estimate.problem
    return replace(estimate, problem=replace(problem, prior_std=problem.prior_std.clamp_min(least)))


def camera_std(estimate: Estimate) -> Tensor:
    """One standard deviation of every parameter: (*B, C, K).

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth
        >>> from imgcal.types import Observations
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 5, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
        >>> observations = Observations(truth.uv, torch.full(seen.shape, 0.05), seen)
        >>> std = camera_std(imgcal.estimate(observations, factory, obj))
        >>> std.shape, float(std[0, 6]) < 0.02 * float(factory.focal_length[0, 0])  # the prior: 2 %
        (torch.Size([4, 15]), True)
    """
    variance = camera_covariance(estimate).diagonal(dim1=-2, dim2=-1)
    return variance.clamp_min(0).sqrt().unflatten(-1, (estimate.rig.num_cameras, -1))


def relative_covariance(estimate: Estimate, reference: int = 0) -> Tensor:
    """Covariance with the extrinsics relative to a reference camera: independent of the gauge.

    Returns:
        (*B, K C, K C) like `camera_covariance`; the rotation is that of cam_from_reference, the position that of the
        camera in the reference camera's frame. The reference's own six entries are zero.
    """
    covariance = camera_covariance(estimate, curved=False)
    jacobian = relative_jacobian(estimate.rig, reference)
    centre = estimate.rig.reshape(estimate.chi2.numel()).map_tensors(lambda tensor, _: tensor.unsqueeze(1))

    def relative(rigs: CameraRig, _: Tensor) -> Tensor:
        return relative_difference(rigs, centre, reference).flatten(-2)

    flat = jacobian @ covariance @ jacobian.mT
    covariance = flat + curvature_covariance(estimate, relative, flat)
    own = slice(first := reference * estimate.rig.num_parameters, first + POSE_PARAMETERS)
    covariance[..., own, :] = covariance[..., own] = 0  # exactly, in spite of rounding in the second order
    return covariance


def relative_jacobian(rig: CameraRig, reference: int) -> Tensor:
    """Jacobian of all parameters relative to a reference camera by the parameters: (*B, K C, K C).

    For cam_from_reference = R_i R_r^T, it is a left rotation w_i - R_i R_r^T w_r; for the position p = R_r (c_i - c_r),
    it is w_r x p + R_r (dc_i - dc_r).
    """
    cameras, rotation, positions = rig.num_cameras, rig.cam_from_rig.rotation, rig.positions
    to_reference = rotation[..., reference : reference + 1, :, :]
    relative = rotation @ to_reference.mT  # (*B, C, 3, 3)
    place = (to_reference @ (positions - positions[..., reference : reference + 1, :])[..., None]).squeeze(-1)
    eye = torch.eye(cameras * rig.num_parameters, dtype=rotation.dtype, device=rotation.device)
    jacobian = eye.expand(*rotation.shape[:-3], -1, -1).clone()
    blocks = jacobian.unflatten(-2, (cameras, -1)).unflatten(-1, (cameras, -1))
    for i in range(cameras):
        blocks[..., i, 3:6, i, 3:6] = to_reference.squeeze(-3)
        blocks[..., i, 0:3, reference, 0:3] -= relative[..., i, :, :]
        blocks[..., i, 3:6, reference, 3:6] -= to_reference.squeeze(-3)
        blocks[..., i, 3:6, reference, 0:3] -= cross_matrix(place[..., i, :])
    blocks[..., reference, :6, :, :] = 0  # exactly, not up to the rounding of R_r R_r^T
    return blocks.flatten(-2).flatten(-3, -2)


def relative_difference(rig: CameraRig, other: CameraRig, reference: int = 0) -> Tensor:
    """Error of a rig against another one, extrinsics relative to a reference camera: (*B, C, K), independent of gauge.

    Examples:
        >>> import imgcal
        >>> rig = imgcal.load_rig("T4")
        >>> float(relative_difference(rig, rig).abs().max()) < 1e-12
        True
    """
    return _relative_to(rig, reference).local(_relative_to(other, reference))


def _relative_to(rig: CameraRig, reference: int) -> CameraRig:
    transform = rig.cam_from_rig
    one = slice(reference, reference + 1)
    reference_from_rig = RigidTransform(transform.rotation[..., one, :, :], transform.translation[..., one, :])
    return replace(rig, cam_from_rig=transform @ reference_from_rig.inverse())


def _unwhitening(estimate: Estimate) -> Tensor:
    """Jacobian of the parameters by the whitened offsets: (B, C, K, K)."""
    problem, state = estimate.problem, estimate.solution.state
    prior_std = problem.prior_std.detach()
    scale = torch.diag_embed(prior_std)
    left = left_jacobian(state.offset[..., :3] * prior_std[..., :3])
    scale[..., :3, :3] = left * prior_std[..., None, :3]
    return scale


def scale_response(estimate: Estimate) -> Tensor:
    """Sensitivity of the parameters to the object's scale: (K C,) change of each by a relative change of one.

    The poses adapt, too, and so do the fiducials within their tolerances; the cameras' prior resists.

    Args:
        estimate: without batch axes.

    Raises:
        RefusedError: the information is singular.
    """
    problem, state = estimate.problem, estimate.solution.state
    points = points_at(problem, state)[0]
    unit = points.new_zeros(1, 3 * len(points) + 1)
    if problem.object_prior_std is not None:
        unit = problem.object_prior_std.clone()
    unit[:, -1] = 1.0
    free = replace(problem, points=points, object_prior_std=unit)
    equations = equations_at(free, replace(state, object_offset=torch.zeros_like(unit)), estimate.loss)
    lower = _determined(factorize(equations, cameras_first=False)).kept[0]
    # A unit step of the last unknown changes the others by -A^-1 a; with the Cholesky factor, -L^-T l.
    follow = -torch.linalg.solve_triangular(lower[:-1, :-1].mT, lower[-1, :-1, None], upper=True)[:, 0]
    cameras = estimate.rig.num_cameras
    whitened = follow[: problem.prior_std[0].numel()].unflatten(0, (cameras, -1))
    return torch.einsum("cij,cj->ci", _unwhitening(estimate)[0], whitened).flatten()


def object_covariance(estimate: Estimate, curved: bool = True) -> Tensor:
    """Joint covariance of the estimated fiducials' coordinates: (*B, 3 N, 3 N) mm^2, in the object's frame.

    Zero where the object was given as exact. Only the fiducials' tolerances constrain their common motion; see
    `imgcal.estimation.object_shape` for quantities that do not depend on it.

    Args:
        estimate: the estimate.
        curved: add the second order, as in `camera_covariance`.

    Raises:
        RefusedError: the information is singular.
    """
    problem, equations = estimate.problem, estimate.solution.equations
    fiducials = len(problem.points)
    batch = estimate.chi2.shape
    if equations.object is None or problem.object_prior_std is None:
        return problem.points.new_zeros(*batch, 3 * fiducials, 3 * fiducials)
    reduced = _determined(estimate.solution.factorization)
    size = 3 * fiducials + 1
    whitened = torch.cholesky_inverse(reduced.kept)[:, -size:, -size:]
    prior_std = problem.object_prior_std
    jacobian = torch.cat(
        (torch.diag_embed(prior_std[:, :-1]), (problem.points.flatten() * prior_std[:, -1:])[..., None]), dim=-1
    )
    flat = (jacobian @ whitened @ jacobian.mT).reshape(*batch, 3 * fiducials, 3 * fiducials)
    if not curved:
        return flat
    centre = points_at(problem, estimate.solution.state).unsqueeze(1)
    return flat + curvature_covariance(estimate, lambda _, points: (points - centre).flatten(-2), flat)
