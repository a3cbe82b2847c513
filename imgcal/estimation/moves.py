"""Cameras that moved while snapshots were taken: which ones, when, and by how much.

Motion is relative, so a gauge is needed: relative to a camera that was bumped, all the others moved. A candidate camera
therefore gets a second place from some snapshot on, and everything is estimated again. The answer is the smallest set
of such steps that leaves nothing significant unexplained. Most cameras stand still, and they fix the gauge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from imgcal.estimation import EstimationOptions
from imgcal.estimation.change_points import (
    CLIP,
    LEAST_SNAPSHOTS,
    Blocks,
    Step,
    dispersion,
    is_significant,
    least_significant,
    likeliest_step,
    linearize_snapshots,
)
from imgcal.estimation.correlation import correlation_time
from imgcal.estimation.linearization import Problem, State, points_at, pose_at, rig_at
from imgcal.estimation.map_estimate import equations_at, minimize
from imgcal.estimation.pose_support import has_poses
from imgcal.estimation.robust_losses import NamedLoss, huber
from imgcal.medians import median
from imgcal.types import PARAMETER_KINDS, Kind, MovedCamera

# When a camera has moved.
FALSE_ALARM = 1e-5
"""Probability of naming a camera in a capture in which none has moved, if the noise is as stated."""
LEAST_MOVE = 0.15
"""Pixels, in the image of the camera: smaller moves do no harm, and slow drifts of every rig reach them. Multiplied by
the square root of the dispersion, since correlated errors reach more."""
LEAST_GAIN = 50.0
"""Smallest chi-squared of the kind of values that explains a step best."""
LEAST_MOTION = 0.9
"""Share of a step's chi-squared that a motion alone must explain, not counting the noise in other values."""
LEAST_SIGMAS = 5.0
"""Smallest size in standard deviations, given the dispersion, of the kind of values that explains a step best."""
MOST_UNEXPLAINED = 0.5
"""Largest share of a camera's misfit that may remain after it is given several places."""
MOST_MISFIT = 4.0
"""Largest cost of a label in the middle snapshot of a new place, in multiples of what noise alone would leave."""
LEAST_LEAD = 0.8
"""Relative to the best camera's statistic: another one that reaches this may be the one that moved."""

# Correlated errors.
EPISODE, LEAST_EPISODE = 2.0, 3
"""Longest transient error in correlation times, and its smallest length in snapshots where errors are correlated."""
PERSISTENT = 1e-3
"""Error probability of the evidence that must remain on either side of a step without the half that supports it most,
in one piece or by episodes, where errors are correlated: a camera that has moved stays there, but errors end."""
MOST_EPISODES, OUTERMOST = 4.0, 4
"""Longest time, in episodes, between a step and the nearer end of a capture for which the step may be an error that has
passed. Whether it has passed is judged by the outermost of these snapshots, one in so many."""
TRACE = 1e-3
"""Share of its root weight that a label keeps if the object's pose needs it but it must not count: a millionth of its
information, which decides nothing and still determines the pose."""
LEAST_LABELS = 2
"""Smallest number of labels from which the shift of a camera's image in a snapshot is computed."""

KINDS: dict[Kind, tuple[slice, float]] = {
    "rotation": (PARAMETER_KINDS["rotation"], 180 / np.pi),
    "position": (PARAMETER_KINDS["position"], 1.0),
    "focal_length": (PARAMETER_KINDS["focal_length"], 0.5**0.5),
}
"""Values of a camera by kind, and the factor from their norm to the reported size: degrees, mm, px along one axis."""

MOTION = slice(0, 6)  # rotation and position
MOUNT_JOINT = 150.0
"""Millimetres, one standard deviation per axis: distance between a camera's projection centre and the joint of its
mount, about which it turns."""
FAR_JOINT = 3.0
"""Standard deviations beyond which a camera was shifted by more than its turn about a joint explains."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Places:
    """A rig in which a camera may have several places in succession: V places, each treated as a camera."""

    problem: Problem  # one rig of V cameras
    state: State
    camera: tuple[int, ...]  # (V,) camera of the rig
    first: tuple[int, ...]  # (V,) row of the place's first snapshot
    moment: NDArray[np.int64]  # (S,) snapshot of each row, ascending: several objects or markers have a row each

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """Snapshots with labels: (S, V)."""
        return (self.problem.root_weight[0] > 0).any(-1).numpy()

    @cached_property
    def blocks(self) -> Blocks:
        """Normal equations of each snapshot."""
        return linearize_snapshots(self.problem, self.state)

    def divide(self, step: Step, options: EstimationOptions) -> Places:
        """Give a camera a new place from a step on, and estimate again."""
        problem, state, last = self.problem, self.state, len(self.camera)
        copies = [*range(last), step.camera]
        root_weight = problem.root_weight[:, :, copies].clone()
        root_weight[:, step.row :, step.camera] = 0
        root_weight[:, : step.row, last] = 0
        parted = replace(
            problem,
            uv=problem.uv[:, :, copies].contiguous(),
            root_weight=root_weight,
            factory=problem.factory.select(copies),
            prior_std=problem.prior_std[:, copies],
        )
        start = replace(state, offset=state.offset[:, copies])
        solution = minimize(parted, start, options)
        camera, first = (*self.camera, self.camera[step.camera]), (*self.first, step.row)
        return Places(parted, solution.state, camera, first, self.moment)

    def camera_places(self, camera: int) -> list[int]:
        """Indices of a camera's places, in temporal order."""
        return sorted((v for v, c in enumerate(self.camera) if c == camera), key=lambda v: self.first[v])

    def shift(self, before: int, after: int) -> float:
        """Median distance (px) between the images of the fiducials from two places."""
        rig, poses = rig_at(self.problem, self.state.offset)[0], pose_at(self.problem, self.state)[0]
        points = poses.apply(points_at(self.problem, self.state)[0] + self.problem.centroid)
        seen = rig.select([before, after]).expand(len(points)).project(points)
        both = seen.visible.all(1)
        distance = (seen.uv[:, 0] - seen.uv[:, 1]).norm(dim=-1)[both]
        return float(distance.median()) if len(distance) else 0.0

    def costs(self, place: int) -> Array:
        """Cost of each snapshot's labels if their camera were at one of its places: (S,) half chi-squared."""
        loss, _ = huber(self._squared_residuals(place, self.camera_places(self.camera[place])), CLIP)
        return 0.5 * loss.sum(-1).numpy()

    def cost_per_label(self, place: int) -> float:
        """Median, over a place's snapshots, of the mean cost of a label; noise alone leaves one."""
        labels = (self.problem.root_weight[0][:, place] > 0).sum(-1).numpy()
        return median((self.costs(place) / np.maximum(labels, 1))[labels > 0])

    def misfit(self, camera: int) -> float:
        """Chi-squared of a camera's labels, each clipped, in excess of the noise."""
        own = [self._squared_residuals(place, [place]) for place in self.camera_places(camera)]
        labels = [(self.problem.root_weight[0][:, place] > 0).sum() for place in self.camera_places(camera)]
        return float(sum(part.clamp_max(CLIP**2).sum() for part in own) - 2 * sum(labels))

    def drop_labels(self, place: int, rows: NDArray[np.int64]) -> Places:
        """Drop the labels of one place in some snapshots; the estimate stays.

        Where the others do not determine the object's pose, they keep a trace of their weight, and with it the pose.
        """
        problem, root_weight = self.problem, self.problem.root_weight.clone()
        root_weight[:, rows, place] = 0
        needed = rows[~has_poses((root_weight[0, rows] > 0).numpy(), problem.points, problem.part_of)]
        root_weight[:, needed, place] = TRACE * problem.root_weight[:, needed, place]
        return replace(self, problem=replace(problem, root_weight=root_weight))

    def comparable_rows(self, place: int) -> NDArray[np.int64]:
        """Snapshots with labels of a place in which the others determine the object's pose: only these can judge it."""
        others = (self.problem.root_weight[0] > 0).numpy()
        others[:, place] = False
        rows = np.flatnonzero(self.seen[:, place])
        return rows[has_poses(others[rows], self.problem.points, self.problem.part_of)]

    def episode(self, camera: int) -> int:
        """Longest transient error of a camera, in successive snapshots; 0 = errors are not correlated.

        The duration follows from the common shift of all labels of an image. All cameras together count as well, so
        that a camera with few labels is treated like the others. The position of each unknown marker adapts to an error
        of the whole image, so that correlation does not show: errors of several markers are taken to last.
        """
        shifts = self._shifts()
        own = float(correlation_time(shifts[:, [camera]])[0])
        known = np.isfinite(shifts[..., 0]).sum(0)
        spread = np.sqrt(np.nansum(np.square(shifts), axis=(0, 2)) / np.maximum(2 * known, 1))
        whitened = shifts / np.maximum(spread, 1e-12)[:, None]
        time = max(own, float(correlation_time(whitened[:, None])[0]))
        lasting = time > 1 or len(np.unique(self.moment)) < len(self.moment)
        return max(math.ceil(EPISODE * time), LEAST_EPISODE) if lasting else 0

    def _shifts(self) -> Array:
        """Weighted mean residual of each camera of the rig: (M, C, 2) px, NaN where there are too few labels."""
        weight = self.problem.root_weight[0].square().numpy()  # (S, V, N)
        residual = equations_at(self.problem, self.state, NamedLoss("squared")).residual[0].numpy()
        rows = np.flatnonzero(np.diff(self.moment, prepend=-1))  # first of each snapshot
        total, count = (np.add.reduceat(part, rows) for part in (weight.sum(-1), (weight > 0).sum(-1)))
        mean = np.add.reduceat(np.einsum("svn,svin->svi", weight, residual), rows) / np.maximum(total, 1e-30)[..., None]
        shifts = np.full((len(mean), max(self.camera) + 1, 2), np.nan)
        for place, camera in enumerate(self.camera):
            known = count[:, place] >= LEAST_LABELS
            shifts[known, camera] = mean[known, place]
        return shifts

    def _squared_residuals(self, place: int, labels: list[int]) -> Tensor:
        """Squared whitened residuals (S, N) of the labels of some places of a camera, predicted from one of them."""
        rig, poses = rig_at(self.problem, self.state.offset)[0], pose_at(self.problem, self.state)[0]
        points = poses.apply(points_at(self.problem, self.state)[0] + self.problem.centroid)
        uv = rig.select([place]).expand(len(points)).project(points, self._radius).uv[:, 0]
        weight = self.problem.root_weight[0][:, labels].sum(1)  # at most one place has the label
        return ((uv - self.problem.uv[0, :, place].mT) * weight[..., None]).square().sum(-1)

    @property
    def _radius(self) -> Tensor | None:
        squared = self.problem.radius_squared
        return None if squared is None else squared.sqrt()

    def change(self, before: int, after: int, noise: float) -> Change:
        """Difference between two places of a camera, with its information."""
        offset, prior_std = self.state.offset[0].numpy(), self.problem.prior_std[0, before].numpy()
        covariance = self.blocks.covariance.reshape(len(self.camera), len(prior_std), len(self.camera), len(prior_std))
        joint = covariance[before, :, before] + covariance[after, :, after]
        joint = joint - covariance[before, :, after] - covariance[after, :, before]
        information: Array = np.linalg.inv(noise * joint + 1e-12 * np.eye(len(prior_std))).astype(np.float64)
        return Change(information, information @ (offset[after] - offset[before]), prior_std)


@dataclass(frozen=True)
class Change:
    """A difference of a camera's values, whitened by the prior."""

    information: Array  # (K, K)
    pull: Array  # (K,) information times the difference
    prior_std: Array  # (K,) standard deviations of the prior

    def gain(self, part: slice) -> float:
        """Chi-squared of the difference if only some of the values may differ."""
        return float(self.pull[part] @ np.linalg.solve(self.information[part, part], self.pull[part]))

    @property
    def is_physical(self) -> bool:
        """Check that a motion or a change of focal length explains it; errors of the lens would change all values."""
        kinds = max(self.gain(part) for part, _ in KINDS.values())
        motion = max(self.gain(MOTION), self.gain(KINDS["focal_length"][0]))
        others = int((self.prior_std > 0).sum()) - MOTION.stop  # noise alone gives each an expected chi2 of one
        return kinds >= LEAST_GAIN and motion >= LEAST_MOTION * (self.gain(slice(None)) - others)

    @property
    def is_certain(self) -> bool:
        """Check that its main kind alone is significant, unlike that of the small steps that lens errors cause."""
        size, sigma = self._measure(self._main_kind, KINDS[self._main_kind][0])
        return size >= LEAST_SIGMAS * sigma

    def size(self) -> tuple[Kind, float, float]:
        """Kind, size and standard deviation, for the one kind of values that explains the difference best.

        A camera that turns about a joint of its mount is shifted with it, and one that is shifted may turn.
        """
        kind = self._main_kind
        if kind not in ("rotation", "position"):
            return kind, *self._measure(kind, KINDS[kind][0])
        precision = np.zeros(MOTION.stop)
        if kind == "rotation":
            angle = math.radians(self._measure(kind, KINDS[kind][0])[0])
            position = KINDS["position"][0]
            precision[position] = (self.prior_std[position] / (MOUNT_JOINT * angle)) ** 2
            change = np.linalg.solve(self.information[MOTION, MOTION] + np.diag(precision), self.pull[MOTION])
            if change @ (precision * change) > FAR_JOINT**2:
                precision[:] = 0
        return kind, *self._measure(kind, MOTION, precision)

    @property
    def _main_kind(self) -> Kind:
        return max(KINDS, key=lambda name: self.gain(KINDS[name][0]))

    def _measure(self, kind: Kind, free: slice, precision: Array | float = 0.0) -> tuple[float, float]:
        """Size of a kind of change, and its standard deviation, if some values may differ.

        Args:
            kind: of `KINDS`.
            free: the values that may differ, those of the kind included.
            precision: inverse prior variances of their whitened differences.
        """
        part, unit = KINDS[kind]
        own, scale = slice(part.start - free.start, part.stop - free.start), unit * self.prior_std[part]
        covariance = np.linalg.inv(
            self.information[free, free] + np.diag(np.broadcast_to(precision, free.stop - free.start))
        )
        change = (covariance @ self.pull[free])[own] * scale
        length = float(np.linalg.norm(change))
        direction = change / max(length, 1e-30)
        return length, float(direction @ (covariance[own, own] * scale * scale[:, None]) @ direction) ** 0.5


def longest_episode(problem: Problem, state: State, camera: int, moment: NDArray[np.int64]) -> int:
    """Longest transient error of a camera, in successive snapshots; 0 = errors are not correlated.

    Args:
        problem: one rig, with all labels.
        state: the estimate.
        camera: index of the camera.
        moment: (S,) snapshot of each row, ascending.
    """
    cameras = problem.uv.shape[2]
    return Places(problem, state, tuple(range(cameras)), (0,) * cameras, moment).episode(camera)


def find_moves(
    problem: Problem, state: State, camera_names: tuple[str, ...], snapshot_names: tuple[str, ...],
    options: EstimationOptions,
) -> tuple[MovedCamera, ...]:  # fmt: skip
    """Look for cameras that have moved between two snapshots.

    Args:
        problem: one rig of C cameras, with all labels, outliers included.
        state: the estimate.
        camera_names: C.
        snapshot_names: S, in temporal order; rows with the same name belong to one snapshot.
        options: how to estimate.

    Returns:
        In temporal order. Where two cameras explain a motion equally well, both are named: "cam01 or cam02".
    """
    cameras = len(camera_names)
    moment = np.cumsum([0, *(one != two for one, two in pairwise(snapshot_names))])
    places = still = Places(problem, state, tuple(range(cameras)), (0,) * cameras, moment)
    noise, doubts = 1.0, {}
    left_out: set[int] = set()
    for _ in range(3 * cameras):
        seen = places.seen & ~np.isin(places.camera, list(left_out))
        candidates = int(places.seen.sum())
        step = likeliest_step(places.blocks, seen, least_significant(candidates, FALSE_ALARM))
        if step is None:
            break
        divided = _locate(places, step, options)
        if divided is not None:
            # The statistics that remain after the step show how much of it correlated errors can mimic.
            left = dispersion(divided.blocks, divided.seen)
            new = len(divided.camera) - 1
            if (
                is_significant(step.statistic / left, candidates, FALSE_ALARM)
                and divided.shift(step.camera, new) >= LEAST_MOVE * left**0.5
                and (change := divided.change(step.camera, new, left)).is_physical
                and change.is_certain
                and divided.cost_per_label(new) <= MOST_MISFIT * left
                and _outlasts_an_episode(places, divided, step.camera, least_significant(candidates, FALSE_ALARM), left)
                and not _has_passed(places, divided, step.camera, options, left)
            ):
                doubts[new] = _doubts(places, step)
                places, noise = divided, left
                continue
        left_out.add(places.camera[step.camera])
    moving = {places.camera[v] for v in doubts}
    # Labels that are wrong in many snapshots scatter in all directions, so a few places cannot explain them.
    steady = {c for c in moving if places.misfit(c) > MOST_UNEXPLAINED * still.misfit(c)}
    return _describe(places, doubts, moving - steady, noise, camera_names, snapshot_names)


def _locate(places: Places, step: Step, options: EstimationOptions) -> Places | None:
    """Find the snapshot at which two places explain the most; None = too near an end to distinguish from an outlier."""
    divided = places.divide(step, options)
    new = len(divided.camera) - 1
    for _ in range(4):
        shown = np.flatnonzero(places.seen[:, step.camera])
        # Sum what the new place saves against the old one from each snapshot on.
        saved = (divided.costs(step.camera) - divided.costs(new))[shown]
        row = int(shown[np.cumsum(saved[::-1])[::-1].argmax()])
        if min((shown < row).sum(), (shown >= row).sum()) < LEAST_SNAPSHOTS:
            return None
        if row == step.row:
            break
        step = replace(step, row=row)
        divided = places.divide(step, options)
    return divided


def _outlasts_an_episode(places: Places, divided: Places, camera: int, least: float, noise: float) -> bool:
    """Check that a step does not rest on one episode, nor on the half of either side that supports it most.

    A transient error is no motion: a target at the edge of an image, or behind an arm, may seem to be off by pixels for
    some snapshots.

    Args:
        places: before the camera's time was divided.
        divided: afterwards; the new place is the last.
        camera: index of the divided place.
        least: smallest significant statistic.
        noise: factor by which statistics exceed those of independent noise.
    """
    new = len(divided.camera) - 1
    length, row = divided.episode(divided.camera[new]), divided.first[new]
    if not length:
        return True
    shown = places.comparable_rows(camera)
    saved = divided.costs(camera) - divided.costs(new)
    for rows, gain in ((shown[shown < row], -saved), (shown[shown >= row], saved)):
        moments, number = np.unique(places.moment[rows], return_inverse=True)
        if len(moments) <= length:
            return False
        gained, persistent = np.bincount(number, gain[rows]).astype(np.float64), least_significant(1, PERSISTENT)
        episode = number // length
        best = np.argsort(-np.bincount(episode, gain[rows]))[: (int(episode.max()) + 1) // 2]
        for dropped, enough in (
            (_best_window(number, gained, length), least),
            (_best_window(number, gained, len(moments) // 2), persistent),
            (np.isin(episode, best), persistent),  # an error may come again
        ):
            rest = places.drop_labels(camera, rows[dropped])
            if rest.blocks.statistics([camera], np.array([row]))[0, 0] < enough * noise:
                return False
    return True


def _best_window(number: NDArray[np.int64], gained: Array, length: int) -> NDArray[np.bool_]:
    """Tell which rows (R,), numbered by snapshot, are within the successive snapshots that gain most: (R,)."""
    first = int(np.convolve(gained, np.ones(length), "valid").argmax())
    return (number >= first) & (number < first + length)


def _has_passed(places: Places, divided: Places, camera: int, options: EstimationOptions, noise: float) -> bool:
    """Check whether a camera that left its place near an end of the capture is in it at that end: an error passed.

    Arguments as for `_outlasts_an_episode`. Both places are estimated without the outermost snapshots in question.
    """
    new, row = len(divided.camera) - 1, divided.first[-1]
    shown = places.comparable_rows(camera)
    before, after = shown[shown < row], shown[shown >= row]
    near, own, other = (before, camera, new) if len(before) < len(after) else (after, new, camera)
    moments = np.unique(places.moment[near])
    if len(moments) > MOST_EPISODES * divided.episode(divided.camera[new]):
        return False
    count = max(1, len(moments) // OUTERMOST)
    outer = near[np.isin(places.moment[near], moments[:count] if near is before else moments[-count:])]
    without = places.drop_labels(camera, outer).divide(Step(camera, row, 0.0, np.zeros(0)), options)
    judged = replace(divided, state=without.state)
    here, there = (float(judged.costs(place)[outer].sum()) for place in (own, other))
    labels = int((divided.problem.root_weight[0][outer, own] > 0).sum())
    least = 0.5 * least_significant(1, PERSISTENT) * noise
    return there <= MOST_MISFIT * noise * labels and here - there >= least


def _doubts(places: Places, step: Step) -> set[int]:
    """Other cameras of the rig that explain a step nearly as well."""
    near = np.flatnonzero(step.rivals > LEAST_LEAD * step.statistic)
    return {places.camera[v] for v in near} - {places.camera[step.camera]}


def _describe(
    places: Places, doubts: dict[int, set[int]], moving: set[int], noise: float,
    camera_names: tuple[str, ...], snapshot_names: tuple[str, ...],
) -> tuple[MovedCamera, ...]:  # fmt: skip
    moves = []
    for camera in sorted(moving):
        numbers = places.camera_places(camera)
        for before, after in pairwise(numbers):
            kind, size, sigma = places.change(before, after, noise).size()
            others = sorted(doubts.get(after, set()) - moving)
            name = " or ".join(camera_names[i] for i in (camera, *others))
            row = places.first[after]
            moves.append((row, MovedCamera(name, snapshot_names[row], kind, size, sigma)))
    return tuple(move for _, move in sorted(moves, key=lambda pair: (pair[0], pair[1].camera)))
