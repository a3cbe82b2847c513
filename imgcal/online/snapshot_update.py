"""Learn from a labelled snapshot: absorb what fits, defer the rest, and repeat with a corrected noise level."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from torch import Tensor

from imgcal.monitoring import MonitorUpdate, RigFilter, RigMonitor, far_turned_cameras
from imgcal.online.drift_watch import DriftWatch
from imgcal.online.events import Event
from imgcal.online.keeper_memory import LEAST_LOOKS, KeeperMemory
from imgcal.online.label_consistency import Checked
from imgcal.online.object_checks import ObjectChecks
from imgcal.types import Detections


def learn_snapshot(memory: KeeperMemory, checked: Checked) -> MonitorUpdate:
    """Absorb a snapshot; a camera that does not fit for the first time is left out until the next snapshot.

    Args:
        memory: the keeper's memory; updated.
        checked: the snapshot of `memory.time`, with its labels.

    Returns:
        The update, and the changes found.

    Raises:
        RefusedError: see `RigMonitor.update`.
    """
    monitor, still_open, time = memory.monitor, memory.monitor.open, memory.time
    unsure = set(np.flatnonzero(checked.off & (memory.looks < LEAST_LOOKS)).tolist())
    if unsure:
        shown = memory.observed(checked.blobs), checked.rig_from_object
        unsure -= far_turned_cameras(memory.belief, [shown], unsure)
    off = {camera: memory.off.get(camera, time) for camera in set(np.flatnonzero(checked.off).tolist()) - unsure}
    waiting = [camera for camera in off if camera not in memory.off and camera not in still_open]
    moved = [camera for camera in off if camera in memory.off and camera not in still_open]
    fiducial = np.where(np.isin(checked.blobs.camera, waiting), -1, checked.blobs.fiducial)
    blobs = replace(checked.blobs, fiducial=fiducial)
    seconds = memory.elapsed(time)
    observations = memory.observed(blobs)
    if not off and not still_open:
        memory.before = memory.belief
    found = monitor.update(observations, checked.rig_from_object, seconds, moved)
    if found.restarted:
        memory.drift_watch = DriftWatch(memory.prior.camera_names)
        memory.looks[:] = 0
    if found.learnt:
        found = _conclude(memory, checked, blobs, observations.seen, found, seconds)
    seen = np.unique(checked.given.camera[checked.given.fiducial >= 0])
    waits = {camera: since for camera, since in memory.off.items() if camera not in seen}  # until seen again
    memory.off, memory.learnt, memory.in_vain = waits | off, time, 0
    if found.slips:  # these poses were found with late blobs
        memory.poses.clear()
    memory.poses.append((time, found.update.rig_from_object))
    memory.labels = checked.labels
    memory.search.observe(checked.blobs, memory.count - 1)
    memory.usual.append(checked.usual)
    steady = not (off or found.changes or monitor.open or found.slips)
    if found.learnt and memory.noise.observe(blobs, observations, found.update, steady, monitor.filter.count):
        found = replace(_relearn(memory, found), changes=found.changes)
    return found


def _conclude(
    memory: KeeperMemory, checked: Checked, blobs: Detections, seen: Tensor, found: MonitorUpdate, seconds: float
) -> MonitorUpdate:
    """Follow what has been learned from a snapshot, which the cameras saw as (1, C, N); returns the update."""
    monitor, time = memory.monitor, memory.time
    memory.times.append((monitor.filter.count - 1, time))
    if found.changes or monitor.open or found.object_change is not None:
        memory.doubts = ObjectChecks(memory.obj.num_fiducials)
    elif memory.doubts.observe(checked, blobs, seconds, time):
        of_object = test_object(memory, learnt=True)
        if of_object is not None:
            found = replace(found, update=of_object.update, object_change=of_object.object_change)
    memory.looks += seen[0].any(-1).numpy()
    memory.looks[[change.camera for change in found.changes]] = 0
    if (horizon := monitor.filter.horizon) is not None:
        memory.looks[list(horizon.away)] = 0
        np.minimum(memory.looks, horizon.snapshots, out=memory.looks)
    return found


def test_object(memory: KeeperMemory, learnt: bool) -> MonitorUpdate | None:
    """Test whether labels do not fit because the object differs from its file; return the update in that case.

    Otherwise report where most cameras have moved at once.

    Args:
        memory: the keeper's memory; updated.
        learnt: test the snapshots absorbed without those labels; otherwise the refused ones.
    """
    doubted = memory.doubts.learnt if learnt else memory.doubts.refused
    snapshots = [(memory.observed(one.blobs), one.rig_from_object) for one in doubted]
    first = memory.monitor.filter.count
    pauses = [one.seconds for one in doubted]
    found = memory.monitor.diagnose_object(snapshots, pauses, learnt)
    if found is not None and not learnt:
        memory.times.extend((first + n, one.time) for n, one in enumerate(doubted))
        memory.learnt = doubted[-1].time
    if found is None and not learnt and memory.monitor.have_all_moved(snapshots, pauses):
        message = "most cameras have moved at once, and labels fit in none; if this lasts, the rig is learned anew"
        event = Event(memory.time, memory.count - 1, "moved", None, doubted[0].time, "unknown", message=message)
        memory.pending.append(event)
    memory.doubts.record_test(found is not None)
    return found


def test_clocks(memory: KeeperMemory) -> bool:
    """Test whether unsynchronized cameras are why labels fit nowhere, and quarantine those."""
    doubted = memory.doubts.refused
    snapshots = [(memory.observed(one.blobs), one.rig_from_object) for one in doubted]
    quarantined = memory.monitor.quarantine_doubtful(snapshots, [one.seconds for one in doubted])
    if quarantined:
        memory.off |= dict.fromkeys(quarantined, doubted[0].time)
        memory.doubts = ObjectChecks(memory.obj.num_fiducials)
    return bool(quarantined)


def _relearn(memory: KeeperMemory, found: MonitorUpdate) -> MonitorUpdate:
    """Absorb the first snapshots again, with their measured noise."""
    estimation, horizon = memory.options.estimation, memory.horizon
    monitor = RigMonitor(RigFilter(memory.prior, memory.obj, memory.drift, estimation, horizon=horizon))
    for blobs, pose in memory.noise.first:
        found = monitor.update(memory.observed(blobs), pose)
    memory.monitor = monitor
    memory.doubts = ObjectChecks(memory.obj.num_fiducials)
    return found
