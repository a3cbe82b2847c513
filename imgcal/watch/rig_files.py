"""`rig.yaml` and its history: written beside the loop, the newest first."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from imgcal.errors import InputError
from imgcal.io import RigCovariance, save_rig
from imgcal.online import RigState
from imgcal.watch.learning import ADAPTED, LEARNING

STATE, CURRENT, HISTORY, FRAMES = "state.json", "rig.yaml", "history", "frames"
LONGEST_END = 10.0  # s to wait at the end for unfinished writes
MOST_KEPT = 1000
"""Maximum number of files in the history; the oldest are removed beyond that."""

_Step = tuple[str, Callable[[], None] | None]  # name of the step; None = nothing to do


class RigFiles:
    """Writes rigs with their standard deviations.

    `rig.yaml` is replaced atomically; a rig to keep is also written to `history/<date>/<time>.yaml`. A separate thread
    does the writing; if it cannot keep up, rigs in between are skipped.
    """

    def __init__(self, folder: Path, most_kept: int = MOST_KEPT) -> None:
        """Start the thread; the folder must exist."""
        self.problems: dict[str, str] = {}
        """The steps that failed last time, and why."""
        self._folder, self._most = folder, most_kept
        self._kept = deque(sorted((folder / HISTORY).glob("*/*.yaml")))
        self._current: RigState | None = None
        self._also: Callable[[], None] | None = None
        self._then: Callable[[], None] | None = None
        self._to_keep: deque[RigState] = deque(maxlen=8)
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="rig files", daemon=True)
        self._thread.start()

    def write(
        self,
        state: RigState,
        keep: bool = False,
        also: Callable[[], None] | None = None,
        then: Callable[[], None] | None = None,
    ) -> None:
        """Queue the rig for writing; returns at once.

        Args:
            state: the state of the rig.
            keep: also write it to the history.
            also: writes the keeper's state of this moment, before the rig.
            then: called after that: deletes frames that are no longer needed.
        """
        with self._changed:
            self._current = state
            if also is not None:
                self._also, self._then = also, then
            if keep:
                self._to_keep.append(state)
            self._changed.notify()

    def close(self) -> None:
        """Write what waits, and stop the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(LONGEST_END)
        if self._thread.is_alive():  # the disk does not answer
            self.problems |= {CURRENT: f"{self._folder / CURRENT}: was not written within {LONGEST_END:g} s"}

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._current or self._to_keep or self._closing)
                current, self._current = self._current, None
                (also, then), self._also, self._then = (self._also, self._then), None, None
                to_keep = list(self._to_keep)
                self._to_keep.clear()
            if current is None and not to_keep:
                return
            self._write(also, then, current, to_keep)

    def _write(
        self,
        also: Callable[[], None] | None,
        then: Callable[[], None] | None,
        current: RigState | None,
        to_keep: list[RigState],
    ) -> None:
        """Write the keeper's state, the rig, and the history; if one fails, the others are still written."""
        work: list[_Step] = [(STATE, also)]
        work += [] if current is None else [(CURRENT, partial(_save, current, self._folder / CURRENT))]
        work += [(HISTORY, partial(self._keep, state)) for state in to_keep]
        problems = _problems(work)
        if STATE not in problems:
            work.append((FRAMES, then))
            problems |= _problems(work[-1:])
        tried = {name for name, step in work if step is not None}
        self.problems = {name: why for name, why in self.problems.items() if name not in tried} | problems

    def _keep(self, state: RigState) -> None:
        path = _history_path(self._folder, state.time)
        _save(state, path)
        if not self._kept or self._kept[-1] != path:
            self._kept.append(path)
        while len(self._kept) > self._most:
            oldest = self._kept.popleft()
            oldest.unlink(missing_ok=True)
            with contextlib.suppress(FileNotFoundError):  # somebody has deleted it
                if not any(oldest.parent.iterdir()):
                    oldest.parent.rmdir()


def put_aside(folder: Path) -> bool:
    """Reset a folder: delete an earlier run's state, move its rig into the history, and rename its adapted networks.

    Returns:
        Whether there was anything to reset.

    Raises:
        InputError: the folder cannot be written.
    """
    state, rig, adapted = folder / STATE, folder / CURRENT, folder / LEARNING / ADAPTED
    found = state.is_file() or rig.is_file() or adapted.is_dir()
    try:
        if state.is_file():  # first: a later start must not resume from it
            state.unlink()
        if rig.is_file():
            os.replace(rig, _history_path(folder, rig.stat().st_mtime))
        if adapted.is_dir():  # a later start must not run them: they may be of another object
            made = datetime.fromtimestamp(adapted.stat().st_mtime, UTC)
            os.replace(adapted, adapted.with_name(f"{ADAPTED}-{made:%Y%m%d-%H%M%S}"))
    except OSError as error:
        problem = error.strerror or error
        raise InputError(f"{folder}: the state of an earlier run cannot be moved out of the way: {problem}") from error
    return found


def _history_path(folder: Path, time: float) -> Path:
    """Path in the history for the rig at a time (s since the epoch); creates its folder."""
    day, moment = datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H%M%S.%f").split()
    path = folder / HISTORY / day / f"{moment[:-3]}.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _save(state: RigState, path: Path) -> None:
    save_rig(state.rig, path, RigCovariance(state.std))


def _problems(work: list[_Step]) -> dict[str, str]:
    """Do all steps, and return the names of those that failed, and why."""
    problems: dict[str, str] = {}
    for name, step in work:
        try:
            if step is not None:
                step()
        except OSError as error:
            problems[name] = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        except InputError as error:
            problems[name] = str(error)
    return problems
