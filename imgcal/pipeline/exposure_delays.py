"""Measure by how much each camera exposes later than the others, where that is constant or changes evenly.

Free-running cameras of one rate keep their phase, apart from the drift of their clocks. A camera that is late by a
tenth of an interval shows everything where it will be by then: its residuals lie along the motion of the object in its
image, in proportion to the speed. Delays are estimated together with poses and cameras, which adapt to them. A fit,
with blobs moved back to the common moment, gives a Gauss-Newton step of the delays; then everything is fitted again,
until nothing changes. What remains uncertain of the delays is part of the cameras' covariance. Random differences of
exposure times are another matter; see `synchronization.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import Associations, accepted_observations
from imgcal.estimation import Estimate, ModeEvidence, delay_evidence, estimate
from imgcal.geometry import RigidTransform
from imgcal.medians import median
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations

LEAST_VIEWS = 6
"""Minimum number of images with a known motion for a camera's delay to be known."""
LARGEST = 0.15
"""Snapshots: with larger delays, labels that fit are few and biased."""
MOST_SNAPSHOTS, STRETCH = 600, 60
"""Maximum number of snapshots from which delays are estimated, and the length of the stretches that are taken then."""
UNKNOWN = 0.1
"""Snapshots: standard deviation of a delay before anything is known of it."""
CLOCKS_DIFFER = 1e-4
"""Standard deviation of the clocks' rates: 100 ppm are usual of crystals."""
ROUNDS, CLOSE = 8, 1e-4
"""Most fits, and the change of a delay (snapshots) at which they end."""
NOTICEABLE = 0.002
"""Snapshots: smaller changes of a delay are not told in words."""
LEAST_NOISE = 1e-3
"""Pixels: least noise of a fit, if blobs are exact."""
OUTLIER = 5.0
"""Multiple of a camera's usual residual beyond which a label says nothing about timing."""
ODD_SIGMAS = 6.0
"""Standard deviations by which a camera's squared residuals exceed those of the others where it may be late alone."""
MOST_LEFT_OUT, FEW_LEFT_OUT = 0.1, 4
"""Outliers of a camera, as a share of its other labels and in number, above which it may be late, too."""
LEAST_EXPLAINED = 0.03
"""Share of some camera's squared residuals in the first fit that its delay must explain to be worth more fits."""
MOST_LEFT = 0.9
"""Maximum ratio of some camera's usual residual with delays to that without."""
LEAST, MOST_APART, LEAST_APART = 0.005, 0.1, 0.002
"""Snapshots: the largest delay must exceed this, because other errors explain as much. Maximum difference between the
delays in the two halves of a capture, relative to the largest delay; and snapshots that are always allowed."""
FASTEST = 0.3
"""Largest squared angular frequency of a motion (rad^2 per snapshot^2) to interpolate: eleven snapshots in a period."""
JUMP = 1.6
"""Ratio of the usual motion from one snapshot to the next to the larger one beside it, above which some are missing in
between."""


@dataclass(frozen=True)
class Delays:
    """Cameras that expose at other times than the median camera, by a time that is constant or changes evenly."""

    snapshots: tuple[float | None, ...]  # (C,) delay as a share of the interval between snapshots; None = unknown
    changes: tuple[float | None, ...]  # (C,) by how much it grows from the middle of the capture to the end
    cameras: tuple[str, ...]  # (C,)

    def __str__(self) -> str:
        """Describe them in words."""
        words = [
            f"{name} {'unknown' if delay is None else _add_sign(delay)}{_describe_growth(change)}"
            for name, delay, change in zip(self.cameras, self.snapshots, self.changes, strict=True)
        ]
        return (
            "the cameras expose at different times, each with a delay that stays the same or changes evenly (after the "
            f"median camera, as a share of the interval between snapshots): {', '.join(words)}; blobs were moved back "
            "along the object's motion; for the full accuracy, trigger the cameras together"
        )

    @property
    def values(self) -> dict[str, Any]:
        """Values for scripts."""
        delays, changes = (dict(zip(self.cameras, values, strict=True)) for values in (self.snapshots, self.changes))
        return {"snapshots": delays, "changes": changes, "note": str(self)}


def _add_sign(value: float) -> str:
    return f"{round(value, 3) + 0.0:+.3f}"


def _describe_growth(change: float | None) -> str:
    """Say by how much a delay changes within the capture, where that is worth a word."""
    if change is None or abs(change) < NOTICEABLE:
        return ""
    return f" (growing by {_add_sign(2 * change)} during the capture)"


@dataclass(frozen=True)
class Motion:
    """Motion of all fiducials in the images (S, C, N, 2): px per snapshot and per snapshot squared."""

    velocity: Tensor
    acceleration: Tensor
    neighbours: Tensor  # (S,) snapshots in a row that are known on both sides, 0 to 2; -1 = on neither side

    @classmethod
    def of(cls, uv: Tensor, seen: Tensor, before: NDArray[np.int64]) -> Motion:
        """Take differences of positions.

        Args:
            uv: (S, C, N, 2) px.
            seen: (S, C, N) positions that define whether snapshots are missing.
            before: see `Associations.before_rows`.
        """
        before = _without_jumps(uv, seen, before)
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
        return cls(velocity, bend, torch.where(has[1] | has[2], one.long() + two.long(), -1))

    def velocity_after(self, delay: Tensor) -> Tensor:
        """Velocity (S, C, N, 2) px per snapshot after delays (S, C)."""
        return self.velocity + self.acceleration * delay[..., None, None]

    def during(self, delay: Tensor) -> Tensor:
        """Motion (S, C, N, 2) px within delays (S, C)."""
        time = delay[..., None, None]
        return self.velocity * time + self.acceleration * (time**2 / 2)

    def _powers(self) -> tuple[Tensor, Tensor]:
        """Mean squared velocity and acceleration of each camera's image: (C,)."""
        known = self.neighbours > 0
        speed, bend = (values[known].square().mean((0, 2, 3)) for values in (self.velocity, self.acceleration))
        return speed, bend

    @property
    def rate(self) -> Tensor:
        """Squared angular frequency of the motion, if it is periodic: (C,) rad^2 per snapshot^2."""
        speed, bend = self._powers()
        return bend / speed.clamp_min(1e-12)

    def variance(self, delay: Tensor, unknown: Tensor) -> Tensor:
        """Variance (S, C, N) px^2 of each axis of `during`: what the differences leave out, if motion is periodic.

        Args:
            delay: (S, C).
            unknown: (C,) standard deviation of the delay.
        """
        speed, bend = self._powers()
        rate = self.rate
        nothing = speed * delay.square()
        line = bend * (delay / 2).square()
        three = speed * rate.square() * (delay / 6).square()
        five = speed * ((rate.square() * delay / 30).square() + (rate * delay**3 / 6).square())
        both = [term.expand(delay.shape) for term in (line, three, five, nothing)]  # the last one has number -1
        missing = torch.stack(both)[self.neighbours, torch.arange(len(delay))]  # (S, C)
        return missing[:, :, None] + self.velocity.square().mean(-1) * unknown.square()[:, None]


def has_odd_camera(residual: Tensor, observations: Observations, labelled: Associations) -> bool:
    """Tell whether some camera's labels fit worse than the others', beyond chance.

    Args:
        residual: (S, C, N, 2) px.
        observations: without outliers.
        labelled: with all labels.
    """
    size, sigma, seen = (values.numpy() for values in (residual, observations.sigma, observations.seen))
    relative = np.where(seen, np.square(size).sum(-1) / np.square(sigma), 0.0).sum((0, 2))
    used = seen.sum((0, 2))
    blobs, count = labelled.detections, np.maximum(used, 1)
    usual = median(relative / count)
    labels = (blobs.fiducial >= 0) & np.isin(blobs.snapshot, labelled.used)
    left_out = np.bincount(blobs.camera[labels], minlength=len(used)) - used
    large = relative > usual * (count + ODD_SIGMAS * np.sqrt(count))
    return bool((large | (left_out > np.maximum(MOST_LEFT_OUT * count, FEW_LEFT_OUT))).any())


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
    before, rows, courses = labelled.before_rows, _choose_stretches(len(observations.seen)), Courses.of(labelled)
    some = observations.of_snapshots(rows.tolist())
    numbers = np.full(len(before) + 1, -1)
    numbers[rows] = np.arange(len(rows))
    found = _estimate_delays(
        some, None if poses is None else poses[rows], numbers[before[rows]], courses.of_rows(rows), rig, obj
    )
    if found is None:
        return None
    delay, known, fit, motion = found
    if len(rows) < len(before):
        even = replace(observations, sigma=torch.ones_like(observations.sigma))
        fit = estimate(even, rig, obj.as_exact(), poses, initial_rig=fit.rig)
        motion = _motion(fit, observations.seen, before, obj)
    unknown, late = torch.where(known, 0.0, delay[0, known].square().mean().sqrt()), courses.at(delay)
    moved, variance = motion.during(late).numpy(), motion.variance(late, unknown).numpy()
    shares, changes = (
        tuple(round(one, 4) + 0.0 if is_known else None for one, is_known in zip(row, known.tolist(), strict=True))
        for row in delay.tolist()
    )
    return Delays(shares, changes, rig.camera_names), _move_back(labelled, moved, variance)


@dataclass(frozen=True)
class Courses:
    """What a delay may do over the snapshots: stay the same, and grow evenly from the middle of the capture on."""

    values: Tensor  # (2, S) of a delay of 1, and of one that grows by 1 until the end
    std: Tensor  # (2,) standard deviation of either, in snapshots, before anything is known of it

    @classmethod
    def of(cls, labelled: Associations) -> Courses:
        """Take the moments of the used snapshots."""
        moment = torch.from_numpy(labelled.moments[labelled.used]).double()
        half = max(float(moment.max() - moment.min()) / 2, 1.0)
        growth = (moment - (moment.max() + moment.min()) / 2) / half
        return cls(torch.stack((torch.ones_like(growth), growth)), growth.new_tensor((UNKNOWN, CLOCKS_DIFFER * half)))

    def of_rows(self, rows: NDArray[np.int64]) -> Courses:
        """Keep some snapshots."""
        return replace(self, values=self.values[:, rows])

    def at(self, delay: Tensor) -> Tensor:
        """Delays (S, C) in each snapshot, of delays and changes (2, C)."""
        return self.values.mT @ delay


def _choose_stretches(count: int) -> NDArray[np.int64]:
    """Choose snapshots of a long capture, in stretches evenly over it."""
    if count <= MOST_SNAPSHOTS:
        return np.arange(count)
    first = np.linspace(0, count - STRETCH, MOST_SNAPSHOTS // STRETCH).astype(np.int64)
    return np.unique(first[:, None] + np.arange(STRETCH))


def _estimate_delays(
    observations: Observations, poses: RigidTransform | None, before: NDArray[np.int64], courses: Courses,
    rig: CameraRig, obj: CalibrationObject,
) -> tuple[Tensor, Tensor, Estimate, Motion] | None:  # fmt: skip
    """Estimate delays and their changes together with the rig and the poses.

    Returns:
        The delays and changes (2, C), zero on median, which of them are known (C,), the latest fit and its motion; None
        if they do not explain the residuals.
    """
    rows, exact = torch.arange(len(observations.seen)), obj.as_exact()
    start, usual = rig, list[Tensor]()
    delay, moved = torch.zeros(2, rig.num_cameras, dtype=torch.float64), torch.zeros_like(observations.uv)
    inexact, all_known = torch.zeros_like(observations.sigma), torch.zeros_like(delay[0])
    for _ in range(ROUNDS):
        noise = max(float(usual[-1].nanmedian()), LEAST_NOISE) if usual else 1.0
        even = replace(observations, sigma=(inexact + noise**2).sqrt())
        fit = estimate(replace(even, uv=even.uv - moved), rig, exact, poses, initial_rig=start)
        if not bool(fit.converged):
            return None
        start, poses = fit.rig, fit.rig_from_object
        motion = _motion(fit, observations.seen, before, obj)
        residuals = _Residuals.of(fit.residual, motion, observations.seen)
        usual.append(residuals.usual)
        known = (residuals.views >= LEAST_VIEWS) & (residuals.power > 0)
        if int(known.sum()) < 2:
            return None
        in_vain = bool((residuals.explained[known] < LEAST_EXPLAINED).all())
        if len(usual) == 1 and (in_vain or float(motion.rate[known].median()) > FASTEST):
            return None
        evidence = _evidence(fit, motion, courses, delay, known)
        if evidence is None:
            return None
        step = torch.from_numpy(evidence.step).view_as(delay) * courses.std[:, None]
        # A delay of all cameras is no difference.
        step = torch.where(known, step - step[:, known].median(1, keepdim=True).values, 0.0)
        delay = delay + step
        late = courses.at(delay)
        if bool((late.abs() > LARGEST).any()):
            return None
        moved, inexact = motion.during(late), motion.variance(late, all_known)
        if bool((step.abs() < CLOSE).all()):
            break
    else:
        return None
    first, second = (residuals.of_rows(half).delay for half in (rows < len(rows) // 2, rows >= len(rows) // 2))
    left, largest = float((usual[-1] / usual[0])[known].min()), float(late.abs().max())
    apart = float((first - second)[known].abs().max())
    if left > MOST_LEFT or largest < LEAST or apart > max(MOST_APART * largest, LEAST_APART):
        return None
    return delay - delay[:, known].median(1, keepdim=True).values, known, fit, motion


def _evidence(fit: Estimate, motion: Motion, courses: Courses, delay: Tensor, known: Tensor) -> ModeEvidence | None:
    """Evidence on delays and changes (2, C) of known cameras (C,)."""
    velocity = torch.where(known[:, None, None], motion.velocity_after(courses.at(delay)), 0.0)
    return delay_evidence(fit.problem, fit.solution, fit.loss, velocity, courses.values, delay, courses.std)


def add_uncertainty(fit: Estimate, delays: Delays, labelled: Associations, obj: CalibrationObject) -> Estimate:
    """Add the uncertainty of corrected delays to an estimate.

    Args:
        fit: from blobs that were moved back.
        delays: by which they were.
        labelled: the snapshots of the fit.
        obj: the calibration object.
    """
    delay = [[0.0 if one is None else one for one in values] for values in (delays.snapshots, delays.changes)]
    known = torch.tensor([share is not None for share in delays.snapshots])
    motion = _motion(fit, fit.problem.root_weight[0] > 0, labelled.before_rows, obj)
    tau = torch.tensor(delay, dtype=torch.float64)
    return replace(fit, delays=_evidence(fit, motion, Courses.of(labelled), tau, known))


def _motion(fit: Estimate, seen: Tensor, before: NDArray[np.int64], obj: CalibrationObject) -> Motion:
    """Motion of the object in the images of a fit."""
    points = fit.rig_from_object.apply(fit.points_object)
    return Motion.of(fit.rig.expand(len(points)).project_values(points, obj.radius).uv, seen, before)


def _without_jumps(uv: Tensor, seen: Tensor, before: NDArray[np.int64]) -> NDArray[np.int64]:
    """Leave out neighbours (S,) from which the object has moved much farther than from the others to theirs."""
    rows = np.flatnonzero(before >= 0)
    both = seen[rows] & seen[before[rows]]
    length = torch.where(both, (uv[rows] - uv[before[rows]]).norm(dim=-1), torch.nan)
    step = np.full(len(before) + 1, np.nan)  # from the one before, px; the last one is none
    step[rows] = length.flatten(1).nanmedian(1).values.numpy()
    after = np.full(len(before) + 1, -1)
    after[before[rows]] = rows
    beside = np.fmax(step[before], step[after[: len(before)]])
    return np.where(step[: len(before)] > JUMP * beside, -1, before)


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
        """Delay (C,) by regression; zero where nothing moved."""
        return -(self.velocity * self.residual).sum((0, 2, 3)) / self.power.clamp_min(1e-30)

    @property
    def explained(self) -> Tensor:
        """Share (C,) of the squared residuals that the delays explain."""
        return self.delay.square() * self.power / self.residual.square().sum((0, 2, 3)).clamp_min(1e-30)


def _move_back(labelled: Associations, moved: NDArray[np.float64], variance: NDArray[np.float64]) -> Detections:
    """Move the labelled blobs of used snapshots by what happened during the delays."""
    detections = labelled.detections
    row = labelled.used_rows
    mine = np.flatnonzero((row[detections.snapshot] >= 0) & (detections.fiducial >= 0))
    where = row[detections.snapshot[mine]], detections.camera[mine], detections.fiducial[mine]
    uv, sigma = detections.uv.copy(), detections.sigma.copy()
    uv[mine] -= moved[where]
    sigma[mine] = np.sqrt(np.square(sigma[mine]) + variance[where])
    return replace(detections, uv=uv, sigma=sigma)
