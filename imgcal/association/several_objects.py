"""Several known objects in one capture: match blobs to the fiducials of each object, snapshot by snapshot.

Each object is searched for independently among the blobs not taken by others. The one with the most evidence comes
first. Objects of the same make are found one by one; their order does not matter for the rig. Blobs that two objects
explain about equally well are left out, and so is an object that could equally be at another place that nothing else
explains.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association.identity import Identity, PipelineOptions
from imgcal.association.series import NOT_TRIED, Associations, Patience, Progress, rows_by_snapshot
from imgcal.association.tracker import MOST_REMEMBERED, LearntRig, SnapshotIdentity, Tracker
from imgcal.errors import InputError
from imgcal.types import CalibrationObject, CameraRig, Detections

CLAIMED = 0.5
"""Minimum share of a rival's blobs that belong to other objects, for it to be one of these."""
AROUND = 3.0
"""Distance (px) around a found object's images within which blobs are its own."""

Bools = NDArray[np.bool_]
Row = tuple[SnapshotIdentity, NDArray[np.int64]]  # labels of all blobs of the snapshot, numbered over all objects


def associate_several(
    detections: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions,
    progress: Progress | None = None,
) -> Associations:
    """Do what `associate` does, for several objects: each row of the result is an object found in a snapshot.

    Args:
        detections: blobs of all snapshots, cameras as in the rig; given labels are kept.
        rig: the factory calibration.
        obj: several objects, see `CalibrationObject.of_several`.
        options: how certain each row must be.
        progress: wraps the loop over snapshots.

    Raises:
        InputError: the options give a pose of the first snapshot, but not of which object.
    """
    if options.start_pose is not None:
        raise InputError("start pose: found several objects, expected a single one")
    options = replace(options, identity=replace(options.identity, others_in_view=True))
    learnt = LearntRig(rig, obj, options, MOST_REMEMBERED * len(obj.parts))
    first = np.searchsorted(obj.part_of, np.arange(len(obj.parts)))
    trackers = [
        Tracker(rig, part, options, learnt=learnt, first=int(row))
        for part, row in zip(obj.parts, first, strict=True)
        if not part.unknown_markers  # they are found once the rig is known
    ]
    scene = _Capture(detections, trackers, obj)
    count = len(detections.snapshot_names)
    order: Iterable[int] = range(count)
    scene.decide(progress(order, count) if progress else order, count)
    incomplete = [s for s in range(count) if not scene.coded[s] and len(scene.found[s]) < len(trackers)]
    if len(incomplete) < count:  # the rig learned from the others may help
        for tracker in trackers:
            tracker.in_vain = 0
        scene.decide(incomplete, len(incomplete))
    return scene.associations()


class _Capture:
    """Decisions so far about the snapshots of a capture."""

    def __init__(self, detections: Detections, trackers: Sequence[Tracker], obj: CalibrationObject) -> None:
        self.detections, self.trackers, self.obj = detections, trackers, obj
        count = len(detections.snapshot_names)
        self.rows = rows_by_snapshot(detections, count)
        self.coded = np.zeros(count, dtype=bool)
        self.coded[detections.snapshot[detections.fiducial >= 0]] = True
        self.found: dict[int, list[Row]] = {s: [] for s in range(count)}  # accepted rows by snapshot
        self.reasons = [""] * count

    def decide(self, order: Iterable[int], count: int) -> None:
        """Decide each snapshot, as long as this is promising; of two decisions, keep the one with more objects."""
        patience = [Patience(count) for _ in self.trackers]
        for number, s in enumerate(order):
            found: list[Row] = []
            reason, name = NOT_TRIED, self.detections.snapshot_names[s]
            if self.coded[s]:
                found, reason = self._accept_labels(s)
            else:
                hopeful = [p for p, t in enumerate(self.trackers) if patience[p].allows(number, t.in_vain)]
                if hopeful:
                    found, reason = place_objects(self.trackers, hopeful, self.detections.select(self.rows[s]), name, s)
            if len(found) > len(self.found[s]) or not self.reasons[s]:
                self.found[s], self.reasons[s] = found, reason

    def _accept_labels(self, s: int) -> tuple[list[Row], str]:
        """Take a snapshot's given labels."""
        name, given, found, reason = self.detections.snapshot_names[s], self.detections.fiducial[self.rows[s]], [], ""
        for part, tracker in enumerate(self.trackers):
            own = np.where((given >= 0) & (self.obj.part_of[given] == part), given, -1)
            if (own >= 0).any():
                snapshot, _ = tracker.accept(name, own)
                reason = reason or snapshot.reason
                if snapshot.status != "refused":
                    found.append((replace(snapshot, moment=s, part=part), own))
        return found, reason

    def associations(self) -> Associations:
        """Number blobs by rows; unlabelled ones go into the first row of their snapshot."""
        detections, snapshots, names = self.detections, list[SnapshotIdentity](), list[str]()
        row_of = np.zeros(len(detections), dtype=np.int64)
        fiducial = np.full(len(detections), -1, dtype=np.int64)
        begin = np.zeros(len(self.found) + 1, dtype=np.int64)
        for s, found in self.found.items():
            begin[s] = len(snapshots)
            name = detections.snapshot_names[s]
            if not found:
                snapshots.append(SnapshotIdentity(name, "refused", self.reasons[s], 0, None, moment=s))
            for snapshot, labels in found:
                mine = self.rows[s][labels >= 0]
                fiducial[mine], row_of[mine] = labels[labels >= 0], len(snapshots) - begin[s]
                snapshots.append(snapshot)
            names += [name] * max(len(found), 1)
        table = replace(
            detections, fiducial=fiducial, snapshot=begin[detections.snapshot] + row_of, snapshot_names=tuple(names)
        )
        return Associations(table, tuple(snapshots))


@dataclass(frozen=True)
class _Placed:
    """An object that was found."""

    tracker: int
    identity: Identity  # with labels of all blobs of the snapshot
    own: Bools  # (M,) blobs that belong to it, labelled or not


def place_objects(
    trackers: Sequence[Tracker], asked: Sequence[int], blobs: Detections, name: str, moment: int
) -> tuple[list[Row], str]:
    """Find the objects in view of one snapshot, and label their blobs.

    Args:
        trackers: one per object, with its state.
        asked: numbers of the objects to search for.
        blobs: usable blobs of the snapshot.
        name: of the snapshot.
        moment: its number.

    Returns:
        The accepted rows, and why others were not accepted.
    """
    placed, reason = _place_objects(trackers, asked, blobs)
    found: list[Row] = []
    for part, identity in placed:
        tracker = trackers[part]
        snapshot, labels = tracker.conclude(identity, blobs, name)
        if snapshot.status == "refused":
            reason = reason or snapshot.reason
            continue
        found.append((replace(snapshot, moment=moment, part=part), np.where(labels >= 0, labels + tracker.first, -1)))
    return sorted(found, key=lambda row: row[0].part), reason


def _place_objects(
    trackers: Sequence[Tracker], asked: Sequence[int], blobs: Detections
) -> tuple[list[tuple[int, Identity]], str]:
    """Place objects one by one, the most certain first; then remove those that are uncertain after all."""
    free, placed, left = np.ones(len(blobs), dtype=bool), list[_Placed](), list(asked)
    proposals: dict[int, Identity] = {}
    reason = ""
    # A false stick may consist of markers of another object in view that was not identified.
    doubtful = any(t.obj.pose_rank == 6 and part not in left for part, t in enumerate(trackers))
    while left:
        solid = max(trackers[part].obj.pose_rank for part in left)
        asked = [part for part in left if trackers[part].obj.pose_rank == solid]
        if solid < 6 and doubtful:
            break
        for part in asked:
            if part not in proposals:
                proposals[part] = _propose(trackers[part], blobs, free)
        accepted = [part for part in asked if proposals[part].accepted]
        if not accepted:
            refusal = max((proposals[part] for part in asked), key=lambda found: found.evidence)
            reason = reason or refusal.reason
            doubtful = doubtful or solid == 6
            left = [part for part in left if part not in asked]
            for part in asked:
                trackers[part].in_vain += proposals[part].hypotheses
            continue
        best = max(accepted, key=lambda part: proposals[part].evidence)
        rival = _same_blobs(best, accepted, proposals, trackers)
        if rival is not None:
            reason = f"{trackers[best].obj.name} and {trackers[rival].obj.name} explain the same blobs nearly as well"
            left = [part for part in left if part not in (best, rival)]
            free &= (proposals[best].labels < 0) & (proposals[rival].labels < 0)
            doubtful = True
        else:
            own = _own_blobs(proposals[best], trackers[best], blobs)
            placed.append(_Placed(best, proposals[best], own))
            left.remove(best)
            free &= ~own
        proposals = {
            part: found
            for part, found in proposals.items()
            if part in left and found.accepted and not (~free & (found.labels >= 0)).any()
        }
    kept = [(one.tracker, one.identity) for one in placed if not _has_rival(one, placed)]
    if len(kept) < len(placed):
        reason = reason or "another place of an object explains the blobs nearly as well"
    return kept, reason


def _propose(tracker: Tracker, blobs: Detections, free: Bools) -> Identity:
    """Search for an object among the free blobs; the labels cover all blobs."""
    rows = np.flatnonzero(free)
    found = tracker.propose(blobs.select(rows))

    def spread(labels: NDArray[np.int64]) -> NDArray[np.int64]:
        every = np.full(len(blobs), -1, dtype=np.int64)
        every[rows] = labels
        return every

    rival = None if found.rival is None else spread(found.rival)
    return replace(found, labels=spread(found.labels), rival=rival)


def _same_blobs(
    best: int, accepted: Sequence[int], proposals: dict[int, Identity], trackers: Sequence[Tracker]
) -> int | None:
    """Return another object that explains the best one's blobs about equally well; None = there is none.

    Objects of the same make do not count: they are interchangeable.
    """
    mine, least = proposals[best], trackers[best].options.identity.least_margin
    for part in accepted:
        other = proposals[part]
        both = (mine.labels >= 0) & (other.labels >= 0)
        alike = trackers[part].obj.points.shape == trackers[best].obj.points.shape and torch.equal(
            trackers[part].obj.points, trackers[best].obj.points
        )
        if part != best and both.any() and not alike and other.evidence > mine.evidence - least:
            return part
    return None


def _own_blobs(identity: Identity, tracker: Tracker, blobs: Detections) -> Bools:
    """Mark the blobs (M,) of an object: its labelled ones, and others near its fiducials' images."""
    own: Bools = identity.labels >= 0
    if identity.rig is None or identity.rig_from_object is None:
        return own
    uv = identity.rig.project(identity.rig_from_object.apply(tracker.obj.points), tracker.obj.radius).uv.numpy()
    away = np.linalg.norm(uv[blobs.camera] - blobs.uv[:, None], axis=-1).min(1)
    return own | (away < AROUND)


def _has_rival(one: _Placed, placed: Sequence[_Placed]) -> bool:
    """Tell whether an object could equally be at a place where no other object is."""
    rival = one.identity.rival
    if rival is None:
        return False
    others = np.any([other.own for other in placed if other is not one] or [np.zeros_like(one.own)], axis=0)
    named = rival >= 0
    return int((named & others).sum()) < CLAIMED * int(named.sum())
