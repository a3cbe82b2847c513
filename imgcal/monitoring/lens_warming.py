"""Have all lenses warmed up? Then every focal length grows, and the object seems to; it has not been exchanged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch

from imgcal.monitoring.case import Case, Explanation, Variant
from imgcal.monitoring.change_test import CHANGES
from imgcal.monitoring.rig_belief import widen_along

PACE, OWN_PACE = 3e-4, 1e-4
"""Relative change of all focal lengths in a second, one standard deviation, where lenses warm up or cool down, and by
how much each lens differs from that ..."""
LEAST_SECONDS, MOST_SECONDS = 1.0, 16.0
"""... for so long: what comes at once is no warming, and no lens goes on like that."""


class Warmed(Explanation):
    """The focal lengths of all cameras change slowly and nearly alike."""

    name = "warmed lenses"

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """Let all focal lengths free by as much as they may have changed since."""
        return [partial(_warm, case)]


def _warm(case: Case) -> Variant:
    seconds = min(max(sum(case.pauses[-case.count :]), LEAST_SECONDS), MOST_SECONDS)
    focal = torch.zeros_like(case.before.unit)
    focal[:, CHANGES["focal_length"]] = seconds * case.before.rig.focal_length
    own = torch.eye(len(focal), dtype=focal.dtype)[..., None] * focal
    return Variant(widen_along(case.before, torch.cat((PACE * focal[None], OWN_PACE * own))), case.latest)
