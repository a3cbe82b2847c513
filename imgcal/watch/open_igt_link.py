"""Poses for 3D Slicer, PLUS and other OpenIGTLink clients: a server that sends TRANSFORM and STATUS.

Source: the OpenIGTLink protocol, version 1 of its header: http://openigtlink.org/developers/spec
"""

from __future__ import annotations

import contextlib
import math
import re
import socket
import struct
import time
from dataclasses import dataclass, field

from imgcal.errors import InputError
from imgcal.messages import shorten
from imgcal.watch.poses import PoseRecord, PoseSink, PoseStatus

PORT = 18944
"""Usual port of OpenIGTLink."""
VERSION = 1
HEADER = struct.Struct(">H12s20sQQQ")  # version, type, device, time, body size in bytes, checksum
TRANSFORM = struct.Struct(">12f")  # columns of the rotation, translation
STATUS = struct.Struct(">Hq20s")  # code, subcode, name; followed by a zero-terminated text
CODES: dict[PoseStatus, int] = {"ok": 1, "degraded": 13, "no_object": 16}
"""STATUS codes: OK, device not ready, device not present."""
TRANSFORM_NAME, STATUS_NAME = "ObjectToRig", "Rig"
MOST_CLIENTS = 16
MOST_PENDING = 2**16
"""Maximum number of bytes that wait for a client; it misses poses until it has read them."""
STALLED = 10.0
"""Time (s) after which a client that does not read is disconnected."""
STATUS_EVERY = 1.0  # s
SILENT_SECONDS, SILENT_INTERVALS = 2.0, 3.0
"""Time without a snapshot, in seconds and in multiples of the last interval, from which STATUS says so."""
POLYNOMIAL, WHOLE = 0x42F0E1EBA9EA3693, 2**64 - 1


def _remainder(byte: int) -> int:
    value = byte << 56
    for _ in range(8):
        value = (value << 1 & WHOLE) ^ (POLYNOMIAL if value >> 63 else 0)
    return value


_REMAINDERS = tuple(map(_remainder, range(256)))


def checksum(body: bytes) -> int:
    """CRC-64 (ECMA-182) of a message's body.

    Examples:
        >>> hex(checksum(b"123456789"))
        '0x6c40df5f0b497347'
    """
    value = 0
    for byte in body:
        value = (value << 8 & WHOLE) ^ _REMAINDERS[value >> 56 ^ byte]
    return value


def message(kind: str, device: str, seconds: float, body: bytes) -> bytes:
    """Assemble a message; `seconds` since 1970."""
    stamp = int(seconds) << 32 | int(seconds % 1 * 2**32)
    header = HEADER.pack(VERSION, kind.encode(), device.encode("ascii", "replace"), stamp, len(body), checksum(body))
    return header + body


def transform_message(record: PoseRecord) -> bytes:
    """A record's pose as object to rig, mm; the record must have one."""
    assert record.pose is not None
    matrix = record.pose.matrix()
    body = TRANSFORM.pack(*matrix[:3, :3].T.flatten(), *matrix[:3, 3])
    return message("TRANSFORM", TRANSFORM_NAME, record.time, body)


def status_message(record: PoseRecord) -> bytes:
    """The state of the rig: a code, the number of uncalibrated cameras, and a sentence with the accuracy."""
    text = f"{record.message}; {record.accuracy()}"
    body = STATUS.pack(CODES[record.status], record.not_ok, record.status.encode())
    return message("STATUS", STATUS_NAME, record.time, body + text.encode("ascii", "replace") + b"\0")


def listening_address(text: str) -> tuple[str, int]:
    """Parse `igtl://[HOST][:PORT]` or `igtl://PORT`; the default host is this machine only.

    Raises:
        InputError: any other format.

    Examples:
        >>> listening_address("igtl://"), listening_address("igtl://0.0.0.0:9000"), listening_address("igtl://9000")
        (('127.0.0.1', 18944), ('0.0.0.0', 9000), ('127.0.0.1', 9000))
    """
    found = re.fullmatch(r"igtl://(?:(?P<only>\d{1,5})|(?P<host>[^\s:/]*)(?::(?P<port>\d{1,5}))?)/?", text)
    port = int((found["only"] or found["port"] or PORT) if found else -1)
    if found is None or not 0 <= port < 2**16:
        raise InputError(f"{shorten(text)}: expected igtl://[HOST:]PORT, such as igtl://127.0.0.1:{PORT}")
    return found["host"] or "127.0.0.1", port


@dataclass
class _Client:
    connection: socket.socket
    pending: bytearray = field(default_factory=bytearray)
    moved: float = field(default_factory=time.monotonic)  # s, time of its last read


class OpenIGTLink(PoseSink):
    """Serves any number of clients without blocking; a client that does not read misses poses, then is disconnected."""

    def __init__(self, host: str = "127.0.0.1", port: int = PORT, stalled: float = STALLED) -> None:
        """Listen; port 0 takes any free one.

        Raises:
            InputError: the address is in use, or not one of this machine's.
        """
        self._stalled, self._clients = stalled, list[_Client]()
        self._said: tuple[PoseStatus, float] | None = None  # last status, and its time in s
        self._last: PoseRecord | None = None
        self._came, self._interval = -math.inf, 0.0  # s, when the last snapshot came, and after how long
        self._listening = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
        try:
            self._listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listening.bind((host, port))
            self._listening.listen(MOST_CLIENTS)
        except OSError as error:
            self._listening.close()
            expected = "expected an address of this machine that is free"
            raise InputError(f"igtl://{host}:{port}: {error.strerror or error}, {expected}") from error
        self._listening.setblocking(False)
        self.port = int(self._listening.getsockname()[1])

    def send(self, record: PoseRecord) -> None:
        """See `PoseSink`: send STATUS when it changes, to new clients, and if the last one is a second old."""
        now = time.monotonic()
        self._interval = 0.0 if self._last is None else now - self._came
        self._last, self._came = record, now
        self._serve(record, b"" if record.pose is None else transform_message(record), now)

    def idle(self) -> None:
        """See `PoseSink`: go on with STATUS."""
        now = time.monotonic()
        self._serve(self._record(now), b"", now)

    def _record(self, now: float) -> PoseRecord:
        """What is known at a time (s, monotonic): the last record, or that no snapshot comes."""
        if self._last is None:
            return PoseRecord(time.time(), 0, None, "no_object", "no snapshot has come yet")
        silent = now - self._came
        if silent <= max(SILENT_SECONDS, SILENT_INTERVALS * self._interval):
            return self._last
        message = f"no snapshot has come for {silent:.0f} s"
        return PoseRecord(self._last.time + silent, self._last.snapshot, None, "no_object", message)

    def _serve(self, record: PoseRecord, transform: bytes, now: float) -> None:
        """Send every client a transform, with STATUS where it is due."""
        came = self._accept()
        due = self._said is None or self._said[0] != record.status or now - self._said[1] >= STATUS_EVERY
        if due:
            self._said = record.status, now
        status = status_message(record)
        for client in tuple(self._clients):
            self._give(client, (status if due or client in came else b"") + transform, now)

    def close(self) -> None:
        """See `PoseSink`."""
        for client in self._clients:
            client.connection.close()
        self._clients.clear()
        self._listening.close()

    def _accept(self) -> list[_Client]:
        came = []
        with contextlib.suppress(OSError):  # no pending connection
            while True:
                connection, _ = self._listening.accept()
                if len(self._clients) >= MOST_CLIENTS:
                    connection.close()
                    continue
                connection.setblocking(False)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MOST_PENDING)  # an old pose is useless
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                came.append(_Client(connection))
                self._clients.append(came[-1])
        return came

    def _give(self, client: _Client, data: bytes, now: float) -> None:
        """Send a client what it accepts now; the rest waits unless there is too much."""
        if len(client.pending) + len(data) <= MOST_PENDING:
            client.pending += data
        try:
            if self._has_left(client):
                raise ConnectionResetError
            with contextlib.suppress(BlockingIOError):
                sent = client.connection.send(client.pending)
                del client.pending[:sent]
                client.moved = now
            if client.pending and now - client.moved > self._stalled:
                raise TimeoutError
        except OSError:
            client.connection.close()
            self._clients.remove(client)

    @staticmethod
    def _has_left(client: _Client) -> bool:
        """Skip what a client sends: no requests are supported."""
        with contextlib.suppress(BlockingIOError):
            while data := client.connection.recv(MOST_PENDING):
                if len(data) < MOST_PENDING:
                    return False
            return True
        return False
