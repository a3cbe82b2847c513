"""The latest labelled snapshots of a running rig, fitted together; what is out of date is noticed and left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.breaks import Series, find_breaks, series_of
from imgcal.errors import RefusedError
from imgcal.estimation import estimate, initial_pose
from imgcal.following import widened
from imgcal.labelling import Labelled, PipelineOptions, SnapshotIdentity, to_observations
from imgcal.objects import CalibrationObject
from imgcal.observations import Detections, Observations
from imgcal.pipeline import Calibration, fit_labelled
from imgcal.rig import CameraRig
from imgcal.transforms import RigidTransform

SIGNIFICANT = 50.0
"""Chi-squared, six degrees of freedom: a camera that stands still exceeds it once in 200 million tests."""
USUAL = 5.348
"""Median of chi-squared with six degrees of freedom."""
RELEARNT = 0.1
"""Radians, standard deviation of the rotation of a camera that has moved: what it starts afresh from."""


@dataclass(frozen=True)
class Kept:
    """A labelled snapshot."""

    blobs: Detections
    snapshot: SnapshotIdentity

    def sees(self, camera: int) -> bool:
        """Tell whether a camera has labels."""
        return bool(((self.blobs.camera == camera) & (self.blobs.fiducial >= 0)).any())

    def without(self, camera: int) -> Kept:
        """Forget what a camera saw."""
        fiducial = np.where(self.blobs.camera == camera, -1, self.blobs.fiducial)
        return replace(self, blobs=replace(self.blobs, fiducial=fiducial))


@dataclass(frozen=True)
class Window:
    """Snapshots, the newest last, and how far the factory values may be off."""

    kept: tuple[Kept, ...]
    spread: Tensor  # (C, 15)
    moved: Mapping[int, str] = field(default_factory=dict)  # camera -> first snapshot from its new place; "" = none yet
    restarted: bool = False  # the older snapshots were given up

    def after_move(self, camera: int, first: int, wide: Tensor) -> Window:
        """Forget what a camera saw before the snapshot of a number.

        Args:
            camera: its number.
            first: number of the first snapshot that counts.
            wide: (C, 15) standard deviations that such a camera starts afresh from.
        """
        kept = tuple(k.without(camera) if i < first else k for i, k in enumerate(self.kept))
        spread = self.spread.clone()
        spread[camera, :6] = torch.maximum(spread[camera, :6], wide[camera, :6])
        name = self.kept[first].snapshot.name if first < len(self.kept) else ""
        return replace(self, kept=kept, spread=spread, moved={**self.moved, camera: name})


@dataclass(frozen=True)
class Fitted:
    """A calibration from a window."""

    result: Calibration
    window: Window  # without what is out of date
    usual: tuple[float, ...]  # what the test for moves says of the newest snapshot where nothing has moved


@dataclass(frozen=True)
class WindowFit:
    """Fits windows of one rig."""

    rig: CameraRig
    obj: CalibrationObject
    options: PipelineOptions
    size: int  # number of latest snapshots that a calibration is made from

    def __call__(
        self, window: Window, latest: Calibration | None, excess: float | None = None, doubtful: bool = False
    ) -> Fitted:
        """Fit the latest snapshots; of cameras that moved meanwhile, only what they saw afterwards.

        Args:
            window: with the new snapshot.
            latest: what the window before gave: a start that saves time.
            excess: how much larger than by noise alone the test for moves usually is; None = ask the snapshots.
            doubtful: compare the new snapshot with those before also where these take no part in the calibration.

        Raises:
            RefusedError: the new snapshot cannot even be fitted by itself.
        """
        for _ in range(self.rig.cameras):
            result, kept = None, window.kept[-self.size :]
            try:
                result = self._fit(kept, window.spread, latest)
            except RefusedError:
                if len(window.kept) == 1:
                    raise
            if result is not None and len(kept) > 1:
                used = result.labelled.used
                everything = self._observations(result.labelled)
                labels = replace(everything, sigma=result.observations.sigma)
                series = series_of(result, labels, self.obj.radius)
            elif len(window.kept) > 1 and (result is None or doubtful):
                kept, doubtful = window.kept, False
                series, used = self._rough_series(window)
            else:
                break
            if len(used) < 2:
                break
            breaks = find_breaks(series)
            first, camera, statistic = breaks.most_significant()
            newest = breaks.statistic[-1][breaks.statistic[-1] > 0]
            if statistic <= SIGNIFICANT * max(1.0, _excess(breaks.statistic) if excess is None else excess):
                if result is not None:
                    return Fitted(result, window, tuple(newest.tolist()))
                break
            number = len(window.kept) - len(kept) + used[first]
            wide = widened(window.spread, series.rig, [camera], series.rig_from_object[-1], self.obj, RELEARNT)
            window = window.after_move(camera, number, wide)
        if result is not None:
            return Fitted(result, window, ())
        # The new snapshot does not go with the older ones, and nothing says why: it begins a new window.
        alone = replace(window, kept=window.kept[-1:], restarted=True)
        return Fitted(self._fit(alone.kept, alone.spread, None), alone, ())

    def _fit(self, kept: tuple[Kept, ...], spread: Tensor, latest: Calibration | None) -> Calibration:
        labelled = joined(kept, self.rig)
        result = fit_labelled(labelled, self.rig, self.obj, self.options, latest=latest, spread=spread)
        if (now := result.labelled.snapshots[-1]).status == "refused":
            raise RefusedError(f"estimation: {now.reason}")
        return result

    def _rough_series(self, window: Window) -> tuple[Series, list[int]]:
        """Fit all snapshots in a way that no minority of wrong labels can spoil, for the test alone."""
        labelled = joined(window.kept, self.rig)
        observations = self._observations(labelled)
        observations = replace(
            observations, sigma=observations.sigma.square().add(self.options.identity_error**2).sqrt()
        )
        known = [kept.snapshot.rig_from_object for kept in window.kept]
        poses = [pose for pose in known if pose is not None]
        start = (
            RigidTransform.joined(poses, torch.stack)
            if len(poses) == len(known)
            else initial_pose(observations, self.rig, self.obj)
        )
        robust = replace(self.options.estimation, loss="cauchy")
        fit = estimate(observations, self.rig, self.obj, start, spread=window.spread, options=robust)
        return series_of(fit, observations, self.obj.radius), labelled.used

    def _observations(self, labelled: Labelled) -> Observations:
        """All labels of the used snapshots."""
        detections = labelled.detections
        rows = np.isin(detections.snapshot, labelled.used) & (detections.fiducial >= 0)
        return to_observations(detections.select(rows), self.rig, self.obj)


def _excess(statistic: NDArray[np.float64]) -> float:
    """How much larger than by noise alone a test (S - 1, C) is, in spite of one camera that may have moved."""
    usual = np.delete(statistic, int(statistic.max(0).argmax()), axis=1)
    return float(np.median(usual[usual > 0])) / USUAL if (usual > 0).any() else 1.0


def joined(kept: tuple[Kept, ...], rig: CameraRig) -> Labelled:
    """Put labelled snapshots into one table."""
    tables = [k.blobs for k in kept]
    columns: dict[str, NDArray[np.generic]] = {
        name: np.concatenate([getattr(table, name) for table in tables])
        for name in ("uv", "sigma", "camera", "fiducial", "radius", "flags")
    }
    number = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    snapshots = tuple(k.snapshot for k in kept)
    names = tuple(snapshot.name for snapshot in snapshots)
    table = Detections(**columns, snapshot=number, camera_names=rig.camera_names, snapshot_names=names)  # type: ignore[arg-type]
    return Labelled(table, snapshots)
