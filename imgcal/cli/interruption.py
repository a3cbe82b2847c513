"""Ctrl-C, SIGTERM, SIGHUP: during imports, beside worker processes, in a loop. Light, since it is loaded first."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

ENDING = (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))  # not on Windows
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


class Stopped(threading.Event):
    """Set by Ctrl-C, by SIGTERM, or by SIGHUP."""

    interrupted = False  # by Ctrl-C


@contextlib.contextmanager
def stop_at_signals() -> Iterator[Stopped]:
    """Let signals that end a program set an event, so that a loop ends cleanly; a second one does not wait.

    Yields:
        The event.
    """
    stopped = Stopped()

    def stop(number: int, frame: FrameType | None) -> None:
        if stopped.is_set():
            raise KeyboardInterrupt
        stopped.interrupted = number == signal.SIGINT
        stopped.set()

    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in ENDING:
            if signal.getsignal(number) != signal.SIG_IGN:  # in the background of a shell, Ctrl-C is not for us
                before[number] = signal.signal(number, stop)
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


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
