"""`rig.yaml` as it is now, and as it was: written beside the loop, the newest first."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from imgcal.errors import InputError
from imgcal.io import RigCovariance, save_rig
from imgcal.online import RigState

CURRENT, HISTORY = "rig.yaml", "history"
MOST_KEPT = 1000
"""Files of the history; more, and the oldest are removed."""


class RigFiles:
    """Writes rigs with their standard deviations.

    `rig.yaml` is replaced in one step; a rig that is to be kept goes to `history/<date>/<time>.yaml`, too. Writing is
    done by a thread of its own; where it cannot follow, the rigs between are left out.
    """

    def __init__(self, folder: Path, most_kept: int = MOST_KEPT) -> None:
        """Begin; the folder must exist."""
        self.problem: str | None = None
        """Why the last one could not be written."""
        self._folder, self._most = folder, most_kept
        self._kept = deque(sorted((folder / HISTORY).glob("*/*.yaml")))
        self._current: RigState | None = None
        self._also: Callable[[], None] | None = None
        self._to_keep: deque[RigState] = deque(maxlen=8)
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="rig files", daemon=True)
        self._thread.start()

    def write(self, state: RigState, keep: bool = False, also: Callable[[], None] | None = None) -> None:
        """Let the rig be written; returns at once.

        Args:
            state: what is known of it.
            keep: into the history as well.
            also: writes what else belongs to this moment, before the rig.
        """
        with self._changed:
            self._current = state
            self._also = also or self._also
            if keep:
                self._to_keep.append(state)
            self._changed.notify()

    def close(self) -> None:
        """Write what waits, and end."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(10.0)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._current or self._to_keep or self._closing)
                current, self._current = self._current, None
                also, self._also = self._also, None
                to_keep = list(self._to_keep)
                self._to_keep.clear()
            if current is None and not to_keep:
                return
            try:
                if also is not None:
                    also()
                for state in to_keep:
                    self._keep(state)
                if current is not None:
                    _save(current, self._folder / CURRENT)
                self.problem = None
            except (InputError, OSError) as error:
                self.problem = str(error)

    def _keep(self, state: RigState) -> None:
        day, moment = datetime.fromtimestamp(state.time, UTC).strftime("%Y-%m-%d %H%M%S.%f").split()
        path = self._folder / HISTORY / day / f"{moment[:-3]}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        _save(state, path)
        if not self._kept or self._kept[-1] != path:
            self._kept.append(path)
        while len(self._kept) > self._most:
            oldest = self._kept.popleft()
            oldest.unlink(missing_ok=True)
            if not any(oldest.parent.iterdir()):
                oldest.parent.rmdir()


def _save(state: RigState, path: Path) -> None:
    save_rig(state.rig, path, RigCovariance(state.std))
