"""Estimate the noise of each camera's blobs beyond their own sigmas."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import Associations, PipelineOptions, SnapshotIdentity
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform
from imgcal.medians import median, median_of_known
from imgcal.monitoring import MeasurementUpdate, shared_shifts
from imgcal.online.labelling import NEAR_PREDICTION
from imgcal.pipeline import fit_labelled
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations

TESTED_TOGETHER = (1, 2, 4, 8, 16, 32)
"""Numbers of first snapshots that are tested together."""
DIFFERENT_LEVEL = 1.2
"""Minimum ratio of noise levels that counts as different."""
FIRST_ESTIMATES, ESTIMATE_INTERVAL = (16, 32), 64
"""Numbers of snapshots at which cameras are first tested one by one; then the interval, and the most snapshots used."""


class NoiseLevel:
    """Tests the first snapshots together, and each later one by its residuals."""

    STATE: ClassVar = {
        "additive": ("additive", NDArray[np.float64]),
        "early": ("_early", list[tuple[Detections, SnapshotIdentity]]),
        "asking": ("_asking", bool),
        "ratios": ("_ratios", deque[NDArray[np.float64]]),
        "first": ("first", list[tuple[Detections, RigidTransform]]),
    }

    def __init__(self, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions) -> None:
        """Start with the blobs' own noise."""
        self._rig, self._obj, self._options = rig, obj, options
        self.additive = np.zeros(rig.num_cameras)  # (C,) px
        self.restart()

    def trust(self) -> None:
        """Skip the test of first snapshots: the rig is known, so each snapshot's residuals show its noise."""
        self._asking = False

    def restart(self) -> None:
        """Test first snapshots again."""
        self._early: list[tuple[Detections, SnapshotIdentity]] = []  # one snapshot each
        self._asking = True
        self._ratios: deque[NDArray[np.float64]] = deque(maxlen=ESTIMATE_INTERVAL)  # (C, N)
        self.first: list[tuple[Detections, RigidTransform]] = []  # snapshots with another noise level, and poses

    def observe(
        self, blobs: Detections, observations: Observations, result: MeasurementUpdate, steady: bool, count: int
    ) -> bool:
        """Take an absorbed snapshot.

        Args:
            blobs: labelled.
            observations: the same, with the noise that was assumed.
            result: the update by it.
            steady: no camera is in doubt.
            count: number of absorbed snapshots.

        Returns:
            Whether to absorb the first snapshots again: `first` has them all.
        """
        again = False
        if self._asking:
            self._asking = steady and count == len(self._early) + 1 and count <= TESTED_TOGETHER[-1]
            if self._asking:
                identity = SnapshotIdentity(f"{count}", "by_tracking", NEAR_PREDICTION, 1, result.rig_from_object[0])
                self._early.append((blobs, identity))
                again = count in TESTED_TOGETHER and self._estimate()
                if count == TESTED_TOGETHER[-1]:
                    self._asking = False
            if not self._asking:
                self._early = []
        if steady:
            self._follow(observations, result, count)
        return again

    def _estimate(self) -> bool:
        """Estimate the noise from the first snapshots together."""
        try:
            fit = fit_labelled(stack_labelled(self._early), self._rig, self._obj, self._options)
        except RefusedError:
            return False
        before, now = self.additive, np.full(len(self.additive), fit.additive_noise)
        if not self._differs(fit.additive_noise):
            return False
        self.additive = now
        poses = fit.rig_from_object
        if len(poses.translation) != len(self._early):
            self.additive = before
            return False
        self.first = [(blobs, poses[number : number + 1]) for number, (blobs, _) in enumerate(self._early)]
        return True

    def _differs(self, additive: float) -> bool:
        sigma = median(self._early[-1][0].sigma)
        before, now = math.hypot(sigma, median(self.additive)), math.hypot(sigma, additive)
        return max(before, now) > DIFFERENT_LEVEL * min(before, now)

    def _follow(self, observations: Observations, result: MeasurementUpdate, count: int) -> None:
        """Track the noise by the residuals of single snapshots."""
        seen, residual = observations.seen[0], result.residual[0].numpy()
        if result.dof <= 0:
            return
        # The median of a 2D squared residual is 2 log 2; it ignores outliers.
        free = result.dof / (2 * int(seen.sum()))
        if observations.shake is not None:  # a shift shared by a camera's points is not their noise
            residual = residual - shared_shifts(observations, result.residual)[0][0, :, None]
            free *= 1 - int(seen.any(1).sum()) / int(seen.sum())
        whitened = residual / observations.sigma[0, ..., None].numpy()
        squared = np.einsum("cni,cni->cn", whitened, whitened) / (2 * math.log(2) * free)
        self._ratios.append(np.where(seen.numpy(), squared, np.nan))
        if (count in FIRST_ESTIMATES or count % ESTIMATE_INTERVAL == 0) and len(self._ratios) >= FIRST_ESTIMATES[0]:
            self._ask_later(observations)

    def _ask_later(self, observations: Observations) -> None:
        """Compare each camera's noise in the latest snapshots with the assumed noise."""
        known = np.stack(self._ratios)
        often = np.isfinite(known).any(-1).sum(0) > len(known) // 2
        some = often & observations.seen[0].any(1).numpy()
        if not some.any():
            return
        ratio = median_of_known(known[:, some].swapaxes(1, 2).reshape(-1, int(some.sum())))
        other = np.maximum(ratio, 1 / np.maximum(ratio, 1e-9)) > DIFFERENT_LEVEL**2
        if not other.any():
            return
        sigma = torch.where(observations.seen[0], observations.sigma[0], torch.nan)[torch.from_numpy(some)]
        variance = np.square(median_of_known(sigma.numpy().T))
        before = self.additive[some]
        own = np.maximum(variance - before**2, 0.0)
        self.additive = self.additive.copy()
        self.additive[some] = np.where(other, np.sqrt(np.maximum(variance * ratio - own, 0.0)), before)
        self._ratios.clear()


def stack_labelled(snapshots: Sequence[tuple[Detections, SnapshotIdentity]]) -> Associations:
    """Concatenate labelled snapshots into one table."""
    tables, identities = zip(*snapshots, strict=True)
    columns: dict[str, NDArray[np.generic]] = {
        name: np.concatenate([getattr(table, name) for table in tables])
        for name in ("uv", "sigma", "camera", "fiducial", "radius", "flags")
    }
    number = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    names, cameras = tuple(identity.name for identity in identities), tables[0].camera_names
    table = Detections(**columns, snapshot=number, camera_names=cameras, snapshot_names=names)  # type: ignore[arg-type]
    return Associations(table, identities)
