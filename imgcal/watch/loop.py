"""The loop of `imgcal watch`: snapshots in, results out, and the state saved for the next start."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Protocol

from imgcal.association import Proposer
from imgcal.errors import InputError, RefusedError
from imgcal.io import Frame
from imgcal.online import Event, RigState
from imgcal.types import CameraRig, Detections
from imgcal.watch.earlier_run import Progress
from imgcal.watch.event_log import EventLog
from imgcal.watch.hook import Hook
from imgcal.watch.learning import Learning
from imgcal.watch.metrics import Tally
from imgcal.watch.poses import Poses
from imgcal.watch.rig_files import FRAMES, STATE, RigFiles
from imgcal.watch.source_reader import SourceReader
from imgcal.watch.synchronization import TimedSnapshot

EVENTS = "events.jsonl"
SAVED_EVERY = 1.0  # s between two saves of the state
LOOKED_EVERY = 0.1  # s to wait for a snapshot before doing other things
KEPT_EVERY = 3600.0  # s between two rigs of the history without events
IN_HISTORY = frozenset({"moved", "relearnt", "drift", "factory", "restart"})
"""Events after which the rig is kept in the history."""


class Writable(Protocol):
    """A copy of the state at one moment."""

    def write(self, path: Path) -> None:
        """Write the state atomically."""


class Keeper(Protocol):
    """The part of `RigKeeper` that the loop uses."""

    @property
    def factory(self) -> CameraRig:
        """The factory calibration."""

    def update(
        self, source: Mapping[str, Frame | None] | Detections, time: float, silent: Collection[str] = ()
    ) -> RigState:
        """Learn from a snapshot: frames (H, W) by camera, or blobs; `time` in s since the epoch; `silent`: no data."""

    def saved(self, progress: dict[str, Any]) -> Writable:
        """Copy the state, within milliseconds, together with the position in the source."""

    def accept_as_factory(self) -> Event:
        """Make the current rig the factory calibration.

        Raises:
            RefusedError: no snapshot has come yet.
        """

    def use_proposer(self, proposer: Proposer) -> None:
        """Find fiducials in frames with this proposer from now on."""


class Page(Protocol):
    """A page that shows the state to people."""

    def publish(self, state: RigState, frames: Mapping[str, Frame | None] | None) -> None:
        """Take the state after a snapshot, and its frames (H, W) by camera if there are any; must return at once."""

    def tell(self, event: Event) -> None:
        """Take an event without a snapshot; must return at once."""

    def commands(self) -> Iterable[Any]:
        """Return the users' commands since the last call, each with a `name`; must return at once."""


class Watch:
    """Processes one snapshot after another. A context manager: leaving it saves the state.

    A failure to write is counted, reported once, and retried: a full disk does not stop the loop.
    """

    def __init__(
        self,
        keeper: Keeper,
        folder: Path,
        hook: Hook | None = None,
        page: Page | None = None,
        told: Callable[[Event], None] = lambda event: None,
        problem: Callable[[str], None] = lambda message: None,
        saved: Callable[[Progress], None] = lambda progress: None,
        source: str | None = None,
        rate: float | None = None,
        poses: Collection[Poses] = (),
        learning: Learning | None = None,
    ) -> None:
        """Prepare; nothing is written before it is entered.

        Args:
            keeper: keeps the rig calibrated; not closed here.
            folder: for rig.yaml, its history, events.jsonl and the state; must exist.
            hook: command for events.
            page: shows the state.
            told: gets every event.
            problem: gets each write failure once, and users' commands that failed.
            saved: gets the position in the source once the results up to there have been written.
            source: identity of the source.
            rate: snapshots per second of a source without times.
            poses: get the state after each snapshot; not closed here.
            learning: adapts the network that finds fiducials; not closed here.
        """
        self.keeper, self.folder, self.tally = keeper, folder, Tally()
        self.paused = False
        self._hook, self._page, self._told, self._problem = hook, page, told, problem
        self.poses, self.learning = poses, learning
        self._when_saved, self._source, self._rate = saved, source, rate
        self._saved = -math.inf  # the first snapshot is saved at once
        self._progress: Progress | None = None
        self._unsaved = self._hook_told = False
        self._first: int | None = None  # digest of the source's first snapshot that shows anything
        self._kept: float | None = None  # s, time of the latest rig in the history

    def __enter__(self) -> Watch:
        """Open the outputs.

        Raises:
            InputError: events.jsonl cannot be written.
        """
        self._log, self._files = EventLog(self.folder / EVENTS), RigFiles(self.folder)
        return self

    def __exit__(self, *error: object) -> None:
        """Save the state, and close the outputs."""
        self.save()
        self._files.close()
        self._report_problems()
        self._report_poses()
        self._log.close()
        if self._hook is not None:
            self._hook.close()
            self._report_hook()

    @property
    def unwritten(self) -> dict[str, str]:
        """Outputs whose last write failed, and why."""
        return {output: why for output, why in self._files.problems.items() if output != FRAMES}

    def run(self, intake: SourceReader, stopped: threading.Event, looked: Callable[[], None] = lambda: None) -> None:
        """Process snapshots until the source ends or `stopped` is set.

        Args:
            intake: source of the snapshots.
            stopped: may be set by any thread.
            looked: called after each snapshot, and ten times a second while there are none.

        Raises:
            InputError: the source cannot continue.
        """
        while not stopped.is_set():
            snapshot = intake.next(LOOKED_EVERY)
            if snapshot is None and intake.ended:
                return
            self._apply_commands()
            self._report_hook()
            self._report_poses()
            self._apply_learning()
            self._first = intake.first
            if snapshot is not None:
                self.process(snapshot, live=intake.live)
            if time.monotonic() - self._saved >= SAVED_EVERY:
                self.save()
            looked()

    def process(self, snapshot: TimedSnapshot, live: bool = True) -> RigState | None:
        """Process one snapshot; None = it could not be used, or learning is paused.

        Args:
            snapshot: the snapshot.
            live: whether the next one will not wait; otherwise, slow outputs of poses are waited for.
        """
        if self.paused:
            self.tally.paused += 1
            return None
        names = self.keeper.factory.camera_names
        started = time.perf_counter()
        self.tally.snapshots += 1
        try:
            silent = [name for name in names if name not in snapshot.exposures]
            state = self.keeper.update(snapshot.source(names), snapshot.time, silent)
        except InputError as error:
            self.tally.unusable += 1
            self._fail("snapshots", str(error))
            return None
        self.tally.update_took(time.perf_counter() - started)
        self.tally.refused += state.refused is not None
        self.tally.latest = state
        for exposure in snapshot.exposures.values():
            self.tally.count_time_stamp(exposure.camera, exposure.time - snapshot.time)
        files = {name: exposure.file for name, exposure in snapshot.exposures.items() if exposure.file is not None}
        position = snapshot.time, snapshot.name, snapshot.era, self._first
        self._progress = Progress(*position, source=self._source, rate=self._rate, files=files)
        self._unsaved = True
        for event in state.events:
            self.publish_event(event)
        for output in self.poses:
            output.publish(state, wait=not live)
        if self._page is not None:
            self._page.publish(state, snapshot.frames(names))
        if self.learning is not None:
            self.learning.offer(state, snapshot.frames(names))
        return state

    def publish_event(self, event: Event) -> None:
        """Pass an event to all outputs."""
        self.tally.events[event.kind] += 1
        self._log.add(event)
        try:
            self._log.write()
        except OSError as error:
            self._fail(EVENTS, f"{self._log.path}: {error.strerror}" if error.strerror else str(error))
        self.tally.unwritten = self._log.unwritten
        if self._hook is not None:
            self._hook.notify(event)
        if self.tally.latest is not None and event.kind in IN_HISTORY:
            self._keep(self.tally.latest)
        if self._page is not None and (self.tally.latest is None or event not in self.tally.latest.events):
            self._page.tell(event)  # other events come with their state
        self._told(event)

    def save(self) -> None:
        """Write the state from which the next start resumes."""
        with contextlib.suppress(OSError):  # said when the event came
            self._log.write()
        self.tally.unwritten = self._log.unwritten
        state = self.tally.latest
        unsaved = self._unsaved or bool(self._files.problems)
        if state is None or self._progress is None or not unsaved:
            return
        self._saved = time.monotonic()
        self._report_problems()
        tables = dict(output.table for output in self.poses if output.table is not None)
        progress = replace(self._progress, logged=self._log.size, tables=tables, snapshot=state.snapshot)
        memory = self.keeper.saved(asdict(progress))
        self._files.write(
            state, also=lambda: memory.write(self.folder / STATE), then=lambda: self._when_saved(progress)
        )
        self._unsaved = False
        if self._kept is None or abs(state.time - self._kept) >= KEPT_EVERY:
            self._keep(state)

    def _keep(self, state: RigState) -> None:
        self._kept = state.time
        self._files.write(state, keep=True)

    def _report_problems(self) -> None:
        for output, message in self._files.problems.items():
            self._fail(output, message)

    def _report_hook(self) -> None:
        """Report once that the command fails; the display and the metrics show how often."""
        problem = None if self._hook is None or self._hook_told else self._hook.problem
        if problem is not None:
            self._hook_told = True
            self._problem(problem)

    def _report_poses(self) -> None:
        """Report once for each output of poses that it fails."""
        for output in self.poses:
            if output.problem is not None and not self.tally.problems[output.name]:
                self._fail(output.name, output.problem)

    def _fail(self, output: str, message: str) -> None:
        self.tally.problems[output] += 1
        if self.tally.problems[output] == 1:
            self._problem(message)

    def _apply_learning(self) -> None:
        """Switch to an adapted network, and report what came of trainings."""
        for outcome in () if self.learning is None else self.learning.outcomes():
            if outcome.proposer is not None:
                self.keeper.use_proposer(outcome.proposer)
            state = self.tally.latest
            when = (time.time(), 0) if state is None else (state.time, state.snapshot)
            self.publish_event(Event(*when, "network", message=outcome.message))

    def _apply_commands(self) -> None:
        """Execute users' commands."""
        for command in () if self._page is None else self._page.commands():
            if command.name in ("pause", "resume"):
                self.paused = command.name == "pause"
            elif command.name == "factory":
                try:
                    self.publish_event(self.keeper.accept_as_factory())
                except RefusedError as error:
                    self._problem(str(error))
                else:
                    self._unsaved = True
