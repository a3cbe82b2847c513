"""What identification decides about a snapshot, how certain it must be, and the orientation of symmetric objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform, geodesic_angle
from imgcal.types import CalibrationObject, CameraRig

Status = Literal["unique", "by_prior", "by_tracking", "ambiguous", "refused"]
"""How a labelling was decided: by the blobs alone (`unique`, or `ambiguous` if the object's symmetry allows others), by
a pose from the user (`by_prior`), or by that of an earlier snapshot (`by_tracking`)."""
BOARD_OUTLIER, BOARD_THRESHOLD = 50.0, 20.0
"""Printed boards, in standard deviations: labels beyond the first are left out, those beyond the second count less."""
CLEAR = 0.5
"""Maximum ratio of the angles of the nearest and the second nearest orientation for a given pose to decide."""
TOO_FEW_BLOBS = "too few blobs"
"""How the reason begins where no camera has as many blobs as a pose needs."""


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


@dataclass(frozen=True)
class PipelineOptions:
    """How certain the pipeline must be before it returns a result.

    Examples:
        >>> options = PipelineOptions(blind_cameras=True, most_outliers=0.1)
        >>> options.blind_cameras, options.outlier
        (True, 5.0)
    """

    identity: IdentityOptions = IdentityOptions()
    estimation: EstimationOptions = EstimationOptions()
    identity_error: float = 0.3  # px: error of a centre beyond its own sigma during identification
    least_fiducials: int = 4  # minimum number of different fiducials in a snapshot, over all cameras
    outlier: float = 5.0  # standard deviations beyond which a labelled blob is left out
    most_outliers: float = 0.25  # share of left-out blobs above which the data do not fit the object
    largest_additive_noise: float = 1.0  # px: unexplained residual above which the data do not fit the camera model
    largest_drift: float = 10.0  # maximum change of a single factory value, in prior standard deviations
    widest_prior: float = 4.0  # maximum factor by which a kind of value may have drifted more than its prior
    blind_cameras: bool = False  # accept cameras that saw nothing; they keep their factory values
    after_last_move: bool = False  # if a camera moved during the capture, use the snapshots after that
    start_pose: RigidTransform | None = None  # approximate rig_from_object of the first snapshot, against symmetry

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, int | float) and not value >= 0:
                raise InputError(f"{name}: found {value}, expected 0 or more")

    def of_object(self, obj: CalibrationObject) -> PipelineOptions:
        """Options for an object: a printed board's corners are labelled from the whole board.

        A large error is then rarely a wrong label. It comes from a lens that the model does not fit, in image regions
        with few corners: without those, the model would be unconstrained there.
        """
        if obj.board is None:
            return self
        estimation = replace(self.estimation, threshold=max(self.estimation.threshold, BOARD_THRESHOLD))
        return replace(self, outlier=max(self.outlier, BOARD_OUTLIER), estimation=estimation)

    def begin_at(self, pose: RigidTransform | None) -> PipelineOptions:
        """Options for later snapshots: the object's approximate pose in the first of them; None = not known."""
        return self if self.start_pose is None else replace(self, start_pose=pose)


def orient(identity: Identity, obj: CalibrationObject, given: RigidTransform) -> Identity:
    """Choose, among the labellings that the object's symmetry allows, the one whose orientation is nearest to a given
    pose.

    Args:
        identity: accepted.
        obj: the calibration object.
        given: approximate rig_from_object of this snapshot; all these labellings have the same centre, so only its
            rotation counts.

    Returns:
        `by_prior` if one is clearly nearest, otherwise unchanged: `ambiguous`.
    """
    pose = identity.rig_from_object
    assert pose is not None  # an accepted identity has one
    turns = torch.stack([torch.from_numpy(motion.rotation) for motion in obj.symmetries]).to(pose.rotation)
    angle = geodesic_angle(pose.rotation @ turns.mT, given.rotation.to(pose.rotation)).numpy()
    order = np.argsort(angle, kind="stable")
    if len(order) > 1 and angle[order[0]] > CLEAR * angle[order[1]]:
        return replace(identity, status="ambiguous", alternatives=len(order))
    motion = obj.symmetries[order[0]]
    rotation = pose.rotation @ turns[order[0]].mT
    shift = rotation @ torch.from_numpy(motion.translation).to(rotation)
    return replace(
        identity,
        labels=np.append(motion.permutation, -1)[identity.labels],
        rig_from_object=RigidTransform(rotation, pose.translation - shift),
        status="by_prior",
        alternatives=1,
    )
