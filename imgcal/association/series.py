"""Which blob is which fiducial, snapshot by snapshot: each accepted one helps with the next."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imgcal.association.options import PipelineOptions
from imgcal.association.proposals import Sight
from imgcal.association.tracker import SnapshotIdentity, Tracker, to_observations
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import ON_A_LINE
from imgcal.geometry import RigidTransform
from imgcal.messages import list_names
from imgcal.types import CalibrationObject, CameraRig, Detections, Observations

NOT_TRIED = "not tried: nothing could be decided in many snapshots before"
MOST_IN_VAIN = 8_000_000
"""Hypotheses without any success, after which only a choice of the other snapshots is tried: as many once more."""

MOST_LOOKS_IN_VAIN = 8
"""Snapshots in which a proposer finds nothing, after which it looks at no more: as often again for each success."""
LEAST_CERTAIN_FIRST = ("ambiguous", "by_prior", "unique", "coded", "by_tracking")

Progress = Callable[[Iterable[int], int], Iterable[int]]


@dataclass(frozen=True)
class Associations:
    """Detections with a fiducial for every blob that has one, and how that was decided."""

    detections: Detections  # `fiducial` filled in, -1 = not used
    snapshots: tuple[SnapshotIdentity, ...]  # S

    def __repr__(self) -> str:
        """Say how much was decided, and how."""
        return f"Associations({len(self.used)} of {len(self.snapshots)} snapshots {self.identity}, {self.detections!r})"

    @property
    def used(self) -> list[int]:
        """Numbers of the snapshots that are not refused."""
        return [i for i, snapshot in enumerate(self.snapshots) if snapshot.status != "refused"]

    @property
    def moments(self) -> NDArray[np.int64]:
        """Number of the input's snapshot that each row is of, ascending: (S,).

        With one object, rows are snapshots. With several objects or unknown markers, a row is one of them in a
        snapshot, and a snapshot in which there are none is one row that was refused.
        """
        return np.array([row if s.moment < 0 else s.moment for row, s in enumerate(self.snapshots)], dtype=np.int64)

    @property
    def moment_counts(self) -> tuple[int, int]:
        """Number of the input's snapshots of which some row is used, and of all."""
        moments = self.moments
        return len(np.unique(moments[self.used])), len(np.unique(moments))

    @property
    def part_of_rows(self) -> NDArray[np.int64]:
        """Number of the object that each of the used rows shows: (U,)."""
        return np.array([self.snapshots[row].part for row in self.used], dtype=np.int64)

    def columns(self, obj: CalibrationObject) -> NDArray[np.bool_]:
        """Mark the fiducials that each used row may show: (U, 1, N)."""
        return (obj.part_of == self.part_of_rows[:, None])[:, None]

    @property
    def before_rows(self) -> NDArray[np.int64]:
        """Of each used row, the used row of the same object one snapshot earlier, -1 = there is none: (U,).

        Of several unknown markers nobody knows which one is which in another snapshot.
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

    def repeated(self, obj: CalibrationObject) -> Detections:
        """The detections in which blobs without a label belong to every known object of their snapshot."""
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
        """How identity was decided as a whole: as the least certain snapshot was.

        Snapshots that were followed from another are as certain as that one.
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
    """Decide which blob is which fiducial, snapshot by snapshot.

    Each accepted snapshot predicts the next one. What the accepted ones say about the rig narrows the search in the
    following; refused ones are tried once more at the end, with the rig that all the others gave.

    Args:
        detections: blobs of all snapshots, cameras as in the rig; snapshots that come with labels keep them.
        rig: the factory calibration.
        obj: the calibration object.
        options: how sure each snapshot must be.
        progress: wraps the loop over snapshots.
        sight: the frames, and who looks at them: at all, or where blobs decide nothing. What it measures is in the
            result's detections.

    Raises:
        RefusedError: no snapshot could be decided.

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
        from imgcal.association.several import associate_several  # it builds on this module

        labelled = associate_several(detections, rig, obj, options, progress)
        if not labelled.used:
            raise RefusedError(f"identity: {_why(labelled.snapshots)}")
        return labelled
    count = len(detections.snapshot_names)
    if obj.pose_rank < 6:
        sight = None  # it looks for patterns, and these objects have none
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
        raise RefusedError(f"identity: {_why(snapshots)}")
    return labelled


class _Series:
    """What was decided so far about the snapshots of some detections."""

    def __init__(self, detections: Detections, tracker: Tracker, sight: Sight | None) -> None:
        self.detections, self.tracker, self.sight = detections, tracker, sight
        self.count = len(detections.snapshot_names)
        self.coded = _coded_snapshots(detections, self.count)
        self.rows = _rows_by_snapshot(detections, self.count)
        self.results: dict[int, tuple[SnapshotIdentity, NDArray[np.int64]]] = {}
        self.looked: dict[int, Detections] = {}  # what was measured in the frames instead of blobs

    @property
    def accepted(self) -> NDArray[np.int64]:
        """Numbers of the snapshots that are not refused, ascending."""
        return np.array([s for s in range(self.count) if self.results[s][0].status != "refused"], dtype=np.int64)

    def decide_each(self, order: Iterable[int]) -> None:
        """Decide about each snapshot, as long as there is hope."""
        patience = Patience(self.count)
        for number, s in enumerate(order):
            if self.coded[s] or patience.tries(number, self.tracker.in_vain):
                self.decide(s)
            else:
                self._not_tried(s)

    def retry_incomplete(self, accepted: NDArray[np.int64]) -> None:
        """Try what is incomplete once more, with the rig that the accepted ones gave."""
        incomplete = [s for s in range(self.count) if not self.coded[s] and self._incomplete(s)]
        patience, tracker = Patience(len(incomplete)), self.tracker
        tracker.in_vain, tracker.looks_in_vain = 0, 0
        # Those nearest to where the object was seen first: they are the likeliest to show it.
        for number, s in enumerate(sorted(incomplete, key=lambda s: _gap(s, accepted))):
            first = self.results[s][0]
            if patience.tries(number, tracker.in_vain):
                self.decide(s)
            found, labels = self.results[s]
            if first.status != "refused" and found.status != "refused":
                # The rig that it helped to find labels more of it, but says nothing new of how sure it is.
                self.results[s] = replace(found, status=first.status, alternatives=first.alternatives), labels

    def where_blobs_fail(self, sight: Sight, accepted: NDArray[np.int64]) -> None:
        """Look at the frames of what is refused."""
        refused = [s for s in range(self.count) if self.results[s][0].status == "refused"]
        for s in sorted(refused, key=lambda s: _gap(s, accepted) if len(accepted) else s):
            self.look(s, sight)

    def decide(self, s: int) -> None:
        """Decide about one snapshot, by the labels it has, its frames or its blobs."""
        name = self.detections.snapshot_names[s]
        if self.coded[s]:
            self.results[s] = self.tracker.accept(name, self.detections.fiducial[self.rows[s]])
        elif self.sight is not None and not self.sight.where_blobs_fail:
            self.look(s, self.sight)
        else:
            self.results[s] = self.tracker.decide(self.detections.select(self.rows[s]), name)

    def look(self, s: int, sight: Sight) -> None:
        """Decide about one snapshot by its frames, as long as looks are worth it."""
        name, blobs = self.detections.snapshot_names[s], self.detections.select(self.rows[s])
        if self.tracker.looks_in_vain >= MOST_LOOKS_IN_VAIN:
            if sight.where_blobs_fail:
                self._not_tried(s)
            else:
                self.looked.pop(s, None)
                self.results[s] = self.tracker.decide(blobs, name)
            return
        snapshot, labels, self.looked[s] = self.tracker.look(sight, s, blobs, name)
        self.results[s] = snapshot, labels

    def _not_tried(self, s: int) -> None:
        name = self.detections.snapshot_names[s]
        self.results[s] = SnapshotIdentity(name, "refused", NOT_TRIED, 0, None), np.full_like(self.rows[s], -1)

    def _incomplete(self, s: int) -> bool:
        """Tell whether another try may help: the snapshot was refused, or no blob of some camera has a label."""
        snapshot, labels = self.results[s]
        camera = self.looked[s].camera if s in self.looked else self.detections.camera[self.rows[s]]
        return snapshot.status == "refused" or not np.isin(camera, camera[labels >= 0]).all()


def _why(snapshots: Sequence[SnapshotIdentity]) -> str:
    """Say why nothing could be decided: what was said most often."""
    if not snapshots:
        return "found no snapshot"
    reasons = Counter(snapshot.reason for snapshot in snapshots if snapshot.reason != NOT_TRIED)
    reason, times = reasons.most_common(1)[0]
    tried = f"{reasons.total()} snapshots" + (
        f" tried, {len(snapshots)} in all" if reasons.total() < len(snapshots) else ""
    )
    return f"{reason} ({times} of {tried})"


def drop_snapshots(labelled: Associations, rows: Sequence[int]) -> Associations:
    """Refuse snapshots (numbers among the used ones) whose labels lie on one line.

    Raises:
        RefusedError: none is left.
    """
    numbers, snapshots = [labelled.used[row] for row in rows], list(labelled.snapshots)
    for number in numbers:
        snapshots[number] = replace(snapshots[number], status="refused", reason=ON_A_LINE, rig_from_object=None)
    detections = labelled.detections
    fiducial = np.where(np.isin(detections.snapshot, numbers), -1, detections.fiducial)
    left = Associations(replace(detections, fiducial=fiducial), tuple(snapshots))
    if not left.used:
        raise RefusedError(f"estimation: in every snapshot: {ON_A_LINE}; capture more, with the whole object in view")
    return left


def _gap(snapshot: int, accepted: NDArray[np.int64]) -> int:
    """Snapshots to the nearest of the accepted ones, which are in ascending order."""
    near = int(np.searchsorted(accepted, snapshot))
    return int(np.abs(accepted[max(near - 1, 0) : near + 1] - snapshot).min())


@dataclass
class Patience:
    """Bounds the effort for snapshots in which nothing is found, however many: a wrong object, clutter alone."""

    count: int  # snapshots
    first_left_out: int = -1
    stride: int = 1

    def tries(self, number: int, in_vain: int) -> bool:
        """Tell whether the next snapshot is worth the effort, after so many hypotheses without any success."""
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
        InputError: a camera that the rig does not have.
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
    """Observations of the accepted snapshots, and their poses where identity found all of them."""
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
    """Give the usable blobs of each snapshot their labels; those that were looked at have other blobs there."""
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


def _rows_by_snapshot(detections: Detections, count: int) -> list[NDArray[np.int64]]:
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
