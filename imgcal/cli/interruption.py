"""Ctrl-C during imports, and SIGTERM beside worker processes; this module is light, so that it is loaded first."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType


@contextlib.contextmanager
def end_at_once() -> Iterator[None]:
    """End the process with one line at Ctrl-C: within an import, KeyboardInterrupt can surface as anything."""
    # In the background of a shell, Ctrl-C is not for us; and other programs may have handlers of their own.
    ours = threading.current_thread() is threading.main_thread()
    if not (ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler):
        yield
        return
    signal.signal(signal.SIGINT, _end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextlib.contextmanager
def unwind_at_termination() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt, so that worker processes are ended and the command says one line."""
    ours = threading.current_thread() is threading.main_thread()
    if not (ours and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL):  # other programs may have their handlers
        yield
        return
    signal.signal(signal.SIGTERM, _unwind)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _unwind(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt("terminated")


def _end(number: int, frame: FrameType | None) -> None:
    os.write(2, b"imgcal: interrupted\n")
    os._exit(130)
