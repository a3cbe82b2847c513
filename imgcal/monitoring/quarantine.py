"""Cameras that see the object in the wrong place: they are excluded from learning until the reason is known."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from imgcal.estimation import EstimationOptions
from imgcal.monitoring.case import Case, Snapshot
from imgcal.monitoring.object_change import ObjectChanged
from imgcal.monitoring.recent_snapshots import RecentSnapshots
from imgcal.monitoring.shaking import Shaking
from imgcal.types import Observations

CASE_SNAPSHOTS, CASE_SNAPSHOTS_UNCERTAIN = 16, 64
"""Latest snapshots of a case; the second number applies if the cameras' poses are hardly known, which takes more."""
CASE_AFTER = (1, 2, 3, 4, 6, 8, 12, 16, 20, 24, 28, 32, 48, 64)
CASE_EVERY = 32
"""Numbers of snapshots in quarantine after which a case is made, and the interval later."""
SETTLE_SECONDS, SETTLE_SNAPSHOTS = 2.0, 20
"""Seconds and snapshots during which an unsynchronized camera may equally be one that is being shaken."""


@dataclass
class Quarantine:
    """Cameras excluded from learning, and what they have seen in the meantime."""

    cameras: set[int] = field(default_factory=set)
    seen: deque[Observations] = field(default_factory=lambda: deque(maxlen=CASE_SNAPSHOTS_UNCERTAIN))  # (1, C, N)
    snapshots: int = 0  # since the quarantine began
    sightings: int = 0  # relevant snapshots in which these cameras see the object
    passing: bool = True  # the error may still pass
    seconds: float = 0.0  # since the quarantine began
    uncertain: bool = False  # the cameras' poses are hardly known
    unsynchronized: bool = False  # they are unsynchronized or being shaken ...
    reported: bool = False  # ... and were reported as unsynchronized
    least: int = 0  # sightings before the first case

    def add(self, cameras: Collection[int], uncertain: bool) -> None:
        """Add cameras; restart if one of them is new."""
        if not set(cameras) <= self.cameras:
            self._begin(self.cameras | set(cameras), uncertain)

    def report_unsynchronized(self) -> tuple[int, ...]:
        """Report surely unsynchronized cameras once; shaken cameras would be at rest by now."""
        soon = self.seconds < SETTLE_SECONDS or len(self.seen) < SETTLE_SNAPSHOTS
        if not self.unsynchronized or self.reported or soon:
            return ()
        self.reported = True
        return tuple(sorted(self.cameras))

    def observe(self, observations: Observations, seconds: float, episode: int = 1) -> bool:
        """Keep a snapshot, and tell whether to make a case now.

        Args:
            observations: (1, C, N).
            seconds: since the previous snapshot.
            episode: successive snapshots that a passing error of one of these cameras may last, the least of all. No
                case is made before that is over, because the error may pass.
        """
        self.seconds += seconds if self.seen else 0.0
        self.snapshots += 1
        self.seen.append(observations)
        if not self._is_sighting(observations):
            return False
        self.sightings += 1
        if self.passing and self.snapshots > episode > 1:
            self._forget_episode()
        self.passing = self.snapshots <= episode and episode > 1
        due = self.sightings in CASE_AFTER or self.sightings % CASE_EVERY == 0
        return due and not self.passing and self.sightings >= self.least

    def expect_passing(self) -> None:
        """Wait for another episode: an error begins after these cameras have seen the object in its place."""
        self.snapshots, self.passing = 0, True

    def _is_sighting(self, observations: Observations) -> bool:
        return bool(observations.seen[:, list(self.cameras)].any())

    def _forget_episode(self) -> None:
        """Of the first episode, keep only the last snapshot that shows the object: later ones must agree with it."""
        shown = [number for number, observations in enumerate(self.seen) if self._is_sighting(observations)]
        for _ in range(shown[-2] if len(shown) > 1 else 0):
            self.seen.popleft()
        self.sightings = min(len(shown), 2)

    def add_unsynchronized(
        self,
        snapshots: Sequence[Snapshot],
        pauses: Sequence[float],
        cameras: Collection[int],
        uncertain: bool,
        least: int = 0,
    ) -> None:
        """Add cameras that seem to be unsynchronized.

        Args:
            snapshots: since then.
            pauses: s before each of them.
            cameras: the cameras to add.
            uncertain: their poses are hardly known.
            least: sightings before the first case.
        """
        self.add(cameras, uncertain)
        self.least = max(self.least, least)
        for (observations, _), seconds in zip(snapshots, pauses, strict=True):
            self.observe(observations, seconds)
        self.unsynchronized = True

    def case(self, recent: RecentSnapshots, options: EstimationOptions, lasting: Tensor | None = None) -> Case:
        """Make a case of these cameras: the latest snapshots, including what the cameras have seen.

        Raises:
            RefusedError: nothing is known about the rig.
        """
        total, pauses = recent.latest(len(recent))
        most = CASE_SNAPSHOTS_UNCERTAIN if self.uncertain else CASE_SNAPSHOTS
        window = list(self.seen)[-min(most, len(total)) :]
        count = len(window)
        snapshots = [*total[:-count], *zip(window, [pose for _, pose in total[-count:]], strict=True)]
        before = recent.belief_before(count)
        excluded = {
            Shaking.name: "the error is too large for shaking",
            ObjectChanged.name: "the other cameras see an unchanged object",
        }
        cameras = tuple(sorted(self.cameras))
        return Case(
            before, snapshots, pauses, count, options, cameras, self.uncertain, True, lasting, excluded=excluded
        )

    def release(self) -> None:
        """Release all cameras."""
        self._begin(set(), uncertain=False)

    def _begin(self, cameras: set[int], uncertain: bool) -> None:
        """Start with cameras that have not seen anything yet."""
        self.cameras, self.uncertain = cameras, uncertain
        self.snapshots, self.sightings, self.passing = 0, 0, True
        self.seconds, self.unsynchronized, self.reported, self.least = 0.0, False, False, 0
        self.seen.clear()
