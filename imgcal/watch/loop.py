"""The loop of a rig that is watched: a snapshot in, what is known out, the state kept for the next start."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

from imgcal.errors import InputError, RefusedError
from imgcal.io import Frame, read_json
from imgcal.online import Event, RigState
from imgcal.types import CameraRig, Detections
from imgcal.watch.event_log import EventLog
from imgcal.watch.hook import Hook
from imgcal.watch.metrics import Tally
from imgcal.watch.poses import Poses
from imgcal.watch.rig_files import FRAMES, STATE, RigFiles
from imgcal.watch.source_reader import SourceReader
from imgcal.watch.synchronization import TimedSnapshot

EVENTS = "events.jsonl"
SAVED_EVERY = 1.0  # s between two savings of what is known
LOOKED_EVERY = 0.1  # s that is waited for a snapshot before other things are seen to
KEPT_EVERY = 3600.0  # s between two rigs of the history, where nothing happens
IN_HISTORY = frozenset({"moved", "relearnt", "drift", "factory", "restart"})
"""Events whose rig is kept."""


class Writable(Protocol):
    """What is known, as it was at one moment."""

    def write(self, path: Path) -> None:
        """Write it in one step."""


class Keeper(Protocol):
    """What keeps the rig calibrated: a `RigKeeper`."""

    @property
    def factory(self) -> CameraRig:
        """The factory calibration."""

    def update(
        self, source: Mapping[str, Frame | None] | Detections, time: float, silent: Collection[str] = ()
    ) -> RigState:
        """Learn from a snapshot, for which some cameras sent nothing."""

    def saved(self, progress: dict[str, Any]) -> Writable:
        """Take down what is known, within milliseconds, and beside it how far its source has been worked on."""

    def accept_as_factory(self) -> Event:
        """Make the present rig the factory calibration.

        Raises:
            RefusedError: no snapshot has come yet.
        """


class Page(Protocol):
    """Who shows what is known to people."""

    def publish(self, state: RigState, frames: Mapping[str, Frame | None] | None) -> None:
        """Take what is known after a snapshot; must return at once."""

    def tell(self, event: Event) -> None:
        """Take an event that came with no snapshot; must return at once."""

    def commands(self) -> Iterable[Any]:
        """Give what people have asked for since the last call, each with a `name`; must return at once."""


@dataclass(frozen=True)
class Progress:
    """How far a source has been worked on."""

    time: float  # s, of the last snapshot
    name: str | None = None  # of it, where its source names snapshots
    logged: int | None = None  # bytes of events.jsonl until then
    source: str | None = None  # which one it was; None = not known
    rate: float | None = None  # snapshots a second, of a source that has no times

    @classmethod
    def load(cls, folder: Path) -> Progress | None:
        """Read it: it stands in the state, so that both are of the same moment; None = there is none.

        Raises:
            InputError: the file is none of ours.
        """
        path = folder / STATE
        if not path.is_file():
            return None
        try:
            entry = read_json(path.read_text())["progress"]
            if entry is None:
                return None
            time, name, logged = float(entry["time"]), entry["name"], entry.get("logged")
            source, rate = entry.get("source"), entry.get("rate")
            if not all(text is None or isinstance(text, str) for text in (name, source)):
                raise ValueError("a name is no text")
            if not (logged is None or isinstance(logged, int)):
                raise ValueError("the length is no number")
            return cls(time, name, logged, source, None if rate is None else float(rate))
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise InputError(f"{path}: found something else than imgcal watch writes there") from error


class Watch:
    """Works on one snapshot after another. A context manager: leaving it saves what is known.

    Whatever cannot be written is counted, said once, and tried again: a full disk does not end the watching.
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
    ) -> None:
        """Prepare; nothing is written before it is entered.

        Args:
            keeper: what keeps the rig; not closed here.
            folder: for rig.yaml, its history, events.jsonl and the state; must exist.
            hook: command for events.
            page: shows what is known.
            told: gets every event.
            problem: gets what could not be written, once, and what people ask for in vain.
            saved: gets how far the source has been worked on, once what it taught until then has been written.
            source: which source it is.
            rate: snapshots a second, of a source that has no times.
            poses: get what is known after each snapshot; not closed here.
        """
        self.keeper, self.folder, self.tally = keeper, folder, Tally()
        self.paused = False
        self._hook, self._page, self._told, self._problem = hook, page, told, problem
        self._poses = poses
        self._when_saved, self._source, self._rate = saved, source, rate
        self._saved = time.monotonic()
        self._progress: Progress | None = None
        self._unsaved = self._hook_told = False
        self._kept: float | None = None  # s, time of the snapshot whose rig went into the history last

    def __enter__(self) -> Watch:
        """Open the outputs.

        Raises:
            InputError: events.jsonl cannot be written.
        """
        self._log, self._files = EventLog(self.folder / EVENTS), RigFiles(self.folder)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Save what is known, and close the outputs."""
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
        """What could not be written the last time that it was tried, by output, and why."""
        return {output: why for output, why in self._files.problems.items() if output != FRAMES}

    def run(self, intake: SourceReader, stopped: threading.Event, looked: Callable[[], None] = lambda: None) -> None:
        """Work on what comes until it ends, or until told to stop.

        Args:
            intake: gives snapshots.
            stopped: may be set by anybody.
            looked: called after each snapshot, and ten times a second while none comes.

        Raises:
            InputError: the source cannot go on.
        """
        while not stopped.is_set():
            snapshot = intake.next(LOOKED_EVERY)
            if snapshot is None and intake.ended:
                return
            self._apply_commands()
            self._report_hook()
            self._report_poses()
            if snapshot is not None:
                self.process(snapshot)
            if time.monotonic() - self._saved >= SAVED_EVERY:
                self.save()
            looked()

    def process(self, snapshot: TimedSnapshot) -> RigState | None:
        """Work on one snapshot; None = it could not be used, or nothing is to be learnt now."""
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
        self._progress = Progress(snapshot.time, snapshot.name, source=self._source, rate=self._rate)
        self._unsaved = True
        for event in state.events:
            self.publish_event(event)
        for output in self._poses:
            output.publish(state)
        if self._page is not None:
            self._page.publish(state, snapshot.frames(names))
        return state

    def publish_event(self, event: Event) -> None:
        """Give an event to all who want to know."""
        self.tally.events[event.kind] += 1
        try:
            self._log.append(event)
        except OSError as error:
            self._fail(EVENTS, str(error))
        if self._hook is not None:
            self._hook.notify(event)
        if self.tally.latest is not None and event.kind in IN_HISTORY:
            self._keep(self.tally.latest)
        if self._page is not None and (self.tally.latest is None or event not in self.tally.latest.events):
            self._page.tell(event)  # the others come with their state
        self._told(event)

    def save(self) -> None:
        """Write what is known: what a start after this moment goes on from."""
        self._saved = time.monotonic()
        state = self.tally.latest
        unsaved = self._unsaved or bool(self._files.problems)
        if state is None or self._progress is None or not unsaved:
            return
        self._report_problems()
        progress = replace(self._progress, logged=self._log.size)
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
        """Say once that the command fails; how often, the display and the metrics say."""
        problem = None if self._hook is None or self._hook_told else self._hook.problem
        if problem is not None:
            self._hook_told = True
            self._problem(problem)

    def _report_poses(self) -> None:
        """Say once of each output of poses that it fails."""
        for output in self._poses:
            if output.problem is not None and not self.tally.problems[output.name]:
                self._fail(output.name, output.problem)

    def _fail(self, output: str, message: str) -> None:
        self.tally.problems[output] += 1
        if self.tally.problems[output] == 1:
            self._problem(message)

    def _apply_commands(self) -> None:
        """Do what people have asked for."""
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
