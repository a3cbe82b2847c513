"""Have cameras moved, or have their clocks slipped? Both are supposed of the same snapshots, and compared."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from imgcal.errors import RefusedError
from imgcal.estimation.absorption import absorbed, joined
from imgcal.estimation.clock_slip import Slipped, slipped
from imgcal.estimation.map_estimate import EstimationOptions
from imgcal.estimation.open_change import let_free
from imgcal.estimation.rig_belief import RigBelief
from imgcal.estimation.rig_changes import JUMPS
from imgcal.geometry import RigidTransform
from imgcal.types import Observations

SLIP_ODDS = 5.0
"""Log odds from which it is a clock that has slipped, not a camera that has moved, or the other way round ..."""
SLIP_PATIENCE = 16
"""... and the snapshots for which that is waited for, before it is what is more probable."""


@dataclass(frozen=True)
class Suspicion:
    """Cameras that seem to have moved before some snapshots."""

    before: RigBelief  # what was believed before them
    snapshots: list[tuple[Observations, RigidTransform]]  # and earlier ones, which say how the object moves
    pauses: list[float]  # s before each
    count: int  # of those since then
    cameras: Mapping[int, str | None]  # the surest first
    first: RigBelief | None = None  # what was believed before all of them, where that is what the factory says

    def clocks(self, options: EstimationOptions) -> tuple[float, Slipped | None]:
        """Suppose that it is the clocks of all these cameras that have slipped, or of the first alone.

        Returns:
            Log odds of slips against moves, and the slips, where there is an earlier belief also of ones before
            everything; -inf and None = no slips explain what was seen.
        """
        some = [tuple(self.cameras)[:1], tuple(self.cameras)]
        moved, found = self._moved(options), list[tuple[float, Slipped]]()
        for cameras in dict.fromkeys(some):
            with contextlib.suppress(RefusedError):
                late = slipped(self.before, self.snapshots, self.pauses, self.count, cameras, options)
                if late is not None:
                    found.append((late.evidence - moved, late))
        if self.first is not None and self.count < len(self.snapshots):
            count = len(self.snapshots)
            with contextlib.suppress(RefusedError):
                earlier = absorbed(self.first, *joined(self.snapshots[: -self.count]), options).evidence
                late = slipped(self.first, self.snapshots, self.pauses, count, some[0], options, wide=True)
                if late is not None:
                    found.append((late.evidence - earlier - moved, late))
        return max(found, key=lambda one: one[0], default=(-math.inf, None))

    def _moved(self, options: EstimationOptions) -> float:
        """Log probability of the snapshots since, the cameras having moved."""
        found = []
        for jump in JUMPS:
            with contextlib.suppress(RefusedError):
                free = let_free(self.before, self.cameras, jump)
                found.append(absorbed(free, *joined(self.snapshots[-self.count :]), options).evidence)
        return float(np.logaddexp.reduce(found)) - math.log(len(JUMPS)) if found else -math.inf


@dataclass
class SlipQuestion:
    """Asks of each suspicion whether it is clocks, and waits for a while where that cannot be told."""

    unsure: int = 0  # snapshots in a row that might tell of a slip or of a move

    def ask(self, suspicion: Suspicion, since: int, options: EstimationOptions, patient: bool) -> Slipped | None:
        """Ask whether clocks have slipped of cameras that seem to have moved.

        Args:
            suspicion: which, and what was seen.
            since: number of the first snapshot since then.
            options: how to minimize.
            patient: it may be waited for.

        Returns:
            What slips make of the snapshots; None = the cameras have moved.

        Raises:
            RefusedError: it cannot be told yet.
        """
        odds, found = suspicion.clocks(options)
        self.unsure = self.unsure + 1 if abs(odds) < SLIP_ODDS else 0
        if 0 < self.unsure <= SLIP_PATIENCE and patient:
            raise RefusedError("estimation: it cannot be told yet whether a camera has moved, or its clock slipped")
        self.unsure = 0
        if found is None or odds < 0:
            return None
        since -= len(found.snapshots) - suspicion.count
        return replace(found, slips=tuple(replace(slip, since=since, odds=odds) for slip in found.slips))
