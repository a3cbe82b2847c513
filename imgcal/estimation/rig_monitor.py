"""A filter that notices when a camera changes, says how, and learns that camera anew while it keeps the others."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation.rig_changes import CHANGES, change_scores, jump
from imgcal.estimation.rig_filter import Absorbed, RigBelief, RigFilter, absorbed, aged, joined, widened
from imgcal.geometry import RigidTransform
from imgcal.types import PARAMETERS, Observations

SIGNIFICANT = 60.0
"""Chi-squared (two or three degrees of freedom) that a camera which stands still exceeds once in 10^12 tests."""
LEAST_AGE = 2
"""Snapshots that must agree that something has changed."""
NEARBY = 3
"""Snapshots around the most significant one among which the first one after a change is looked for."""
OLDEST = 64
"""Snapshots within which a change must show: one second at 60 a second."""
DECIDED = 5.0
"""Log odds of a kind of change against every other, from which it is told."""
JUDGED = (4, 8, 16, 32, 48, 64)
"""Numbers of snapshots since a change at which its kind is asked for."""
JUMP = {"rotation": 0.05, "position": 20.0, "focal_length": 30.0, "principal_point": 20.0}
"""Standard deviations (rad, mm, pixels) of a change of each kind before anything is known of it."""
DISTORTED = 0.01  # of the distortion, where the kind of change is not known


@dataclass(frozen=True)
class Change:
    """What happened to a camera."""

    camera: int
    since: int  # number of the first snapshot, counted from 0, that saw it from its new place
    kind: str  # of `CHANGES`; "unknown" = not decided yet
    size: float  # rad, mm or pixels; nan where the kind is not known
    sigma: float  # one standard deviation of it


@dataclass(frozen=True)
class _Seen:
    """A snapshot, and what was believed before it."""

    before: RigBelief
    observations: Observations
    rig_from_object: RigidTransform
    evidence: float  # of nothing having changed with it


class RigMonitor:
    """A `RigFilter` whose cameras may be bumped.

    Examples:
        >>> import imgcal
        >>> monitor = RigMonitor(RigFilter(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")))
        >>> monitor.filter.count, monitor.open
        (0, {})
    """

    def __init__(self, rig_filter: RigFilter) -> None:
        """Watch over a filter, which is to be updated by this monitor alone from now on."""
        self.filter = rig_filter
        self.open: dict[int, Change] = {}  # changes whose kind is not decided yet, by camera
        self._recent: deque[_Seen] = deque(maxlen=OLDEST)  # comparable with what is believed now
        self._before = rig_filter.belief  # what was believed before the first open change ...
        self._since: list[_Seen] = []  # ... and what has been seen since then

    def update(
        self, observations: Observations, rig_from_object: RigidTransform, seconds: float = 0.0
    ) -> tuple[Absorbed, tuple[Change, ...]]:
        """Learn from a snapshot.

        Args:
            observations: (1, C, N).
            rig_from_object: (1,) first guess of the object's pose.
            seconds: since the update before.

        Returns:
            What was learnt, and the changes that became known with this snapshot: first that there is one, then, once
            that is decided, of which kind it is.

        Raises:
            RefusedError: see `absorbed`.
        """
        before = aged(self.filter.belief, seconds, self.filter.rate)
        result = self.filter.follow(observations, rig_from_object, seconds)
        seen = _Seen(before, observations, result.rig_from_object, result.evidence)
        self._recent.append(seen)
        if self.open:
            self._since.append(seen)
        found = self._most_significant()
        if found is not None:
            return self._alarmed(*found)
        if self.filter.due:
            result = self.filter.relinearize()
            self._recent.clear()  # beliefs from before have another linearization
        if self.open and len(self._since) in JUDGED:
            return self._judged()
        return result, ()

    def _most_significant(self) -> tuple[int, int] | None:
        """The camera that has surely changed, and before how many snapshots; None = no camera."""
        count, known = len(self._recent), self.filter.count
        due = [age for age in (2, 4, 8, 16, 32, 64) if LEAST_AGE <= age <= count and known % (age // 2) == 0]
        if max((float(self._scores(age).max()) for age in due), default=0.0) < SIGNIFICANT:
            return None
        scores = torch.stack([self._scores(age) for age in range(LEAST_AGE, count + 1)])  # (ages, C)
        age, camera = divmod(int(scores.argmax()), scores.shape[1])
        return camera, age + LEAST_AGE

    def _scores(self, age: int) -> Tensor:
        """Largest score of each camera (C,) of any kind, since so many snapshots ago; open changes are known."""
        return self._worst(self._recent[-age].before, self.filter.belief)

    def _worst(self, before: RigBelief, after: RigBelief) -> Tensor:
        scores = torch.stack(list(change_scores(before, after).values())).amax(0)
        scores[list(self.open)] = 0.0
        return scores

    def _alarmed(self, camera: int, age: int) -> tuple[Absorbed, tuple[Change, ...]]:
        """Let cameras free that have changed, the surest first, until what has been seen since then is explained."""
        told: list[Change] = []
        if not self.open:
            age = self._age(camera, age)
            self._since = list(self._recent)[-age:]
            self._before = self._since[0].before
        since = self.filter.count - age
        while True:
            self.open[camera] = Change(camera, since, "unknown", float("nan"), float("nan"))
            told.append(self.open[camera])
            before = self._let_free({})
            result = self.filter.restart(before, self._snapshots())
            self._recent.clear()
            scores = self._worst(before, result.belief)
            if float(scores.max()) < SIGNIFICANT:
                return result, tuple(told)
            camera = int(scores.argmax())

    def _age(self, camera: int, age: int) -> int:
        """Number of snapshots since a camera changed, by the evidence of the snapshots before and after."""
        seen = list(self._recent)
        oldest = min(age + NEARBY, len(seen))
        found: dict[int, float] = {}
        for candidate in range(max(age - NEARBY, 1), oldest + 1):
            still, later = seen[len(seen) - oldest : len(seen) - candidate], seen[-candidate:]
            free = _widened(later[0].before, {camera: None})
            given = joined([(s.observations, s.rig_from_object) for s in later])
            with contextlib.suppress(RefusedError):
                changed = absorbed(free, *given, self.filter.options).evidence
                found[candidate] = sum(s.evidence for s in still) + changed
        return max(found, key=lambda candidate: found[candidate], default=age)

    def _judged(self) -> tuple[Absorbed, tuple[Change, ...]]:
        """Decide what kind of change each open one is, where the snapshots since can tell, or it is time."""
        told, kinds, given = [], {}, joined(self._snapshots())
        for camera, change in self.open.items():
            supposed = {kind: self._let_free({camera: kind}) for kind in CHANGES}
            found = {kind: absorbed(before, *given, self.filter.options) for kind, before in supposed.items()}
            best, second = sorted(found, key=lambda kind: -found[kind].evidence)[:2]
            if found[best].evidence - found[second].evidence >= DECIDED or len(self._since) >= OLDEST:
                kinds[camera] = best
                size = self._size(camera, best, supposed[best], found[best].belief)
                told.append(Change(camera, change.since, best, *size))
        result = self.filter.restart(self._let_free(kinds), self._snapshots())
        self._recent.clear()
        self.open = {camera: change for camera, change in self.open.items() if camera not in kinds}
        self._since = self._since if self.open else []
        return result, tuple(told)

    def _let_free(self, kinds: Mapping[int, str]) -> RigBelief:
        """What was believed before, the cameras with open changes widened: in all ways where the kind is not given."""
        return _widened(self._before, {camera: kinds.get(camera) for camera in self.open})

    def _snapshots(self) -> list[tuple[Observations, RigidTransform]]:
        """All that has been seen since the first open change."""
        return [(seen.observations, seen.rig_from_object) for seen in self._since]

    def _size(self, camera: int, kind: str, let_free: RigBelief, after: RigBelief) -> tuple[float, float]:
        """How far a camera went, were it of this kind alone, and the standard deviation of that."""
        change, covariance = jump(self._before, let_free, after, camera, kind)
        size = float(change.norm())
        along = change / max(size, 1e-30)
        return size, float((along @ covariance @ along).clamp_min(0).sqrt())


def _widened(belief: RigBelief, cameras: Mapping[int, str | None]) -> RigBelief:
    """Let cameras have changed in some way; None = in all ways."""
    variance = torch.zeros(belief.rig.num_cameras, PARAMETERS, dtype=torch.float64)
    for camera, known in cameras.items():
        for kind, part in CHANGES.items():
            if known in (None, kind):
                variance[camera, part] = JUMP[kind] ** 2
        if known is None:
            variance[camera, 10:] = DISTORTED**2
    return widened(belief, variance)
