"""Explain by lenses that warm up together: all focal lengths grow, so the same object seems to grow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch

from imgcal.monitoring.case import Case, Explanation, Variant
from imgcal.monitoring.change_test import CHANGES
from imgcal.monitoring.rig_belief import widen_along

PACE, OWN_PACE = 3e-4, 1e-4
"""Relative change per second, one standard deviation, of all focal lengths together as lenses warm up or cool down; the
same of each lens relative to the others ..."""
LEAST_SECONDS, MOST_SECONDS = 1.0, 16.0
"""... and how long it may last: a sudden change is not warming, and warming ends."""


class Warmed(Explanation):
    """The focal lengths of all cameras change slowly and nearly alike."""

    name = "warmed lenses"

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """Free all focal lengths by as much as they may have changed since."""
        return [partial(_warm, case)]


def _warm(case: Case) -> Variant:
    seconds = min(max(sum(case.pauses[-case.count :]), LEAST_SECONDS), MOST_SECONDS)
    focal = torch.zeros_like(case.before.unit)
    focal[:, CHANGES["focal_length"]] = seconds * case.before.rig.focal_length
    own = torch.eye(len(focal), dtype=focal.dtype)[..., None] * focal
    return Variant(widen_along(case.before, torch.cat((PACE * focal[None], OWN_PACE * own))), case.latest)
