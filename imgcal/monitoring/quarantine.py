"""Cameras that see the object elsewhere than the others do, and nobody knows yet why: nothing is learnt of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

from imgcal.geometry import RigidTransform
from imgcal.monitoring.explanations import Suspicion
from imgcal.monitoring.recent_snapshots import RecentSnapshots
from imgcal.monitoring.unsynchronized import without
from imgcal.types import Observations

MOST = 16
"""Latest snapshots that are asked why ..."""
MOST_WIDE = 64
"""... of cameras that are known; and of others, of which it takes more to tell anything."""
ASKED = (1, 2, 3, 4, 6, 8, 12, 16, 20, 24, 28, 32, 48, 64)
EVERY = 32
"""Numbers of snapshots since cameras are held after which it is asked, and how often later."""
SHAKEN_SECONDS, SHAKEN = 2.0, 20
"""For how long, and how many snapshots at least, a camera that sees the object at moments of its own may as well be one
that is being shaken."""


@dataclass
class Quarantine:
    """Cameras of which nothing is learnt, and what they have seen meanwhile."""

    cameras: set[int] = field(default_factory=set)
    seen: deque[Observations] = field(default_factory=lambda: deque(maxlen=MOST_WIDE))  # (1, C, N), of all cameras
    elapsed: int = 0  # snapshots since they are held
    passing: bool = True  # what is wrong with them may still be an error that passes
    taken: int = 0  # of those that count, the ones in which they see the object
    seconds: float = 0.0  # since then
    wide: bool = False  # it is hardly known where they are
    apart: bool = False  # they see the object at moments of their own, or are shaken ...
    told: bool = False  # ... and it is told that it is the former

    def hold(self, cameras: Collection[int], wide: bool) -> None:
        """Hold cameras, and begin anew where one of them is new."""
        if not set(cameras) <= self.cameras:
            self._begin(self.cameras | set(cameras), wide)

    def tell(self) -> tuple[int, ...]:
        """Cameras that surely have moments of their own, once: they would stand still by now if they were shaken."""
        if not self.apart or self.told or self.seconds < SHAKEN_SECONDS or len(self.seen) < SHAKEN:
            return ()
        self.told = True
        return tuple(sorted(self.cameras))

    def take(self, observations: Observations, seconds: float, episode: int = 1) -> bool:
        """Keep a snapshot, and tell whether to ask what has happened to the cameras.

        Args:
            observations: (1, C, N).
            seconds: since the one before.
            episode: successive snapshots that one passing error of these cameras may last. The first so many are no
                evidence: what is wrong with them may pass.
        """
        self.seconds += seconds if self.seen else 0.0
        self.elapsed += 1
        self.seen.append(observations)
        if not self._shows(observations):
            return False
        self.taken += 1
        if self.passing and self.elapsed > episode > 1:
            self._forget_episode()
        self.passing = self.elapsed <= episode and episode > 1
        return not self.passing and (self.taken in ASKED or self.taken % EVERY == 0)

    def _shows(self, observations: Observations) -> bool:
        return bool(observations.seen[:, list(self.cameras)].any())

    def _forget_episode(self) -> None:
        """Keep of the first episode the last snapshot that shows the object: later ones must agree with it."""
        shown = [number for number, observations in enumerate(self.seen) if self._shows(observations)]
        for _ in range(shown[-2] if len(shown) > 1 else 0):
            self.seen.popleft()
        self.taken = min(len(shown), 2)

    def hold_since(
        self,
        snapshots: Sequence[tuple[Observations, RigidTransform]],
        pauses: Sequence[float],
        cameras: Collection[int],
        wide: bool,
    ) -> list[tuple[Observations, RigidTransform]]:
        """Hold cameras that seem to have moments of their own; returns what may be learnt of snapshots with them.

        Args:
            snapshots: observations (1, C, N) and the object's pose (1,) of each.
            pauses: s before each of them.
            cameras: those.
            wide: it is hardly known where they are.
        """
        self.hold(cameras, wide)
        for (observations, _), seconds in zip(snapshots, pauses, strict=True):
            self.take(observations, seconds)
        self.apart = True
        return [(without(observations, self.cameras), pose) for observations, pose in snapshots]

    def suspicion(self, recent: RecentSnapshots) -> Suspicion:
        """What is to be asked: these cameras, and the latest snapshots with what they have seen.

        Raises:
            RefusedError: nothing is known of the rig.
        """
        total = recent.snapshots(len(recent))
        window = list(self.seen)[-min(MOST_WIDE if self.wide else MOST, len(total)) :]
        count = len(window)
        snapshots = [*total[:-count], *zip(window, [pose for _, pose in total[-count:]], strict=True)]
        before, pauses = recent.belief_before(count), recent.pauses(len(recent))
        cameras = dict.fromkeys(sorted(self.cameras))
        return Suspicion(before, snapshots, pauses, count, cameras, wide=self.wide, held=True)

    def release(self) -> None:
        """Hold none."""
        self._begin(set(), wide=False)

    def _begin(self, cameras: set[int], wide: bool) -> None:
        """Hold cameras of which nothing has been seen yet."""
        self.cameras, self.wide = cameras, wide
        self.elapsed, self.passing = 0, True
        self.taken, self.seconds, self.apart, self.told = 0, 0.0, False, False
        self.seen.clear()
