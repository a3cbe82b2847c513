"""What the report shows: `ReportContent`, filled by the pipeline, and the numbers that several sections share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.estimation import Gauge, PredictedError
from imgcal.geometry import RigidTransform
from imgcal.pipeline import MOVED, UNDETERMINED
from imgcal.types import CameraRig, Detections

Array = NDArray[np.float64]

NOT_IDENTIFIED = "identity"
"""Refusals that begin so could not tell which blob is which; the others had labels, which the report does not know."""

UNKNOWN_MARKERS = "unknown_markers"
"""The identity of a calibration from markers that were never measured: each marker at each moment is a row."""


@dataclass(frozen=True)
class SnapshotSummary:
    """The outcome of one snapshot."""

    name: str
    found: int  # blobs, all cameras together
    used: int  # blobs that took part in the estimate
    reason: str = ""  # why it was rejected; empty = used


@dataclass(frozen=True)
class ReportContent:
    """Everything on the page. A field that a refused run cannot fill keeps its default.

    Convention: extrinsics in `std` and `prior_std` are those of `gauge`; parameters in the order of
    `CameraRig.parameter_names`.
    """

    title: str
    status: Literal["ok", "refused"]
    reason: str  # why it was refused, or what the run wants to say; may be empty
    identity: (
        str  # coded | unique | by_prior | by_tracking | ambiguous | unknown_markers, or what the run says when refused
    )
    factory: CameraRig  # no batch axes, C cameras
    detections: Detections  # M blobs of S snapshots
    labels: NDArray[np.int64]  # (M,) fiducial of each blob, -1 = unlabelled
    snapshots: tuple[SnapshotSummary, ...] = ()  # of the input; S, or fewer: one of several objects is a row of its own
    recalibrated: CameraRig | None = None
    predicted_before: Array | None = None  # (M, 2) pixels by the factory rig, pose refitted; nan where not used
    predicted_after: Array | None = None  # (M, 2) pixels by the recalibrated rig; nan where not used
    sigma: Array | None = None  # (M,) pixels, as weighted in the estimate; None = as detected
    std: Array | None = None  # (C, K) posterior standard deviation of the change
    prior_std: Array | None = None  # (C, K) standard deviation before the data
    from_scratch: bool = False  # there was no factory calibration: `factory` is a first rig made from the same data
    gauge: Gauge | None = None  # which cameras are taken to have stood still; None = nothing is compared
    predicted: PredictedError | None = None  # over the working volume
    scale: str = ""  # what the prediction leaves out, since no image shows it, in words
    moves: tuple[str, ...] = ()  # cameras that moved during the capture, in words; earlier snapshots are rejected
    late: tuple[str, ...] = ()  # cameras whose frames are of other moments, in words; these took no part
    timing: tuple[str, ...] = ()  # how cameras do not expose together, in words
    rests: str = ""  # snapshots that were averaged because they show the object at rest, in words
    doubtful: tuple[str, ...] = ()  # cameras that stop fitting at the end of the capture, in words
    unknown: tuple[str, ...] = ()  # what the data do not say, in words
    advice: str = ""  # where to move the object, in words
    unexplained: NDArray[np.int64] | None = None  # (C,) blobs that may be fiducials in view, not where these should be
    object_points: Array | None = None  # (N, 3) mm
    rig_from_object: RigidTransform | None = None  # (S) in the recalibrated rig's frame; nan for rejected snapshots
    frames: tuple[NDArray[np.uint8] | NDArray[np.uint16] | None, ...] = ()  # C grey images (H, W) of one snapshot
    frame_snapshots: tuple[int, ...] = (0,)
    """Numbers of that snapshot in `detections`: several where each object, or each unknown marker, has a row."""
    chi2_per_dof: float = float("nan")
    rms_before: float = float("nan")  # pixels, RMS length of the residuals
    rms_after: float = float("nan")
    seconds: Mapping[str, float] = field(default_factory=dict)  # by stage, in the order in which they ran
    command: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        blobs, cameras = len(self.detections), self.factory.num_cameras
        expected = {
            "labels": (blobs,),
            "predicted_before": (blobs, 2),
            "predicted_after": (blobs, 2),
            "sigma": (blobs,),
            "std": self.shape,
            "prior_std": self.shape,
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"report: {name} has shape {value.shape}, expected {shape}")
        if self.frames and len(self.frames) != cameras:
            raise ValueError(f"report: found {len(self.frames)} frames, expected {cameras}, None where there is none")
        if self.detections.camera_names != self.factory.camera_names:
            raise ValueError("report: cameras of the detections differ from those of the rig")

    @property
    def pictured(self) -> NDArray[np.bool_]:
        """Mark the blobs of the snapshot that `frames` show: (M,) bool."""
        return np.isin(self.detections.snapshot, self.frame_snapshots)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, C."""
        return self.factory.camera_names

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cameras and of parameters of each: C, K."""
        return self.factory.num_cameras, self.factory.num_parameters

    @cached_property
    def image_size(self) -> NDArray[np.int64]:
        """Width and height of each camera's image: (C, 2) pixels."""
        return self.factory.image_size.cpu().numpy().astype(np.int64)

    @cached_property
    def used(self) -> NDArray[np.bool_]:
        """Mark the blobs that took part in the estimate: (M,) bool."""
        if self.predicted_after is None:
            return np.zeros(len(self.detections), dtype=bool)
        return np.isfinite(self.predicted_after).all(axis=1) & (self.labels >= 0)

    @cached_property
    def residual_before(self) -> Array:
        """Predicted by the factory rig minus observed: (M, 2) pixels, nan where there is none."""
        return self._residual(self.predicted_before)

    @cached_property
    def residual_after(self) -> Array:
        """Predicted by the recalibrated rig minus observed: (M, 2) pixels, nan where there is none."""
        return self._residual(self.predicted_after)

    @cached_property
    def whitened(self) -> Array:
        """Residuals after, of the used blobs, in standard deviations: (K, 2)."""
        sigma = self.detections.sigma if self.sigma is None else self.sigma
        return self.residual_after[self.used] / sigma[self.used, None]

    @cached_property
    def observations(self) -> NDArray[np.int64]:
        """Used blobs of each camera: (C,)."""
        return self.detections.count_by_camera(self.used)

    @cached_property
    def change(self) -> Array | None:
        """Recalibrated minus factory, a motion of the whole rig taken out: (C, K)."""
        if self.aligned_rig is None:
            return None
        return self.aligned_rig.local(self.factory.to(torch.float64)).detach().cpu().numpy()

    @cached_property
    def aligned_rig(self) -> CameraRig | None:
        """The recalibrated rig, aligned with the factory's as `gauge` says."""
        if self.recalibrated is None or self.gauge is None:
            return None
        return self.gauge.align(self.recalibrated.to(torch.float64), self.factory.to(torch.float64))

    @property
    def reference(self) -> int | None:
        """Index of the reference camera; None = the rig is aligned with most cameras."""
        return None if self.gauge is None else self.gauge.reference

    @cached_property
    def fixed(self) -> NDArray[np.bool_]:
        """Mark values that could not change, the extrinsics of a reference camera among them: (C, K) bool."""
        fixed = np.zeros(self.shape, dtype=bool) if self.std is None else self.std <= 0
        if self.reference is not None:
            fixed[self.reference, :6] = True
        return fixed

    @cached_property
    def moved(self) -> NDArray[np.bool_]:
        """Mark changes larger than `MOVED` standard deviations: (C, K) bool."""
        if self.change is None or self.std is None:
            return np.zeros(self.shape, dtype=bool)
        return (np.abs(self.change) > MOVED * self.std) & ~self.fixed

    @cached_property
    def undetermined(self) -> NDArray[np.bool_]:
        """Mark values that the data hardly determine beyond the prior: (C, K) bool."""
        if self.std is None or self.prior_std is None:
            return np.zeros(self.shape, dtype=bool)
        return (self.std > UNDETERMINED * self.prior_std) & ~self.fixed

    def rms_by(self, group: NDArray[np.int64], residual: Array, count: int) -> Array:
        """RMS length of the used blobs' residuals, by group.

        Args:
            group: (M,) index of the group of each blob, below `count`.
            residual: (M, 2) pixels.
            count: number of groups, G.

        Returns:
            (G,) pixels, nan for a group without residuals.
        """
        rows = self.used & np.isfinite(residual).all(axis=1)
        squares = np.bincount(group[rows], weights=(residual[rows] ** 2).sum(axis=1), minlength=count)
        number = np.bincount(group[rows], minlength=count)
        return np.sqrt(np.divide(squares, number, out=np.full(count, np.nan), where=number > 0))

    def _residual(self, predicted: Array | None) -> Array:
        return np.full((len(self.detections), 2), np.nan) if predicted is None else predicted - self.detections.uv
