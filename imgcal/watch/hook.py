"""A user's command that runs for each event, beside the loop and without blocking it."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import signal
import subprocess
import threading
import time
from collections import deque

from imgcal.errors import InputError
from imgcal.messages import shorten
from imgcal.online import Event

MOST_WAITING = 100
"""Maximum number of events that wait for the command; the oldest is dropped beyond that."""
TIMEOUT = 10.0
"""Time (s) after which the command and its child processes are killed."""


class Hook:
    """Runs a command for each event, one at a time.

    The event is its standard input, one line of JSON; `IMGCAL_EVENT` (the kind of event) and `IMGCAL_CAMERA` are in its
    environment. No shell is involved, so nothing in an event can become a command.
    """

    def __init__(self, command: str, timeout: float = TIMEOUT) -> None:
        """Find the program.

        Args:
            command: program and arguments, quoted as for a shell.
            timeout: s.

        Raises:
            InputError: there is no such program.
        """
        try:
            self.command = shlex.split(command)
        except ValueError as error:
            raise InputError(f"--hook: found {shorten(command)!r}, expected a command: {error}") from error
        if not self.command or shutil.which(self.command[0]) is None:
            raise InputError(f"--hook: found {shorten(command)!r}, expected a program that can be run")
        self.dropped = self.failed = 0
        """Number of dropped events; number of runs that failed or timed out."""
        self.problem: str | None = None
        """The last problem; None = no problem."""
        self._timeout = timeout
        self._events: deque[Event] = deque()
        self._changed = threading.Condition()
        self._closing, self._ends = False, float("inf")  # s, deadline of the last run
        self._thread = threading.Thread(target=self._work, name="hook", daemon=True)
        self._thread.start()

    def notify(self, event: Event) -> None:
        """Queue the command for an event; returns at once."""
        with self._changed:
            self._events.append(event)
            if len(self._events) > MOST_WAITING:
                self._drop(f"more than {MOST_WAITING} events waited for the command")
            self._changed.notify()

    def _drop(self, why: str) -> None:
        self._events.popleft()
        self.dropped += 1
        self.problem = f"--hook: events were dropped: {why}"

    def close(self) -> None:
        """Run the waiting commands within one timeout in total; drop the others."""
        with self._changed:
            self._closing, self._ends = True, time.monotonic() + self._timeout
            self._changed.notify()
        self._thread.join(self._timeout + 1)
        with self._changed:
            while self._events:
                self._drop("the command did not finish in time")

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._events or self._closing)
                if not self._events or time.monotonic() >= self._ends:
                    return
                event = self._events.popleft()
            try:
                self._run(event)
            except Exception as error:  # a bad event must not stop the next ones
                self._fail(f"could not be run: {error}")

    def _run(self, event: Event) -> None:
        line = event.to_json().encode(errors="replace") + b"\n"
        environment = os.environ | {"IMGCAL_EVENT": event.kind, "IMGCAL_CAMERA": event.camera or ""}
        process = subprocess.Popen(
            self.command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env=environment, start_new_session=True,
        )  # fmt: skip
        timeout = min(self._timeout, max(self._ends - time.monotonic(), 0.0))
        try:
            process.communicate(line, timeout)
        except subprocess.TimeoutExpired:
            with contextlib.suppress(ProcessLookupError):
                if hasattr(os, "killpg"):
                    os.killpg(process.pid, signal.SIGKILL)
                else:  # Windows: child processes survive
                    process.kill()
            process.communicate()
            self._fail(f"was killed after {timeout:.3g} s")
            return
        finally:
            if process.stdin is not None:  # still open if there was no time to write
                with contextlib.suppress(OSError):
                    process.stdin.close()
        if process.returncode:
            self._fail(f"ended with exit code {process.returncode}")

    def _fail(self, how: str) -> None:
        self.failed += 1
        self.problem = f"--hook: {shorten(shlex.join(self.command))} {how}"
