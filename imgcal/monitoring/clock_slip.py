"""Does a camera expose at another time, or has it moved? A late camera sees an object that moves somewhere else, too.

What a move and what a slip of its clock make of the snapshots since are compared by how probable they are: a move
shifts the image alike wherever the object goes, a slip along its motion, and not at all where it stands still.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform
from imgcal.monitoring.case import Case, ClockSlip, Explained, Explanation, Finding, Snapshot, Start, Variant
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.object_motion import ObjectMotion
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief
from imgcal.monitoring.unsynchronized_cameras import drop_cameras
from imgcal.types import Observations

# What is known of a slip before anything is seen.
SLIP_SECONDS = 0.03
"""One standard deviation: a frame or two ..."""
MOST_SLIP_SECONDS = 0.15
"""... and the most: over a longer time the motion of an object is not known."""
# How a slip is found.
SEARCH_ROUNDS = 4
"""In which a slip is found of a camera that is where it was; each leaves a hundredth of what was left."""
SEARCH_STEPS = (8e-3, 1e-3)
"""Seconds around a slip at which its evidence is taken, the camera's place being learnt with it; the first only where
nothing is known of that place."""
VELOCITY_SECONDS = 1e-3
"""Seconds over which the velocity of an image is taken."""
INEXACT = 0.03
"""Share of the way that a camera is behind by which blobs may be off that are put where they were in time."""
TOO_LONG = f"the slip would be longer than {MOST_SLIP_SECONDS:g} s"
VAGUE_SLIP_SECONDS, VAGUE_SLIP = (5e-4, 8.5e-4), 0.07
"""Standard deviation above which a slip is not believed of a camera that is hardly known: this share of it, but within
these bounds (s)."""


class ClockSlipExplanation(Explanation):
    """The clocks of the suspected cameras, or of the surest alone, have slipped."""

    name = "clock slip"

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """Put the blobs of the cameras where they would have been in time."""
        case.require_body()
        return [partial(_slip, case, start, cameras) for start in case.starts for cameras in case.camera_sets]

    def premature(self, case: Case, found: Explained) -> str | None:
        """Wait where the slip of a camera that is hardly known is itself hardly known."""
        uncertain = case.uncertain or len(found.snapshots) > case.count
        slips = found.finding.slips if uncertain else ()
        least, most = VAGUE_SLIP_SECONDS
        vague = any(slip.sigma > min(max(VAGUE_SLIP * abs(slip.seconds), least), most) for slip in slips)
        return "the slip is hardly known" if vague else None


def _slip(case: Case, start: Start, cameras: Sequence[int]) -> Variant:
    """Find the most probable slips of clocks.

    Args:
        case: its earlier snapshots say how the object moves, too.
        start: since when clocks may have slipped.
        cameras: whose clocks.

    Raises:
        RefusedError: the other cameras do not see enough of the object, it is not known how it moves, or no slip is
            more probable than others.
    """
    count, uncertain = len(start.snapshots), case.uncertain or start is not case.starts[0]
    given, poses = stack_snapshots(start.snapshots)
    there = absorb(start.before, drop_cameras(given, cameras), poses, case.options)
    seconds = torch.tensor(case.pauses, dtype=torch.float64).cumsum(0)
    way = [*(pose for _, pose in case.snapshots[:-count]), there.rig_from_object]
    motion = ObjectMotion.of(RigidTransform.cat(way), seconds)
    if not bool(motion.known[-count:].all()):
        raise RefusedError("it is not known how the object moves")
    cases = _Late(start.before, given, there, motion, seconds[-count:], case.options)
    late = dict.fromkeys(cameras, 0.0) if uncertain else {camera: cases.rough_slip(camera) for camera in cameras}
    sigma = dict.fromkeys(cameras, math.nan)
    for step in SEARCH_STEPS[0 if uncertain else 1 :]:
        for camera in cameras:
            three = cases.climb(late, camera, step)
            curvature = (2 * three[1] - three[0] - three[2]) / step**2
            if not curvature > 0:
                raise RefusedError("no slip is more probable than others")
            late[camera] += (three[2] - three[0]) / (2 * step) / curvature
            sigma[camera] = curvature**-0.5
            if not abs(late[camera]) < MOST_SLIP_SECONDS:
                raise RefusedError(TOO_LONG)
    corrected, log_prior = cases.correct(late)
    log_prior += sum(math.log(spread / SLIP_SECONDS) for spread in sigma.values())  # of all slips, not the best alone
    spreads = {camera: math.hypot(sigma[camera], INEXACT * late[camera]) for camera in cameras}
    slips = tuple(ClockSlip(camera, 0, late[camera], spreads[camera], math.nan) for camera in cameras)
    return Variant(start.before, corrected, start.log_prior + log_prior, find=lambda _: Finding(slips=slips))


def project_fiducials(belief: RigBelief, rig_from_object: RigidTransform, camera: int) -> Tensor:
    """Where a camera sees the fiducials of an object in poses (S,): (S, N, 2) pixels."""
    alone = belief.rig.select([camera]).expand(len(rig_from_object.translation))
    return alone.project_values(belief.points_at(rig_from_object), belief.obj.radius).uv[:, 0]


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
        return project_fiducials(self.there.belief, self.motion.interpolate(self.seconds + late), camera)

    def rough_slip(self, camera: int) -> float:
        """How late (s) a camera exposes if it is where it was."""
        given, late = self.given, 0.0
        seen = given.seen[:, camera]
        weight = torch.where(seen, given.sigma[:, camera].square().reciprocal(), 0.0)[..., None]
        for _ in range(SEARCH_ROUNDS):
            velocity = (self.image(camera, late + VELOCITY_SECONDS) - self.image(camera, late - VELOCITY_SECONDS)) / (
                2 * VELOCITY_SECONDS
            )
            rest = torch.where(seen[..., None], given.uv[:, camera] - self.image(camera, late), 0.0)
            power = float((weight * velocity.square()).sum()) + SLIP_SECONDS**-2
            late += (float((weight * velocity * rest).sum()) - late * SLIP_SECONDS**-2) / power
            late = min(max(late, -MOST_SLIP_SECONDS), MOST_SLIP_SECONDS)
        return late

    def correct(self, late: Mapping[int, float]) -> tuple[list[Snapshot], float]:
        """Put blobs where they would have been in time, less surely; and the log probability of these slips."""
        uv, sigma, seen = self.given.uv.clone(), self.given.sigma.clone(), self.given.seen
        for camera, seconds in late.items():
            behind = self.image(camera, seconds) - self.image(camera, 0.0)
            uv[:, camera] -= behind
            sigma[:, camera] = torch.hypot(sigma[:, camera], INEXACT * behind.norm(dim=-1))
        log_prior = -2 * float((sigma / self.given.sigma).log()[seen].sum())
        log_prior -= sum(0.5 * (seconds / SLIP_SECONDS) ** 2 for seconds in late.values())
        given, poses = Observations(uv, sigma, seen, self.given.shake), self.there.rig_from_object
        return [(given.of_snapshots([s]), poses[s : s + 1]) for s in range(len(uv))], log_prior

    def climb(self, late: dict[int, float], camera: int, step: float) -> list[float]:
        """Go on with the slip of one camera by steps (s) while that makes the snapshots more probable.

        Returns:
            Evidence a step before, at, and a step after the slip, which `late` then holds.

        Raises:
            RefusedError: the slip becomes too long, or see `absorb`.
        """
        before, here, after = (self.evidence({**late, camera: late[camera] + way}) for way in (-step, 0.0, step))
        while max(before, after) > here:
            way = step if after > before else -step
            late[camera] += way
            if not abs(late[camera]) < MOST_SLIP_SECONDS:
                raise RefusedError(TOO_LONG)
            further = self.evidence({**late, camera: late[camera] + way})
            before, here, after = (here, after, further) if way > 0 else (further, before, here)
        return [before, here, after]

    def evidence(self, late: Mapping[int, float]) -> float:
        """Log probability of the snapshots where cameras expose later.

        Raises:
            RefusedError: see `absorb`.
        """
        corrected, log_prior = self.correct(late)
        return absorb(self.before, *stack_snapshots(corrected), self.options).evidence + log_prior
