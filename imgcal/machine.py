"""Resources of the machine that this process may use."""

import contextlib
import gc
import os
from collections.abc import Iterator
from functools import cache


def usable_cores() -> int:
    """Count the cores that this process may use; all cores on systems that do not report this (macOS, Windows).

    Examples:
        >>> usable_cores() >= 1
        True
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Pause the garbage collector during imports, and exempt what they load from later collections.

    The modules of a command stay until it ends, and looking for garbage among them takes a fifth of the time that it
    takes to import them. A process exempts once: a later exemption would keep garbage of the meantime for good.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        _exempt_once()
        if enabled:
            gc.enable()


@cache
def _exempt_once() -> None:
    """Exempt what there is from garbage collection, unless that has been done already, as the tests do."""
    if not gc.get_freeze_count():  # goes through all that is exempt, which takes a while
        gc.freeze()
