"""Explain by a lens that differs from its model where the image has shown few labels, mostly near its border."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch

from imgcal.errors import RefusedError
from imgcal.monitoring.case import Case, Explanation, Variant
from imgcal.monitoring.rig_belief import RigBelief
from imgcal.types import PARAMETER_KINDS

MISFIT = 4.0
"""True errors of a lens model beyond the labels that determined it, relative to their standard deviation. Two halves of
a recording of ten real cameras: 2.6 to 3.6 where their labels did not overlap, 1 elsewhere."""


class LensMisfit(Explanation):
    """The distortion of a suspected camera is less certain than its covariance says.

    A polynomial that fits its labels need not fit beyond them. Where labels are dense, the covariance is so small that
    a multiple of it moves no image.
    """

    name = "lens misfit"

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """Widen the distortion of the suspected cameras."""
        if not case.cameras:
            raise RefusedError("no camera is suspected")
        return [partial(_widen, case)]


def _widen(case: Case) -> Variant:
    return Variant(widen_distortion(case.before, case.cameras), case.latest)


def widen_distortion(belief: RigBelief, cameras: Sequence[int]) -> RigBelief:
    """Multiply the standard deviations of the distortion of some cameras by `MISFIT`."""
    covariance, width = torch.cholesky_inverse(belief.factor), belief.rig.num_parameters
    first = PARAMETER_KINDS["distortion"].start
    for camera in cameras:
        own = slice(camera * width + first, (camera + 1) * width)
        covariance[own, own] *= MISFIT**2
    return belief.with_covariance(covariance)
