"""Telling that the first run of a command on a machine waits for its functions to be compiled."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator

HINT = "compiling for this machine, once after installation; `imgcal warmup` does it ahead of time"


@contextlib.contextmanager
def tells_of_compiling(hint: str = HINT) -> Iterator[list[object]]:
    """Say so on standard error when the first function is compiled.

    Yields:
        A list that gets an entry for each function that is compiled.
    """
    compiled: list[object] = []
    if "numba" not in sys.modules:  # nothing that this command does is compiled
        yield compiled
        return
    from numba.core import event

    class Told(event.Listener):
        def on_start(self, happening: event.Event) -> None:
            if not compiled:
                print(f"imgcal: {hint}", file=sys.stderr, flush=True)
            compiled.append(happening.data)

        def on_end(self, happening: event.Event) -> None:
            pass

    listener = Told()
    event.register("numba:compile", listener)
    try:
        yield compiled
    finally:
        event.unregister("numba:compile", listener)
