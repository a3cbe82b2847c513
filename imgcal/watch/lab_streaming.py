"""Blobs through the Lab Streaming Layer (LSL), which synchronizes clocks: lines of JSON in a text channel."""

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
LOOK_EVERY = 1.0  # s between two searches for new streams
BUFFERED = 30  # s of samples buffered by LSL
FORGET_AFTER = 15.0  # s without an answer to a search after which a stream is gone
LONGEST_WAIT = 10.0  # s to wait for the sender's clock
NAME = re.compile(r"lsl://([^\s/'\"]{1,200})/?")


@dataclass(frozen=True)
class LabStreaming:
    """Reads every stream of a name; a sample holds the blobs of a camera at one moment, as in `exposure_from_json`.

    A sample without `time` gets the time of its LSL stamp, by this machine's clock: LSL measures the offset of the
    sender's. Streams may start later, and may disappear and return.
    """

    address: str  # lsl://NAME
    live: bool = True

    def items(self) -> Iterator[Item]:
        """Receive until the caller stops.

        Raises:
            InputError: the address is invalid.
        """
        found = NAME.fullmatch(self.address)
        if found is None:
            raise InputError(f"{shorten(self.address)}: expected lsl://NAME, the name of one or more streams")
        try:
            import pylsl  # not in the core
        except (OSError, RuntimeError) as error:  # its wheels for some machines lack the library
            raise InputError(f"{self.address}: pylsl finds no liblsl, which has to be installed: {error}") from error
        resolver = pylsl.ContinuousResolver(prop="name", value=found[1], forget_after=FORGET_AFTER)
        streams: dict[str, _Stream | None] = {}  # by LSL's stream number; None = unusable
        looked = float("-inf")
        while True:
            if time.monotonic() - looked >= LOOK_EVERY:
                looked = time.monotonic()
                yield from _open_new(resolver.results(), streams, pylsl)
            came = False
            for number, stream in tuple(streams.items()):
                if stream is None or not stream.is_ready(pylsl):
                    continue
                try:
                    sample, stamp = stream.inlet.pull_sample(timeout=0.0)
                except pylsl.util.LostError:
                    del streams[number]  # opened again if it is found again
                    continue
                if sample is not None:
                    came = True
                    yield _item(sample[0], stamp, stream.inlet, pylsl)
            if not came:
                time.sleep(TICK / 10)
                yield None


@dataclass
class _Stream:
    """An open stream. Samples stay in LSL until the sender's clock is known."""

    inlet: Any
    opened: float  # s
    ready: bool = False

    def is_ready(self, library: Any) -> bool:
        """Tell whether to read samples: the clock is known, or the wait for it is over."""
        if not self.ready:
            try:
                self.inlet.time_correction(timeout=TICK)
                self.ready = True
            except _failures(library) as error:
                lost = isinstance(error, library.util.LostError)  # there is no clock to wait for
                self.ready = lost or time.monotonic() - self.opened > LONGEST_WAIT
        return self.ready


def _open_new(found: list[Any], streams: dict[str, _Stream | None], library: Any) -> Iterator[Item]:
    """Open new streams of one text channel, and forget those that are gone."""
    for gone in streams.keys() - {one.uid() for one in found}:
        del streams[gone]
    for one in found:
        if one.uid() in streams:
            continue
        if (one.channel_format(), one.channel_count()) != (library.cf_string, 1):
            streams[one.uid()] = None
            kind = f"{one.channel_count()} channels of type {one.channel_format()}"
            yield Unreadable(f"stream {shorten(one.name())}: found {kind}, expected one of text")
            continue
        inlet = library.StreamInlet(one, max_buflen=BUFFERED, recover=False)  # a restarted sender is a new stream
        with contextlib.suppress(*_failures(library)):
            inlet.open_stream(timeout=TICK)  # continues in the background
        streams[one.uid()] = _Stream(inlet, time.monotonic())


def _failures(library: Any) -> tuple[type[Exception], ...]:
    """The exceptions LSL raises if the other side does not answer."""
    return library.util.TimeoutError, library.util.LostError, RuntimeError


def _item(text: str, stamp: float, inlet: Any, library: Any) -> Item:
    """Blobs, or why they are unreadable."""
    try:
        if len(text) > LONGEST_LINE:
            raise InputError(f"found {len(text):,} characters, expected a line of JSON")
        if '"time"' not in text:
            text = _add_time(text, stamp, inlet, library)
        return exposure_from_json(text)
    except InputError as error:
        return Unreadable(str(error))


def _add_time(text: str, stamp: float, inlet: Any, library: Any) -> str:
    """Add the time of its stamp to a line, in seconds since 1970."""
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
