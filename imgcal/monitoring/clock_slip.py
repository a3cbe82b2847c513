"""Does a camera expose at another time, or has it moved? A late camera sees an object that moves somewhere else, too.

What a move and what a slip of its clock make of the snapshots since are compared by how probable they are: a move
shifts the image alike wherever the object goes, a slip along its motion, and not at all where it stands still.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.object_motion import ObjectMotion
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief
from imgcal.types import Observations

USUAL_SLIP = 0.03
"""Seconds, one standard deviation of a slip before anything is known of it: a frame or two ..."""
MOST_SLIP = 0.15
"""... and the most: over more, nobody knows how an object moves."""
ROUNDS = 4
"""In which a slip is found of a camera that is where it was; each leaves a hundredth of what was left."""
STEPS = (8e-3, 1e-3)
"""Seconds around a slip at which it is asked how probable it is, the camera's place being learnt with it; the first
where nothing is known of that place."""
MOMENT = 1e-3
"""Seconds over which the velocity of an image is taken."""
INEXACT = 0.03
"""Share of the way that a camera is behind by which blobs may be off that are put where they were in time."""


@dataclass(frozen=True)
class ClockSlip:
    """A camera that exposes at another time than before."""

    camera: int
    since: int  # number of the first snapshot, counted from 0, that saw it so
    seconds: float  # by which it exposes later
    sigma: float  # one standard deviation of it
    odds: float  # log odds against that the camera has moved


@dataclass(frozen=True)
class Slipped:
    """Some snapshots, if clocks of cameras have slipped before them."""

    before: RigBelief
    slips: tuple[ClockSlip, ...]
    snapshots: list[tuple[Observations, RigidTransform]]  # as the cameras had seen them in time
    evidence: float  # log probability, to compare with that of `MeasurementUpdate`


def slipped(
    before: RigBelief,
    snapshots: Sequence[tuple[Observations, RigidTransform]],
    pauses: Sequence[float],
    count: int,
    cameras: Sequence[int],
    options: EstimationOptions,
    wide: bool = False,
) -> Slipped | None:
    """Suppose that clocks of cameras have slipped before the last `count` snapshots.

    Args:
        before: what was believed before them.
        snapshots: observations (1, C, N) and the object's pose (1,) of each; also earlier ones, which say how it moves.
        pauses: s before each of them.
        count: snapshots since the slip.
        cameras: those whose clocks may have slipped.
        options: how to minimize.
        wide: it is hardly known where the cameras are.

    Returns:
        What that makes of the snapshots; None = nobody knows how the object moved, or no slip explains anything.

    Raises:
        RefusedError: the other cameras do not see enough of the object.
    """
    given, start = stack_snapshots(snapshots[-count:])
    others = given.seen.clone()
    others[:, list(cameras)] = False
    there = absorb(before, replace(given, seen=others), start, options)
    seconds = torch.tensor(pauses, dtype=torch.float64).cumsum(0)
    poses = [*(pose for _, pose in snapshots[:-count]), there.rig_from_object]
    motion = ObjectMotion.of(RigidTransform.cat(poses), seconds)
    if not bool(motion.known[-count:].all()):
        return None
    cases = _Late(before, given, there, motion, seconds[-count:], options)
    late = dict.fromkeys(cameras, 0.0) if wide else {camera: cases.rough(camera) for camera in cameras}
    sigma = dict.fromkeys(cameras, math.nan)
    for step in STEPS[0 if wide else 1 :]:
        for camera in cameras:
            three = [cases.supposed({**late, camera: late[camera] + way})[1] for way in (-step, 0.0, step)]
            curvature = (2 * three[1] - three[0] - three[2]) / step**2
            if not curvature > 0:
                return None
            late[camera] += (three[2] - three[0]) / (2 * step) / curvature
            sigma[camera] = curvature**-0.5
            if not abs(late[camera]) < MOST_SLIP:
                return None
    corrected, evidence = cases.supposed(late)
    evidence += sum(math.log(spread / USUAL_SLIP) for spread in sigma.values())
    spreads = {camera: math.hypot(sigma[camera], INEXACT * late[camera]) for camera in cameras}
    slips = tuple(ClockSlip(camera, 0, late[camera], spreads[camera], math.nan) for camera in cameras)
    return Slipped(before, slips, corrected, evidence)


def image_of(belief: RigBelief, rig_from_object: RigidTransform, camera: int) -> Tensor:
    """Where a camera sees the fiducials of an object in poses (S,): (S, N, 2) pixels."""
    alone = belief.rig.select([camera]).expand(len(rig_from_object.translation))
    return alone.project_values(rig_from_object.apply(belief.points_object), belief.obj.radius).uv[:, 0]


@dataclass(frozen=True)
class _Late:
    """Snapshots (S,) of which some cameras may have exposed later."""

    before: RigBelief
    given: Observations
    there: MeasurementUpdate  # where the other cameras say that the object was
    motion: ObjectMotion
    seconds: Tensor  # (S,) when those exposed
    options: EstimationOptions

    def image(self, camera: int, late: float) -> Tensor:
        """Where a camera sees the fiducials, so much later: (S, N, 2) pixels."""
        return image_of(self.there.belief, self.motion.at(self.seconds + late), camera)

    def rough(self, camera: int) -> float:
        """How late (s) a camera exposes if it is where it was."""
        given, late = self.given, 0.0
        seen = given.seen[:, camera]
        weight = torch.where(seen, given.sigma[:, camera].square().reciprocal(), 0.0)[..., None]
        for _ in range(ROUNDS):
            velocity = (self.image(camera, late + MOMENT) - self.image(camera, late - MOMENT)) / (2 * MOMENT)
            rest = torch.where(seen[..., None], given.uv[:, camera] - self.image(camera, late), 0.0)
            power = float((weight * velocity.square()).sum()) + USUAL_SLIP**-2
            late += (float((weight * velocity * rest).sum()) - late * USUAL_SLIP**-2) / power
            late = min(max(late, -MOST_SLIP), MOST_SLIP)
        return late

    def supposed(self, late: Mapping[int, float]) -> tuple[list[tuple[Observations, RigidTransform]], float]:
        """Suppose that cameras expose later: what they had seen in time, and how probable that all is.

        Raises:
            RefusedError: see `absorb`.
        """
        uv, sigma, seen = self.given.uv.clone(), self.given.sigma.clone(), self.given.seen
        for camera, seconds in late.items():
            behind = self.image(camera, seconds) - self.image(camera, 0.0)
            uv[:, camera] -= behind
            sigma[:, camera] = torch.hypot(sigma[:, camera], INEXACT * behind.norm(dim=-1))
        observations = Observations(uv, sigma, seen, self.given.shake)
        result = absorb(self.before, observations, self.there.rig_from_object, self.options)
        unlikely = 2 * float((sigma / self.given.sigma).log()[seen].sum())
        unlikely += sum(0.5 * (seconds / USUAL_SLIP) ** 2 for seconds in late.values())
        rows = range(len(uv))
        parts = [observations.of_snapshots([s]) for s in rows]
        return [(parts[s], result.rig_from_object[s : s + 1]) for s in rows], result.evidence - unlikely
