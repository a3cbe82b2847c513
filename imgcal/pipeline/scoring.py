"""Measure how well a fixed rig explains what its cameras saw: `score`, as the command of that name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.association import (
    Associations,
    PipelineOptions,
    Progress,
    accepted_observations,
    associate,
    fit_snapshot_poses,
    refuse_unfit,
)
from imgcal.detection import DetectionOptions
from imgcal.errors import RefusedError
from imgcal.pipeline.board_turns import settle_labels
from imgcal.pipeline.lights import FoundLights, find_lights
from imgcal.pipeline.partial_labels import name_missing_labels
from imgcal.pipeline.sources import Frames, as_one, as_unknown_marker, find_blobs
from imgcal.pipeline.units import require_solvable, require_units
from imgcal.types import CalibrationObject, CameraRig, Detections, check_rig

OUTLYING = 10.0
"""Multiple of the median distance; noise alone exceeds it once in 10^30."""
ROUNDS = 5
LEAST_POINTS, LEAST_OF_LIGHT = 6, 2
"""Minimum number of points in a snapshot for a pose; the same for one light."""


def rms_length(residual: Tensor, seen: Tensor) -> float | None:
    """RMS length (px) of the seen residuals, as in OpenCV's calibrateCamera; None if nothing was seen.

    Args:
        residual: (..., 2) pixels.
        seen: (...) bool.
    """
    return float(residual[seen].square().sum(-1).mean().sqrt()) if bool(seen.any()) else None


@dataclass(frozen=True)
class RigScore:
    """Reprojection errors of a fixed rig; only the object's poses are fitted."""

    labelled: Associations
    residual: Tensor  # (S, C, N, 2) pixels
    seen: Tensor  # (S, C, N) bool
    lights: FoundLights | None = None  # unknown markers: S counts single markers at one moment

    @property
    def distances(self) -> Tensor:
        """Length of each residual: (M,) pixels."""
        return self.residual.norm(dim=-1)[self.seen]

    @property
    def outliers(self) -> Tensor:
        """Mark the seen fiducials that are `OUTLYING` times as far off as most of their camera's: (S, C, N) bool.

        Half-hidden and merged markers are outliers, whatever the rig. A median ignores them; they dominate an RMS. A
        camera that is off as a whole has no outliers: it shows in the RMS.
        """
        distance = torch.where(self.seen, self.residual.norm(dim=-1), torch.nan)
        own = distance.movedim(1, 0).flatten(1).nanmedian(dim=1).values.nan_to_num(0.0)
        limit = OUTLYING * own.clamp_min(float(self.distances.median()))
        return distance > limit[:, None]

    def __repr__(self) -> str:
        """Summarize, with the robust figures first."""
        distances, outliers = self.distances, self.outliers
        rms, most = rms_length(self.residual, self.seen & ~outliers), float(distances.median())
        return (
            f"RigScore(median {most:.3g} px, RMS {rms:.3g} px without {int(outliers.sum())} outliers of "
            f"{len(distances)} points, {self.labelled!r})"
        )


def score(
    source: Detections | Frames,
    rig: CameraRig,
    obj: CalibrationObject | Sequence[CalibrationObject],
    options: PipelineOptions = PipelineOptions(),
    progress: Progress | None = None,
    *,
    detection: DetectionOptions = DetectionOptions(),
) -> RigScore:
    """Measure how well a rig explains what its cameras saw.

    Args:
        source: blobs, labelled or not, or frames in memory (see `imgcal.detect`).
        rig: the rig to score; its prior is used for identification only.
        obj: the calibration object; or several, any of which may be in view of any snapshot.
        options: how certain identification must be.
        progress: wraps the loop over snapshots.
        detection: how blobs are found in frames.

    Raises:
        RefusedError: no snapshot could be identified, or no pose fits most of them.
        InputError: the rig or the object is invalid, or the data do not belong to them: other cameras, frames of
            another size.

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
    check_rig(rig)
    obj = as_one(obj)
    rig, options = rig.as_constant(), options.of_object(obj)
    detections = settle_labels(find_blobs(source, rig, obj, detection), rig, obj)
    obj = as_unknown_marker(obj, detections)
    try:
        with require_solvable():
            if obj.unknown_markers:
                lights = find_lights(detections, rig, obj)
                return replace(_fit_poses(lights.labelled, rig, obj, options), lights=lights)
            return _fit_poses(associate(detections, rig, obj, options, progress), rig, obj, options)
    except RefusedError as error:
        with name_missing_labels(detections):
            require_units(error, detections, rig, obj)
            raise


def _fit_poses(labelled: Associations, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions) -> RigScore:
    """Fit a pose in each labelled snapshot."""
    observations, poses = accepted_observations(labelled, rig, obj)
    if obj.unknown_markers:
        poses = None  # those are of the rig by which the markers were found
    # What is reported is an RMS in pixels: centres count alike, however well each was measured.
    even = replace(observations, sigma=torch.full_like(observations.sigma, options.identity_error))
    least, solver = LEAST_POINTS, options.estimation
    if obj.pose_rank == 3:  # plain triangulation: a robust one has several minima where a rig is far off
        least, solver = LEAST_OF_LIGHT, replace(options.estimation, loss="squared")
    for _ in range(ROUNDS):
        poses, fits = fit_snapshot_poses(even, rig, obj, poses, solver)
        if not bool(fits.all()):
            return _fit_poses(refuse_unfit(labelled, fits, "score"), rig, obj, options)
        points = poses.apply(obj.points.to(rig.focal_length))
        residual = rig.expand(len(points)).project_values(points, obj.radius).uv - observations.uv
        scored = RigScore(labelled, torch.where(observations.seen[..., None], residual, 0.0), observations.seen)
        # Most fiducials determine the poses, too: outliers must not pull them.
        kept = observations.seen & ~scored.outliers
        if bool((kept == even.seen).all()) or bool((kept.flatten(1).sum(1) < least).any()):
            break
        even = replace(even, seen=kept)
    return scored
