"""Find the camera that has changed, and the snapshot since which it has."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Collection, Mapping, Sequence

from imgcal.errors import RefusedError
from imgcal.estimation import EstimationOptions
from imgcal.geometry import RigidTransform
from imgcal.monitoring.change_test import CHANGES, ChangeTest
from imgcal.monitoring.measurement_update import absorb
from imgcal.monitoring.pending_change import free_anywhere
from imgcal.monitoring.recent_snapshots import SCREENED_AGES, RecentSnapshots
from imgcal.monitoring.rig_belief import RigBelief
from imgcal.types import Observations

# Chi-squared of a change of a camera, with two or three degrees of freedom.
ALARM_CHI2 = 60.0
"""A camera that stands still exceeds this once in 10^12 tests."""
SCREEN_CHI2 = 20.0
"""Score of the quick test (`screen`) that triggers the exact one. The quick score may be a third of the exact one when
half of the information is new."""
SCREENED_CAMERAS = 10
"""Number of cameras up to which that score applies. With more cameras it grows, so that chance does not trigger more
exact tests."""
REMAINING_CHI2 = 20.0
"""Minimum score without the episode that supports the change most; wrong labels or passing errors leave nothing."""

# Numbers of snapshots.
SLOW_TESTS = {16: (16, 0), 64: (32, 8)}
"""Numbers of snapshots to test without a suspicion, each with the interval between its tests and their offset, so that
no snapshot waits for both: for young rigs."""
NEARBY_SNAPSHOTS = 4
"""Half width, in snapshots, of the search for the first snapshot after a change."""

EPISODE_STEPS = 4
"""Positions tried per length of an episode when an episode is left out."""

FIT_CHI2_PER_DOF = 4.0
"""Largest chi-squared per degree of freedom of a snapshot that fits, where it would otherwise be refused."""


def slow_tests(recent: RecentSnapshots, count: int) -> set[int]:
    """Numbers of latest snapshots to test without a suspicion; arguments as for `find_alarm`."""
    return {age for age, (every, at) in SLOW_TESTS.items() if age <= len(recent) and count % every == at}


def find_alarm(
    recent: RecentSnapshots, count: int, episode: Callable[[int, float], int], least_shifts: Sequence[float]
) -> int | None:
    """Find the number of latest snapshots before which some camera has surely changed; None = no change.

    Args:
        recent: the latest snapshots.
        count: number of snapshots so far.
        episode: number of successive snapshots that a passing error may last, given the camera and the shift in pixels.
        least_shifts: smallest image shift, in pixels, that counts as a change; one for each camera.
    """
    ages, screened = slow_tests(recent, count), recent.screen()
    suspicion = SCREEN_CHI2 + 2 * math.log(max(1.0, screened.shape[1] / SCREENED_CAMERAS))
    if screened.max() >= suspicion:
        ages.add(int(SCREENED_AGES[int(screened.max(1).argmax())]))
    for age in sorted(ages):
        scores = recent.test_each(age).scores()
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
    """Most probable number of snapshots since a camera changed; the search starts with `age`."""
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


def likeliest_camera(test: ChangeTest, cameras: Collection[int] | None = None) -> int:
    """The camera that most probably changed in any way, out of some or all."""
    odds = {camera: test.odds({camera: None}) for camera in (range(len(test.pixels)) if cameras is None else cameras)}
    return max(odds, key=lambda camera: odds[camera])


def changed_cameras(
    recent: RecentSnapshots,
    age: int,
    known: dict[int, str | None],
    episode: Callable[[int, float], int],
    least_shifts: Sequence[float],
) -> tuple[dict[int, str | None], dict[int, float]]:
    """Free the cameras that have changed, most likely first, until the later snapshots are explained.

    Beside another changed camera, a camera must have changed without the episode that supports it most, too; the alarm
    has tested the first one.

    Args:
        recent: the latest snapshots.
        age: number of snapshots since the change.
        known: cameras already known to have changed, and how.
        episode: as for `find_alarm`.
        least_shifts: as for `find_alarm`.

    Returns:
        The changed cameras, at least one, and how each changed (None = in any way); the chi-squared of each new one.
    """
    test = recent.test(age)
    free, evidence, passing = dict(known), dict[int, float](), set[int]()
    while len(free) + len(passing) < len(test.pixels):
        given = test.condition_on(free) if free else test
        scores = given.each.scores()
        others = {
            camera: max(float(score[camera]) for score in scores.values())
            for camera in range(len(test.pixels))
            if camera not in free
            and camera not in passing
            and (not free or _largest_shift(given, camera) >= least_shifts[camera])
        }
        if free and max(others.values(), default=0.0) < ALARM_CHI2:
            break
        camera = likeliest_camera(given, others)
        if free and _may_pass(recent, age, free, camera, episode(camera, _largest_shift(given, camera))):
            passing.add(camera)
            continue
        free[camera], evidence[camera] = None, others[camera]
        passing.clear()
    return free, evidence


def _may_pass(recent: RecentSnapshots, age: int, free: Mapping[int, str | None], camera: int, episode: int) -> bool:
    """Tell whether a camera's change may be a passing error, given that others have changed."""
    if episode <= 1:
        return False
    if age <= episode:
        return True
    starts = [*range(0, age - episode, math.ceil(episode / EPISODE_STEPS)), age - episode]
    tests = (recent.test(age, without=range(start, start + episode)).condition_on(free) for start in starts)
    return any(max(float(score[camera]) for score in test.each.scores().values()) < REMAINING_CHI2 for test in tests)


def _largest_shift(test: ChangeTest, camera: int) -> float:
    """Largest image shift (px) by a change of a single kind, if no other camera changed."""
    kinds = (test.jump(camera, kind)[0] / test.pixels[camera, part] for kind, part in CHANGES.items())
    return max(float(shift.norm()) for shift in kinds)


def contradicting_camera(
    belief: RigBelief, observations: Observations, rig_from_object: RigidTransform, options: EstimationOptions
) -> int | None:
    """Find the camera whose move would explain why a snapshot is refused; None = no single camera.

    Args:
        belief: the current belief.
        observations: (1, C, N) of the snapshot.
        rig_from_object: (1,) first guess of the object's pose.
        options: how to minimize.
    """
    found: dict[int, float] = {}
    for camera in observations.seen[0].any(-1).nonzero()[:, 0].tolist():
        with contextlib.suppress(RefusedError):
            free = free_anywhere(belief, (camera,), [(observations, rig_from_object)])
            result = absorb(free, observations, rig_from_object, options)
            if result.chi2 <= FIT_CHI2_PER_DOF * max(result.dof, 1):
                found[camera] = result.evidence
    return max(found, key=lambda camera: found[camera], default=None)
