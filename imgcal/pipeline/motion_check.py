"""Check that all cameras stood still during a capture, before one rig is estimated from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import Associations, PipelineOptions, associate
from imgcal.errors import RefusedError
from imgcal.estimation import (
    CLIP,
    LEAST_SNAPSHOTS,
    Problem,
    Solution,
    State,
    find_moves,
    initial_state,
    longest_episode,
    make_problem,
    minimize,
    pose_at,
    rig_at,
)
from imgcal.geometry import RigidTransform
from imgcal.medians import MEDIAN_SQUARED
from imgcal.pipeline.camera_places import CameraView
from imgcal.pipeline.label_counts import LEAST_FOUND, LabelCounts, count_labels
from imgcal.pipeline.labelled_capture import LabelledCapture, arrange_frames, arrange_labels
from imgcal.types import CalibrationObject, CameraRig, Detections, MovedCamera, MovedError

LEAST_AGREEMENT = 0.9
"""Minimum share of the other cameras' labels that must agree when a snapshot is labelled again."""
MOST_MIXED = 0.2
"""Maximum share of snapshots of the other kind before and after the time at which a camera was lost."""
LEAST_CHANCE = 0.05
"""Maximum probability that chance separates a camera's wrong snapshots so cleanly, over all cameras that have any."""
EARLIER = "taken before a camera moved"
"""Why snapshots before the last move are refused."""
MOST_MOVES = 8  # maximum number of parts of a capture

Bools = NDArray[np.bool_]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class SteadyPart:
    """Snapshots during which no camera moved."""

    arranged: LabelledCapture  # snapshots before the last move are refused
    moved: tuple[MovedCamera, ...] = ()  # in chronological order
    fits: tuple[Solution, ...] = ()  # of one rig to all labels: with the noise for identification, with their own noise


def steady_part(
    arranged: LabelledCapture, detections: Detections, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions
) -> SteadyPart:
    """Leave out the snapshots before the last move of a camera.

    Args:
        arranged: all snapshots.
        detections: the same as given, with the labels of the input only.
        rig: the factory calibration.
        obj: the calibration object.
        options: whether to continue when a camera has moved.

    Raises:
        MovedError: a camera has moved, and the options do not say how to continue.
        RefusedError: no snapshot after the last move could be identified.
    """
    frames = arrange_frames(arranged.labelled, rig, obj) if arranged.labelled.rests_with else arranged
    found, fits = _moves(frames, rig, obj, options)
    if not found:
        return SteadyPart(arranged, fits=fits if frames is arranged else ())
    labelled, moved = arranged.labelled, list(found)
    total, first, names = len(detections.snapshot_names), 0, detections.snapshot_names
    for _ in range(MOST_MOVES):
        first = max(names.index(move.snapshot) for move in found if move.snapshot is not None)
        later = options.begin_at(_pose_from(labelled, first))
        explained = _are_explained(found, detections, first, rig, obj, (options, later))
        if not (options.after_last_move and explained):
            raise MovedError(moved, len(set(names[first:])), len(set(names)), explained, labelled.detections)
        part = associate(detections.of_snapshots(first, total), rig, obj, later)
        found = list_moves(part, rig, obj, options)
        if not found:
            return SteadyPart(arrange_labels(_prepend_earlier(part, labelled, names[first]), rig, obj), tuple(moved))
        moved += found
    raise MovedError(moved, len(set(names[first:])), len(set(names)), labelled=labelled.detections)


def _pose_from(labelled: Associations, first: int) -> RigidTransform | None:
    """The object's pose in the first snapshot from a number on in which it is known."""
    poses = (snapshot.rig_from_object for snapshot in labelled.snapshots[first:])
    return next((pose for pose in poses if pose is not None), None)


def _are_explained(
    moves: tuple[MovedCamera, ...], detections: Detections, first: int, rig: CameraRig, obj: CalibrationObject,
    options: tuple[PipelineOptions, PipelineOptions],
) -> bool:  # fmt: skip
    """Tell whether cameras that were lost at a moment fit the others before and after it, each part by itself.

    A motion of known size has been measured on both sides. If a camera fits on one side only, nothing shows that it
    moved: its labels or frames may be wrong on the other side.

    Args:
        moves: the moves found.
        detections: as given.
        first: number of the first snapshot after the last move.
        rig: the factory calibration.
        obj: the calibration object.
        options: how certain identification must be, before and after it.
    """
    lost = [rig.camera_names.index(move.camera) for move in moves if move.size is None]
    parts = (detections.of_snapshots(0, first), detections.of_snapshots(first, len(detections.snapshot_names)))
    for part, own in zip(parts, options, strict=True) if lost else ():
        try:
            counts = count_fitting_labels(arrange_frames(associate(part, rig, obj, own), rig, obj), rig, obj, own)
        except RefusedError:
            return False
        if (counts.unexplained > counts.kept)[:, lost].sum() > MOST_MIXED * (counts.usable > 0)[:, lost].sum():
            return False
    return True


def _prepend_earlier(part: Associations, labelled: Associations, first: str) -> Associations:
    """Restore the snapshots before the part that begins with the snapshot `first`, as refused ones."""
    rows = labelled.detections.snapshot_names.index(first)
    moment = int(labelled.moments[rows])
    earlier = tuple(
        s if s.status == "refused" else replace(s, status="refused", reason=EARLIER, rig_from_object=None)
        for s in labelled.snapshots[:rows]
    )
    # Rows of several objects were newly made; those of unknown markers are unchanged.
    later = tuple(
        replace(s, moment=labelled.snapshots[row].moment) if s.moment < 0 else replace(s, moment=moment + s.moment)
        for row, s in enumerate(part.snapshots, rows)
    )
    late = labelled.detections.snapshot >= rows
    fiducial = np.full(len(labelled.detections), -1, dtype=np.int64)
    snapshot = labelled.detections.snapshot.copy()
    fiducial[late], snapshot[late] = part.detections.fiducial, rows + part.detections.snapshot
    names = (*labelled.detections.snapshot_names[:rows], *part.detections.snapshot_names)
    table = replace(labelled.detections, fiducial=fiducial, snapshot=snapshot, snapshot_names=names)
    return Associations(table, (*earlier, *later))


def list_moves(
    labelled: Associations, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions
) -> tuple[MovedCamera, ...]:
    """List the cameras that moved between two snapshots, in chronological order."""
    return _moves(arrange_frames(labelled, rig, obj), rig, obj, options)[0]


def _moves(
    arranged: LabelledCapture, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions
) -> tuple[tuple[MovedCamera, ...], tuple[Solution, ...]]:
    """Do the work of `list_moves`, and return the fits of all labels, too.

    After a large move, identification that relies on earlier snapshots no longer labels the camera. Such snapshots are
    labelled independently, so that the size of the move can be measured.
    """
    labelled = arranged.labelled
    if len(labelled.used) < 2 * LEAST_SNAPSHOTS:
        return (), ()
    fit = _fit(arranged, rig, obj, options)
    fits, lost = fit.fits, _find_unlabelled(fit.tally)
    if (lost.sum(0) >= LEAST_SNAPSHOTS).any():
        again = _label_again(labelled, lost, rig, obj, options)
        fit = _fit(arrange_frames(again, rig, obj), rig, obj, options)
    names = tuple(labelled.snapshots[s].name for s in labelled.used)
    found = find_moves(fit.problem, fit.state, rig.camera_names, names, options.estimation)
    gone = _find_gone(fit, labelled, rig, obj, {move.camera for move in found})
    return tuple(sorted((*found, *gone), key=lambda move: names.index(move.snapshot))), fits


@dataclass(frozen=True)
class _Fit:
    """One rig for all labels, however badly some of them fit."""

    problem: Problem
    state: State
    tally: LabelCounts
    fits: tuple[Solution, ...]  # with the noise for identification, with that of the residuals


def count_fitting_labels(
    arranged: LabelledCapture, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions
) -> LabelCounts:
    """Count the labels, with those kept that one rig fits."""
    return _fit(arranged, rig, obj, options).tally


def _fit(arranged: LabelledCapture, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions) -> _Fit:
    """Estimate one rig from all labels, with the noise that the residuals show.

    If one rig cannot fit, this converges slowly, and need not converge: its residuals are then tested for steps.
    """
    observations = arranged.observations
    own, seen = observations.sigma.square(), observations.seen
    problem = make_problem(observations, rig, obj, None)
    state, noise = initial_state(problem, arranged.poses, arranged.labelled.rig), own + options.identity_error**2
    solutions: list[Solution] = []
    for _ in range(2):
        problem = replace(problem, root_weight=torch.where(seen, noise.rsqrt(), 0.0)[None])
        solutions.append(minimize(problem, state, options.estimation))
        state = solutions[-1].state
        squared, used = solutions[-1].equations.residual[0].square().sum(-2), noise
        taken = rig.num_parameters * rig.num_cameras + float(problem.pose_freedom)
        free = max(1 - taken / (2 * int(seen.sum())), 0.2)
        noise = own + (squared[seen].median() / (MEDIAN_SQUARED * free) - own[seen].median()).clamp_min(0)
    fitting = (squared <= CLIP**2 * used) & seen
    poses, fitted = pose_at(problem, state)[0], rig_at(problem, state.offset)[0]
    counts = count_labels(arranged.labelled, fitting.numpy(), poses, rig, obj, fitted)
    return _Fit(problem, state, counts, tuple(solutions))


def _find_unlabelled(counts: LabelCounts) -> Bools:
    """Snapshots in which most of a camera's possible view of the object has no label: (S, C)."""
    in_view = np.minimum(counts.expected, counts.usable)
    return (in_view > 0) & (2 * counts.labelled < in_view)


def _label_again(
    labelled: Associations, lost: Bools, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions
) -> Associations:
    """Label the snapshots in which cameras are `lost` (S, C) independently of the others, and take those labels."""
    detections, moments = labelled.detections, labelled.moments
    asked = np.isin(moments, moments[lost.any(1)])
    rows = np.flatnonzero(asked[detections.snapshot])
    try:
        given = labelled.by_moment() if obj.parts else detections
        given = replace(given.select(rows), fiducial=np.full(len(rows), -1))
        again = associate(given, rig, obj, options.begin_at(None)).detections
    except RefusedError:
        return labelled
    old, new = detections.fiducial[rows], again.fiducial
    snapshot = _row_of(labelled, detections.snapshot[rows], new, obj)
    here = (snapshot >= 0) & lost[snapshot, detections.camera[rows]]
    # A symmetric object may have another orientation in the new labels; the other cameras' labels show that.
    both = (old >= 0) & (new >= 0) & ~here
    count = len(labelled.snapshots)
    same = np.bincount(snapshot[both & (old == new)], minlength=count)
    agreed = same >= np.maximum(LEAST_AGREEMENT * np.bincount(snapshot[both], minlength=count), 3)
    taken = here & agreed[snapshot]
    fiducial, row = detections.fiducial.copy(), detections.snapshot.copy()
    fiducial[rows], row[rows] = np.where(taken, new, old), np.where(taken, snapshot, row[rows])
    return replace(labelled, detections=replace(detections, fiducial=fiducial, snapshot=row))


def _row_of(
    labelled: Associations, row: NDArray[np.int64], fiducial: NDArray[np.int64], obj: CalibrationObject
) -> NDArray[np.int64]:
    """Row (M,) for the blobs of some rows after relabelling; -1 = there is no row for that object."""
    if not obj.parts:
        return row
    table = np.full((int(labelled.moments[-1]) + 1, len(obj.parts)), -1, dtype=np.int64)
    table[labelled.moments[labelled.used], labelled.part_of_rows] = labelled.used
    return np.where(fiducial >= 0, table[labelled.moments[row], obj.part_of[fiducial]], row)


def _find_gone(
    fit: _Fit, labelled: Associations, rig: CameraRig, obj: CalibrationObject, known: set[str]
) -> list[MovedCamera]:
    """Find cameras that first saw the object in the right place and later in a wrong one, or vice versa.

    The probability that a moment separates the agreeing from the disagreeing snapshots so cleanly follows from random
    order. Where errors are correlated, more snapshots are needed than a transient error lasts.
    """
    counts, moments = fit.tally, labelled.moments[labelled.used]
    moves = []
    agrees, differs = compare_views(counts.kept, counts.unexplained, counts.expected)
    doubtful = int((differs.sum(0) >= LEAST_SNAPSHOTS).sum())
    for camera, name in enumerate(rig.camera_names):
        rows = np.flatnonzero(agrees[:, camera] | differs[:, camera])
        wrong = differs[rows, camera]
        if name in known or not LEAST_SNAPSHOTS <= wrong.sum() <= len(rows) - LEAST_SNAPSHOTS:
            continue
        least = max(LEAST_SNAPSHOTS, longest_episode(fit.problem, fit.state, camera, moments) + 1)
        place = split_cleanly(wrong, least, doubtful)
        if place is not None and _shows_object_elsewhere(fit, labelled, rig, obj, rows[~wrong], rows[wrong], camera):
            moves.append(MovedCamera(name, labelled.snapshots[rows[place]].name, "unknown"))
    return moves


def compare_views(kept: Rows, unexplained: Rows, expected: Rows) -> tuple[Bools, Bools]:
    """Tell where cameras agree with the rest of the rig, and where they differ: (S, C) each; see `LabelCounts`."""
    return kept > unexplained, (unexplained > kept) & (2 * unexplained >= expected)


def split_cleanly(wrong: Bools, least: int, cameras: int, mixed: float = MOST_MIXED) -> int | None:
    """Find the moment that separates a camera's agreeing snapshots from the others more cleanly than chance would.

    Args:
        wrong: (T,) the snapshots that disagree, in chronological order.
        least: smallest number of snapshots on either side.
        cameras: number of cameras that are tested like this.
        mixed: maximum share of snapshots of the other kind on either side.

    Returns:
        The first snapshot after it; None = there is no such moment.
    """
    total, count = len(wrong), int(wrong.sum())
    if total < 2 * least or not 0 < count < total:
        return None
    place = np.arange(least, total - least + 1)
    before = np.cumsum(wrong)[place - 1]
    from scipy.stats import hypergeom  # slow to import, and rarely needed

    chance = np.minimum(
        hypergeom.sf(before - 1, total, count, place), hypergeom.sf(count - before - 1, total, count, total - place)
    )
    best = int(chance.argmin())
    shares = before[best] / place[best], (count - before[best]) / (total - place[best])
    parted = min(shares) <= mixed and max(shares) >= 1 - mixed
    return int(place[best]) if parted and 2 * len(place) * cameras * chance[best] < LEAST_CHANCE else None


def _shows_object_elsewhere(
    fit: _Fit, labelled: Associations, rig: CameraRig, obj: CalibrationObject, right: Rows, wrong: Rows, camera: int
) -> bool:
    """Check that the blobs of a camera in the `wrong` snapshots are the object, and that only another place shows it.

    Blobs that are few may be reflections beside a hidden object. They do not follow it as its image does.
    """
    view = CameraView.of(labelled, pose_at(fit.problem, fit.state)[0], rig, obj, camera)
    right, wrong = (np.searchsorted(labelled.used, rows) for rows in (right, wrong))
    many = fit.tally.unexplained[:, camera][labelled.used][wrong] >= LEAST_FOUND
    is_object = 2 * many.sum() > len(wrong) or view.some_turn_explains(wrong)
    return is_object and not view.one_place_explains(right, wrong)
