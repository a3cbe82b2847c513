"""Notice and speed up compilation: the first run of a command on a machine compiles its functions."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import imgcal
from imgcal.machine import usable_cores

HINT = "compiling for this machine: 10 to 60 s, once; `imgcal warmup` compiles everything ahead of time"
WAIT = "waiting for another process that compiles for this machine"
HELP = """
import os, sys, threading
threading.Thread(target=lambda: (sys.stdin.read(), os._exit(1)), daemon=True).start()  # ends with its parent
from imgcal.detection.warmup import warm_up_detection
warm_up_detection()
from imgcal.machine import without_garbage_collection
with without_garbage_collection():
    from imgcal.online import warm_up_fits
warm_up_fits()
"""
NEEDED_LAST = "levenberg_marquardt_cpu.*"  # files of the cache that show that there is nothing to help with
_helpers: list[subprocess.Popen[bytes]] = []  # running processes that compile for this one


@contextlib.contextmanager
def announce_compilation(hint: str = HINT) -> Iterator[list[object]]:
    """Print one notice on standard error when the first function is compiled, here or in another process.

    Args:
        hint: what to say.

    Yields:
        A list that gets an entry for each function that is compiled.
    """
    compiled: list[object] = []
    if "numba" not in sys.modules:  # nothing that this command does is compiled
        yield compiled
        return
    from numba.core import event

    from renderers.compiling import WAITING

    said: list[str] = []

    def say(notice: str) -> None:
        if not said:
            print(f"imgcal: {notice}", file=sys.stderr, flush=True)
        said.append(notice)

    class Told(event.Listener):
        def on_start(self, happening: event.Event) -> None:
            say(hint)
            compiled.append(happening.data)

        def on_end(self, happening: event.Event) -> None:
            pass

    class Waiting(event.Listener):
        def on_start(self, happening: event.Event) -> None:
            say(hint if _helpers else WAIT)

        def on_end(self, happening: event.Event) -> None:
            pass

    listeners = {"numba:compile": Told(), WAITING: Waiting()}
    for kind, listener in listeners.items():
        event.register(kind, listener)
    try:
        yield compiled
    finally:
        for kind, listener in listeners.items():
            event.unregister(kind, listener)


@contextlib.contextmanager
def help_to_compile() -> Iterator[None]:
    """Compile in a second process, while this one imports modules and interprets what is not compiled yet.

    The second process ends with the context; the next command goes on where it has stopped.
    """
    helper = None
    if is_useful():
        with contextlib.suppress(OSError):  # alone, then: everything is compiled before it is called
            helper = start_helper()
    if helper is None:
        yield
        return
    from renderers.interpreting import interpret_first

    _helpers.append(helper)
    try:
        with interpret_first():
            yield
    finally:
        _helpers.remove(helper)
        with helper:
            helper.terminate()


def is_useful() -> bool:
    """Tell whether a second process can compile beside this one, and leave it where this one finds it."""
    if not sys.executable or usable_cores() - _load() <= 1:
        return False
    from renderers.compiling import cache_folder, is_shared

    return is_shared() and not any(Path(cache_folder()).rglob(NEEDED_LAST))


def _load() -> float:
    """Processes that wanted a core within the last minute: one that is busy gains nothing from another process."""
    try:
        return os.getloadavg()[0]
    except (AttributeError, OSError):  # not known on this system
        return 0.0


def start_helper() -> subprocess.Popen[bytes]:
    """Compile the fits in a second process, which has this package and says nothing."""
    # Not from the current folder, which anybody may have filled.
    path = os.pathsep.join(filter(None, (str(Path(imgcal.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    command, nothing = [sys.executable, "-P", "-c", HELP], subprocess.DEVNULL
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=nothing, stderr=nothing, env=environment)
