"""Blobs through the Lab Streaming Layer (LSL), which takes care of clocks: a line of JSON in a channel of text."""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from imgcal.errors import InputError
from imgcal.io import read_json
from imgcal.messages import shorten
from imgcal.watch.exposures import Item, Unreadable
from imgcal.watch.wire import LONGEST_LINE, exposure_from_json

TICK = 0.05  # s
LOOK_EVERY = 1.0  # s, between two looks for new streams
BUFFERED = 30  # s of samples that LSL keeps
LONGEST_WAIT = 10.0  # s, for the sender's clock
NAME = re.compile(r"lsl://([^\s/'\"]{1,200})/?")


@dataclass(frozen=True)
class LabStreaming:
    """Reads every stream of a name; a sample is the blobs of one camera at one moment, as in `exposure_from_json`.

    Where a sample has no `time`, it is that of its LSL stamp, by the clock of this machine: LSL measures how far the
    sender's is off. Streams need not be there yet, and may go and come back.
    """

    address: str  # lsl://NAME
    live: bool = True

    def items(self) -> Iterator[Item]:
        """Receive until the reader stops asking.

        Raises:
            InputError: the address is none.
        """
        found = NAME.fullmatch(self.address)
        if found is None:
            raise InputError(f"{shorten(self.address)}: expected lsl://NAME, the name of one or more streams")
        try:
            import pylsl  # not in the core
        except (OSError, RuntimeError) as error:  # its wheels for some machines bring no library along
            raise InputError(f"{self.address}: pylsl finds no liblsl, which has to be installed: {error}") from error
        resolver = pylsl.ContinuousResolver(prop="name", value=found[1])
        streams: dict[str, _Stream | None] = {}  # by LSL's own number of a stream; None = of no use
        looked = float("-inf")
        while True:
            if time.monotonic() - looked >= LOOK_EVERY:
                looked = time.monotonic()
                yield from _open_new(resolver.results(), streams, pylsl)
            came = False
            for stream in filter(None, streams.values()):
                if not stream.is_ready(pylsl):
                    continue
                sample, stamp = stream.inlet.pull_sample(timeout=0.0)
                if sample is not None:
                    came = True
                    yield _item(sample[0], stamp, stream.inlet, pylsl)
            if not came:
                time.sleep(TICK / 10)
                yield None


@dataclass
class _Stream:
    """An open stream. LSL keeps its samples until the sender's clock is known."""

    inlet: Any
    opened: float  # s
    ready: bool = False

    def is_ready(self, library: Any) -> bool:
        """Tell whether its samples can be read: the clock is known, or will not be."""
        if not self.ready:
            with contextlib.suppress(*_failures(library)):
                self.inlet.time_correction(timeout=TICK)
                self.ready = True
            self.ready = self.ready or time.monotonic() - self.opened > LONGEST_WAIT
        return self.ready


def _open_new(found: list[Any], streams: dict[str, _Stream | None], library: Any) -> Iterator[Item]:
    """Open what is new: streams of one text channel."""
    for one in found:
        if one.uid() in streams:
            continue
        if (one.channel_format(), one.channel_count()) != (library.cf_string, 1):
            streams[one.uid()] = None
            kind = f"{one.channel_count()} channels of type {one.channel_format()}"
            yield Unreadable(f"stream {shorten(one.name())}: found {kind}, expected one of text")
            continue
        inlet = library.StreamInlet(one, max_buflen=BUFFERED, recover=True)
        with contextlib.suppress(*_failures(library)):
            inlet.open_stream(timeout=TICK)  # goes on by itself
        streams[one.uid()] = _Stream(inlet, time.monotonic())


def _failures(library: Any) -> tuple[type[Exception], ...]:
    """What LSL raises where the other side does not answer."""
    return library.util.TimeoutError, library.util.LostError, RuntimeError


def _item(text: str, stamp: float, inlet: Any, library: Any) -> Item:
    """Blobs, or why they are none."""
    try:
        if len(text) > LONGEST_LINE:
            raise InputError(f"found {len(text):,} characters, expected a line of JSON")
        if '"time"' not in text:
            text = _add_time(text, stamp, inlet, library)
        return exposure_from_json(text)
    except InputError as error:
        return Unreadable(str(error))


def _add_time(text: str, stamp: float, inlet: Any, library: Any) -> str:
    """Give a line the time of its stamp, in seconds since 1970."""
    try:
        entry = read_json(text)
        offset = inlet.time_correction(timeout=TICK)
    except ValueError as error:
        raise InputError(f"found {shorten(repr(text))}, expected a line of JSON: {error}") from error
    except _failures(library) as error:
        raise InputError("found no time in the blobs, and the sender's clock is not known yet") from error
    if not isinstance(entry, dict):
        raise InputError(f"found {shorten(repr(text))}, expected a line of JSON")
    return json.dumps({**entry, "time": stamp + offset + time.time() - library.local_clock()})
