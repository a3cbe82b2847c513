"""Match blobs to fiducials snapshot by snapshot: each accepted snapshot helps with the next."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association.identity import TOO_FEW_BLOBS, PipelineOptions
from imgcal.association.proposals import Sight
from imgcal.association.tracker import SnapshotIdentity, Tracker, to_observations
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import UNPOSED
from imgcal.geometry import RigidTransform
from imgcal.messages import list_names, plural
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations

NOT_TRIED = "not tried: nothing could be decided in many snapshots before"
MOST_IN_VAIN = 8_000_000
"""Number of hypotheses without success after which only a subset of the other snapshots is tried, at the same cost."""

MOST_LOOKS_IN_VAIN = 8
"""Number of snapshots without a proposal after which the proposer stops; each success allows as many more."""
PATTERN = 3
"""Blobs of one camera that are likely to show the object, not only stray lights."""
LEAST_CERTAIN_FIRST = ("ambiguous", "by_prior", "unique", "coded", "by_tracking")

Pose = tuple[NDArray[np.float64], NDArray[np.float64]]  # rotation (3, 3), translation (3,) mm: quicker than tensors
Progress = Callable[[Iterable[int], int], Iterable[int]]


@dataclass(frozen=True)
class Associations:
    """Detections with a fiducial for every identified blob, and how each snapshot was decided."""

    detections: Detections  # `fiducial` filled in, -1 = not used
    snapshots: tuple[SnapshotIdentity, ...]  # S
    rig: CameraRig | None = None  # to which the poses belong; None = the factory rig
    rests_with: Mapping[int, int] = field(default_factory=dict)  # rows of an object at rest: the row of their average

    def __repr__(self) -> str:
        """Summarize how much was decided, and how."""
        return f"Associations({len(self.used)} of {len(self.snapshots)} snapshots {self.identity}, {self.detections!r})"

    @property
    def used(self) -> list[int]:
        """Numbers of the snapshots that are neither refused nor part of the average of another one."""
        return [i for i, s in enumerate(self.snapshots) if s.status != "refused" and i not in self.rests_with]

    @property
    def used_rows(self) -> NDArray[np.int64]:
        """For each row, the used row that stands for it, itself or the average of a rest, -1 = refused: (S,)."""
        row, used = np.full(len(self.snapshots), -1), self.used
        row[used] = np.arange(len(used))
        row[list(self.rests_with)] = row[list(self.rests_with.values())]
        return row

    @property
    def moments(self) -> NDArray[np.int64]:
        """Number of the input snapshot that each row belongs to, ascending: (S,).

        With one object, rows are snapshots. With several objects or unknown markers, a row is one of them in a
        snapshot, and a snapshot with none of them is a single refused row.
        """
        return np.array([row if s.moment < 0 else s.moment for row, s in enumerate(self.snapshots)], dtype=np.int64)

    @property
    def moment_counts(self) -> tuple[int, int]:
        """Number of the input's snapshots with a used row, and of all."""
        moments = self.moments
        return len(np.unique(moments[self.used_rows >= 0])), len(np.unique(moments))

    @property
    def part_of_rows(self) -> NDArray[np.int64]:
        """Number of the object in each used row: (U,)."""
        return np.array([self.snapshots[row].part for row in self.used], dtype=np.int64)

    def columns(self, obj: CalibrationObject) -> NDArray[np.bool_]:
        """Mark the fiducials that each used row may show: (U, 1, N)."""
        return (obj.part_of == self.part_of_rows[:, None])[:, None]

    @property
    def before_rows(self) -> NDArray[np.int64]:
        """For each used row, the used row of the same object one snapshot earlier, -1 = there is none: (U,).

        With several unknown markers, the correspondence between snapshots is unknown.
        """
        keys = list(zip(self.moments[self.used].tolist(), self.part_of_rows.tolist(), strict=True))
        count = Counter(keys)
        rows = {key: row for row, key in enumerate(keys) if count[key] == 1}
        before = [rows.get((moment - 1, part), -1) if count[moment, part] == 1 else -1 for moment, part in keys]
        return np.array(before, dtype=np.int64)

    def by_moment(self) -> Detections:
        """The detections numbered by the input's snapshots instead of by rows."""
        if all(snapshot.moment < 0 for snapshot in self.snapshots):
            return self.detections
        moments = self.moments
        names = dict(zip(moments.tolist(), self.detections.snapshot_names, strict=True))
        return replace(
            self.detections, snapshot=moments[self.detections.snapshot], snapshot_names=tuple(names.values())
        )

    def repeat_unlabelled(self, obj: CalibrationObject) -> Detections:
        """The detections, with unlabelled blobs repeated in the row of every known object of their snapshot."""
        detections, moments = self.detections, self.moments
        known = np.array([not obj.each[snapshot.part].unknown_markers for snapshot in self.snapshots])
        count = np.bincount(moments)
        left = np.flatnonzero((detections.fiducial < 0) & (count[moments] > 1)[detections.snapshot])
        if not len(left):
            return detections
        rows = np.split(np.arange(len(moments)), np.cumsum(count)[:-1])
        where = [np.setdiff1d(rows[moments[s]], s) for s in detections.snapshot[left]]
        where = [others[known[others]] for others in where]
        more = np.repeat(left, [len(part) for part in where])
        table = detections.select(np.concatenate((np.arange(len(detections)), more)))
        table.snapshot[len(detections) :] = np.concatenate([*where, np.empty(0, dtype=np.int64)])
        return table

    @property
    def identity(self) -> str:
        """How identity was decided as a whole: as in the least certain snapshot.

        Snapshots that were tracked from another one are as certain as that one.
        """
        found = {snapshot.status for snapshot in self.snapshots}
        return next((status for status in LEAST_CERTAIN_FIRST if status in found), "refused")


def associate(
    detections: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions = PipelineOptions(),
    progress: Progress | None = None,
    sight: Sight | None = None,
) -> Associations:
    """Match blobs to fiducials, snapshot by snapshot.

    Each accepted snapshot predicts the next one. The information of accepted snapshots about the rig narrows the search
    in the following; refused ones are tried again at the end, with the rig estimated from all others.

    Args:
        detections: blobs of all snapshots, cameras as in the rig; given labels are kept.
        rig: the factory calibration.
        obj: the calibration object.
        options: how certain each snapshot must be.
        progress: wraps the loop over snapshots.
        sight: a proposer with frames, used always or only if blobs are not sufficient. Its measurements are part of the
            result's detections.

    Raises:
        RefusedError: no snapshot could be identified.

    Examples:
        >>> import torch, imgcal
        >>> from dataclasses import replace
        >>> from imgcal.synthesis import simulate_truth, true_detections
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> seen = true_detections(simulate_truth(rig, obj, 2, torch.Generator().manual_seed(0), None))
        >>> unlabelled = replace(seen, fiducial=np.full_like(seen.fiducial, -1))
        >>> found = associate(unlabelled, rig, obj)
        >>> found.identity, bool((found.detections.fiducial == seen.fiducial).all())
        ('unique', True)
    """
    if obj.parts:
        from imgcal.association.several_objects import associate_several  # it imports this module

        labelled = associate_several(detections, rig, obj, options, progress)
        if not labelled.used:
            raise _refusal(labelled.snapshots, sight)
        return labelled
    count = len(detections.snapshot_names)
    if obj.pose_rank < 6:
        sight = None  # it finds patterns, and these objects have none
    series = _Series(detections, Tracker(rig, obj, options), sight)
    order: Iterable[int] = range(count)
    series.decide_each(progress(order, count) if progress else order)
    accepted = series.accepted
    if len(accepted):
        series.retry_incomplete(accepted)
    if sight is not None and sight.where_blobs_fail:
        series.where_blobs_fail(sight, accepted)
    snapshots = tuple(series.results[s][0] for s in range(count))
    labelled = Associations(_label_blobs(detections, series.rows, series.results, series.looked), snapshots)
    if not labelled.used:
        raise _refusal(snapshots, sight)
    return labelled


class _Series:
    """Decisions so far about the snapshots of some detections."""

    def __init__(self, detections: Detections, tracker: Tracker, sight: Sight | None) -> None:
        self.detections, self.tracker, self.sight = detections, tracker, sight
        self.count = len(detections.snapshot_names)
        self.coded = _coded_snapshots(detections, self.count)
        self.rows = rows_by_snapshot(detections, self.count)
        self.results: dict[int, tuple[SnapshotIdentity, NDArray[np.int64]]] = {}
        self.looked: dict[int, Detections] = {}  # measurements in the frames that replace blobs
        self.rigs: dict[int, CameraRig] = {}  # the rig with which each snapshot was decided

    @property
    def accepted(self) -> NDArray[np.int64]:
        """Numbers of the snapshots that are not refused, ascending."""
        return np.array([s for s in range(self.count) if self.results[s][0].status != "refused"], dtype=np.int64)

    def decide_each(self, order: Iterable[int]) -> None:
        """Decide each snapshot, as long as this is promising."""
        patience = Patience(self.count)
        for number, s in enumerate(order):
            if self.coded[s] or patience.allows(number, self.tracker.in_vain):
                self.decide(s, self._expected_pose(s))
            else:
                self._mark_not_tried(s)

    def retry_incomplete(self, accepted: NDArray[np.int64]) -> None:
        """Try incomplete snapshots again, with the rig estimated from the accepted ones."""
        incomplete = [s for s in range(self.count) if not self.coded[s] and self._is_incomplete(s)]
        patience, tracker = Patience(len(incomplete)), self.tracker
        tracker.in_vain, tracker.looks_in_vain = 0, 0
        # Start with those nearest to accepted snapshots: they most probably show the object.
        for number, s in enumerate(sorted(incomplete, key=lambda s: _gap(s, accepted))):
            before = self.results[s]
            first, known_rig = before[0], self.rigs.get(s) is tracker.rig
            if patience.allows(number, tracker.in_vain):
                tracker.pose = self._nearest_pose(s, accepted) or tracker.pose
                # With the same rig, another search for a pose would find as little as the first.
                self.decide(s, search=first.status != "refused" or not known_rig)
            found, labels = self.results[s]
            if found.status == "refused" and known_rig:
                self.results[s] = before
            if first.status != "refused" and found.status != "refused":
                # It helped to estimate the rig, so more labels with this rig do not make it more certain.
                self.results[s] = replace(found, status=first.status, alternatives=first.alternatives), labels

    def _expected_pose(self, s: int) -> RigidTransform | None:
        """Pose of the object if it moves on; None where motion predicts the last snapshot no better than rest."""
        before = (self.results.get(i) for i in range(s - 3, s))
        first, second, third = (None if result is None else result[0].rig_from_object for result in before)
        if first is None or second is None or third is None or self.tracker.obj.pose_rank < 6:
            return None
        points = self.tracker.obj.points.double().numpy()
        poses = [(pose.rotation.double().numpy(), pose.translation.double().numpy()) for pose in (first, second, third)]
        moved = [_continue(poses[0], poses[1], points), poses[1]]
        shown = [points @ rotation.T + translation for rotation, translation in (*moved, poses[2])]
        by_motion, by_rest = (np.linalg.norm(one - shown[-1], axis=1).mean() for one in shown[:2])
        if by_motion >= by_rest:
            return None
        there = _continue(poses[1], poses[2], points)
        return RigidTransform(*(torch.from_numpy(part).to(third.rotation) for part in there))

    def _nearest_pose(self, s: int, accepted: NDArray[np.int64]) -> RigidTransform | None:
        """Pose of the nearest of the accepted snapshots, which may be the snapshot itself."""
        return self.results[_nearest(s, accepted)][0].rig_from_object

    def where_blobs_fail(self, sight: Sight, accepted: NDArray[np.int64]) -> None:
        """Search the frames of refused snapshots."""
        refused = [s for s in range(self.count) if self.results[s][0].status == "refused"]
        for s in sorted(refused, key=lambda s: _gap(s, accepted) if len(accepted) else s):
            self.look(s, sight)

    def decide(self, s: int, expected: RigidTransform | None = None, search: bool = True) -> None:
        """Decide one snapshot by its given labels, its frames or its blobs; see `Tracker.decide`."""
        name = self.detections.snapshot_names[s]
        self.rigs[s] = self.tracker.rig
        if self.coded[s]:
            self.results[s] = self.tracker.accept(name, self.detections.fiducial[self.rows[s]])
        elif self.sight is not None and not self.sight.where_blobs_fail:
            self.look(s, self.sight)
        else:
            self.results[s] = self.tracker.decide(self.detections.select(self.rows[s]), name, expected, search)

    def look(self, s: int, sight: Sight) -> None:
        """Decide one snapshot by its frames, as long as this is promising."""
        name, blobs = self.detections.snapshot_names[s], self.detections.select(self.rows[s])
        if self.tracker.looks_in_vain >= MOST_LOOKS_IN_VAIN:
            if sight.where_blobs_fail:
                self._mark_not_tried(s)
            else:
                self.looked.pop(s, None)
                self.results[s] = self.tracker.decide(blobs, name)
            return
        snapshot, labels, self.looked[s] = self.tracker.look(sight, s, blobs, name)
        self.results[s] = snapshot, labels

    def _mark_not_tried(self, s: int) -> None:
        name = self.detections.snapshot_names[s]
        self.results[s] = SnapshotIdentity(name, "refused", NOT_TRIED, 0, None), np.full_like(self.rows[s], -1)

    def _is_incomplete(self, s: int) -> bool:
        """Tell whether another try may help.

        It may where the snapshot was refused, where a camera has as many blobs as a pattern and no label, and where a
        camera has any blob and no label, but the rig is better known by now.
        """
        snapshot, labels = self.results[s]
        if snapshot.status == "refused":
            return True
        camera = self.looked[s].camera if s in self.looked else self.detections.camera[self.rows[s]]
        blobs, labelled = np.bincount(camera), np.bincount(camera[labels >= 0], minlength=camera.max() + 1)
        least = PATTERN if self.rigs.get(s) is self.tracker.rig else 1
        return bool((blobs[labelled == 0] >= least).any())


def _refusal(snapshots: Sequence[SnapshotIdentity], sight: Sight | None) -> RefusedError:
    """Say why no snapshot could be decided, and what may help where nothing but blobs was looked at."""
    reason = _most_frequent_reason(snapshots)
    advice = "if the frames show more markers, faint or not round, try --detector auto"
    helps = sight is None and reason.startswith(TOO_FEW_BLOBS)
    return RefusedError(f"identity: {reason}", command=advice if helps else "")


def _most_frequent_reason(snapshots: Sequence[SnapshotIdentity]) -> str:
    """Say why no snapshot could be decided: the most frequent reason."""
    if not snapshots:
        return "found no snapshot"
    reasons = Counter(snapshot.reason for snapshot in snapshots if snapshot.reason != NOT_TRIED)
    reason, times = reasons.most_common(1)[0]
    tried = plural(reasons.total(), "snapshot") + (
        f" tried, {len(snapshots)} in all" if reasons.total() < len(snapshots) else ""
    )
    return f"{reason} ({times} of {tried})"


def drop_snapshots(labelled: Associations, rows: Sequence[int], reason: str = UNPOSED) -> Associations:
    """Refuse snapshots (numbers among the used ones) whose labels do not determine a pose.

    Raises:
        RefusedError: no snapshot is left.
    """
    left = refuse_snapshots(labelled, rows, reason)
    if not left.used:
        raise RefusedError(f"estimation: in every snapshot, {reason}; capture more, with the whole object in view")
    return left


def refuse_snapshots(labelled: Associations, rows: Sequence[int], reason: str) -> Associations:
    """Remove the labels of snapshots (numbers among the used ones), and record the reason."""
    numbers, snapshots = np.flatnonzero(np.isin(labelled.used_rows, rows)), list(labelled.snapshots)
    for number in numbers.tolist():
        snapshots[number] = replace(snapshots[number], status="refused", reason=reason, rig_from_object=None)
    rests = {row: at for row, at in labelled.rests_with.items() if snapshots[row].status != "refused"}
    detections = labelled.detections
    fiducial = np.where(np.isin(detections.snapshot, numbers), -1, detections.fiducial)
    detections = replace(detections, fiducial=fiducial)
    return replace(labelled, detections=detections, snapshots=tuple(snapshots), rests_with=rests)


def _continue(before: Pose, last: Pose, points: NDArray[np.float64]) -> Pose:
    """Pose after the motion between two snapshots has happened once more, about the centroid of points (N, 3)."""
    centre, rotation = points.mean(0), last[0] @ before[0].T @ last[0]
    there = 2 * (last[0] @ centre + last[1]) - (before[0] @ centre + before[1])
    return rotation, there - rotation @ centre


def _gap(snapshot: int, accepted: NDArray[np.int64]) -> int:
    """Distance, in snapshots, to the nearest accepted one; `accepted` is ascending."""
    return abs(_nearest(snapshot, accepted) - snapshot)


def _nearest(snapshot: int, accepted: NDArray[np.int64]) -> int:
    """Nearest of the accepted snapshots, which are ascending; the earlier of two."""
    near = int(np.searchsorted(accepted, snapshot))
    return min(accepted[max(near - 1, 0) : near + 1].tolist(), key=lambda s: abs(s - snapshot))


@dataclass
class Patience:
    """Limits the effort for snapshots without a result: a wrong object, or clutter alone."""

    count: int  # number of snapshots
    first_left_out: int = -1
    stride: int = 1

    def allows(self, number: int, in_vain: int) -> bool:
        """Tell whether to try the next snapshot after `in_vain` hypotheses without success."""
        if in_vain <= MOST_IN_VAIN:
            self.first_left_out = -1
            return True
        if self.first_left_out < 0:
            self.first_left_out = number
            self.stride = max(1, round((self.count - number) * in_vain / max(number, 1) / MOST_IN_VAIN))
        return (number - self.first_left_out) % self.stride == self.stride - 1


def match_to_rig(detections: Detections, rig: CameraRig) -> Detections:
    """Renumber the cameras of detections in the order of the rig.

    Raises:
        InputError: the rig does not have one of the cameras.
    """
    unknown = [name for name in detections.camera_names if name not in rig.camera_names]
    if unknown:
        raise InputError(
            f"detections: found camera {list_names(unknown)}, expected cameras of rig {rig.name}: "
            f"{list_names(rig.camera_names)}"
        )
    index = np.array([rig.camera_names.index(name) for name in detections.camera_names], dtype=np.int64)
    camera = index[detections.camera] if len(detections) else detections.camera
    return replace(detections, camera=camera, camera_names=rig.camera_names)


def accepted_observations(
    labelled: Associations, rig: CameraRig, obj: CalibrationObject
) -> tuple[Observations, RigidTransform | None]:
    """Observations (U, C, N) of the U accepted snapshots, and rig_from_object (U,); None = some pose is unknown."""
    used = labelled.used
    detections = labelled.detections
    rows = detections.fiducial >= 0
    if len(used) < len(labelled.snapshots):
        rows &= np.isin(detections.snapshot, used)
    observations = to_observations(detections if rows.all() else detections.select(rows), rig, obj)
    poses = [labelled.snapshots[s].rig_from_object for s in used]
    known = [pose for pose in poses if pose is not None]
    return observations, RigidTransform.stack(known) if len(known) == len(used) else None


def _label_blobs(
    detections: Detections,
    rows: list[NDArray[np.int64]],
    results: dict[int, tuple[SnapshotIdentity, NDArray[np.int64]]],
    looked: dict[int, Detections],
) -> Detections:
    """Label the usable blobs of each snapshot; measurements in frames replace the blobs there."""
    fiducial, kept, parts = np.full(len(detections), -1, dtype=np.int64), np.ones(len(detections), dtype=bool), []
    for s, (snapshot, labels) in results.items():
        if snapshot.status == "refused":
            continue
        if s not in looked:
            fiducial[rows[s]] = labels
            continue
        kept[rows[s]] = False
        parts.append(replace(looked[s], fiducial=labels, snapshot=np.full(len(labels), s)))
    table = replace(detections, fiducial=fiducial)
    if not parts:
        return table
    parts.append(table.select(kept))
    columns = ("uv", "sigma", "camera", "snapshot", "fiducial", "radius", "flags")
    values: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in columns}
    table = replace(table, **values)
    return table.select(np.lexsort((table.camera, table.snapshot)))


def rows_by_snapshot(detections: Detections, count: int) -> list[NDArray[np.int64]]:
    """Rows of the usable blobs of each snapshot, in one pass over the table."""
    usable = np.flatnonzero(detections.usable)
    snapshot = detections.snapshot[usable]
    order = np.argsort(snapshot, kind="stable")
    return np.split(usable[order], np.searchsorted(snapshot[order], np.arange(1, count)))[:count]


def _coded_snapshots(detections: Detections, count: int) -> NDArray[np.bool_]:
    """Tell which snapshots come with labels."""
    coded = np.zeros(count, dtype=bool)
    coded[detections.snapshot[detections.fiducial >= 0]] = True
    return coded
