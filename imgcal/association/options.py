"""How certain a result must be before it is returned."""

from __future__ import annotations

from dataclasses import dataclass, replace

from imgcal.association.result import IdentityOptions
from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform
from imgcal.types import CalibrationObject

BOARD_OUTLIER, BOARD_THRESHOLD = 50.0, 20.0
"""Printed boards, in standard deviations: labels beyond the first are left out, those beyond the second count less."""


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
    identity_error: float = (
        0.3  # px: error of a centre beyond its own sigma (partly hidden markers) during identification
    )
    least_fiducials: int = 4  # minimum number of different fiducials in a snapshot, over all cameras
    outlier: float = 5.0  # standard deviations beyond which a labelled blob is left out
    most_outliers: float = 0.25  # share of left-out blobs above which the data do not fit the object
    largest_additive_noise: float = 1.0  # px: unexplained residual above which the data do not fit the camera model
    largest_drift: float = 10.0  # maximum change of a single factory value, in prior standard deviations
    widest_prior: float = 4.0  # maximum factor by which a kind of value may have drifted more than its prior
    blind_cameras: bool = False  # accept cameras that saw nothing; they keep their factory values
    after_last_move: bool = False  # if a camera moved during the capture, use the snapshots after that
    start_pose: RigidTransform | None = (
        None  # approximate rig_from_object of the first snapshot: resolves an object's symmetry
    )

    def of_object(self, obj: CalibrationObject) -> PipelineOptions:
        """Options for an object: a printed board's corners are labelled from the whole board.

        A large error is then rarely a wrong label. It comes from a lens that the model does not fit, in image regions
        with few
        corners: without those, the model would be unconstrained there.
        """
        if obj.board is None:
            return self
        estimation = replace(self.estimation, threshold=max(self.estimation.threshold, BOARD_THRESHOLD))
        return replace(self, outlier=max(self.outlier, BOARD_OUTLIER), estimation=estimation)
