"""Absorb labelled snapshots of a rig that stood still: `absorb`.

The state is the parameters of every camera and, if the object has tolerances, of the object. The object's pose is
eliminated from each snapshot. Snapshots that are absorbed together are linearized at their joint estimate; `RigFilter`
does so with its first ones.

Each light has its own position in each snapshot, which is eliminated; a light seen by one camera adds no information.
Known distances between lights (a stick, several objects) are rows of the same equations: see `known_distances.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions, levenberg_marquardt_cpu
from imgcal.geometry import RigidTransform
from imgcal.monitoring import measurement_update_cpu
from imgcal.monitoring.known_distances import KnownDistances, known_distances
from imgcal.monitoring.measurement_update_cpu import DAMPED, MOST_DAMPING, SLACK, STALLED, WHY_NOT
from imgcal.monitoring.rig_arrays import RigArrays
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief
from imgcal.monitoring.snapshot_information import SnapshotInformation
from imgcal.types import CameraRig, Observations, has_plausible_values


def absorb(
    belief: RigBelief,
    observations: Observations,
    rig_from_object: RigidTransform,
    options: EstimationOptions = EstimationOptions(),
    start: RigBelief | None = None,
) -> MeasurementUpdate:
    """Learn from labelled snapshots of a rig that stood still while they were taken.

    Args:
        belief: what is known before the snapshots.
        observations: (S, C, N) of the object of `belief`.
        rig_from_object: (S,) first guess of the object's poses; (S, N) for lights, see `CalibrationObject.unknown`.
        options: how to minimize.
        start: a belief about the same rig and object at which to start, which saves iterations; None = `belief`.

    Raises:
        RefusedError: the observations do not determine the object's pose, no minimum was found, or the rig there has
            impossible values, such as a negative focal length.
        ValueError: the number of poses differs from the number of snapshots.
    """
    if rig_from_object.translation.shape[0] != observations.seen.shape[0]:
        counts = f"{rig_from_object.translation.shape[0]} poses of {observations.seen.shape[0]} snapshots"
        raise ValueError(f"rig_from_object: found {counts}, expected one pose per snapshot")
    constants, unit, shake = belief.constants, belief.unit, observations.shake
    given, shown = rig_from_object, None
    if belief.obj.unknown_markers:
        observations, rig_from_object, shown = _select_lights(observations, rig_from_object)
    seen = observations.seen.numpy()
    uv = np.where(seen[..., None], observations.uv.numpy(), 0.0).astype(np.float64, copy=False)
    uv = np.ascontiguousarray(uv.swapaxes(-1, -2))
    sigma = np.where(seen, observations.sigma.numpy(), np.inf)
    rotation = np.ascontiguousarray(rig_from_object.rotation.detach().double().reshape(-1, 3, 3).numpy())
    translation = rig_from_object.translation.detach().double().reshape(-1, 3).numpy()
    centre, shared = translation + rotation @ constants.centroid, constants.shared
    if shown is not None:
        centre, rotation = centre.reshape(len(seen), -1, 3), rotation[: len(seen)]
        shared = (*(None if part is None else part[: seen.shape[2]] for part in shared[:2]), shared[2])
    distances = KnownDistances.empty(len(seen)) if shown is None else shown.distances(constants.parts)
    shaken = np.empty((0, 0)) if shake is None else np.ascontiguousarray(shake.double().numpy())
    loss = (levenberg_marquardt_cpu.LOSS_CODES[options.loss], float(options.threshold))
    found = measurement_update_cpu.absorb(
        shared,
        (uv, (1 / sigma).astype(np.float64, copy=False), shaken),
        distances.arrays,
        (belief.arrays, unit.numpy(), belief.object_offset.numpy(), constants.own_std, belief.information.numpy()),
        (rotation, centre),
        (*loss, options.max_iterations, options.tolerance, SLACK, DAMPED, STALLED, MOST_DAMPING),
        None if start is None else (start.arrays, start.object_offset.numpy()),
    )
    if found.status:
        raise RefusedError(f"estimation: {WHY_NOT[found.status]}")
    own, factor = torch.from_numpy(found.own), torch.from_numpy(found.factor)
    rig = _make_rig(found.rig, belief.rig)
    if not has_plausible_values(rig):
        raise RefusedError("estimation: only a rig with impossible values explains these observations")
    now = RigBelief(rig, belief.obj, own, factor, unit)
    carried = found.carried
    if carried.shape[1] < 6:  # a single light
        carried = np.concatenate((carried, np.zeros((len(carried), 6 - carried.shape[1], carried.shape[2]))), 1)
    brought = SnapshotInformation(
        _make_rig(found.from_rig, belief.rig), torch.from_numpy(found.from_own), unit,
        *(torch.from_numpy(part) for part in (found.camera, found.border, carried, found.pull)),
    )  # fmt: skip
    # Set the cached properties: their values are at hand.
    half_log_determinant = float(np.log(found.factor.diagonal()).sum())
    information = torch.from_numpy(found.information)
    vars(now).update(information=information, arrays=found.rig, constants=constants)
    vars(now).update(half_log_determinant=half_log_determinant)
    vars(brought).update(arrays=found.from_rig)
    residual = torch.from_numpy(np.where(seen[..., None], found.residual.swapaxes(-1, -2), 0.0))
    evidence = belief.half_log_determinant - half_log_determinant - found.cost
    if shake is not None:
        evidence -= float(np.log1p(shake.numpy() ** 2 * np.square(1 / sigma).sum(-1)).sum())
    freedom = constants.pose_rank * len(seen)
    if shown is None:
        translation = found.centre - found.rotation @ constants.centroid
        poses = RigidTransform(torch.from_numpy(found.rotation), torch.from_numpy(translation))
    else:
        freedom = 3 * int(seen.any(1).sum()) - distances.numbers
        poses = shown.places(given, torch.from_numpy(found.centre))
        residual = shown.of_all(residual, given.translation.shape[1])
    dof = 2 * int(np.count_nonzero(seen)) - freedom
    return MeasurementUpdate(now, poses, residual, 2 * found.cost, dof, evidence, belief, brought)


def _make_rig(values: RigArrays, like: CameraRig) -> CameraRig:
    """Make a rig with these values; `replace` would take longer than a projection."""
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


def stack_snapshots(snapshots: Sequence[tuple[Observations, RigidTransform]]) -> tuple[Observations, RigidTransform]:
    """Concatenate snapshots: (S, C, N) and (S,)."""
    observations, poses = zip(*snapshots, strict=True)
    uv, sigma, seen = (torch.cat([getattr(part, name) for part in observations]) for name in ("uv", "sigma", "seen"))
    shake = None
    if any(part.shake is not None for part in observations):
        still = torch.zeros(1, observations[0].seen.shape[1], dtype=torch.float64)
        parts = [still.expand(len(part.seen), -1) if part.shake is None else part.shake for part in observations]
        shake = torch.cat(parts)
    return Observations(uv, sigma, seen, shake), RigidTransform.cat(poses)


@dataclass(frozen=True)
class _Shown:
    """The lights of each snapshot that enter the equations, and their columns."""

    number: Tensor  # (S, M) number of the light in each column
    used: Tensor  # (S, M) bool: the column is not empty

    def distances(self, parts: Sequence[tuple[int, NDArray[np.float64]]]) -> KnownDistances:
        """Known distances between them, from the first number and the markers of each known object."""
        return known_distances(parts, self.number.numpy(), self.used.numpy())

    def places(self, given: RigidTransform, centre: Tensor) -> RigidTransform:
        """Replace the given positions (S, N) by estimated positions (S, M, 3)."""
        places = given.translation.detach().double().clone()
        snapshot, column = self.used.nonzero(as_tuple=True)
        places[snapshot, self.number[snapshot, column]] = centre[snapshot, column]
        return RigidTransform(given.rotation.detach().double(), places)

    def of_all(self, residual: Tensor, count: int) -> Tensor:
        """Scatter residuals (S, C, M, 2) to all lights: (S, C, N, 2)."""
        every = residual.new_zeros(*residual.shape[:2], count, 2)
        snapshot, column = self.used.nonzero(as_tuple=True)
        every[snapshot, :, self.number[snapshot, column]] = residual[snapshot, :, column]
        return every


def _select_lights(
    observations: Observations, rig_from_object: RigidTransform
) -> tuple[Observations, RigidTransform, _Shown]:
    """Keep the lights that two cameras see: (S, C, M) and (S, M), with M the largest number in a snapshot.

    Raises:
        RefusedError: there are none.
    """
    known = (observations.seen.sum(1) >= 2) & rig_from_object.translation.isfinite().all(-1)  # (S, N)
    most = int(known.sum(1).max())
    if not most:
        raise RefusedError("estimation: no light is seen by two cameras")
    used, number = known.int().sort(dim=1, descending=True, stable=True)
    used, number = used[:, :most] > 0, number[:, :most]
    column = number[:, None].expand(-1, observations.seen.shape[1], -1)
    seen = observations.seen.gather(2, column) & used[:, None]
    uv = observations.uv.gather(2, column[..., None].expand(-1, -1, -1, 2))
    kept = Observations(uv, observations.sigma.gather(2, column), seen, observations.shake)
    snapshot = torch.arange(len(number))[:, None]
    places = rig_from_object.translation.detach().double()[snapshot, number].nan_to_num()
    return kept, RigidTransform(rig_from_object.rotation.detach()[snapshot, number], places), _Shown(number, used)
