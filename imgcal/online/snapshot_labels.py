"""Label a snapshot of a rig that is kept calibrated: from the last pose, or independently."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from imgcal.association import to_observations
from imgcal.detection import Frame
from imgcal.errors import RefusedError
from imgcal.estimation import initial_pose
from imgcal.geometry import RigidTransform
from imgcal.online.keeper_memory import UNUSUAL, KeeperMemory
from imgcal.online.label_consistency import Checked, check_labels, predict_usual
from imgcal.online.labelling import LEAST_FOLLOWED, Labelling
from imgcal.online.light_labels import label_lights
from imgcal.online.object_checks import object_event
from imgcal.online.prediction_labels import near_prediction
from imgcal.online.snapshot_update import test_clocks, test_object
from imgcal.pipeline import settle_labels
from imgcal.types import Detections

Correct = Callable[[Detections, RigidTransform], Detections]
"""Moves labelled blobs of late cameras to where they would have been in time, given the object's pose (1,)."""

MOST_VAIN = 64
"""Successive snapshots that fit in no camera, after which the rig is relearned from the factory calibration."""


@dataclass(frozen=True)
class Labelled:
    """A snapshot with labels."""

    checked: Checked
    astray: frozenset[int]  # cameras that see a possible object without labels


def label_snapshot(
    memory: KeeperMemory,
    labelling: Labelling,
    usable: Detections,
    name: str,
    frames: Mapping[str, Frame | None] | None,
    correct: Correct | None = None,
) -> Labelled:
    """Label a snapshot.

    Args:
        memory: the keeper's memory.
        labelling: labels snapshots independently.
        usable: its blobs.
        name: its name.
        frames: frames that the blobs were found in; None = there are none.
        correct: corrects blobs as soon as the object's pose is known; None = no camera is late.

    Raises:
        RefusedError: the blobs cannot be labelled, or the labels fit in no camera.
    """
    if memory.lights is not None:
        return Labelled(*label_lights(memory, memory.lights, usable))
    usable = settle_labels(usable, memory.belief.rig, memory.obj_now)
    coded = usable.fiducial.copy() if (usable.fiducial >= 0).any() else None
    followed = None if coded is not None else _follow(memory, labelling, usable, correct)
    if followed is not None:
        return followed
    there = memory.surroundings
    known = None if there is None else (there.rig, there.std)
    blobs, snapshot = labelling.decide(usable, name, coded, None if coded is not None else frames, known)
    pose = snapshot.rig_from_object
    if pose is None:
        obj = memory.obj_now
        pose = initial_pose(to_observations(blobs, memory.prior, obj), memory.belief.rig, obj)[0]
    checked = _check(memory, blobs, pose.reshape(1), correct)
    misfit = _fits_nowhere(memory, checked)
    if misfit and memory.doubts.due and test_clocks(memory):
        checked = _check(memory, blobs, pose.reshape(1), correct)
        misfit = _fits_nowhere(memory, checked)
    changed = test_object(memory, learnt=False) if misfit and memory.doubts.due else None
    if changed is not None and (change := changed.object_change) is not None:
        memory.pending.append(object_event(change, memory.change_time(change.since), memory.time, memory.count - 1))
        checked = _check(memory, blobs, pose.reshape(1), correct)
        misfit = _fits_nowhere(memory, checked)
    if misfit:
        memory.doubts.observe_refused(checked, memory.time if memory.learnt is None else memory.learnt, memory.time)
        memory.in_vain += 1
        if memory.in_vain >= MOST_VAIN:
            memory.reset()
        raise RefusedError(
            f"estimation: labels are {checked.usual:.1f} px off in most cameras: labels are wrong, or this is "
            "a different rig"
        )
    return _search(memory, checked)


def _follow(memory: KeeperMemory, labelling: Labelling, usable: Detections, correct: Correct | None) -> Labelled | None:
    """Label a snapshot by the last one's pose; None = not possible."""
    if not labelling.follows or labelling.slips or not memory.poses:
        return None
    pose = _extrapolate(memory)
    named = replace(usable, fiducial=near_prediction(usable, memory.predicted(pose)))
    if (named.fiducial >= 0).sum() < LEAST_FOLLOWED * memory.labels:
        return None
    sought = frozenset(memory.search.sought)
    try:
        found = _search(memory, _check(memory, named, pose, correct))
    except RefusedError:
        return None
    few = found.checked.labels < LEAST_FOLLOWED * memory.labels
    return None if few or found.astray - sought or _fits_nowhere(memory, found.checked) else found


def _fits_nowhere(memory: KeeperMemory, checked: Checked) -> bool:
    """Tell whether most cameras are off by more than usual, and by more than is not yet known about the rig."""
    if checked.usual <= memory.most_usual:
        return False
    unknown = predict_usual(checked, memory.belief, memory.options.identity_error)
    return checked.usual > memory.most_usual + UNUSUAL * unknown


def _extrapolate(memory: KeeperMemory) -> RigidTransform:
    """Predicted pose of the object: (1,)."""
    last_time, last = memory.poses[-1]
    first_time, first = memory.poses[-min(2, len(memory.poses))]
    share = 0.0 if last_time <= first_time else (memory.time - last_time) / (last_time - first_time)
    if not 0.5 < share < 2.0:
        return last
    return RigidTransform(last.rotation, last.translation + share * (last.translation - first.translation))


def _check(memory: KeeperMemory, named: Detections, pose: RigidTransform, correct: Correct | None) -> Checked:
    """Find the labels that fit; unsynchronized cameras do not count for the object's pose."""
    given = memory.belief.rig, memory.obj_now, pose, memory.options
    every = check_labels(named, *given)
    if correct is not None:
        named = correct(named, every.rig_from_object)
        every = check_labels(named, *given)
    if not memory.monitor.quarantine.cameras:
        return every
    quarantined = np.isin(named.camera, list(memory.monitor.quarantine.cameras))
    others = check_labels(replace(named, fiducial=np.where(quarantined, -1, named.fiducial)), *given)
    fiducial = np.where(quarantined, every.blobs.fiducial, others.blobs.fiducial)
    blobs, labels = replace(others.blobs, fiducial=fiducial), int((fiducial >= 0).sum())
    off = others.off | every.off & np.isin(np.arange(len(every.off)), list(memory.monitor.quarantine.cameras))
    return replace(others, blobs=blobs, given=every.given, off=off, labels=labels)


def _search(memory: KeeperMemory, checked: Checked) -> Labelled:
    """Search for the object in cameras that do not see it where it should be."""
    there = memory.surroundings
    if there is None:
        return Labelled(checked, frozenset())
    seen = memory.sightings
    doubted = seen.missing_cameras | seen.astray.keys() | seen.lost.keys()
    return Labelled(*memory.search.label_lost_cameras(checked, there, memory.time, memory.count - 1, doubted))
