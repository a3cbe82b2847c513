"""Test whether the object has changed, not a camera: estimate with the object's shape or size free."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import object_prior_std
from imgcal.monitoring.case import SHAPE, Case, Explained, Explanation, Finding, ObjectChange, Variant
from imgcal.monitoring.cusum import Cusum, RunningMedian
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.pending_change import free_cameras
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief

# Prior standard deviations of a change.
ONE_MM = 3.0
"""Millimetres per axis: one fiducial was bent or moved."""
ALL_MM = 0.2
"""Millimetres per axis, for all fiducials: the object was made or measured less accurately than stated."""
SCALE_CHANGE = 0.1
"""Relative scale of the object."""

# Which changes of an object are tested, and how significant they must be.
ASKED_FIDUCIALS = 8
"""Maximum number of fiducials to test: if there are more, those with the largest residuals."""
PRINT_FIDUCIALS = 64
"""Objects with more fiducials than this are prints, in which no fiducial moves alone."""
LEAST_SIGMAS = 3.0
"""Minimum significance of a change, in standard deviations."""
MISFIT_LEAD = 30.0
"""Log odds against the next best explanation at which a change of the object is believed without a suspected camera:
a bad fit has many causes."""
LEAST_CAMERAS = 2
"""Number of cameras that must see the object in most snapshots: to one, a wrong label is a fiducial elsewhere."""
LEAST_GAIN = MISFIT_LEAD / 2
"""Least gain of log likelihood, with all fiducials free, for which the parts of the object are weighed: half of the
lead, because fits are not exact."""

# When the object is tested: snapshots fit worse than usual, or the first ones have never fitted.
SNAPSHOTS_PER_FALSE_ALARM = 1e9
MOST_STEP = 4.0
"""Maximum number of standard deviations that one snapshot counts for: a single bad one is no misfit."""
LEAST_USUAL = 30
"""Number of snapshots after which their usual fit is known."""
FIRST_ASKED, FIRST_SIGMAS = (8, 16, 32, 64), 2.0
"""Numbers of first snapshots to test, and standard deviations by which chi-squared must exceed its expectation."""


def free_object(belief: RigBelief, fiducial: int | None, by: float = ONE_MM) -> RigBelief:
    """Free a fiducial by a standard deviation in mm (`SHAPE`: all of them), or the scale if `fiducial` is None.

    Raises:
        RefusedError: nothing is known about the rig.
    """
    obj, known, wide = belief.obj, len(belief.object_offset), belief.unit.numel()
    if not known:
        tolerance = torch.zeros(obj.num_fiducials, dtype=torch.float64)
        if fiducial is not None:
            tolerance[slice(None) if fiducial == SHAPE else fiducial] = by
        obj = replace(obj, tolerance=tolerance, scale_tolerance=SCALE_CHANGE if fiducial is None else 0.0)
        size = 3 * obj.num_fiducials + 1
        factor = torch.eye(wide + size, dtype=torch.float64)
        factor[:wide, :wide] = belief.factor
        return replace(belief, obj=obj, object_offset=belief.object_offset.new_zeros(size), factor=factor)
    std = object_prior_std(obj)
    rows = _rows(known, fiducial)
    spread = torch.zeros(wide + known, dtype=torch.float64)
    spread[wide + rows] = (SCALE_CHANGE if fiducial is None else by) / std[rows].clamp_min(1e-6)
    covariance = torch.cholesky_inverse(belief.factor) + spread.square().diag()
    return belief.with_covariance(covariance)


def may_have_changed(case: Case) -> bool:
    """Tell whether a change of some part of the object may lead by `MISFIT_LEAD`, before all parts are weighed.

    No part improves the fit by more than all fiducials together, each free by `ONE_MM`. A change of scale that is
    too large for that still improves it by far more than the lead.
    """
    obj = case.before.obj
    if obj.unknown_markers:
        return False
    if obj.num_fiducials > PRINT_FIDUCIALS:  # one part
        return True
    observations, poses = stack_snapshots(case.latest)
    try:
        steady = absorb(case.before, observations, poses, case.options)
        free = absorb(free_object(case.before, SHAPE), observations, poses, case.options)
    except RefusedError:
        return True
    return 0.5 * (steady.chi2 - free.chi2) >= LEAST_GAIN


def _rows(known: int, fiducial: int | None) -> Tensor:
    """Indices in the object's offset that belong to a change of it."""
    rows = torch.arange(known)
    if fiducial is None:
        return rows[-1:]
    return rows[:-1] if fiducial == SHAPE else rows[3 * fiducial : 3 * fiducial + 3]


class ObjectChanged(Explanation):
    """One fiducial has moved, all have, or the scale of the object differs; the cameras stand still."""

    name = "object changed"

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """Free one part of the object at a time; each part takes as long as the whole object."""
        case.require_body()
        known: tuple[int | None, float] = (None, ONE_MM)
        if case.before.obj.num_fiducials > PRINT_FIDUCIALS:
            return [partial(_free_part, case, *known)]
        parts = [known, (SHAPE, ALL_MM), (SHAPE, ONE_MM), *((n, ONE_MM) for n in _suspected_fiducials(case))]
        return [partial(_free_part, case, *part) for part in parts]

    def premature(self, case: Case, found: Explained) -> str | None:
        """Wait while single cameras see the object."""
        cameras = torch.cat([one.seen.any(-1).sum(-1) for one, _ in case.latest])
        return None if 2 * int((cameras >= LEAST_CAMERAS).sum()) > len(cameras) else "a single camera sees the object"


def _free_part(case: Case, fiducial: int | None, by: float) -> Variant:
    """Free a part of the object: see `free_object`."""

    def find(result: MeasurementUpdate) -> Finding:
        size, sigma = _measure_change(case.before, result.belief, fiducial)
        if not abs(size) > LEAST_SIGMAS * sigma:
            raise RefusedError("no change of the object is significant")
        return Finding(object_change=ObjectChange(fiducial, 0, size, sigma, math.nan))

    return Variant(free_object(case.before, fiducial, by), case.latest, find=find)


def _suspected_fiducials(case: Case) -> list[int]:
    """Select the fiducials that may have moved: all that are seen, or those with the largest residuals.

    Raises:
        RefusedError: see `absorb`.
    """
    observations, poses = stack_snapshots(case.latest)
    count = observations.seen.sum((0, 1))
    found = count.nonzero()[:, 0].tolist()
    if len(found) > ASKED_FIDUCIALS:
        free = free_cameras(case.before, dict.fromkeys(case.cameras))
        residual = absorb(free, observations, poses, case.options).residual
        squared = torch.where(observations.seen, residual.square().sum(-1) / observations.sigma.square(), 0.0)
        mean = squared.sum((0, 1)) / count.clamp_min(1)
        found = mean.argsort(descending=True)[:ASKED_FIDUCIALS].tolist()
    return sorted(found)


def _measure_change(before: RigBelief, after: RigBelief, fiducial: int | None) -> tuple[float, float]:
    """Measure the size of a change and its standard deviation, for all fiducials without rigid motion and scale."""
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
    share = (3 / len(rows)) ** 0.5 if fiducial == SHAPE else 1.0  # per fiducial
    sigma = share * float((along @ covariance @ along).clamp_min(0).sqrt())
    return (float(change[0]) if fiducial is None else share * size), sigma


def _similarities(points: Tensor) -> Tensor:
    """Directions of fiducials (N, 3) in which an object moves, turns or grows without changing its shape: (3 N, 7)."""
    arms = points - points.mean(0)
    shifts = torch.eye(3).to(points).expand(len(points), -1, -1)
    turns = torch.linalg.cross(shifts[:1], arms[:, None], dim=-1)
    return torch.cat((shifts, turns, arms[:, None]), 1).movedim(1, -1).flatten(0, 1)


@dataclass
class Misfit:
    """Detects snapshots that fit worse than usual.

    Examples:
        >>> watch = Misfit()
        >>> watch.update(chi2=50.0, dof=48)
        0
    """

    risen: Cusum = field(default_factory=lambda: Cusum(1, 1.0, SNAPSHOTS_PER_FALSE_ALARM))
    usual: RunningMedian = field(default_factory=lambda: RunningMedian(256))

    def update(self, chi2: float, dof: int) -> int:
        """Number of snapshots that fit worse than usual, this one included; 0 = no misfit."""
        ratio = chi2 / max(dof, 1)
        self.usual.append(ratio)
        step = (ratio / self.usual.value - 1) * math.sqrt(max(dof, 1) / 2)
        risen = self.risen.update([min(step, MOST_STEP)])
        return int(self.risen.found[0]) if risen[0] and len(self.usual) >= LEAST_USUAL else 0


def has_never_fitted(result: MeasurementUpdate, count: int) -> bool:
    """Tell whether the first snapshots together fit so badly that the object may never have matched its file."""
    return count in FIRST_ASKED and result.chi2 - result.dof >= FIRST_SIGMAS * math.sqrt(2 * result.dof)
