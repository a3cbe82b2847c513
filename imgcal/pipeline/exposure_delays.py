"""Measure by how much each camera exposes later than the others, where that is the same in every snapshot.

Free-running cameras of one rate keep their phase: a camera that is late by a tenth of an interval shows everything
where it will be by then. Its residuals lie along the motion of the object in its image, in proportion to the speed. A
delay is estimated by regression of the residuals on the velocity; poses and cameras, which have adapted to it, are
fitted again with blobs moved back to the common moment, until nothing changes. A random difference of exposure times is
another matter; see `synchronization.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import Associations, accepted_observations
from imgcal.estimation import estimate
from imgcal.medians import median
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations

LEAST_VIEWS = 10
"""Minimum number of images of each camera with a known motion."""
LARGEST = 0.15
"""Snapshots: with larger delays, labels that fit are few and biased."""
ROUNDS, CLOSE = 16, 1e-4
"""Most fits, and the change of a delay (snapshots) at which they end."""
LEAST_NOISE = 1e-3
"""Pixels: least noise of a fit, if blobs are exact."""
MOST_REMAINING = 0.8
"""Largest ratio of successive steps by which they are extrapolated."""
OUTLIER = 5.0
"""Multiple of a camera's usual residual beyond which a label says nothing about timing."""
ODD_SIGMAS = 6.0
"""Standard deviations by which a camera's squared residuals exceed those of the others where it may be late alone."""
LEAST_EXPLAINED = 0.03
"""Share of some camera's squared residuals in the first fit that its delay must explain to be worth more fits."""
MOST_LEFT = 0.9
"""Maximum ratio of some camera's usual residual with delays to that without."""
MOST_APART = 0.2
"""Maximum difference between the delays in the two halves of a capture, relative to the largest delay."""


@dataclass(frozen=True)
class Delays:
    """Cameras that expose at other times than the median camera, by the same time in every snapshot."""

    snapshots: tuple[float, ...]  # (C,) delay as a share of the interval between snapshots
    cameras: tuple[str, ...]  # (C,)

    def __str__(self) -> str:
        """Describe them in words."""
        delays = ", ".join(f"{name} {delay:+.3f}" for name, delay in zip(self.cameras, self.snapshots, strict=True))
        return (
            "the cameras expose at different times, by the same difference in every snapshot, in intervals between "
            f"snapshots after the median camera: {delays}; blobs were moved back along the object's motion: trigger "
            "the cameras together for the full accuracy"
        )

    @property
    def values(self) -> dict[str, Any]:
        """Values for scripts."""
        return {"snapshots": dict(zip(self.cameras, self.snapshots, strict=True)), "note": str(self)}


@dataclass(frozen=True)
class Motion:
    """Motion of all fiducials in the images (S, C, N, 2): px per snapshot and per snapshot squared."""

    velocity: Tensor
    acceleration: Tensor
    neighbours: Tensor  # (S,) snapshots in a row before and after that are known, the smaller number: 0, 1 or 2

    @classmethod
    def of(cls, uv: Tensor, before: NDArray[np.int64]) -> Motion:
        """Take differences of positions (S, C, N, 2); `before`: see `Associations.before_rows`."""
        count = len(before)
        after = np.full(count + 1, -1)
        after[before] = np.arange(count)
        after[-1] = -1
        back, ahead = np.append(before, -1), after  # row -1 = none
        rows = [torch.from_numpy(part) for part in (back[back[:-1]], back[:-1], ahead[:-1], ahead[ahead[:-1]])]
        (u0, u1, u3, u4), u2 = (uv[row] for row in rows), uv
        has = [row >= 0 for row in rows]
        one, two = has[1] & has[2], has[0] & has[1] & has[2] & has[3]
        velocity = torch.where(_wide(has[2]), u3 - u2, torch.where(_wide(has[1]), u2 - u1, 0.0))
        velocity = torch.where(_wide(one), (u3 - u1) / 2, velocity)
        velocity = torch.where(_wide(two), (8 * (u3 - u1) - (u4 - u0)) / 12, velocity)
        bend = torch.where(_wide(one), u3 - 2 * u2 + u1, 0.0)
        bend = torch.where(_wide(two), (16 * (u1 + u3) - 30 * u2 - u0 - u4) / 12, bend)
        return cls(velocity, bend, one.long() + two.long())

    def during(self, delay: Tensor) -> Tensor:
        """Motion (S, C, N, 2) px within delays (C,)."""
        time = delay[:, None, None]
        return self.velocity * time + self.acceleration * (time**2 / 2)

    def variance(self, delay: Tensor) -> Tensor:
        """Variance (S, C, N) px^2 of each axis of `during`, where too few neighbours are known."""
        known = self.neighbours > 0
        speed, bend = (values[known].square().mean((0, 2, 3)) for values in (self.velocity, self.acceleration))
        jerk = bend * bend / speed.clamp_min(1e-12)  # as if the motion were periodic
        missing = torch.stack((bend * (delay / 2).square(), jerk * (delay / 6).square(), torch.zeros_like(delay)))
        return missing[self.neighbours][:, :, None].expand(self.velocity.shape[:-1])


def has_odd_camera(residual: Tensor, observations: Observations) -> bool:
    """Tell whether some camera's residuals (S, C, N, 2) are larger than the others', beyond chance."""
    size, sigma, seen = (values.numpy() for values in (residual, observations.sigma, observations.seen))
    relative = np.where(seen, np.square(size).sum(-1) / np.square(sigma), 0.0).sum((0, 2))
    count = np.maximum(seen.sum((0, 2)), 1)
    usual = median(relative / count)
    return bool((relative > usual * (count + ODD_SIGMAS * np.sqrt(count))).any())


def find_delays(labelled: Associations, rig: CameraRig, obj: CalibrationObject) -> tuple[Delays, Detections] | None:
    """Measure the cameras' delays from labelled snapshots.

    Args:
        labelled: all snapshots.
        rig: what is known before, float64.
        obj: the calibration object.

    Returns:
        The delays, and the detections as if all cameras had exposed together; None if delays do not explain the
        residuals, or if the object hardly moved.
    """
    if rig.num_cameras < 2 or obj.unknown_markers:
        return None
    observations, poses = accepted_observations(labelled, rig, obj)
    before, exact, rows = labelled.before_rows, obj.as_exact(), torch.arange(len(labelled.used))
    halves = rows < len(rows) // 2, rows >= len(rows) // 2
    start, usual, last_step = rig, list[Tensor](), None
    delay, moved = torch.zeros(rig.num_cameras, dtype=torch.float64), torch.zeros_like(observations.uv)
    for _ in range(ROUNDS):
        noise = max(float(usual[-1].median()), LEAST_NOISE) if usual else 1.0
        even = replace(observations, sigma=torch.full_like(observations.sigma, noise))
        fit = estimate(replace(even, uv=even.uv - moved), rig, exact, poses, initial_rig=start)
        if not bool(fit.converged):
            return None
        start, poses = fit.rig, fit.rig_from_object
        points = poses.apply(fit.points_object)
        motion = Motion.of(start.expand(len(points)).project_values(points, obj.radius).uv, before)
        residuals = _Residuals.of(fit.residual, motion, observations.seen)
        usual.append(residuals.usual)
        if bool((residuals.views < LEAST_VIEWS).any()) or not bool((residuals.power > 0).all()):
            return None
        if len(usual) == 1 and bool((residuals.explained < LEAST_EXPLAINED).all()):
            return None
        step = residuals.delay - residuals.delay.median()  # a delay of all cameras is no difference
        # Cameras and poses adapt to a delay, so that each step shows a part of it only.
        remains = 0.0 if last_step is None else float(step @ last_step / last_step.square().sum())
        last_step = step
        parts = [residuals.of_rows(half) for half in halves]
        delay = delay + step / (1 - min(max(remains, 0.0), MOST_REMAINING))
        if bool((delay.abs() > LARGEST).any()):
            return None
        moved = motion.during(delay)
        if bool(step.abs().max() < CLOSE):
            break
    apart = (parts[0].delay - parts[1].delay).abs().max()
    if bool((usual[-1] > MOST_LEFT * usual[0]).all()) or not bool(apart <= MOST_APART * delay.abs().max()):
        return None
    after = delay - delay.median()
    delays = Delays(tuple(round(value, 4) for value in after.tolist()), rig.camera_names)
    return delays, _move_back(labelled, moved.numpy(), motion.variance(delay).numpy())


def _wide(rows: Tensor) -> Tensor:
    """Shape a mask (S,) for (S, C, N, 2)."""
    return rows[:, None, None, None]


@dataclass(frozen=True)
class _Residuals:
    """Residuals and motion of labels where both are known; zero elsewhere."""

    residual: Tensor  # (S, C, N, 2) px, predicted minus observed
    velocity: Tensor  # (S, C, N, 2) px per snapshot
    views: Tensor  # (C,) images
    usual: Tensor  # (C,) px, median length of a camera's residuals

    @classmethod
    def of(cls, residual: Tensor, motion: Motion, seen: Tensor) -> _Residuals:
        """Leave out labels (S, C, N) that are wrong, and snapshots without neighbours."""
        size = residual.norm(dim=-1)
        usual = torch.where(seen, size, torch.nan).transpose(0, 1).flatten(1).nanmedian(-1).values  # of each camera
        used = seen & (motion.neighbours > 0)[:, None, None] & (size < OUTLIER * usual[:, None])
        there = used[..., None]
        return cls(
            torch.where(there, residual, 0.0), torch.where(there, motion.velocity, 0.0), used.any(-1).sum(0), usual
        )

    def of_rows(self, rows: Tensor) -> _Residuals:
        """Keep some snapshots."""
        return replace(self, residual=self.residual[rows], velocity=self.velocity[rows])

    @property
    def power(self) -> Tensor:
        """Squared motion of each camera: (C,)."""
        return self.velocity.square().sum((0, 2, 3))

    @property
    def delay(self) -> Tensor:
        """Delay (C,) by regression."""
        return -(self.velocity * self.residual).sum((0, 2, 3)) / self.power

    @property
    def explained(self) -> Tensor:
        """Share (C,) of the squared residuals that the delays explain."""
        return self.delay.square() * self.power / self.residual.square().sum((0, 2, 3)).clamp_min(1e-30)


def _move_back(labelled: Associations, moved: NDArray[np.float64], variance: NDArray[np.float64]) -> Detections:
    """Move the labelled blobs of used snapshots by what happened during the delays."""
    detections = labelled.detections
    row = np.full(len(labelled.snapshots), -1)
    row[labelled.used] = np.arange(len(labelled.used))
    mine = np.flatnonzero((row[detections.snapshot] >= 0) & (detections.fiducial >= 0))
    where = row[detections.snapshot[mine]], detections.camera[mine], detections.fiducial[mine]
    uv, sigma = detections.uv.copy(), detections.sigma.copy()
    uv[mine] -= moved[where]
    sigma[mine] = np.sqrt(np.square(sigma[mine]) + variance[where])
    return replace(detections, uv=uv, sigma=sigma)
