"""Silence decoders that print about a bad file: our error says it in one line."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator

_lock = threading.Lock()
_within = 0  # decodings that are under way, in any thread
_kept = -1  # standard error meanwhile


@contextlib.contextmanager
def silence_stderr() -> Iterator[None]:
    """Redirect file descriptor 2 to nowhere: libpng, libjpeg and FFmpeg write there regardless of settings."""
    global _within, _kept
    with _lock:
        if _within == 0:
            _kept = _lead_away()
        _within += 1
    try:
        yield
    finally:
        with _lock:
            _within -= 1
            if _within == 0 and _kept >= 0:
                os.dup2(_kept, 2)
                os.close(_kept)


def _lead_away() -> int:
    try:
        kept = os.dup(2)
    except OSError:  # a service without standard error
        return -1
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)
    return kept
