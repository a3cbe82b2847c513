"""Tell a camera whose clock has slipped from one that has moved; both see a moving object in the wrong place.

Both explanations are compared by the evidence of the snapshots since. A move shifts the image alike wherever the object
goes. A slip shifts it along the object's motion, and not at all while the object stands still.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform
from imgcal.monitoring.case import Case, ClockSlip, Explained, Explanation, Finding, Start, Variant
from imgcal.monitoring.measurement_update import absorb, stack_snapshots
from imgcal.monitoring.object_motion import ObjectMotion
from imgcal.monitoring.rig_belief import MeasurementUpdate, RigBelief
from imgcal.monitoring.unsynchronized_cameras import drop_cameras
from imgcal.types import Observations

# Prior of a slip.
SLIP_SECONDS = 0.03
"""One standard deviation: one or two frames ..."""
MOST_SLIP_SECONDS = 0.15
"""... and the upper limit: the object's motion cannot be extrapolated further."""
# Search for a slip.
SEARCH_ROUNDS = 4
"""Iterations when the camera's pose is known; each reduces the remaining error to a hundredth."""
SEARCH_STEPS = (8e-3, 1e-3)
"""Seconds around a slip at which its evidence is computed while the camera's pose is estimated, too. The first step is
used only if nothing is known about that pose."""
VELOCITY_SECONDS = 1e-3
"""Time step for the velocity of an image."""
INEXACT = 0.03
"""Error of a blob that is moved to its place in time, as a share of the distance moved."""
TOO_LONG = f"the slip would be longer than {MOST_SLIP_SECONDS:g} s"
VAGUE_SLIP_SECONDS, VAGUE_SLIP = (5e-4, 8.5e-4), 0.07
"""Largest standard deviation of a slip that is believed of a camera whose pose is hardly known: this share of the slip,
within these bounds (s)."""


class ClockSlipExplanation(Explanation):
    """The clocks of all suspected cameras, or of the most likely one alone, have slipped."""

    name = "clock slip"

    def variants(self, case: Case) -> Sequence[Callable[[], Variant]]:
        """Move the blobs of the cameras to where they would have been without the slip."""
        case.require_body()
        return [partial(_slip, case, start, cameras) for start in case.starts for cameras in case.camera_sets]

    def premature(self, case: Case, found: Explained) -> str | None:
        """Wait while neither the camera's pose nor its slip is well known."""
        uncertain = case.uncertain or len(found.snapshots) > case.count
        slips = found.finding.slips if uncertain else ()
        least, most = VAGUE_SLIP_SECONDS
        vague = any(slip.sigma > min(max(VAGUE_SLIP * abs(slip.seconds), least), most) for slip in slips)
        return "the slip is hardly known" if vague else None


def _slip(case: Case, start: Start, cameras: Sequence[int]) -> Variant:
    """Find the most probable clock slips of some cameras since a start; earlier snapshots show how the object moves.

    Raises:
        RefusedError: the other cameras do not see enough of the object, its motion is unknown, or no slip is
            more probable than others.
    """
    count, uncertain = len(start.snapshots), case.uncertain or start is not case.starts[0]
    given, poses = stack_snapshots(start.snapshots)
    there = absorb(start.before, drop_cameras(given, cameras), poses, case.options)
    seconds = torch.tensor(case.pauses, dtype=torch.float64).cumsum(0)
    way = [*(pose for _, pose in case.snapshots[:-count]), there.rig_from_object]
    motion = ObjectMotion.of(RigidTransform.cat(way), seconds)
    if not bool(motion.known[-count:].all()):
        raise RefusedError("the object's motion is unknown")
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
    blobs, log_prior = cases.correct(late)
    corrected = [(blobs.of_snapshots([s]), there.rig_from_object[s : s + 1]) for s in range(count)]
    log_prior += sum(math.log(spread / SLIP_SECONDS) for spread in sigma.values())  # over all slips, not only the best
    spreads = {camera: math.hypot(sigma[camera], INEXACT * late[camera]) for camera in cameras}
    slips = tuple(ClockSlip(camera, 0, late[camera], spreads[camera], math.nan) for camera in cameras)
    return Variant(start.before, corrected, start.log_prior + log_prior, find=lambda _: Finding(slips=slips))


def project_fiducials(belief: RigBelief, rig_from_object: RigidTransform, camera: int) -> Tensor:
    """Project the fiducials of an object in poses (S,) into a camera: (S, N, 2) pixels."""
    alone = belief.rig.select([camera]).expand(len(rig_from_object.translation))
    return alone.project_values(belief.points_at(rig_from_object), belief.obj.radius).uv[:, 0]


@dataclass(frozen=True)
class _Late:
    """Snapshots (S,) in which some cameras may have exposed later."""

    before: RigBelief
    given: Observations
    there: MeasurementUpdate  # the object's poses according to the other cameras
    motion: ObjectMotion
    seconds: Tensor  # (S,) exposure times of the other cameras
    options: EstimationOptions

    images: dict[tuple[int, float], Tensor] = field(default_factory=dict)  # by camera and delay, see `image`

    def image(self, camera: int, late: float) -> Tensor:
        """Project the fiducials into a camera that exposes `late` seconds later: (S, N, 2) pixels."""
        key = camera, late
        if key not in self.images:
            self.images[key] = project_fiducials(
                self.there.belief, self.motion.interpolate(self.seconds + late), camera
            )
        return self.images[key]

    def project(self, camera: int, lates: Sequence[float]) -> None:
        """Compute several images at once, which takes hardly longer than one."""
        seconds = torch.cat([self.seconds + late for late in lates])
        images = project_fiducials(self.there.belief, self.motion.interpolate(seconds), camera)
        for late, image in zip(lates, images.split(len(self.seconds)), strict=True):
            self.images[camera, late] = image

    def rough_slip(self, camera: int) -> float:
        """Estimate the delay (s) of a camera that has not moved."""
        given, late = self.given, 0.0
        seen = given.seen[:, camera]
        weight = torch.where(seen, given.sigma[:, camera].square().reciprocal(), 0.0)[..., None]
        for _ in range(SEARCH_ROUNDS):
            three = late - VELOCITY_SECONDS, late, late + VELOCITY_SECONDS
            self.project(camera, three)
            before, here, after = (self.image(camera, one) for one in three)
            velocity = (after - before) / (2 * VELOCITY_SECONDS)
            rest = torch.where(seen[..., None], given.uv[:, camera] - here, 0.0)
            power = float((weight * velocity.square()).sum()) + SLIP_SECONDS**-2
            late += (float((weight * velocity * rest).sum()) - late * SLIP_SECONDS**-2) / power
            late = min(max(late, -MOST_SLIP_SECONDS), MOST_SLIP_SECONDS)
        return late

    def correct(self, late: Mapping[int, float]) -> tuple[Observations, float]:
        """Move blobs to where they belong without the delay, with more noise; also return the slips' log prior."""
        uv, sigma, seen = self.given.uv.clone(), self.given.sigma.clone(), self.given.seen
        for camera, seconds in late.items():
            behind = self.image(camera, seconds) - self.image(camera, 0.0)
            uv[:, camera] -= behind
            sigma[:, camera] = torch.hypot(sigma[:, camera], INEXACT * behind.norm(dim=-1))
        log_prior = -2 * float((sigma / self.given.sigma).log()[seen].sum())
        log_prior -= sum(0.5 * (seconds / SLIP_SECONDS) ** 2 for seconds in late.values())
        return Observations(uv, sigma, seen, self.given.shake), log_prior

    def climb(self, late: dict[int, float], camera: int, step: float) -> list[float]:
        """Go on with the slip of one camera by steps (s) while that makes the snapshots more probable.

        Returns:
            Evidence a step before, at, and a step after the slip, which `late` then holds.

        Raises:
            RefusedError: the slip becomes too long, or see `absorb`.
        """
        self.project(camera, [late[camera] + way for way in (-step, 0.0, step)])
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
        blobs, log_prior = self.correct(late)
        return absorb(self.before, blobs, self.there.rig_from_object, self.options).evidence + log_prior
