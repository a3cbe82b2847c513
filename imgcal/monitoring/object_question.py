"""Is the object still as it was? What makes one ask, and what is asked: snapshots that fit worse than is usual."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform
from imgcal.monitoring.cusum import Cusum, RunningMedian
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.object_change import ObjectChange, changed_object
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief
from imgcal.monitoring.shaking import shaken
from imgcal.types import Observations

FALSE_ALARMS = 1e9
"""Snapshots for one false alarm of misfit, which is then asked whether the object has changed."""
MOST_MISFIT = 4.0
"""Standard deviations by which one snapshot counts at most."""
LEAST_USUAL = 30
"""Snapshots from which it is known how well they usually fit."""
OBJECT_ODDS = 30.0
"""Log odds from which the object has changed where no camera has."""
OBJECT_ASKED, MOST_FIRST = (8, 16, 32, 64), 2.0
"""Numbers of first snapshots, and the standard deviations that chi-squared must be more than is expected, from which it
is asked whether the object never was as its file says."""


@dataclass
class Misfit:
    """Notices that snapshots fit worse than is usual.

    Examples:
        >>> watch = Misfit()
        >>> watch.take(chi2=50.0, dof=48)
        0
    """

    risen: Cusum = field(default_factory=lambda: Cusum(1, 1.0, FALSE_ALARMS))
    usual: RunningMedian = field(default_factory=lambda: RunningMedian(256))

    def take(self, chi2: float, dof: int) -> int:
        """Number of snapshots that fit worse than is usual, this one included; 0 = they fit."""
        ratio = chi2 / max(dof, 1)
        self.usual.append(ratio)
        step = (ratio / self.usual.value - 1) * math.sqrt(max(dof, 1) / 2)
        risen = self.risen.update([min(step, MOST_MISFIT)])
        return int(self.risen.found[0]) if risen[0] and len(self.usual) >= LEAST_USUAL else 0


def never_fitted(result: MeasurementUpdate, count: int) -> bool:
    """Tell whether the first snapshots, absorbed together, fit so badly that the object may never have been as said."""
    return count in OBJECT_ASKED and result.chi2 - result.dof >= MOST_FIRST * math.sqrt(2 * result.dof)


def object_explains(
    before: RigBelief, snapshots: Sequence[tuple[Observations, RigidTransform]], options: EstimationOptions
) -> tuple[ObjectChange, RigBelief] | None:
    """Ask whether a change of the object explains snapshots that a steady rig, or one that shakes, does not.

    See `changed_object`.

    Raises:
        RefusedError: see `absorb`.
    """
    steady, shaking = absorb(before, *stack_snapshots(snapshots), options), shaken(before, snapshots, (), options)
    if shaking is not None:
        steady = replace(steady, evidence=max(steady.evidence, shaking.evidence))
    return changed_object(before, snapshots, options, steady, OBJECT_ODDS)
