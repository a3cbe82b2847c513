"""Ctrl-C during imports, and SIGTERM beside worker processes; this module is light, so that it is loaded first."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

Handler = Callable[[int, FrameType | None], object] | signal.Handlers


@contextlib.contextmanager
def end_at_once() -> Iterator[None]:
    """End the process with one line at Ctrl-C: within an import, KeyboardInterrupt can surface as anything."""
    with _handler(signal.SIGINT, signal.default_int_handler, _end):  # in a shell's background, Ctrl-C is not for us
        yield


@contextlib.contextmanager
def unwind_at_termination() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt, so that worker processes are ended and the command says one line."""
    with _handler(signal.SIGTERM, signal.SIG_DFL, _unwind):
        yield


@contextlib.contextmanager
def _handler(number: signal.Signals, usual: Handler, ours: Handler) -> Iterator[None]:
    """Handle a signal in the main thread, unless another program has a handler of its own."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(number) is not usual:
        yield
        return
    signal.signal(number, ours)
    try:
        yield
    finally:
        signal.signal(number, usual)


def _unwind(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt("terminated")


def _end(number: int, frame: FrameType | None) -> None:
    os.write(2, b"imgcal: interrupted\n")
    os._exit(130)
