"""How well a rig that is held fixed explains what its cameras saw: `score`, as the command of that name."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.association import Associations, PipelineOptions, Progress, associate, observations_of
from imgcal.detection import DetectionOptions
from imgcal.errors import RefusedError
from imgcal.estimation import estimate
from imgcal.pipeline.sources import Frames, blobs_of
from imgcal.types import CalibrationObject, CameraRig, Detections


def rms_length(residual: Tensor, seen: Tensor) -> float | None:
    """RMS length (px) of the seen residuals, as OpenCV's calibrateCamera defines it; None where nothing was seen.

    Args:
        residual: (..., 2) pixels.
        seen: (...) bool.
    """
    return float(residual[seen].square().sum(-1).mean().sqrt()) if bool(seen.any()) else None


@dataclass(frozen=True)
class RigScore:
    """Reprojection errors of a rig that is held fixed; only the object's poses are fitted."""

    labelled: Associations
    residual: Tensor  # (S, C, N, 2) pixels
    seen: Tensor  # (S, C, N) bool

    @property
    def distances(self) -> Tensor:
        """Length of each residual: (M,) pixels."""
        return self.residual.norm(dim=-1)[self.seen]


def score(
    source: Detections | Frames,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions = PipelineOptions(),
    progress: Progress | None = None,
    *,
    detection: DetectionOptions = DetectionOptions(),
) -> RigScore:
    """Measure how well a rig explains what its cameras saw.

    Args:
        source: blobs, labelled or not, or frames in memory (see `imgcal.detect`).
        rig: the rig to be scored; its prior is used for identity only.
        obj: the calibration object.
        options: how sure identity must be.
        progress: wraps the loop over snapshots.
        detection: how blobs are found in frames.

    Raises:
        RefusedError: no snapshot could be decided.
        InputError: the data do not belong to this rig or object: other cameras, frames of another size.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
        >>> factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> truth = simulate_truth(factory, obj, 4, torch.Generator().manual_seed(1), PhysicalDrift())
        >>> blobs = true_detections(truth)
        >>> float(imgcal.score(blobs, truth.rig, obj).distances.max()) < 1e-3
        True
        >>> float(imgcal.score(blobs, factory, obj).distances.mean()) > 5
        True
    """
    rig = rig.to(torch.float64)
    labelled = associate(blobs_of(source, rig, obj, detection), rig, obj, options, progress)
    observations, poses = observations_of(labelled, rig, obj)
    fixed = torch.zeros(*rig.distortion.shape[:-1], 15, dtype=rig.distortion.dtype)
    # What is reported is an RMS in pixels: centres count alike, however well each was measured.
    even = replace(observations, sigma=torch.full_like(observations.sigma, options.identity_error))
    fit = estimate(even, rig, obj.taken_as_exact(), poses, prior_std=fixed, options=options.estimation)
    if not bool(fit.converged):
        raise RefusedError(f"score: no pose of the object fits (RMS {2**0.5 * float(fit.rms):.3g} px)")
    return RigScore(labelled, fit.residual, observations.seen)
