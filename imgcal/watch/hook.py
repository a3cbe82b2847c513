"""A command of the user that is run for each event, beside the loop and never in its way."""

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
"""Events that wait for the command; more, and the oldest is dropped."""
TIMEOUT = 10.0
"""Seconds after which the command, and what it has started, is killed."""


class Hook:
    """Runs a command for each event, one after the other.

    The event is its standard input, one line of JSON; `IMGCAL_EVENT` (what happened) and `IMGCAL_CAMERA` are in its
    environment. No shell takes part: nothing in an event can become a command.
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
        """Events that were dropped; runs that ended with an error, or not in time."""
        self.problem: str | None = None
        """What went wrong the last time; None = nothing did."""
        self._timeout = timeout
        self._events: deque[Event] = deque()
        self._changed = threading.Condition()
        self._closing, self._ends = False, float("inf")  # when the last one must have ended, s
        self._thread = threading.Thread(target=self._work, name="hook", daemon=True)
        self._thread.start()

    def notify(self, event: Event) -> None:
        """Let the command be run; returns at once."""
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
        """Let the commands be run that wait, as far as one timeout suffices; the others are dropped."""
        with self._changed:
            self._closing, self._ends = True, time.monotonic() + self._timeout
            self._changed.notify()
        self._thread.join(self._timeout + 1)
        with self._changed:
            while self._events:
                self._drop("the command was not done with them in time")

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._events or self._closing)
                if not self._events or time.monotonic() >= self._ends:
                    return
                event = self._events.popleft()
            try:
                self._run(event)
            except Exception as error:  # whatever one event holds, the next ones are told
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
                else:  # Windows: what it has started goes on
                    process.kill()
            process.communicate()
            self._fail(f"was killed after {timeout:.3g} s")
            return
        finally:
            if process.stdin is not None:  # still open where there was no time to write
                with contextlib.suppress(OSError):
                    process.stdin.close()
        if process.returncode:
            self._fail(f"ended with exit code {process.returncode}")

    def _fail(self, how: str) -> None:
        self.failed += 1
        self.problem = f"--hook: {shorten(shlex.join(self.command))} {how}"
