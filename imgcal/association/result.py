"""Results of identification, and the thresholds for their certainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from imgcal.geometry import RigidTransform
from imgcal.types import CameraRig

Status = Literal["unique", "by_prior", "by_tracking", "ambiguous", "refused"]
"""How a labelling was decided: by the blobs alone (`unique`, or `ambiguous` if the object's symmetry allows others), by
a pose from the user (`by_prior`), or by that of an earlier snapshot (`by_tracking`)."""


@dataclass(frozen=True)
class Identity:
    """Which blob is which fiducial, in one snapshot."""

    labels: NDArray[np.int64]  # (M,) fiducial of each blob, -1 = none or uncertain; all -1 if refused
    rig_from_object: RigidTransform | None  # pose of the best fit; None if nothing could be fitted
    rig: CameraRig | None  # drifted rig of the best fit, a start for estimation
    status: Status
    alternatives: int  # labellings that explain the blobs equally well: the object's symmetry order, 1 = unique
    margin: float  # log odds against the best different labelling; inf = there is none
    reason: str  # one line: why it was refused, or what decided
    explained: float = 0.0  # labelled share of the smaller number of blobs and visible fiducials, over the cameras
    hypotheses: int = 0  # number of hypotheses tried without a known pose
    undecided: bool = False  # refused because a different labelling explains the blobs nearly as well
    evidence: float = 0.0  # log odds against all blobs being clutter
    rival: NDArray[np.int64] | None = None  # (M,) a nearly equally good labelling of other blobs

    @property
    def accepted(self) -> bool:
        """Tell whether the labels may be used."""
        return self.status != "refused"


@dataclass(frozen=True)
class IdentityOptions:
    """How certain an identity must be."""

    label_odds: float = 1e5  # odds of a single label against a false blob or another fiducial
    least_label_odds: float = 1e2  # the same if dense false blobs allow few labels such certainty
    least_margin: float = 20.0  # log odds of the whole labelling against the best different one
    least_share: float = 0.45  # minimum labelled share of the smaller number of blobs and visible fiducials
    rounds: int = 24  # rounds of hypotheses before giving up
    most_hypotheses: int = 6_000_000  # the same in hypotheses: a large object has many per round
    seed: int = 0  # seed of the random choice of blob triples
    others_in_view: bool = False
    """Other objects may be in view, including a second copy of this one: a labelling of other blobs is then reported
    (`Identity.rival`) rather than a rival, and cameras that do not see the object need not explain anything."""
