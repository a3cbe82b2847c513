"""A stream that a filter follows without tests for changes, and a monitor that expects independent errors."""

from dataclasses import dataclass

import torch

import imgcal
from imgcal.geometry import RigidTransform
from imgcal.monitoring import RecentSnapshots, RigBelief, RigFilter, RigMonitor
from imgcal.types import CalibrationObject, CameraRig, Observations
from scripts.benchmarks.rig_streams import Conditions, Stream


@dataclass
class Followed:
    """What was learnt from all snapshots of a stream, and them."""

    stream: Stream
    filter: RigFilter
    recent: RecentSnapshots
    beliefs: list[RigBelief]  # before each snapshot, and after the last one
    snapshots: list[tuple[Observations, RigidTransform]]


def followed(count: int, seed: int = 5, rate: float = 60.0, **happened) -> Followed:
    """Follow rig T4 by labelled snapshots."""
    conditions = Conditions(rate=rate, labelled=True)
    stream = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), seed, conditions, **happened)
    poses = stream.poses_at(torch.arange(count, dtype=torch.float64) / rate)
    seen, _ = stream.labelled(0, count)
    follows = RigFilter(stream.factory, stream.obj)
    recent, beliefs, snapshots = RecentSnapshots(follows.belief, follows.walk), [follows.belief], []
    for number in range(count):
        observations = seen.of_snapshots([number])
        result = follows.follow(observations, poses[number : number + 1], 1 / rate)
        recent.append(result, observations, 1 / rate)
        if follows.due:
            recent.relinearize(follows.relinearize())
        beliefs.append(follows.belief)
        snapshots.append((observations, result.rig_from_object))
    return Followed(stream, follows, recent, beliefs, snapshots)


def monitor_of(rig: CameraRig, obj: CalibrationObject) -> RigMonitor:
    """Monitor a rig whose errors are not expected to last: those of a simulation do not."""
    monitor = RigMonitor(RigFilter(rig, obj))
    monitor.noise.expect_usual = lambda calibrated: None  # type: ignore[method-assign]
    return monitor
