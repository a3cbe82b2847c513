"""`rig.yaml` as it is now, and as it was: written beside the loop, the newest first."""

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

STATE, CURRENT, HISTORY, FRAMES = "state.json", "rig.yaml", "history", "frames"
LONGEST_END = 10.0  # s that are waited at the end for what has not been written
MOST_KEPT = 1000
"""Files of the history; more, and the oldest are removed."""

_Step = tuple[str, Callable[[], None] | None]  # name of what is done; None = nothing of it now


class RigFiles:
    """Writes rigs with their standard deviations.

    `rig.yaml` is replaced in one step; a rig that is to be kept goes to `history/<date>/<time>.yaml`, too. Writing is
    done by a thread of its own; where it cannot follow, the rigs between are left out.
    """

    def __init__(self, folder: Path, most_kept: int = MOST_KEPT) -> None:
        """Begin; the folder must exist."""
        self.problems: dict[str, str] = {}
        """What could not be done the last time, and why."""
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
        """Let the rig be written; returns at once.

        Args:
            state: what is known of it.
            keep: into the history as well.
            also: writes the state that belongs to this moment, before the rig.
            then: done once that has been written: deletes frames that are not needed any more.
        """
        with self._changed:
            self._current = state
            if also is not None:
                self._also, self._then = also, then
            if keep:
                self._to_keep.append(state)
            self._changed.notify()

    def close(self) -> None:
        """Write what waits, and end."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(LONGEST_END)
        if self._thread.is_alive():  # a disk that does not answer
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
        """Write what is known, the rig, and the history: one that fails keeps none of the others from it."""
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
            with contextlib.suppress(FileNotFoundError):  # somebody has tidied up
                if not any(oldest.parent.iterdir()):
                    oldest.parent.rmdir()


def put_aside(folder: Path) -> bool:
    """Forget what an earlier run knew: its state is deleted, its rig goes into the history.

    Returns:
        Whether there was something.

    Raises:
        InputError: the folder cannot be written.
    """
    state, rig = folder / STATE, folder / CURRENT
    found = state.is_file() or rig.is_file()
    try:
        if state.is_file():  # first: a start after this one must not go on from it
            state.unlink()
        if rig.is_file():
            os.replace(rig, _history_path(folder, rig.stat().st_mtime))
    except OSError as error:
        problem = error.strerror or error
        raise InputError(f"{folder}: what an earlier run left there cannot be put aside: {problem}") from error
    return found


def _history_path(folder: Path, time: float) -> Path:
    """Name of the rig of a moment (s since the epoch) in the history, whose folder is made."""
    day, moment = datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H%M%S.%f").split()
    path = folder / HISTORY / day / f"{moment[:-3]}.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _save(state: RigState, path: Path) -> None:
    save_rig(state.rig, path, RigCovariance(state.std))


def _problems(work: list[_Step]) -> dict[str, str]:
    """Do one after the other; gives the names of those that fail, and why."""
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
