"""MAP estimation of a rig from labelled fiducials: `estimate` and its result."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.estimation import implicit, levenberg_marquardt, levenberg_marquardt_cpu
from imgcal.estimation.linearization import (
    NormalEquations,
    Problem,
    State,
    linearize,
    points_at,
    pose_at,
    rig_at,
)
from imgcal.estimation.pose_initialization import initial_pose
from imgcal.estimation.robust_losses import LOSSES, LossName, NamedLoss
from imgcal.estimation.shape_modes import ModeEvidence
from imgcal.geometry import RigidTransform, require_shapes
from imgcal.messages import brief
from imgcal.types import (
    CalibrationObject,
    CameraRig,
    Observations,
    Range,
    RigPrior,
    check_object,
    check_observations,
    check_rig,
    check_rig_shapes,
)

RESTART_AFTER = 15
"""Steps after which a rig starts over; from factory values within their prior, 6 are usual."""
COARSER = (3000.0, 300.0, 30.0, 3.0)
"""Factors on the standard deviation of the observations, in stages."""
COARSE_TOLERANCE = 0.1
FINITE_STD = Range(0.0, torch.finfo(torch.float64).max, "")


@dataclass(frozen=True)
class EstimationOptions:
    """How to minimize.

    Examples:
        >>> EstimationOptions(loss="cauchy").threshold
        3.0
    """

    loss: LossName = "huber"
    threshold: float = 3.0  # standard deviations, where the loss stops being quadratic
    max_iterations: int = 100  # per attempt; see `minimize`
    tolerance: float = 1e-4  # expected decrease of the cost (half a squared standard deviation) at which to stop

    def __post_init__(self) -> None:
        if self.loss not in LOSSES:
            raise InputError(f"loss: found {self.loss!r:.80}, expected one of {', '.join(LOSSES)}")
        if not self.threshold > 0:
            raise InputError(f"threshold: found {self.threshold}, expected standard deviations > 0")
        if not self.max_iterations >= 0:
            raise InputError(f"max_iterations: found {self.max_iterations}, expected 0 or more")
        if not self.tolerance >= 0:
            raise InputError(f"tolerance: found {self.tolerance}, expected a decrease of the cost of 0 or more")


@dataclass(frozen=True)
class Estimate:
    """The most probable rig and poses of the object, with the data for `covariance.py` at the end.

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth
        >>> from imgcal.types import Observations
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 5, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
        >>> observations = Observations(truth.uv, torch.full(seen.shape, 0.05), seen)
        >>> result = estimate(observations, factory, obj)
        >>> result.rig.focal_length.shape, result.residual.shape  # one rig; snapshots, cameras, fiducials, (u, v)
        (torch.Size([4, 2]), torch.Size([5, 4, 8, 2]))
        >>> float(result.chi2_per_dof) < 1  # no noise was added
        True
    """

    rig: CameraRig  # (*B)
    rig_from_object: RigidTransform  # (*B, S)
    residual: Tensor  # (*B, S, C, N, 2) pixels, predicted minus observed; zero where not seen
    chi2: Tensor  # (*B) sum of squared whitened residuals (robust), data and prior
    dof: Tensor  # (*B) expected chi2: 2 observations - rank of the poses (prior terms and their parameters cancel)
    converged: Tensor  # (*B) bool
    iterations: int
    points_object: Tensor  # (*B, N, 3) mm, the fiducials as estimated; as given where the object is exact
    problem: Problem  # (B,) flattened, as solved
    solution: levenberg_marquardt.Solution  # (B,) flattened: state and normal equations at the minimum
    loss: NamedLoss  # of the observations
    inflation: Tensor | None = field(default=None, kw_only=True)
    """(C,) factors on the noise part of each camera's standard deviations, where blocks of snapshots scatter more than
    the noise: `block_scatter`; None = they do not."""
    modes: ModeEvidence | None = field(default=None, kw_only=True)
    """Uncertainty of the object's modes, and how the cameras depend on them; None = no modes."""
    delays: ModeEvidence | None = field(default=None, kw_only=True)
    """The same of the cameras' exposure delays; None = the cameras are taken to expose together."""

    @property
    def mean_inflation(self) -> float:
        """Root mean square of `inflation`, for the object, which all cameras see; 1 = no inflation."""
        return 1.0 if self.inflation is None else float(self.inflation.square().mean().sqrt())

    def mode_covariance(self, modes: ModeEvidence) -> Tensor:
        """Covariance of the modes (M, M), in standard deviations of their prior, with the inflation.

        The prior contributes the square of the covariance, which stays: images that scatter say nothing about it.
        """
        plain = torch.from_numpy(modes.covariance)
        by_prior = plain @ plain
        return by_prior + self.mean_inflation**2 * (plain - by_prior)

    def covariance(self, reference: int = 0) -> Tensor:
        """Covariance of the cameras relative to one of them: (*B, K C, K C); see `relative_covariance`."""
        from imgcal.estimation.covariance import relative_covariance  # avoids a circular import

        return relative_covariance(self, reference)

    @property
    def chi2_per_dof(self) -> Tensor:
        """About 1 where the residuals agree with the noise and the prior: (*B)."""
        return self.chi2 / self.dof

    @property
    def rms(self) -> Tensor:
        """RMS length of the observed fiducials' residuals, as OpenCV's calibrateCamera returns it: (*B) pixels."""
        count = (self.problem.root_weight > 0).flatten(1).sum(1).clamp_min(1).reshape(self.chi2.shape)
        return (self.residual.square().flatten(len(self.chi2.shape)).sum(-1) / count).sqrt()

    def __repr__(self) -> str:
        """Show the type and shapes instead of walls of numbers."""
        poses = brief(self.rig_from_object.translation)
        return f"Estimate({self.rig!r}, poses {poses}, residual {brief(self.residual)}, {self.iterations} iterations)"


def estimate(
    observations: Observations,
    rig: CameraRig,
    obj: CalibrationObject,
    rig_from_object: RigidTransform | None = None,
    *,
    prior_std: Tensor | None = None,
    initial_rig: CameraRig | None = None,
    options: EstimationOptions = EstimationOptions(),
) -> Estimate:
    """Estimate the rig and the object's poses that best explain the observations and the factory calibration.

    The rig is constant over the snapshots while the object moves. Differentiable in uv, sigma, the factory rig and the
    prior's standard deviations: gradients flow through the solution by the implicit function theorem.

    Args:
        observations: (*B, S, C, N).
        rig: the factory rig, (*B) or without batch axes.
        obj: N fiducials. With a radius, their images are ellipses, and the observations are the centres of those. With
            tolerances, the object's shape is estimated too, one shape for all snapshots; of a stick, only the scale.
            The object's modes stay zero.
        rig_from_object: (*B, S) first guess of the poses; None = `initial_pose`.
        prior_std: (*B, C, K) standard deviation of each factory value, as `CameraRig.parameter_names`; zero keeps a
            value fixed; None = the rig's own prior, or `RigPrior()`.
        initial_rig: (*B) where to start, for example a network's output; None = the factory rig.
        options: how to minimize.

    Returns:
        The estimate. Check `converged`: a rig that has not converged is returned in its last state.

    Raises:
        InputError: inconsistent shapes; a rig or prior with implausible values; an observed fiducial whose pixel is
            not finite, or with a sigma of zero or less.

    Examples:
        >>> import imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth
        >>> from imgcal.types import Observations
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 5, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> seen = torch.ones(truth.uv.shape[:-1], dtype=torch.bool)
        >>> observations = Observations(truth.uv, torch.full(seen.shape, 0.05), seen)
        >>> result = estimate(observations, factory, obj)
        >>> bool(result.converged), float(result.rms) < 0.01
        (True, True)
    """
    batch = observations.seen.shape[:-3]
    check_rig(rig, any_batch=True)
    check_object(obj)
    problem = make_problem(observations, rig, obj, prior_std)
    check_observations(observations)
    if not FINITE_STD.holds_all(problem.prior_std):
        raise InputError("prior_std: found a value below 0 or not finite, expected standard deviations of 0 or more")
    if rig_from_object is None:
        with torch.no_grad():
            rig_from_object = initial_pose(observations, initial_rig or rig, obj)
    solution = minimize(problem, initial_state(problem, rig_from_object, initial_rig), options)
    loss = make_loss(options)
    return make_estimate(problem, solution, implicit.attach_gradient(problem, solution, loss), loss, batch)


def make_loss(options: EstimationOptions) -> NamedLoss:
    """Create the robust loss that the options name."""
    return NamedLoss(options.loss, options.threshold)


def minimize(problem: Problem, start: State, options: EstimationOptions) -> levenberg_marquardt.Solution:
    """Minimize from a start, on the CPU with the compiled solver; no gradient flows through the result.

    Precise observations make narrow, winding valleys of the cost. A rig without convergence after `RESTART_AFTER` steps
    starts over with larger standard deviations, which shrink to the given ones in stages (graduated non-convexity).
    """
    first = descend(problem, start, replace(options, max_iterations=min(options.max_iterations, RESTART_AFTER)))
    rows = (~first.converged).nonzero().squeeze(-1)
    left = options.max_iterations - first.iterations
    if left <= 0 or not len(rows):
        return first
    slow = problem.select(rows)
    coarse = replace(options, tolerance=COARSE_TOLERANCE, max_iterations=min(options.max_iterations, 2 * RESTART_AFTER))
    state, spent = levenberg_marquardt.select_rows(start, rows), first.iterations
    for factor in COARSER:
        stage = descend(replace(slow, root_weight=slow.root_weight / factor), state, coarse)
        state, spent = stage.state, spent + stage.iterations
    second = descend(slow, state, options)
    spent += second.iterations
    if not bool((second.converged & (second.equations.cost <= first.equations.cost[rows])).all()):
        further = descend(
            slow, levenberg_marquardt.select_rows(first.state, rows), replace(options, max_iterations=left)
        )
        spent += further.iterations
        second = levenberg_marquardt.choose_better(second, further)
    return levenberg_marquardt.replace_rows(first, rows, second, spent)


def descend(problem: Problem, start: State, options: EstimationOptions) -> levenberg_marquardt.Solution:
    """Minimize from a start in one attempt; see `minimize`."""
    with torch.no_grad():
        if problem.uv.device.type == "cpu":
            limits = (options.loss, options.threshold, options.max_iterations, options.tolerance)
            return levenberg_marquardt_cpu.minimize(problem, start, *limits)
        return levenberg_marquardt.minimize(
            problem, start, make_loss(options), options.max_iterations, options.tolerance
        )


def equations_at(problem: Problem, state: State, loss: NamedLoss) -> NormalEquations:
    """Compute the normal equations at a state, with compiled loops on the CPU; no gradient flows through them."""
    with torch.no_grad():
        if problem.uv.device.type == "cpu":
            return levenberg_marquardt_cpu.linearize(problem, state, loss.name, loss.threshold)
        return linearize(problem, state, loss)


def equations_by_snapshot(problem: Problem, state: State, loss: NamedLoss) -> NormalEquations:
    """Compute the normal equations of each snapshot of one rig (B = 1), as S rigs of one snapshot, with a fixed object.

    Each includes the whole prior. Without it, their sum gives the equations of the rig.
    """
    count = problem.uv.shape[1]

    def repeat(tensor: Tensor) -> Tensor:
        return tensor.expand(count, *tensor.shape[1:])

    alone = replace(
        problem,
        uv=problem.uv[0].unsqueeze(1),
        root_weight=problem.root_weight[0].unsqueeze(1),
        points=points_at(problem, state)[0],
        factory=problem.factory.map_tensors(lambda tensor, _: repeat(tensor)),
        prior_std=repeat(problem.prior_std),
        object_prior_std=None,
    )
    there = State(repeat(state.offset), state.rotation[0].unsqueeze(1), state.centre[0].unsqueeze(1))
    return equations_at(alone, there, loss)


def make_estimate(
    problem: Problem,
    solution: levenberg_marquardt.Solution,
    state: State,
    loss: NamedLoss,
    batch: torch.Size = torch.Size(),
) -> Estimate:
    """Build the estimate from a solution; `state` is the solution's, possibly with a gradient."""
    seen = problem.root_weight > 0
    plain = state is solution.state and state.offset.device.type == "cpu"  # no gradient to carry
    rigs, poses = (levenberg_marquardt_cpu.rig_at if plain else rig_at)(problem, state.offset), pose_at(problem, state)
    residual = torch.where(seen.unsqueeze(-2), solution.equations.residual, 0.0).mT
    dof = 2 * seen.flatten(1).sum(1) - problem.pose_freedom
    return Estimate(
        rig=rigs.reshape(*batch),
        rig_from_object=poses.reshape(*batch, seen.shape[1]),
        residual=residual.reshape(*batch, *residual.shape[1:]),
        chi2=(2 * solution.equations.cost).reshape(batch),
        dof=dof.reshape(batch),
        converged=solution.converged.reshape(batch),
        iterations=solution.iterations,
        points_object=(points_at(problem, state) + problem.centroid).reshape(*batch, -1, 3),
        problem=problem,
        solution=solution,
        loss=loss,
    )


def make_problem(
    observations: Observations, rig: CameraRig, obj: CalibrationObject, prior_std: Tensor | None
) -> Problem:
    """Flatten the batch axes and whiten; arguments as for `estimate`.

    Raises:
        InputError: the observations do not fit the rig and the object, or have `shake`.
    """
    check_rig_shapes(rig)
    cameras, fiducials = (0, 0, *observations.seen.shape)[-2:]
    if (
        cameras != rig.num_cameras
        or fiducials != obj.num_fiducials
        or observations.seen.ndim < 3
        or observations.uv.shape != (*observations.seen.shape, 2)
    ):
        raise InputError(
            f"observations: found uv {tuple(observations.uv.shape)} and seen {tuple(observations.seen.shape)}, "
            f"expected uv (..., snapshots, {rig.num_cameras} cameras, {obj.num_fiducials} fiducials, 2) and seen "
            "without the last axis"
        )
    if observations.shake is not None:
        raise InputError(
            "observations: found `shake`, which only a running rig (`RigKeeper`) supports; expected observations "
            "without it"
        )
    batch = observations.seen.shape[:-3]
    count = batch.numel()
    uv, sigma = observations.uv, observations.sigma
    rig, width = rig.to(uv.dtype), rig.num_parameters
    if prior_std is None:
        prior_std = (rig.prior or RigPrior()).std(rig)
    require_shapes("estimation", [("prior_std", prior_std, (cameras, width))], any_batch=True)
    seen = observations.seen.reshape(count, *observations.seen.shape[-3:])
    uv = uv.reshape(count, *uv.shape[-4:])
    sigma = sigma.expand(observations.seen.shape).reshape(seen.shape)
    points = obj.points.to(uv)
    centroid = points.mean(0)
    modes = None if obj.modes is None else obj.modes.to(uv) - obj.modes.to(uv).mean(1, keepdim=True)
    own = None if obj.exact else object_prior_std(obj).to(uv)
    return Problem(
        modes=modes,
        part_of=torch.from_numpy(obj.part_of).to(uv.device) if obj.parts else None,
        object_prior_std=None if own is None or not bool(own.any()) else own.expand(count, -1),
        uv=torch.where(seen[..., None], uv, 0.0).mT.contiguous(),
        root_weight=torch.where(seen, 1 / torch.where(seen, sigma, 1.0), 0.0),
        points=points - centroid,
        centroid=centroid,
        radius_squared=None if obj.radius is None else obj.radius.to(uv).square(),
        factory=rig.map_tensors(
            lambda tensor, axes: tensor.expand(*batch, *tensor.shape[-axes:]).reshape(count, *tensor.shape[-axes:])
        ),
        prior_std=rig.only_existing(prior_std.to(uv)).expand(*batch, cameras, width).reshape(count, cameras, width),
    )


def object_prior_std(obj: CalibrationObject) -> Tensor:
    """Prior standard deviation of the object's own parameters, in the order of `State`: (M,).

    Zero where they are taken from its file: the fiducials of a stick, and the scale of a single point.
    """
    granted = torch.cat([part.granted * (part.pose_rank == 6) for part in obj.each])
    scale = obj.scale_tolerance * (obj.pose_rank > 3)
    return torch.cat((granted.repeat_interleave(3), obj.points.new_tensor([scale])))


def initial_state(problem: Problem, rig_from_object: RigidTransform, initial_rig: CameraRig | None) -> State:
    """Convert a first guess, poses (B, S) in mm and rigs (B) or None, to a state of the problem.

    Raises:
        InputError: poses of another number of snapshots, or a rig whose values do not fit together.
    """
    count, snapshots = problem.uv.shape[:2]
    if rig_from_object.translation.shape[-2:-1] != (snapshots,):
        found = f"poses of shape {tuple(rig_from_object.translation.shape[:-1])}"
        raise InputError(f"rig_from_object: found {found}, expected (..., {snapshots}), one for each snapshot")
    if initial_rig is not None:
        check_rig_shapes(initial_rig)
    rotation = rig_from_object.rotation.detach().to(problem.uv).reshape(count, snapshots, 3, 3)
    translation = rig_from_object.translation.detach().to(problem.uv).reshape(count, snapshots, 3)
    offset = torch.zeros_like(problem.prior_std)
    if initial_rig is not None:
        guess = initial_rig.to(problem.uv.dtype)
        difference = guess.reshape(-1).local(problem.factory).detach()
        offset = torch.where(problem.prior_std > 0, difference / problem.prior_std.clamp_min(1e-30), 0.0)
    own = None if problem.object_prior_std is None else torch.zeros_like(problem.object_prior_std)
    return State(offset.detach(), rotation, translation + rotation @ problem.centroid, own)
