"""Markers of Qualisys cameras from a running QTM: the 2D component of its real-time protocol, over TCP.

Source: QTM Real-time Server Protocol Documentation, version 1.20: https://docs.qualisys.com/qtm-rt-protocol/
"""

from __future__ import annotations

import contextlib
import errno
import math
import re
import select
import socket
import struct
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.formats import Element, parse_xml
from imgcal.live_page import is_host
from imgcal.messages import list_names, one_line, shorten
from imgcal.types import CameraRig
from imgcal.watch.exposures import MOST_BLOBS, CameraBlobs, Exposure, Item, Unreadable

PORT = 22223
"""QTM's base port plus one: little-endian numbers."""
TICK = 0.05  # s
LARGEST = 2**24  # maximum bytes of a packet
AT_ONCE = 2**16  # bytes
VERSION = "1.20"
COMMANDS = (f"Version {VERSION}", "GetParameters General", "StreamFrames AllFrames 2D")
ERROR, COMMAND, XML, DATA = 0, 1, 2, 3
TWO_DIMENSIONAL = 7
HEADER, DATA_HEADER, COMPONENT, CAMERAS, CAMERA = map(struct.Struct, ("<II", "<qII", "<II", "<Ihh", "<iB"))
MARKER = np.dtype([("x", "<i4"), ("y", "<i4"), ("width", "<u2"), ("height", "<u2")])
UNITS = 64  # units per pixel if the image is a part of the sensor
LEAST_UNITS = 8.0  # the same if it is the whole sensor
BEFORE_NOW = 5.0
"""Seconds that time stamps may be off the clock after a new connection, or jump ahead of it; if they are off by more,
they have restarted."""
LEAST_STEP = 0.006
"""Minimum gap (s) between the last frame and one with restarted time stamps: they are not the same snapshot."""


class _Lost(Exception):
    """The connection is unusable."""


@dataclass(frozen=True)
class _Camera:
    """Converts a camera's markers to pixels of the rig."""

    name: str  # name in the rig
    unit: float  # units of its coordinates per pixel
    corner: tuple[float, float]  # pixels, position of the image on the sensor


@dataclass
class _Clock:
    """Converts time stamps with an arbitrary zero, which restarts with each measurement, to seconds since 1970.

    A time stamp continues from the last one unless it is earlier, or jumps ahead of the clock. The first one after a
    restart is set to the present time, but always after all earlier ones.
    """

    now: Callable[[], float]
    began: float | None = None  # s, time of time stamp zero
    fresh: bool = True  # the connection is new
    last: float = -math.inf  # s, last result
    heard: float = 0.0  # s, clock at that moment

    def seconds(self, stamp: int) -> float:
        """Convert a time stamp in microseconds."""
        passed, now = stamp * 1e-6, self.now()
        time = math.nan if self.began is None else self.began + passed
        goes_on = time >= self.last and (time - self.last) - (now - self.heard) <= BEFORE_NOW
        if not goes_on or (self.fresh and abs(time - now) > BEFORE_NOW):
            time = max(now, self.last + LEAST_STEP)
            self.began = time - passed
        self.fresh, self.last, self.heard = False, time, now
        return time


@dataclass(frozen=True)
class Qualisys:
    """Receives the markers of all cameras, frame by frame, from QTM live or in playback.

    Cameras are matched to the rig by serial number; otherwise, if their number is equal, by QTM's order. QTM may start
    later, and may disappear and return. An unreadable packet is skipped; if packets do not begin where they should, the
    connection is renewed.
    """

    address: str  # qtm://host[:port]
    rig: CameraRig
    silence: float = 5.0  # s without data after which the connection is renewed
    pause: float = 1.0  # s between two attempts
    clock: Callable[[], float] = time.time
    live: bool = True

    def items(self) -> Iterator[Item]:
        """Receive until the caller stops.

        Raises:
            InputError: the address is invalid.
        """
        host, port = _host_and_port(self.address)
        clock, reported = _Clock(self.clock), ""
        while True:
            clock.fresh = True
            try:
                with (yield from _connect(host, port, self.silence)) as connection:
                    for item in self._session(connection, clock):
                        reported = "" if isinstance(item, Exposure) else reported
                        yield item
            except (_Lost, OSError) as error:
                reason = one_line(f"{self.address}: {error}")
                if reason != reported:  # once, however many retries follow
                    reported = reason
                    yield Unreadable(reason)
            ends = time.monotonic() + self.pause
            while time.monotonic() < ends:
                time.sleep(min(TICK, self.pause))
                yield None

    def _session(self, connection: socket.socket, clock: _Clock) -> Iterator[Item]:
        """Request the stream and read it.

        Raises:
            _Lost, OSError: the connection is unusable.
        """
        for command in COMMANDS:
            text = command.encode() + b"\0"
            connection.sendall(HEADER.pack(HEADER.size + len(text), COMMAND) + text)
        cameras: tuple[_Camera | None, ...] | None = None
        for packet in _packets(connection, self.silence):
            if packet is None:
                yield None
                continue
            kind, body = packet
            if kind == ERROR:
                raise _Lost(f"QTM says: {shorten(_text(body))}")
            try:
                if kind == XML:
                    cameras = find_cameras(parse_xml(_text(body), "GetParameters General"), self.rig)
                elif kind == DATA and cameras is None:
                    raise InputError("found data before the parameters of the cameras")
                elif kind == DATA and cameras is not None:
                    yield from _exposures(body, cameras, clock)
            except InputError as error:
                yield Unreadable(str(error))
                if cameras is None:
                    raise _Lost(str(error)) from error


def find_cameras(root: Element, rig: CameraRig) -> tuple[_Camera | None, ...]:
    """Find the cameras of a rig in QTM's general settings.

    Args:
        root: its answer to `GetParameters General`.
        rig: to which the cameras should belong.

    Returns:
        QTM's cameras in its order; None = not in the rig.

    Raises:
        InputError: the cameras are not those of the rig, or have images of another size.
    """
    general = root.find("General")
    elements = [] if general is None else general.all("Camera")
    if not elements:
        raise InputError(f"found no cameras in QTM's parameters, expected those of rig {rig.name}")
    serials = [_value(element, "Serial") or f"camera {number}" for number, element in enumerate(elements, 1)]
    known = {name: name for name in rig.camera_names}
    names = [known.get(serial, serial) for serial in serials]
    if not any(serial in known for serial in serials):
        if len(serials) != rig.num_cameras:
            found = f"{len(serials)} cameras ({list_names(serials)})"
            raise InputError(f"found {found}, expected {rig.num_cameras}, or cameras with serials as in rig {rig.name}")
        names = list(rig.camera_names)
    sizes = dict(zip(rig.camera_names, rig.image_size.tolist(), strict=True))
    return tuple(
        _camera(name, element, sizes[name]) if name in sizes else None
        for name, element in zip(names, elements, strict=True)
    )


def _camera(name: str, element: Element, size: list[int]) -> _Camera:
    """Compare a camera's settings with the size of its image."""
    width, height = (_number(name, element, "Marker_Res", side) for side in ("Width", "Height"))
    unit = width / size[0]
    if unit >= LEAST_UNITS and abs(height / size[1] - unit) <= 1e-3 * unit:
        return _Camera(name, unit, (0.0, 0.0))
    left, top, right, bottom = (_number(name, element, "Marker_FOV", s) for s in ("Left", "Top", "Right", "Bottom"))
    if [right - left + 1, bottom - top + 1] == size:
        return _Camera(name, UNITS, (left, top))
    found = f"{width / UNITS:g}x{height / UNITS:g} pixels (Marker_Res in 1/{UNITS}), {right - left + 1:g}x"
    raise InputError(f"{name}: found {found}{bottom - top + 1:g} of them used, expected {size[0]}x{size[1]}")


def _exposures(body: bytes, cameras: tuple[_Camera | None, ...], clock: _Clock) -> Iterator[Exposure]:
    """Exposures of all cameras in a frame; the whole frame is read before any is yielded.

    Raises:
        InputError: the data is not a frame of these cameras.
    """
    try:
        stamp, frame, components = DATA_HEADER.unpack_from(body)
        at = DATA_HEADER.size
        for _ in range(components):
            size, kind = COMPONENT.unpack_from(body, at)
            if kind == TWO_DIMENSIONAL:
                break
            if size < COMPONENT.size:
                raise InputError(f"frame {frame}: found a component of {size} bytes")
            at += size
        else:
            raise InputError(f"frame {frame}: found no 2D component")
        inside = body[at + COMPONENT.size : at + size]
        if len(inside) != size - COMPONENT.size:
            raise InputError(f"frame {frame}: found {len(inside)} bytes of markers, expected {size - COMPONENT.size}")
        markers = _markers(inside, len(cameras), frame)
    except struct.error as error:
        raise InputError(f"found {len(body)} bytes of data, expected a frame: {error}") from error
    seconds = clock.seconds(stamp)
    found = []
    for camera, rows in zip(cameras, markers, strict=True):
        if camera is None:
            continue
        uv = np.stack((rows["x"], rows["y"]), axis=-1) / camera.unit - camera.corner
        found.append(Exposure(camera.name, seconds, CameraBlobs.of(uv)))
    yield from found


def _markers(inside: bytes, count: int, frame: int) -> list[NDArray[np.void]]:
    """Markers of each camera."""
    found, _, _ = CAMERAS.unpack_from(inside)
    if found != count:
        raise InputError(f"frame {frame}: found {found} cameras, expected {count}")
    at, markers = CAMERAS.size, []
    for _ in range(count):
        number, _ = CAMERA.unpack_from(inside, at)
        at += CAMERA.size
        if not 0 <= number <= MOST_BLOBS or at + number * MARKER.itemsize > len(inside):
            raise InputError(f"frame {frame}: found {number} markers of a camera in {len(inside)} bytes")
        markers.append(np.frombuffer(inside, MARKER, number, at))
        at += number * MARKER.itemsize
    return markers


def _packets(connection: socket.socket, silence: float) -> Iterator[tuple[int, bytes] | None]:
    """Yield packets, as kind and content, and None while there are none.

    Raises:
        _Lost: the stream has ended, is silent, or does not consist of packets.
    """
    waiting, heard = bytearray(), time.monotonic()
    while True:
        ready, _, _ = select.select([connection], [], [], TICK)
        if not ready:
            if time.monotonic() - heard >= silence:
                raise _Lost(f"nothing has come for {silence:g} s")
            yield None
            continue
        chunk = connection.recv(AT_ONCE)
        if not chunk:
            raise _Lost("the connection was closed")
        heard = time.monotonic()
        waiting += chunk
        at = 0
        while len(waiting) - at >= HEADER.size:
            size, kind = HEADER.unpack_from(waiting, at)
            if not HEADER.size <= size <= LARGEST:
                raise _Lost(f"found a packet of {size:,} bytes, expected {HEADER.size} to {LARGEST:,}")
            if len(waiting) - at < size:
                break
            yield kind, bytes(waiting[at + HEADER.size : at + size])
            at += size
        del waiting[:at]


def _connect(host: str, port: int, timeout: float) -> Generator[None, None, socket.socket]:
    """Connect, yielding None while waiting.

    Raises:
        _Lost, OSError: the host is unknown, nothing listens there, or there is no answer.
    """
    family, kind, protocol, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    connection, ends = socket.socket(family, kind, protocol), time.monotonic() + timeout
    try:
        connection.setblocking(False)
        failed = connection.connect_ex(where)
        while failed in (errno.EINPROGRESS, errno.EWOULDBLOCK):
            yield None
            if select.select([], [connection], [], TICK)[1]:
                failed = connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            elif time.monotonic() > ends:
                raise _Lost("no answer")
        if failed:
            raise _Lost(f"cannot connect: {errno.errorcode.get(failed, failed)}")
        connection.setblocking(True)
    except BaseException:
        connection.close()
        raise
    return connection


def _host_and_port(address: str) -> tuple[str, int]:
    found = re.fullmatch(r"qtm://([^\s:/]+)(?::(\d{1,5}))?/?", address)
    if found is None or not is_host(found[1]) or not 0 < int(found[2] or PORT) < 2**16:
        raise InputError(f"{shorten(address)}: expected an address qtm://HOST[:PORT], such as qtm://127.0.0.1:{PORT}")
    return found[1], int(found[2] or PORT)


def _text(body: bytes) -> str:
    return body.rstrip(b"\0").decode(errors="replace")


def _value(element: Element, *path: str) -> str:
    """Text of the node at a path of names; empty if there is none."""
    for tag in path:
        child = element.find(tag)
        if child is None:
            return ""
        element = child
    return element.text.strip()


def _number(name: str, element: Element, *path: str) -> float:
    with contextlib.suppress(ValueError):
        value = float(_value(element, *path))
        if 0 <= value < 2**32:
            return value
    raise InputError(f"{name}: found no {'/'.join(path)} in QTM's parameters")
