"""A command of the user that is run for each event, beside the loop and never in its way."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import signal
import subprocess
import threading
from collections import deque

from imgcal.errors import InputError
from imgcal.messages import shortened
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
            raise InputError(f"--hook: found {shortened(command)!r}, expected a command: {error}") from error
        if not self.command or shutil.which(self.command[0]) is None:
            raise InputError(f"--hook: found {shortened(command)!r}, expected a program that can be run")
        self.dropped = self.failed = 0
        """Events that were dropped; runs that ended with an error, or not in time."""
        self._timeout = timeout
        self._events: deque[Event] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="hook", daemon=True)
        self._thread.start()

    def tell(self, event: Event) -> None:
        """Let the command be run; returns at once."""
        with self._changed:
            self._events.append(event)
            if len(self._events) > MOST_WAITING:
                self._events.popleft()
                self.dropped += 1
            self._changed.notify()

    def close(self) -> None:
        """Let the commands be run that wait, as far as one timeout suffices."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(self._timeout + 1)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._events or self._closing)
                if not self._events:
                    return
                event = self._events.popleft()
            try:
                self._run(event)
            except Exception:  # whatever one event holds, the next ones are told
                self.failed += 1

    def _run(self, event: Event) -> None:
        line = event.to_json().encode(errors="replace") + b"\n"
        environment = os.environ | {"IMGCAL_EVENT": event.kind, "IMGCAL_CAMERA": event.camera or ""}
        process = subprocess.Popen(
            self.command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env=environment, start_new_session=True,
        )  # fmt: skip
        try:
            process.communicate(line, self._timeout)
        except subprocess.TimeoutExpired:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
        if process.returncode:
            self.failed += 1
