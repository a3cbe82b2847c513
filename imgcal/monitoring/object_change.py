"""Has the object changed, not a camera? What is believed, with the object's shape or size let free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions, object_prior_std
from imgcal.geometry import RigidTransform
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief
from imgcal.types import Observations

BENT = 3.0
"""Millimetres, one standard deviation of each axis: how far a fiducial may be off that is."""
ROUGH = 0.2
"""The same of fiducials that are all off by a little, since the object was made or measured less well than is said."""
SCALED = 0.1
"""The same of the object's scale, relative."""
MOST_ASKED = 8
"""Fiducials that are asked whether they are off: those whose residuals are the largest."""
LEAST_SIGMAS = 3.0
"""Standard deviations by which it must have changed."""
MANY = 64
"""Fiducials of an object that is a print, from here on: none of them goes anywhere by itself."""

SHAPE = -1
"""In place of a fiducial's number: all of them are somewhere else."""


@dataclass(frozen=True)
class ObjectChange:
    """What happened to the object."""

    fiducial: int | None  # the one that is somewhere else, `SHAPE` = all; None = another scale: it is another object
    since: int  # number of the first snapshot, counted from 0, that saw it so
    size: float  # mm that the fiducial went (RMS of all), or the relative change of scale
    sigma: float  # one standard deviation of it
    odds: float  # log odds against that cameras have moved


def free_object(belief: RigBelief, fiducial: int | None, by: float = BENT) -> RigBelief:
    """Let a fiducial be off by so many mm (`SHAPE`: all of them), or, where that is None, the scale."""
    obj, known, wide = belief.obj, len(belief.object_offset), belief.unit.numel()
    if not known:
        tolerance = torch.zeros(obj.num_fiducials, dtype=torch.float64)
        if fiducial is not None:
            tolerance[slice(None) if fiducial == SHAPE else fiducial] = by
        obj = replace(obj, tolerance=tolerance, scale_tolerance=SCALED if fiducial is None else 0.0)
        size = 3 * obj.num_fiducials + 1
        factor = torch.eye(wide + size, dtype=torch.float64)
        factor[:wide, :wide] = belief.factor
        return replace(belief, obj=obj, object_offset=belief.object_offset.new_zeros(size), factor=factor)
    std = object_prior_std(obj)
    rows = _rows(known, fiducial)
    spread = torch.zeros(wide + known, dtype=torch.float64)
    spread[wide + rows] = (SCALED if fiducial is None else by) / std[rows].clamp_min(1e-6)
    covariance = torch.cholesky_inverse(belief.factor) + spread.square().diag()
    return replace(belief, factor=torch.linalg.cholesky(torch.cholesky_inverse(torch.linalg.cholesky(covariance))))


def _rows(known: int, fiducial: int | None) -> Tensor:
    """Which of the numbers of what is known of an object belong to a change of it."""
    rows = torch.arange(known)
    if fiducial is None:
        return rows[-1:]
    return rows[:-1] if fiducial == SHAPE else rows[3 * fiducial : 3 * fiducial + 3]


def changed_object(
    before: RigBelief,
    snapshots: Sequence[tuple[Observations, RigidTransform]],
    options: EstimationOptions,
    otherwise: MeasurementUpdate,
    least: float = 0.0,
) -> tuple[ObjectChange, RigBelief] | None:
    """Ask whether a change of the object explains some snapshots better than what is supposed else.

    Args:
        before: what was believed before them.
        snapshots: observations (1, C, N) and the object's pose (1,) of each.
        options: how to minimize.
        otherwise: the same snapshots absorbed where the object has not changed, cameras that moved being let free.
        least: log odds against that from which the object has changed.

    Returns:
        The most probable change, its `since` being zero, and what was believed before with that let free; None =
        the object has not changed.
    """
    given = stack_snapshots(list(snapshots))
    cameras = otherwise.evidence + least
    best: tuple[float, int | None, MeasurementUpdate] | None = None
    for fiducial, by in _doubtful(given[0], otherwise.residual):
        try:
            result = absorb(free_object(before, fiducial, by), *given, options)
        except RefusedError:
            continue
        if best is None or result.evidence > best[0]:
            best = result.evidence, fiducial, result
    if best is None or best[0] <= cameras:
        return None
    evidence, fiducial, result = best
    size, sigma = _size(before, result.belief, fiducial)
    if not abs(size) > LEAST_SIGMAS * sigma:
        return None
    return ObjectChange(fiducial, 0, size, sigma, evidence - cameras), result.before


def _doubtful(observations: Observations, residual: Tensor) -> list[tuple[int | None, float]]:
    """What may be off, and by how much: each question takes as long as all that is known of the object."""
    scale: tuple[int | None, float] = (None, BENT)
    if observations.seen.shape[-1] > MANY:
        return [scale]
    squared = torch.where(observations.seen, (residual.square().sum(-1) / observations.sigma.square()), 0.0)
    count = observations.seen.sum((0, 1))
    mean = squared.sum((0, 1)) / count.clamp_min(1)
    found = [int(n) for n in mean.argsort(descending=True) if int(count[n])]
    return [scale, (SHAPE, ROUGH), (SHAPE, BENT), *((n, BENT) for n in sorted(found[:MOST_ASKED]))]


def _size(before: RigBelief, after: RigBelief, fiducial: int | None) -> tuple[float, float]:
    """How far it went, and the standard deviation of that: of all fiducials what is no motion and no scale."""
    std = object_prior_std(after.obj)
    rows = _rows(len(std), fiducial)
    was = before.object_offset if len(before.object_offset) else torch.zeros_like(std)
    change: Tensor = ((after.object_offset - was) * std)[rows]
    wide = after.unit.numel()
    covariance = torch.cholesky_inverse(after.factor)[wide:, wide:][rows[:, None], rows] * std[rows] * std[rows, None]
    if fiducial == SHAPE:
        motions, _ = torch.linalg.qr(_similarities(after.obj.points))
        change = change - motions @ (motions.mT @ change)
    size = float(change.norm())
    along = change / max(size, 1e-30)
    share = (3 / len(rows)) ** 0.5 if fiducial == SHAPE else 1.0  # of one fiducial
    sigma = share * float((along @ covariance @ along).clamp_min(0).sqrt())
    return (float(change[0]) if fiducial is None else share * size), sigma


def _similarities(points: Tensor) -> Tensor:
    """Directions of fiducials (N, 3) in which an object moves, turns or grows and keeps its shape: (3 N, 7)."""
    arms = points - points.mean(0)
    shifts, turns = (
        torch.eye(3).to(points).expand(len(points), -1, -1),
        torch.linalg.cross(torch.eye(3).to(points)[None], arms[:, None], dim=-1),
    )
    return torch.cat((shifts, turns, arms[:, None]), 1).movedim(1, -1).flatten(0, 1)
