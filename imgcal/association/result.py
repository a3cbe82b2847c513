"""What identity gives back, and the few numbers that decide how sure it must be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from imgcal.geometry import RigidTransform
from imgcal.types import CameraRig

Status = Literal["unique", "by_prior", "by_tracking", "ambiguous", "refused"]
"""How a labelling was decided: by the blobs alone (`unique`, or `ambiguous` where the object's symmetry allows others),
by a pose that the user gave (`by_prior`), by that of an earlier snapshot (`by_tracking`)."""


@dataclass(frozen=True)
class Identity:
    """Which blob is which fiducial, in one snapshot."""

    labels: NDArray[np.int64]  # (M,) fiducial of each blob, -1 = none or not certain; all -1 when refused
    rig_from_object: RigidTransform | None  # pose of the best fit; None when nothing could be fitted
    rig: CameraRig | None  # drifted rig of the best fit, a start for estimation
    status: Status
    alternatives: int  # labellings that explain the blobs equally well: the object's symmetry order, 1 = unique
    margin: float  # natural logarithm of the odds against the best different labelling; inf = none is left
    reason: str  # one line: why it was refused, or what decided
    explained: float = 0.0  # labelled part of what could be seen: in each camera, the smaller of blobs and fiducials
    hypotheses: int = 0  # that were tried where no pose was known
    undecided: bool = False  # refused because a different labelling explains the blobs nearly as well
    evidence: float = 0.0  # natural logarithm of the odds against all blobs being clutter
    rival: NDArray[np.int64] | None = None  # (M,) labels of another labelling that is nearly as good, of other blobs

    @property
    def accepted(self) -> bool:
        """Tell whether the labels may be used."""
        return self.status != "refused"


@dataclass(frozen=True)
class IdentityOptions:
    """How sure is sure."""

    label_odds: float = 1e5  # of a single label, against a false blob or another fiducial
    least_label_odds: float = 1e2  # the same where false blobs are so dense that few labels could be that certain
    least_margin: float = 20.0  # of the whole labelling against the best different one, natural logarithm
    least_share: float = (
        0.45  # explained part of what could be seen: the smaller of blobs and fiducials, camera by camera
    )
    rounds: int = 24  # of hypotheses before giving up
    most_hypotheses: int = 6_000_000  # the same in hypotheses: a large object has many a round
    seed: int = 0  # of the random choice of blob triples
    others_in_view: bool = False
    """Other objects may be in view, the same object once more among them: a labelling of other blobs is no rival, but
    reported (`Identity.rival`), and cameras that do not see the object have nothing to explain."""
