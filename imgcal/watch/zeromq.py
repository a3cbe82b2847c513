"""Blobs or frames from another process through ZeroMQ, which never blocks the sender."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from imgcal.errors import InputError
from imgcal.messages import shorten
from imgcal.types import MOST_PIXELS
from imgcal.watch.exposures import Exposure, Item, Unreadable
from imgcal.watch.wire import LONGEST_LINE, exposure_from_json, exposure_from_pixels

if TYPE_CHECKING:
    import zmq

TICK = 50  # ms
QUEUED = 1000  # messages that ZeroMQ buffers: a few moments of frames of all cameras
ADDRESS = re.compile(r"tcp://[^\s/]+:(\d{1,5})|ipc://\S+")


@dataclass(frozen=True)
class ZeroMQ:
    """Subscribes to one or several publishers: one message per camera and moment.

    A message has one part, blobs (`exposure_from_json`), or two: a header and pixels (`exposure_from_pixels`). A
    publisher may start later, and may disappear and return.
    """

    addresses: tuple[str, ...]  # tcp://host:port or ipc://path
    largest: int = 2 * MOST_PIXELS + LONGEST_LINE  # bytes of a message
    queued: int = QUEUED  # messages
    silence: float = 5.0  # s without data after which the connection is renewed
    live: bool = True

    def items(self) -> Iterator[Item]:
        """Receive until the caller stops."""
        import zmq  # not in the core

        with zmq.Context() as context:
            while True:
                # ZeroMQ does not reconnect by itself after an oversized message.
                with context.socket(zmq.SUB) as socket:
                    self._connect(socket)
                    yield from self._receive(socket)

    def _receive(self, socket: zmq.Socket[bytes]) -> Iterator[Item]:
        """Receive until nothing has come for a while; time in which the caller is busy does not count."""
        heard = time.monotonic()
        while True:
            if not socket.poll(TICK):
                if time.monotonic() - heard >= self.silence:
                    return
                yield None
                continue
            parts = socket.recv_multipart(copy=False)
            try:
                yield _exposure([memoryview(part.buffer) for part in parts])
            except InputError as error:
                yield Unreadable(str(error))
            heard = time.monotonic()

    def _connect(self, socket: zmq.Socket[bytes]) -> None:
        import zmq

        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVHWM, self.queued)
        socket.setsockopt(zmq.MAXMSGSIZE, self.largest)
        socket.setsockopt(zmq.SUBSCRIBE, b"")
        for address in self.addresses:
            found = ADDRESS.fullmatch(address)
            if found is None or int(found[1] or 0) >= 2**16:  # ZeroMQ takes the port modulo 65536
                raise InputError(
                    f"{shorten(address)}: expected an address tcp://host:port (at most 65535) or ipc://path"
                )
            try:
                socket.connect(address)
            except zmq.ZMQError as error:
                raise InputError(f"{shorten(address)}: cannot connect: {error}") from error


def _exposure(parts: list[memoryview]) -> Exposure:
    if len(parts) == 1:
        return exposure_from_json(bytes(parts[0]))
    if len(parts) == 2:
        return exposure_from_pixels(bytes(parts[0]), parts[1])
    raise InputError(f"found a message of {len(parts)} parts, expected 1 (blobs) or 2 (header, pixels)")
