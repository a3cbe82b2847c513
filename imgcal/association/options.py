"""How sure the tool must be before it gives an answer."""

from __future__ import annotations

from dataclasses import dataclass

from imgcal.association.result import IdentityOptions
from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform


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
