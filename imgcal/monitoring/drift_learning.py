"""Learn, while nothing else is the matter, how fast cameras drift, and know as much less of those that do."""

from __future__ import annotations

from dataclasses import dataclass

from imgcal.monitoring.drift_pace import SECONDS, DriftPaces, Stretch
from imgcal.monitoring.recent_snapshots import RecentSnapshots
from imgcal.monitoring.rig_belief import widened
from imgcal.monitoring.rig_filter import RigFilter

TOLD_AT_ONCE = 32
"""Snapshots whose information is added up at once."""


@dataclass
class DriftLearning:
    """The paces of a filter's cameras, and the snapshots that are to say more of them."""

    paces: DriftPaces
    stretch: Stretch | None = None  # of snapshots ...
    untold: int = 0  # ... and the latest of them, which it does not know of yet

    def take(self, follows: RigFilter, recent: RecentSnapshots, seconds: float, quiet: bool) -> None:
        """Take the latest snapshot, and change what the filter believes.

        Args:
            follows: the filter that has learnt from it.
            recent: the latest snapshots, this one included.
            seconds: since the one before.
            quiet: no camera has changed of late.
        """
        if follows.young or not quiet:
            self.stretch = None
            return
        if self.stretch is None:
            self.stretch, self.untold = Stretch.after(follows.belief, follows.waited, recent.lasting), 0
            return
        stretch = self.stretch
        stretch.seconds, self.untold = stretch.seconds + seconds, self.untold + 1
        done = stretch.seconds >= SECONDS
        if done or self.untold == TOLD_AT_ONCE:
            stretch.add(follows.belief, *recent.brought(self.untold))
            self.untold = 0
        if done:
            lacking = self.paces.take(stretch, follows.rate.std(follows.belief.rig))
            follows.pace = self.paces.of_parameters(follows.pace.shape[1])
            recent.walk = follows.walk
            if bool(lacking.any()):
                follows.belief = widened(follows.belief, lacking)
            self.stretch = Stretch.after(follows.belief, follows.waited, recent.lasting)
