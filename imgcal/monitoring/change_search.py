"""Which camera has changed, and before how many of the latest snapshots?"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Collection, Sequence

from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform
from imgcal.monitoring.change_test import CHANGES, JUMPS, ChangeTest
from imgcal.monitoring.measurement_update import absorb
from imgcal.monitoring.pending_change import free_cameras
from imgcal.monitoring.recent_snapshots import SCREENED_AGES, RecentSnapshots
from imgcal.monitoring.rig_belief import RigBelief
from imgcal.types import Observations

# Chi-squared of a change of a camera, all of two or three degrees of freedom.
ALARM_CHI2 = 60.0
"""That a camera which stands still exceeds once in 10^12 tests."""
SCREEN_CHI2 = 20.0
"""Of the quick test (`screen`), from which on the exact one is made: it finds a third where half of the rest is new."""
REMAINING_CHI2 = 20.0
"""What is left without the episode that speaks most for a change: a wrong label, or an error that passes, is none."""

# Numbers of snapshots.
SLOW_TESTS = {16: 16, 64: 32}
"""Numbers of snapshots that are tested without a suspicion, and after how many each: where little was known before."""
NEARBY_SNAPSHOTS = 4
"""Snapshots around the most significant one among which the first one after a change is looked for."""

FIT_CHI2_PER_DOF = 4.0
"""Chi-squared per degree of freedom up to which a snapshot fits that is else refused."""


def find_alarm(
    recent: RecentSnapshots, count: int, episode: Callable[[int, float], int], least_shifts: Sequence[float]
) -> int | None:
    """Find the number of latest snapshots before which some camera has surely changed; None = none has.

    Args:
        recent: the latest snapshots.
        count: of all snapshots so far.
        episode: successive snapshots that a passing error may last, by the camera and the pixels that it is off.
        least_shifts: for each camera the pixels by which a change must shift its image.
    """
    ages = {age for age, every in SLOW_TESTS.items() if age <= len(recent) and count % every == 0}
    screened = recent.screen()
    if screened.max() >= SCREEN_CHI2:
        ages.add(int(SCREENED_AGES[int(screened.max(1).argmax())]))
    for age in sorted(ages):
        scores = recent.test(age).scores()
        kind = max(scores, key=lambda name: float(scores[name].max()))
        camera = int(scores[kind].argmax())
        if float(scores[kind][camera]) < ALARM_CHI2:
            continue
        _, shift = recent.score_without_episode(age, camera, kind, episode(camera, math.inf))
        left, shift = recent.score_without_episode(age, camera, kind, episode(camera, shift))
        if left >= REMAINING_CHI2 and shift >= least_shifts[camera]:
            return age
    return None


def likeliest_age(recent: RecentSnapshots, camera: int, age: int) -> int:
    """Number of snapshots since a camera most probably changed; `age` is tried first."""
    found: dict[int, float] = {}

    def ask(candidates: set[int]) -> int:
        for candidate in candidates - found.keys():
            if 1 <= candidate <= len(recent):
                found[candidate] = recent.test(candidate, aged=False).odds({camera: None})
        return max(found, key=lambda candidate: found[candidate])

    best = ask({int(n) for n in SCREENED_AGES} | {age, 1})
    for _ in range(NEARBY_SNAPSHOTS):
        nearest = ask(set(range(best - NEARBY_SNAPSHOTS, best + NEARBY_SNAPSHOTS + 1)))
        if nearest == best:
            break
        best = nearest
    return best


def likeliest_camera(test: ChangeTest, known: Collection[int] = ()) -> int:
    """The camera whose change, of any kind, is most probable; of those that are not known to have changed."""
    odds = {camera: test.odds({camera: None}) for camera in range(len(test.pixels)) if camera not in known}
    return max(odds, key=lambda camera: odds[camera])


def changed_cameras(
    test: ChangeTest, known: dict[int, str | None], least_shifts: Sequence[float] | None = None
) -> tuple[dict[int, str | None], dict[int, float]]:
    """Let cameras free that have changed, the likeliest first, until what has been seen since then is explained.

    Args:
        test: what has been seen since then.
        known: cameras that are known to have changed already, and how.
        least_shifts: for each camera the pixels by which a change must shift its image, of all but the first.

    Returns:
        Cameras that have changed, at least one, and how (None = in any way); and the chi-squared of each new one.
    """
    least = least_shifts or [0.0] * len(test.pixels)
    free, evidence = dict(known), dict[int, float]()
    while len(free) < len(test.pixels):
        given = test.condition_on(free) if free else test
        scores = given.scores()
        others = {
            camera: max(float(score[camera]) for score in scores.values())
            for camera in range(len(test.pixels))
            if camera not in free and (not free or _largest_shift(given, camera) >= least[camera])
        }
        if free and max(others.values(), default=0.0) < ALARM_CHI2:
            break
        odds = {camera: given.odds({camera: None}) for camera in others}
        camera = max(odds, key=lambda camera: odds[camera])
        free[camera], evidence[camera] = None, others[camera]
    return free, evidence


def _largest_shift(test: ChangeTest, camera: int) -> float:
    """Pixels by which a change of some kind would shift the image of a camera, were there no other."""
    kinds = (test.jump(camera, kind)[0] / test.pixels[camera, part] for kind, part in CHANGES.items())
    return max(float(shift.norm()) for shift in kinds)


def contradicting_camera(
    belief: RigBelief, observations: Observations, rig_from_object: RigidTransform, options: EstimationOptions
) -> int | None:
    """The camera that may have moved where a snapshot is refused; None = no single one.

    Args:
        belief: what is known.
        observations: (1, C, N) of the snapshot.
        rig_from_object: (1,) first guess of the object's pose.
        options: how to minimize.
    """
    found: dict[int, float] = {}
    for camera in observations.seen[0].any(-1).nonzero()[:, 0].tolist():
        with contextlib.suppress(RefusedError):
            result = absorb(free_cameras(belief, {camera: None}, JUMPS[-1]), observations, rig_from_object, options)
            if result.chi2 <= FIT_CHI2_PER_DOF * max(result.dof, 1):
                found[camera] = result.evidence
    return max(found, key=lambda camera: found[camera], default=None)
