"""The latest labelled snapshots of a running rig, fitted together; what is out of date is noticed and left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import Associations, PipelineOptions, SnapshotIdentity, to_observations
from imgcal.errors import RefusedError
from imgcal.estimation import Estimate, estimate, initial_pose
from imgcal.geometry import RigidTransform
from imgcal.online.breaks import Series, find_breaks, series_of
from imgcal.online.following import near_prediction, widened
from imgcal.pipeline import Calibration, fit_labelled
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations

SIGNIFICANT = 50.0
"""Chi-squared, six degrees of freedom: a camera that stands still exceeds it once in 200 million tests."""
MOST_EXCESS = 4.0
"""How much larger than by noise alone the test is taken to be usually, where only the tested snapshots can tell."""
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
    prior_std: Tensor  # (C, K)
    moved: Mapping[int, str] = field(default_factory=dict)  # camera -> first snapshot from its new place; "" = none yet
    restarted: bool = False  # the older snapshots were given up

    def after_move(self, camera: int, first: int, wide: Tensor) -> Window:
        """Forget what a camera saw before the snapshot of a number.

        Args:
            camera: its number.
            first: number of the first snapshot that counts.
            wide: (C, K) standard deviations that such a camera starts afresh from.
        """
        kept = tuple(k.without(camera) if i < first else k for i, k in enumerate(self.kept))
        prior_std = self.prior_std.clone()
        prior_std[camera, :6] = torch.maximum(prior_std[camera, :6], wide[camera, :6])
        name = self.kept[first].snapshot.name if first < len(self.kept) else ""
        kept = tuple(k for k in kept if (k.blobs.fiducial >= 0).any())  # of others, nothing is left
        return replace(self, kept=kept, prior_std=prior_std, moved={**self.moved, camera: name})


@dataclass(frozen=True)
class Usual:
    """What fits of a rig look like while nothing moves."""

    excess: float | None = None  # how much larger than by noise alone the test for moves is; None = not known yet
    additive_noise: float = float("inf")  # px


@dataclass(frozen=True)
class Fitted:
    """A calibration from a window."""

    result: Calibration
    window: Window  # without what is out of date
    tests: tuple[float, ...]  # what the test for moves says of the newest snapshot, camera by camera; () = moved


@dataclass(frozen=True)
class WindowFit:
    """Fits windows of one rig."""

    rig: CameraRig
    obj: CalibrationObject
    options: PipelineOptions
    size: int  # number of latest snapshots that a calibration is made from

    def __call__(self, window: Window, latest: Calibration | None, usual: Usual, doubtful: bool = False) -> Fitted:
        """Fit the latest snapshots; of cameras that moved meanwhile, only what they saw afterwards.

        Args:
            window: with the new snapshot.
            latest: what the window before gave: a start that saves time.
            usual: what fits of this rig look like while nothing moves.
            doubtful: compare the new snapshot with those before also where these take no part in the calibration.

        Raises:
            RefusedError: the new snapshot cannot even be fitted by itself.
        """
        for _ in range(self.rig.num_cameras):
            result = self._tried(window, latest)
            series, first = self._series(window, result, usual, doubtful)
            if series is None:
                break
            breaks = find_breaks(series)
            number, camera, statistic = breaks.most_significant()
            # What a robust fit says after a refusal is coarse, and something is wrong.
            excess = 1.0 if result is None or doubtful else usual.excess or breaks.excess(MOST_EXCESS)
            if statistic <= SIGNIFICANT * max(1.0, excess):
                if result is not None and not window.moved and not doubtful:
                    return Fitted(result, window, tuple(breaks.statistic[-1][breaks.statistic[-1] > 0].tolist()))
                break
            wide = widened(window.prior_std, series.rig, [camera], series.rig_from_object[-1], self.obj, RELEARNT)
            window, doubtful = window.after_move(camera, first[number], wide), False
        if result is not None:
            return self._relabelled(result, window)
        # The new snapshot does not go with the older ones, and nothing says why: it begins a new window.
        alone = replace(window, kept=window.kept[-1:], restarted=True)
        return Fitted(self._fit(alone, None), alone, ())

    def _tried(self, window: Window, latest: Calibration | None) -> Calibration | None:
        """Fit; None = refused, where the older snapshots may be the reason."""
        try:
            return self._fit(window, latest)
        except RefusedError:
            if len(window.kept) == 1:
                raise
            return None

    def _series(
        self, window: Window, result: Calibration | None, usual: Usual, doubtful: bool
    ) -> tuple[Series | None, list[int]]:
        """What the test for moves needs, and the number in the window of each of its snapshots; None = no test."""
        kept = window.kept[-self.size :]
        if result is not None and not doubtful:
            if len(result.labelled.used) < 2:
                return None, []
            plain = result.outliers == 0 and result.additive_noise == 0
            labels = result.observations if plain else self._observations(result.labelled)
            noise = labels.sigma.square()
            # A move is no noise, though a fit takes it for that: what is usual, or as much as the blobs' own, counts.
            model = noise.clamp_min(usual.additive_noise**2).clamp_max(result.additive_noise**2)
            labels = replace(labels, sigma=(noise + model).sqrt())
            first = len(window.kept) - len(kept)
            return series_of(result.estimate, labels, self.obj.radius), [first + used for used in result.labelled.used]
        if len(window.kept) < 2:
            return None, []
        return series_of(*self.rough(window), self.obj.radius), list(range(len(window.kept)))

    def _relabelled(self, result: Calibration, window: Window) -> Fitted:
        """Label the newest snapshot again in cameras that moved: they are known now, and were not when it was done."""
        moved = [camera for camera, first in window.moved.items() if first]
        if not moved:
            return Fitted(result, window, ())
        newest = window.kept[-1]
        points = result.rig_from_object[-1:].apply(result.points_object)
        predicted = result.rig.expand(1).project_values(points, self.obj.radius).uv[0].numpy()
        named = near_prediction(newest.blobs, predicted)
        again = np.where(np.isin(newest.blobs.camera, moved), named, newest.blobs.fiducial)
        better = replace(newest, blobs=replace(newest.blobs, fiducial=again))
        more = replace(window, kept=(*window.kept[:-1], better))
        try:
            second = self._fit(more, result)
        except RefusedError:
            return Fitted(result, window, ())
        if int(second.observations.seen[-1].sum()) <= int(result.observations.seen[-1].sum()):
            return Fitted(result, window, ())
        return Fitted(second, more, ())

    def _fit(self, window: Window, latest: Calibration | None) -> Calibration:
        labelled = stacked(window.kept[-self.size :], self.rig)
        result = fit_labelled(labelled, self.rig, self.obj, self.options, latest=latest, prior_std=window.prior_std)
        if (now := result.labelled.snapshots[-1]).status == "refused":
            raise RefusedError(f"estimation: {now.reason}")
        return result

    def rough(self, window: Window) -> tuple[Estimate, Observations]:
        """Fit all snapshots that are kept, in a way that no minority of wrong labels can spoil."""
        labels = self._observations(stacked(window.kept, self.rig))
        labels = replace(labels, sigma=labels.sigma.square().add(self.options.identity_error**2).sqrt())
        known = [kept.snapshot.rig_from_object for kept in window.kept]
        poses = [pose for pose in known if pose is not None]
        start = RigidTransform.stack(poses) if len(poses) == len(known) else initial_pose(labels, self.rig, self.obj)
        robust = replace(self.options.estimation, loss="cauchy")
        return estimate(labels, self.rig, self.obj, start, prior_std=window.prior_std, options=robust), labels

    def _observations(self, labelled: Associations) -> Observations:
        """All labels of the used snapshots."""
        detections = labelled.detections
        rows = np.isin(detections.snapshot, labelled.used) & (detections.fiducial >= 0)
        return to_observations(detections.select(rows), self.rig, self.obj)


def stacked(kept: tuple[Kept, ...], rig: CameraRig) -> Associations:
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
    return Associations(table, snapshots)
