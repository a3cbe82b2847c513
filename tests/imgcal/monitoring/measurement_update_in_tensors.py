"""`absorb` in tensors: the obvious way, on any device, which the compiled one is tested against."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import (
    EstimationOptions,
    NormalEquations,
    Problem,
    State,
    displace,
    equations_at,
    error_between,
    initial_state,
    make_loss,
    make_problem,
    pose_at,
    retract,
    step_by_error,
)
from imgcal.geometry import RigidTransform
from imgcal.monitoring import MeasurementUpdate, RigBelief, SnapshotInformation, measurement_update_cpu
from imgcal.monitoring.measurement_update_cpu import DAMPED, MOST_DAMPING, SLACK, STALLED, WHY_NOT
from imgcal.monitoring.rig_belief import cholesky_factor, whiten
from imgcal.types import Observations


def update_in_tensors(
    belief: RigBelief,
    observations: Observations,
    rig_from_object: RigidTransform,
    options: EstimationOptions = EstimationOptions(),
) -> MeasurementUpdate:
    """Do the work of `absorb` in tensors: on any device, and slowly."""
    at = _Linearization.of(belief, observations, rig_from_object, options)
    damping, light = 0.0, DAMPED
    for iteration in range(options.max_iterations):
        tolerance = options.tolerance * measurement_update_cpu.LOOSER ** max(
            0, iteration - measurement_update_cpu.LOOSEN_AFTER
        )
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
    raise RefusedError(f"estimation: {WHY_NOT[measurement_update_cpu.NO_MINIMUM]}")


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

    def step(self, damping: float) -> tuple[Tensor, float, Tensor, SnapshotInformation]:
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
        damped = factor = cholesky_factor(information)
        if damping:
            damped = cholesky_factor(information + damping * information.diagonal().diag())
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
        rig = displace(problem.factory[0], error * self.belief.unit)
        problem = replace(problem, factory=rig.expand(len(pose)))
        return self._at(self.belief, problem, state, self.options)

    def absorbed(self, factor: Tensor, brought: SnapshotInformation) -> MeasurementUpdate:
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
        return MeasurementUpdate(belief, *rest, self.belief, brought)

    def _basis(self) -> Tensor:
        """Whitened offsets of the problem by errors in units: (C, K, K)."""
        return whiten(step_by_error(self.problem.factory[0]), self.belief.unit)

    def _brought(self) -> SnapshotInformation:
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
            raise RefusedError(f"estimation: {WHY_NOT[measurement_update_cpu.NO_POSE]}")
        carried = torch.linalg.solve_triangular(factor, coupling.mT, upper=False)  # (S, 6, D)
        gradient = torch.linalg.solve_triangular(factor, equations.pose_gradient[:, 0, :, None], upper=False)
        pull = (carried.mT @ gradient)[..., 0] - pull
        blocks = basis.mT @ camera @ basis
        return SnapshotInformation(self.problem.factory[0], there, self.belief.unit, blocks, border, carried, pull)


def _solved(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Solve (S, 6, 6) systems for (S, 6)."""
    return torch.linalg.solve(matrices, vectors[..., None])[..., 0]
