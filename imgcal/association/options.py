"""How sure the tool must be before it gives an answer."""

from __future__ import annotations

from dataclasses import dataclass, replace

from imgcal.association.result import IdentityOptions
from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform
from imgcal.types import CalibrationObject

BOARD_OUTLIER, BOARD_THRESHOLD = 50.0, 20.0
"""Standard deviations, of a printed board: labels are left out beyond the first, and count less beyond the second."""


@dataclass(frozen=True)
class PipelineOptions:
    """How sure the pipeline must be before it gives an answer.

    Examples:
        >>> options = PipelineOptions(blind_cameras=True, most_outliers=0.1)
        >>> options.blind_cameras, options.outlier
        (True, 5.0)
    """

    identity: IdentityOptions = IdentityOptions()
    estimation: EstimationOptions = EstimationOptions()
    identity_error: float = (
        0.3  # px: what a centre may be off beyond its own sigma (partly hidden markers) while blobs are told apart
    )
    least_fiducials: int = 4  # different fiducials that a snapshot must show, all cameras together
    outlier: float = 5.0  # standard deviations beyond which a labelled blob is left out
    most_outliers: float = 0.25  # share of left-out blobs above which the data do not fit the object
    largest_additive_noise: float = 1.0  # px: unexplained residual above which the data do not fit the camera model
    largest_drift: float = 10.0  # prior standard deviations that one factory value may be off
    widest_prior: float = 4.0  # factor by which a kind of factory values may have drifted more than the prior says
    blind_cameras: bool = False  # accept cameras that saw nothing; they keep their factory values
    after_last_move: bool = False  # where a camera moved during the capture, use the snapshots since then
    start_pose: RigidTransform | None = (
        None  # rig_from_object of the first snapshot, roughly: decides which way round a symmetric object is
    )

    def of_object(self, obj: CalibrationObject) -> PipelineOptions:
        """What holds for an object: corners of a printed board are labelled by the whole of it.

        What is far off is a lens that its model does not fit, where an image has few of them, and rarely a wrong label:
        without it, the model is free to be far off there.
        """
        if obj.board is None:
            return self
        estimation = replace(self.estimation, threshold=max(self.estimation.threshold, BOARD_THRESHOLD))
        return replace(self, outlier=max(self.outlier, BOARD_OUTLIER), estimation=estimation)
