"""What `imgcal watch` shows: a line that changes in a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.text import Text

from imgcal.messages import list_names, one_line, plural
from imgcal.online import Event
from imgcal.watch import Hook, SourceReader, Tally

SAID_EVERY = 10.0  # s between two lines without a terminal
DRAWN_EVERY = 0.25  # s
SHOWN = ("late", "duplicate", "clock_off", "out_of_tolerance")
"""Problems of exposures that are counted in the line; missing ones show as lost cameras."""
CLOCK_SIGMAS = 5.0
LEAST_OFFSET = 5e-4  # s: smaller ones are the exposure's length


class Output(Console):
    """A console that tells when its reader is gone, instead of ending the program with exit code 1."""

    def on_broken_pipe(self) -> None:
        """Raise it again."""
        raise BrokenPipeError


class Display:
    """Shows the progress; with `rich` in a terminal."""

    def __init__(self, console: Console, intake: SourceReader, hook: Hook | None = None) -> None:
        """Prepare; nothing is shown before `show_tally`."""
        self._console, self._intake, self._hook, self._tally = console, intake, hook, Tally()
        self._live: Live | None = None
        self._drawn = self._said = -SAID_EVERY
        self._snapshots = 0
        self._rate = 0.0

    @contextlib.contextmanager
    def show_tally(self, tally: Tally) -> Iterator[None]:
        """Show what this tally says while the block runs."""
        self._tally = tally
        self._drawn = self._said = time.monotonic()
        if not self._console.is_terminal:
            yield
            return
        with Live(Text("waiting for the first snapshot"), console=self._console, auto_refresh=False) as self._live:
            yield
            self._live.update(Text(self.line()), refresh=True)
        self._live = None

    def show_event(self, event: Event) -> None:
        """Show an event."""
        at = datetime.fromtimestamp(event.time).strftime("%H:%M:%S")
        self._print(f"{at} {event.kind.replace('_', ' ')}: {event.message}")

    def warn(self, message: str) -> None:
        """Show what could not be done."""
        self._print(f"note: {one_line(message)}")

    def draw(self) -> None:
        """Show how it goes, now and then."""
        now = time.monotonic()
        every = DRAWN_EVERY if self._live is not None else SAID_EVERY
        if now - self._drawn < every:
            return
        self._rate = (self._tally.snapshots - self._snapshots) / (now - self._drawn)
        self._drawn, self._snapshots = now, self._tally.snapshots
        if self._live is not None:
            self._live.update(Text(self.line(), no_wrap=True, overflow="ellipsis"), refresh=True)
        else:
            self._print(self.line())

    def line(self) -> str:
        """Say in one line how it goes."""
        tally, state = self._tally, self._tally.latest
        parts = [self._describe_waiting() if state is None else state.sentence]
        if state is not None and state.refused is not None:
            parts.append("not learning now")
        parts.append(f"{plural(tally.snapshots, 'snapshot')}, {self._rate:.3g}/s")
        watches = (self._clocks(), self._shaking(), self._unsynchronized(), self._stamps())
        return " | ".join([*parts, *self._counts(), *(said for watch in watches for said in watch)])

    def result(self, rig: Path) -> str:
        """Say in one line what came of it, and what did not: `rig` is the file."""
        tally, reasons = self._tally, self._intake.reasons
        said = f"{plural(tally.snapshots, 'snapshot')}, {plural(sum(tally.events.values()), 'event')}: {rig}"
        latest = [f"latest unreadable input: {reasons[-1]}"] if reasons else []
        return " | ".join([said, *self._counts(), *self._stamps(), *latest])

    def _counts(self) -> list[str]:
        """Name what did not go as it should, with its number."""
        tally, intake = self._tally, self._intake
        counts = {"refused": tally.refused, "dropped": intake.dropped, "unreadable": intake.unreadable.total()}
        counts |= {kind: intake.synchronizer.counts[kind].total() for kind in SHOWN}
        counts |= {"jumps of all clocks": intake.synchronizer.leaps}
        counts["events not written"] = tally.unwritten
        if self._hook is not None:
            counts |= {"hooks failed": self._hook.failed, "events without a hook": self._hook.dropped}
        return [f"{count:,} {kind}" for kind, count in counts.items() if count]

    def _describe_waiting(self) -> str:
        """Say that nothing has come, and what did not look like anything that could."""
        reasons = self._intake.reasons
        return "waiting for the first snapshot" + (f": {reasons[-1]}" if reasons else "")

    def _unsynchronized(self) -> list[str]:
        """Name the cameras whose time stamps go with no other's."""
        synchronizer = self._intake.synchronizer
        names = synchronizer.alone
        if not names:
            return []
        tolerance = 1e3 * min(map(synchronizer.tolerance, names))
        said = f"time stamps more than {tolerance:.3g} ms (--tolerance) off the other cameras': set their clocks"
        return [f"{list_names(names)}: {said}"]

    def _stamps(self) -> list[str]:
        """Say what is wrong with all time stamps."""
        advice = self._intake.synchronizer.advice
        return [advice] if advice else []

    def _clocks(self) -> list[str]:
        """Name the cameras whose time stamps do not say when they expose."""
        state = self._tally.latest
        if state is None:
            return []
        found = []
        for name, offset, sigma in zip(
            state.factory.camera_names, state.clock_offset.tolist(), state.clock_offset_sigma.tolist(), strict=True
        ):
            if abs(offset) > max(CLOCK_SIGMAS * sigma, LEAST_OFFSET):
                stamped = self._tally.stamps.get(name, 0.0)
                found.append(f"{name} exposes {1e3 * (offset - stamped):+.1f} ms off its time stamps")
        return found

    def _shaking(self) -> list[str]:
        """Name the cameras that shake."""
        state = self._tally.latest
        if state is None:
            return []
        names = zip(state.factory.camera_names, state.shake.tolist(), strict=True)
        return [f"{name} shakes by {size:.2g} px" for name, size in names if size > 0]

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)
