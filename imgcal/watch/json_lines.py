"""Blobs from another process through a pipe: one line of JSON per camera and moment."""

from __future__ import annotations

import os
import queue
import select
import stat
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass

from imgcal.errors import InputError
from imgcal.watch.exposures import Item, Unreadable
from imgcal.watch.wire import LONGEST_LINE, exposure_from_json

TICK = 0.05  # s
AT_ONCE = 2**16  # bytes


@dataclass(frozen=True)
class JsonLines:
    """Reads a file descriptor, such as 0 (standard input), to its end."""

    descriptor: int

    @property
    def live(self) -> bool:
        """A file waits; a process that writes into a pipe runs by itself."""
        return not stat.S_ISREG(os.fstat(self.descriptor).st_mode)

    def items(self) -> Iterator[Item]:
        """Read lines; a line that is too long is skipped in bounded memory."""
        parts: list[bytes] = []
        length = 0
        chunks = (_chunks_by_thread if sys.platform == "win32" else _chunks)(self.descriptor)
        while True:
            chunk = next(chunks)
            if chunk is None:
                yield None
                continue
            *lines, rest = chunk.split(b"\n")
            for line in lines:
                yield from _item(parts, line, length)
                parts, length = [], 0
            length += len(rest)
            if length <= LONGEST_LINE:
                parts.append(rest)
            if not chunk:
                yield from _item(parts, b"", length)
                return


def _chunks(descriptor: int) -> Iterator[bytes | None]:
    """Yield data as they come, and None while there are none; the last chunk is empty."""
    while True:
        ready, _, _ = select.select([descriptor], [], [], TICK)
        yield os.read(descriptor, AT_ONCE) if ready else None


def _chunks_by_thread(descriptor: int) -> Iterator[bytes | None]:
    """The same on Windows, where only sockets can be polled."""
    read: queue.Queue[bytes] = queue.Queue(1)

    def read_all() -> None:
        chunk = b"x"
        while chunk:
            chunk = os.read(descriptor, AT_ONCE)
            read.put(chunk)

    threading.Thread(target=read_all, daemon=True).start()
    while True:
        try:
            yield read.get(timeout=TICK)
        except queue.Empty:
            yield None


def _item(parts: list[bytes], last: bytes, length: int) -> Iterator[Item]:
    if length + len(last) > LONGEST_LINE:
        yield Unreadable(f"found a line of {length + len(last):,} bytes, expected at most {LONGEST_LINE:,}")
        return
    line = b"".join((*parts, last)).strip()
    if not line:
        return
    try:
        yield exposure_from_json(line)
    except InputError as error:
        yield Unreadable(str(error))
