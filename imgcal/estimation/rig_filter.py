"""What is known of a rig over time: `RigBelief`, what it becomes by what is seen (`absorbed`) and by time (`aged`).

The state is every camera's parameters and, where the object has tolerances, the object's; the object's pose is
eliminated from each snapshot. Information is kept as its Cholesky factor about errors in which a motion of the whole
rig is the same direction everywhere (`rig_error.py`), so that it says nothing about what no image shows, however often
the estimate has moved meanwhile. Several snapshots may be absorbed at once: they are then linearized where they lead
together, which is what `RigFilter` does with its first ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import lm_cpu, rig_filter_cpu
from imgcal.estimation.brought import Brought, add_blocks
from imgcal.estimation.linearization import NormalEquations, Problem, State, pose_at, retract
from imgcal.estimation.map_estimate import (
    EstimationOptions,
    equations_at,
    initial_state,
    make_loss,
    make_problem,
    object_prior_std,
)
from imgcal.estimation.rig_error import displaced, error_between, step_by_error
from imgcal.estimation.rig_filter_cpu import RigArrays
from imgcal.geometry import RigidTransform
from imgcal.types import CalibrationObject, CameraRig, DriftRate, Observations, RigPrior

LEAST_STD = (1e-9,) * 3 + (1e-6,) * 3 + (1e-6,) * 4
LEAST_COEFFICIENT = 1e-9
"""Standard deviation (rad, mm, pixels, 1) of a value that is fixed: small, and not zero."""
MOST_DAMPING = 1e8
SLACK = 1e-6
"""By how much the cost may rise in a step, relative: rounding."""
DAMPED, STALLED = 1e-3, 10.0
"""Damping up to which a step that is as short as the tolerance shows that this is the minimum; the second where lightly
damped steps have failed: their direction is approximate where the belief is far away."""

WHY_NOT = {
    rig_filter_cpu.NO_POSE: "the observations do not determine the object's pose in every snapshot",
    rig_filter_cpu.NOTHING_KNOWN: "these observations leave a rig that nothing is known of: labels may be wrong",
    rig_filter_cpu.NO_MINIMUM: "found no minimum for these observations, expected one: labels may be wrong",
}

TOGETHER = (*range(2, 17), 20, 25, 32, 40, 50, 64, 80, 100, 128)
"""Numbers of snapshots that are absorbed together once there are as many."""
MEMORY = TOGETHER[-1]
YOUNG_SECONDS = 60.0
"""Time over which a rig may be taken to stand still; what it wanders by then is far below the noise of a snapshot."""
LEAST_SECONDS = 1.0
"""Time that is worth an inversion of the information."""


@dataclass(frozen=True)
class _Constants:
    """What `rig_filter_cpu.absorb` is given of an object and of lenses."""

    shared: tuple[NDArray[np.float64] | None, ...]  # see `linearization_cpu`
    centroid: NDArray[np.float64]  # (3,) mm
    own_std: NDArray[np.float64]  # (M,) prior standard deviation of the object's offset

    @classmethod
    def of(cls, obj: CalibrationObject, rig: CameraRig) -> _Constants:
        centroid = obj.points.mean(0)
        own_std = obj.points.new_zeros(0) if obj.exact else object_prior_std(obj)
        squared = None if obj.radius is None else obj.radius.double().square()
        none = obj.points.new_zeros(0)
        problem = Problem(none, none, obj.points - centroid, centroid, squared, rig, none)
        return cls(lm_cpu.shared_given(problem), centroid.numpy(), own_std.numpy())


@dataclass(frozen=True)
class RigBelief:
    """The most probable rig, and how surely it is known."""

    rig: CameraRig  # without batch axes, float64
    obj: CalibrationObject  # with its tolerances, as it was given
    object_offset: Tensor  # (M,) in units of its prior standard deviation: what is known of it; M = 0 where it is exact
    factor: Tensor  # (D, D) lower Cholesky factor of the information; D = K C + M
    unit: Tensor  # (C, K) rad, mm, pixels, 1: of the cameras' errors

    @classmethod
    def of_prior(cls, rig: CameraRig, obj: CalibrationObject, prior_std: Tensor | None = None) -> RigBelief:
        """What the factory says: `prior_std` (C, K), None = as the rig file has it."""
        rig = rig.to(torch.float64)
        std = (rig.prior or RigPrior()).std(rig) if prior_std is None else prior_std
        least = torch.full((rig.num_parameters,), LEAST_COEFFICIENT, dtype=torch.float64)
        least[: len(LEAST_STD)] = torch.tensor(LEAST_STD, dtype=torch.float64)
        unit = std.double().clamp_min(least)
        step = _whitened(step_by_error(rig), unit)
        own, wide = 0 if obj.exact else 3 * obj.num_fiducials + 1, rig.num_cameras * rig.num_parameters
        information = torch.eye(wide + own, dtype=torch.float64)
        add_blocks(information, step.mT @ step - torch.eye(rig.num_parameters, dtype=torch.float64))
        return cls(rig, obj, rig.focal_length.new_zeros(own), _cholesky(information), unit)

    @cached_property
    def information(self) -> Tensor:
        """Inverse covariance (D, D) of the errors in their units."""
        return self.factor @ self.factor.mT

    @cached_property
    def arrays(self) -> RigArrays:
        """The rig for compiled loops."""
        return RigArrays.of(self.rig)

    @cached_property
    def half_log_determinant(self) -> float:
        """Of the information."""
        return float(np.log(self.factor.numpy().diagonal()).sum())

    @cached_property
    def constants(self) -> _Constants:
        """What compiled loops are given of the object and the lenses; the same of all beliefs about them."""
        return _Constants.of(self.obj, self.rig)

    def covariance(self) -> Tensor:
        """Joint covariance (K C, K C) of the cameras in the units and order of `CameraRig.parameter_names`."""
        cameras, wide = self.rig.num_cameras, self.unit.numel()
        covariance = torch.cholesky_inverse(self.factor)[:wide, :wide]
        blocks = covariance.unflatten(0, (cameras, -1)).unflatten(-1, (cameras, -1))
        step = step_by_error(self.rig) * self.unit[:, None, :]
        return torch.einsum("cij,cjdk,dlk->cidl", step, blocks, step).reshape(wide, wide)

    def std(self) -> Tensor:
        """One standard deviation of every parameter: (C, K)."""
        return self.covariance().diagonal().clamp_min(0).sqrt().view(self.unit.shape)

    @property
    def points_object(self) -> Tensor:
        """The fiducials as they are known now: (N, 3) mm."""
        if not len(self.object_offset):
            return self.obj.points
        offset = self.object_offset * object_prior_std(self.obj)
        centroid = self.obj.points.mean(0)
        return centroid + (self.obj.points - centroid) * (1 + offset[-1]) + offset[:-1].unflatten(0, (-1, 3))


@dataclass(frozen=True)
class Absorbed:
    """What some snapshots have taught."""

    belief: RigBelief
    rig_from_object: RigidTransform  # (S,) the object's poses
    residual: Tensor  # (S, C, N, 2) pixels, predicted minus observed; zero where not seen
    chi2: float  # sum of squared whitened residuals (robust), and of the change in standard deviations of the belief
    dof: int  # 2 observations - 6 snapshots: what chi2 is expected to be
    evidence: float  # log probability of what was seen, up to what is the same for every belief before it (Laplace)
    before: RigBelief  # what they were absorbed into
    brought: Brought  # what they say by themselves

    def of_last(self) -> Absorbed:
        """The same, with pose and residual of the last snapshot alone: (1,) and (1, C, N, 2)."""
        return replace(self, rig_from_object=self.rig_from_object[-1:], residual=self.residual[-1:])


def absorbed(
    belief: RigBelief,
    observations: Observations,
    rig_from_object: RigidTransform,
    options: EstimationOptions = EstimationOptions(),
) -> Absorbed:
    """Learn from labelled snapshots of a rig that stood still while they were taken.

    Args:
        belief: what was known before.
        observations: (S, C, N) of the object that the belief is about.
        rig_from_object: (S,) first guess of the object's poses.
        options: how to minimize.

    Raises:
        RefusedError: the observations do not determine the object's pose, or no minimum was found.
        ValueError: there are not as many poses as snapshots.
    """
    if rig_from_object.translation.shape[0] != observations.seen.shape[0]:
        given = f"{rig_from_object.translation.shape[0]} poses of {observations.seen.shape[0]} snapshots"
        raise ValueError(f"rig_from_object: found {given}, expected one of each")
    if belief.factor.device.type == "cpu":
        return _absorbed_compiled(belief, observations, rig_from_object, options)
    return absorbed_in_tensors(belief, observations, rig_from_object, options)


def _absorbed_compiled(
    belief: RigBelief, observations: Observations, rig_from_object: RigidTransform, options: EstimationOptions
) -> Absorbed:
    """Do the work of `absorbed` in one compiled call."""
    constants, unit = belief.constants, belief.unit
    seen = observations.seen.numpy()
    uv = np.where(seen[..., None], observations.uv.numpy(), 0.0).astype(np.float64, copy=False)
    uv = np.ascontiguousarray(uv.swapaxes(-1, -2))
    sigma = np.where(seen, observations.sigma.numpy(), np.inf)
    rotation = np.ascontiguousarray(rig_from_object.rotation.detach().double().reshape(-1, 3, 3).numpy())
    translation = rig_from_object.translation.detach().double().reshape(-1, 3).numpy()
    loss = (lm_cpu.LOSS_CODES[options.loss], float(options.threshold))
    found = rig_filter_cpu.absorb(
        constants.shared,
        (uv, (1 / sigma).astype(np.float64, copy=False)),
        (belief.arrays, unit.numpy(), belief.object_offset.numpy(), constants.own_std, belief.information.numpy()),
        (rotation, translation + rotation @ constants.centroid),
        (*loss, options.max_iterations, options.tolerance, SLACK, DAMPED, STALLED, MOST_DAMPING),
    )
    if found.status:
        raise RefusedError(f"estimation: {WHY_NOT[found.status]}")
    own, factor = torch.from_numpy(found.own), torch.from_numpy(found.factor)
    now = RigBelief(_rig_of(found.rig, belief.rig), belief.obj, own, factor, unit)
    brought = Brought(
        _rig_of(found.from_rig, belief.rig), torch.from_numpy(found.from_own), unit,
        *(torch.from_numpy(part) for part in (found.camera, found.border, found.carried, found.pull)),
    )  # fmt: skip
    # What the properties would make of it, at hand.
    half_log_determinant = float(np.log(found.factor.diagonal()).sum())
    information = torch.from_numpy(found.information)
    vars(now).update(information=information, arrays=found.rig, constants=constants)
    vars(now).update(half_log_determinant=half_log_determinant)
    vars(brought).update(arrays=found.from_rig)
    translation = found.centre - found.rotation @ constants.centroid
    poses = RigidTransform(torch.from_numpy(found.rotation), torch.from_numpy(translation))
    residual = torch.from_numpy(np.where(seen[..., None], found.residual.swapaxes(-1, -2), 0.0))
    evidence = belief.half_log_determinant - half_log_determinant - found.cost
    dof = 2 * int(np.count_nonzero(seen)) - 6 * len(seen)
    return Absorbed(now, poses, residual, 2 * found.cost, dof, evidence, belief, brought)


def _rig_of(values: RigArrays, like: CameraRig) -> CameraRig:
    """The rig that has these values; `replace` would take longer than a projection."""
    translation = -(values.rotation @ values.position[..., None])[..., 0]
    rig = object.__new__(CameraRig)
    vars(rig).update(vars(like))
    vars(rig).update(
        focal_length=torch.from_numpy(values.focal_length),
        principal_point=torch.from_numpy(values.principal_point),
        distortion=torch.from_numpy(values.distortion),
        cam_from_rig=RigidTransform(torch.from_numpy(values.rotation), torch.from_numpy(translation)),
    )
    return rig


def absorbed_in_tensors(
    belief: RigBelief,
    observations: Observations,
    rig_from_object: RigidTransform,
    options: EstimationOptions = EstimationOptions(),
) -> Absorbed:
    """Do the work of `absorbed` in tensors: on any device, and slowly."""
    at = _Linearization.of(belief, observations, rig_from_object, options)
    damping, light = 0.0, DAMPED
    for iteration in range(options.max_iterations):
        tolerance = options.tolerance * rig_filter_cpu.LOOSER ** max(0, iteration - rig_filter_cpu.PATIENCE)
        step, gain, factor, brought = at.step(damping)
        trial = at.moved(step)
        if trial.cost <= at.cost + SLACK * max(1.0, at.cost):
            if gain <= tolerance and damping <= light:
                return trial.absorbed(factor, brought)
            at, damping = trial, 0.0 if damping <= 1e-6 else damping / 8
        else:
            damping, light = max(8 * damping, 1e-4), STALLED
            if damping > MOST_DAMPING:
                break
    raise RefusedError(f"estimation: {WHY_NOT[rig_filter_cpu.NO_MINIMUM]}")


def aged(belief: RigBelief, seconds: float, rate: DriftRate | Tensor) -> RigBelief:
    """Know less of a rig after some time, over which every value took a random walk on its own.

    Args:
        belief: what was known.
        seconds: how long ago.
        rate: of the walks; or the standard deviation (C, K) of each after an hour.
    """
    if seconds <= 0:
        return belief
    walk = rate.std(belief.rig) if isinstance(rate, DriftRate) else rate
    variance = walk.square() * (seconds / 3600)
    return widened(belief, variance) if variance.any() else belief


def widened(belief: RigBelief, variance: Tensor) -> RigBelief:
    """Know less of some parameters: add variances (C, K), in the units and order of `CameraRig.parameter_names`."""
    covariance = torch.cholesky_inverse(belief.factor)
    add_blocks(covariance, error_covariance(belief, variance))
    return replace(belief, factor=_cholesky(torch.cholesky_inverse(_cholesky(covariance))))


def error_covariance(belief: RigBelief, variance: Tensor) -> Tensor:
    """Covariance (C, K, K) of errors in units, of variances (C, K) of a camera's own parameters."""
    error_by_step = torch.linalg.inv(step_by_error(belief.rig)) / belief.unit[:, :, None]
    return error_by_step @ torch.diag_embed(variance) @ error_by_step.mT


class RigFilter:
    """Follows a rig, snapshot after snapshot, in constant memory.

    The first snapshots are kept, and absorbed again together while their number grows: what was linearized far from the
    truth is so no more.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 5, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> follows, seen = RigFilter(factory, obj), torch.ones(1, 4, 8, dtype=torch.bool)
        >>> for s in range(5):
        ...     there = Observations(truth.uv[[s]], torch.full(seen.shape, 0.05), seen)
        ...     result = follows.update(there, truth.rig_from_object[[s]], seconds=1 / 60)
        >>> follows.belief.std()[0, 6] < 0.1 * 0.02 * factory.focal_length[0, 0]  # the factory knew it to 2 %
        tensor(True)
    """

    def __init__(
        self,
        rig: CameraRig,
        obj: CalibrationObject,
        rate: DriftRate | None = None,
        options: EstimationOptions = EstimationOptions(),
        prior_std: Tensor | None = None,
    ) -> None:
        """Begin with the factory calibration.

        Args:
            rig: the factory calibration, without batch axes.
            obj: the calibration object.
            rate: how fast the rig wanders; None = as the rig says.
            options: how to minimize.
            prior_std: (C, K) how far the factory values may be off; None = as the rig says.
        """
        self.rate, self.options = rate or rig.drift_rate or DriftRate(), options
        self.belief = RigBelief.of_prior(rig, obj, prior_std)
        self.count = 0  # snapshots absorbed
        self._young = True  # the first snapshots are still kept
        self.pace = torch.ones_like(self.belief.unit)  # (C, K) times the rate at which values are believed to wander
        self._first = self.belief
        self._early: list[tuple[Observations, RigidTransform]] = []
        self._span = self._waited = 0.0  # s, since the first snapshot; of it, what the belief has not aged by

    @property
    def walk(self) -> Tensor:
        """How far every value is believed to wander in an hour, one standard deviation: (C, K)."""
        return self.rate.std(self.belief.rig) * self.pace

    @property
    def young(self) -> bool:
        """Tell whether the first snapshots are still kept, to be absorbed again."""
        return self._young

    @property
    def waited(self) -> float:
        """Time (s) by which the belief has not aged yet."""
        return self._waited

    def update(self, observations: Observations, rig_from_object: RigidTransform, seconds: float = 0.0) -> Absorbed:
        """Learn from a snapshot; where it is refused, nothing is learnt, and its time counts for the next one.

        Args:
            observations: (1, C, N).
            rig_from_object: (1,) first guess of the object's pose.
            seconds: since the update before.

        Raises:
            RefusedError: see `absorbed`.
        """
        result = self.follow(observations, rig_from_object, seconds)
        return self.relinearize() if self.due else result

    def follow(self, observations: Observations, rig_from_object: RigidTransform, seconds: float = 0.0) -> Absorbed:
        """Do the work of `update`, and leave it to the caller to `relinearize` where that is `due`."""
        passed = max(seconds, 0.0) if self.count else 0.0
        self._span, self._waited = self._span + passed, self._waited + passed
        due = self._waited if self._waited >= LEAST_SECONDS else 0.0
        result = absorbed(aged(self.belief, due, self.walk), observations, rig_from_object, self.options)
        self.belief, self._waited, self.count = result.belief, self._waited - due, self.count + 1
        still = self._span <= YOUNG_SECONDS or not any(vars(self.rate).values())  # a steady rig stands still for ever
        self._young = self._young and len(self._early) < MEMORY and still
        if self._young:
            self._early.append((observations, result.rig_from_object))
        else:
            self._early.clear()
        return result

    @property
    def due(self) -> bool:
        """Tell whether the first snapshots are to be absorbed together now."""
        return len(self._early) in TOGETHER

    def relinearize(self) -> Absorbed:
        """Absorb the first snapshots anew, all together; `rig_from_object` and `residual` are those of the last one."""
        result = absorbed(self._first, *joined(self._early), self.options)
        self.belief, self._waited = aged(result.belief, self._span, self.walk), 0.0
        return replace(result.of_last(), belief=self.belief)

    def restart(self, first: RigBelief, snapshots: Sequence[tuple[Observations, RigidTransform]]) -> Absorbed:
        """Begin anew: with what was believed before some snapshots, and these.

        Args:
            first: what was believed before them.
            snapshots: observations (1, C, N) and the object's pose (1,) of each.

        Raises:
            RefusedError: see `absorbed`; the filter stays as it was.
        """
        result = absorbed(first, *joined(snapshots), self.options)
        self.belief, self._first, self._early = result.belief, first, list(snapshots)
        self._young, self._span, self._waited = True, 0.0, 0.0
        return result

    def suppose(self, first: RigBelief, belief: RigBelief) -> None:
        """Hold other beliefs: before the first snapshots that are kept, and now."""
        self._first, self.belief, self._waited = first, belief, 0.0


def joined(snapshots: Sequence[tuple[Observations, RigidTransform]]) -> tuple[Observations, RigidTransform]:
    """Put snapshots together: (S, C, N) and (S,)."""
    observations, poses = zip(*snapshots, strict=True)
    values = (torch.cat([getattr(part, name) for part in observations]) for name in ("uv", "sigma", "seen"))
    return Observations(*values), RigidTransform.cat(poses)


@dataclass(frozen=True)
class _Linearization:
    """Snapshots at a rig, an object and poses, and what a belief says there."""

    belief: RigBelief
    problem: Problem  # one rig a snapshot, all the same; its factory is the rig, its prior's spread the belief's unit
    state: State  # no offset: the rig is the problem's
    options: EstimationOptions
    equations: NormalEquations  # of each snapshot
    distance: Tensor  # (D,) from the belief's rig and object, in units
    cost: float

    @classmethod
    def of(
        cls,
        belief: RigBelief,
        observations: Observations,
        rig_from_object: RigidTransform,
        options: EstimationOptions,
    ) -> _Linearization:
        """Begin at the belief."""
        alone = Observations(*(x.unsqueeze(1) for x in (observations.uv, observations.sigma, observations.seen)))
        count = len(observations.uv)
        problem = make_problem(alone, belief.rig.expand(count), belief.obj, belief.unit)
        state = initial_state(problem, rig_from_object.reshape(count, 1), None)
        if state.object_offset is not None:
            state = replace(state, object_offset=belief.object_offset.expand(count, -1))
        return cls._at(belief, problem, state, options)

    @classmethod
    def _at(cls, belief: RigBelief, problem: Problem, state: State, options: EstimationOptions) -> _Linearization:
        equations = equations_at(problem, state, make_loss(options))
        own = state.object_offset
        cameras = (error_between(problem.factory[0], belief.rig) / belief.unit).flatten()
        change = cameras if own is None else torch.cat((cameras, own[0] - belief.object_offset))
        prior = 0.5 * float((belief.factor.mT @ change).square().sum())
        data = float(equations.cost.sum()) - (0.0 if own is None else 0.5 * float(own.square().sum()))
        return cls(belief, problem, state, options, equations, change, prior + data)

    def step(self, damping: float) -> tuple[Tensor, float, Tensor, Brought]:
        """Newton's step.

        The derivative of the distance by the error is taken as the unit matrix. It is nearly so, and what it adds would
        pull along motions of the whole rig, of which the belief knows nothing.

        Returns:
            The step (D,) of cameras and object, by how much it should lower the cost, and the factor (D, D) of the
            information, and what the snapshots say by themselves.
        """
        brought = self._brought()
        information = brought.information() + self.belief.information
        pull = brought.pull.sum(0) - self.belief.factor @ (self.belief.factor.mT @ self.distance)
        damped = factor = _cholesky(information)
        if damping:
            damped = _cholesky(information + damping * information.diagonal().diag())
        step = torch.cholesky_solve(pull[:, None], damped)[:, 0]
        right = self.equations.pose_gradient[:, 0]
        gain = 0.5 * float((right * _solved(self.equations.pose[:, 0], right)).sum())
        return step, gain + 0.5 * float(step @ pull), factor, brought

    def moved(self, step: Tensor) -> _Linearization:
        """Take a step of cameras and object; poses follow."""
        problem, state, equations = self.problem, self.state, self.equations
        wide = problem.prior_std[0].numel()
        error = step[:wide].view(problem.prior_std.shape[1:])
        by_offset = torch.einsum("cij,cj->ci", self._basis(), error)
        right = equations.pose_gradient[:, 0] + torch.einsum("scip,ci->sp", equations.coupling[:, 0], by_offset)
        own = step[wide:]
        if equations.object is not None:
            right = right + equations.object.pose[:, 0] @ own
        pose = -_solved(equations.pose[:, 0], right)
        own_step = None if equations.object is None else own.expand(len(pose), -1)
        state = retract(problem, state, torch.zeros_like(state.offset), pose.unsqueeze(1), own_step)
        rig = displaced(problem.factory[0], error * self.belief.unit)
        problem = replace(problem, factory=rig.expand(len(pose)))
        return self._at(self.belief, problem, state, self.options)

    def absorbed(self, factor: Tensor, brought: Brought) -> Absorbed:
        """What is known now, its information being that of the last step, which was hardly any."""
        own = self.state.object_offset
        belief = replace(
            self.belief,
            rig=self.problem.factory[0],
            object_offset=self.belief.object_offset if own is None else own[0],
            factor=factor,
        )
        seen = (self.problem.root_weight > 0)[:, 0]
        residual = torch.where(seen.unsqueeze(-2), self.equations.residual[:, 0], 0.0).mT
        poses = pose_at(self.problem, self.state)
        dof = 2 * int(seen.sum()) - 6 * len(seen)
        known = self.belief.factor.diagonal().log().sum() - factor.diagonal().log().sum()
        evidence = float(known) - self.cost
        rest = (poses.reshape(len(seen)), residual, 2 * self.cost, dof, evidence)
        return Absorbed(belief, *rest, self.belief, brought)

    def _basis(self) -> Tensor:
        """Whitened offsets of the problem by errors in units: (C, K, K)."""
        return _whitened(step_by_error(self.problem.factory[0]), self.belief.unit)

    def _brought(self) -> Brought:
        """What the snapshots say about cameras and object, poses eliminated."""
        equations, own, offset = self.equations, self.equations.object, self.state.object_offset
        basis = self._basis()
        camera = equations.camera - torch.eye(equations.camera.shape[-1], dtype=torch.float64)
        pull = torch.einsum("cij,sci->scj", basis, equations.camera_gradient).flatten(1)
        coupling = (basis.mT @ equations.coupling[:, 0]).flatten(1, 2)  # (S, K C, 6)
        border, there = pull.new_zeros(len(pull), 0, pull.shape[1]), pull.new_zeros(0)
        if own is not None and offset is not None:
            coupling = torch.cat((coupling, own.pose[:, 0].mT), dim=1)
            pull = torch.cat((pull, own.gradient - offset), dim=1)
            across = torch.einsum("cij,scim->smcj", basis, own.camera).flatten(2)
            alone = own.own - torch.eye(own.own.shape[-1], dtype=torch.float64)
            border, there = torch.cat((across, alone), dim=2), offset[0]
        factor, failed = torch.linalg.cholesky_ex(equations.pose[:, 0])
        if bool(failed.any()):
            raise RefusedError(f"estimation: {WHY_NOT[rig_filter_cpu.NO_POSE]}")
        carried = torch.linalg.solve_triangular(factor, coupling.mT, upper=False)  # (S, 6, D)
        gradient = torch.linalg.solve_triangular(factor, equations.pose_gradient[:, 0, :, None], upper=False)
        pull = (carried.mT @ gradient)[..., 0] - pull
        blocks = basis.mT @ camera @ basis
        return Brought(self.problem.factory[0], there, self.belief.unit, blocks, border, carried, pull)


def _cholesky(matrix: Tensor) -> Tensor:
    """Factorize what is positive definite but for rounding.

    Raises:
        RefusedError: it is not.
    """
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if bool(failed):
        raise RefusedError(f"estimation: {WHY_NOT[rig_filter_cpu.NOTHING_KNOWN]}")
    return factor


def _solved(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Solve (S, 6, 6) systems for (S, 6)."""
    return torch.linalg.solve(matrices, vectors[..., None])[..., 0]


def _whitened(step: Tensor, unit: Tensor) -> Tensor:
    """Whitened offsets by errors in units, of the derivative of a step by an error: (C, K, K)."""
    return step * unit[:, None, :] / unit[:, :, None]
