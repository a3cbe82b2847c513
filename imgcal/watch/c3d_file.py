"""C3D, the exchange file of biomechanics for 3D markers: written frame by frame, readable after a kill.

Source: The C3D File Format, user guide, https://www.c3d.org: floating-point points, Intel byte order.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.io import write_bytes
from imgcal.watch.line_file import create_whole, write_whole

BLOCK = 512  # bytes
PARAMETERS_AT = 2  # block of the parameters, counted from 1
INTEL = 84
MOST_SHORT = 65_535  # in 16 bits; to readers it means: this many or more, see the longer counts
MOST_LABELS = 255  # per parameter; more go into LABELS2, LABELS3, ...
MOST_BYTE, MASKED_CAMERAS = 255, 7
INVALID = -1.0
MISSING = struct.pack("<4f", 0.0, 0.0, 0.0, INVALID)  # a point that was not seen
CHARACTER, INTEGER, REAL = -1, 2, 4


class C3DFile:
    """Points in millimetres; the fourth number of each holds its expected error and the cameras that saw it.

    `append` updates the frame counts in the file each time.
    """

    def __init__(self, path: Path, labels: Sequence[str], rate: float, reach: float) -> None:
        """Create the file.

        Args:
            path: must not exist.
            labels: names of the points.
            rate: frames per second.
            reach: maximum coordinate in mm; it fixes the scale of a file with integers converted from this one.

        Raises:
            OSError: the file cannot be created.
        """
        self.frames, self._rate, self._scale = 0, rate, max(reach, 1.0) / 32_000
        self._path, self._points = path, len(labels)
        content = self._begin(labels)
        self._file = create_whole(path, content)

    def _begin(self, labels: Sequence[str]) -> bytes:
        """Make the part before the frames, and note the positions of its counts."""
        parameters, self._places = _parameters(labels, self._rate, self._scale)
        blocks = -(-len(parameters) // BLOCK)
        self._data_at = PARAMETERS_AT + blocks
        content = bytearray(BLOCK) + parameters.ljust(blocks * BLOCK, b"\0")
        content[BLOCK : BLOCK + 4] = bytes((1, 80, blocks, INTEL))
        struct.pack_into("<BB", content, 0, PARAMETERS_AT, 80)
        struct.pack_into("<HHHHH", content, 2, len(labels), 0, 1, 0, 0)
        struct.pack_into("<fHHf", content, 12, -self._scale, self._data_at, 0, self._rate)
        struct.pack_into("<H", content, BLOCK + self._places["POINT:DATA_START"], self._data_at)
        for place, count in self._frame_counts():
            content[place : place + len(count)] = count
        return bytes(content)

    def _frame_counts(self) -> list[tuple[int, bytes]]:
        """The number of frames wherever the file states it, in bytes, with the positions.

        The format counted in 16 bits once; where these do not suffice, readers take one of the longer counts.
        """
        short, long = struct.pack("<H", min(self.frames, MOST_SHORT)), struct.pack("<I", self.frames)
        parameters = {
            "POINT:FRAMES": short,
            "POINT:LONG_FRAMES": struct.pack("<f", self.frames),
            "TRIAL:ACTUAL_END_FIELD": long,
        }
        return [(8, short), *((BLOCK + self._places[name], count) for name, count in parameters.items())]

    def widen(self, labels: Sequence[str]) -> None:
        """Add columns for more points, missing in all frames so far, atomically.

        Args:
            labels: names of the existing points, followed by the new ones.

        Raises:
            InputError: the file cannot be rewritten; it is unchanged.
        """
        self._file.seek((self._data_at - 1) * BLOCK)
        given = self._file.read(self.frames * self._points * 16)
        rows = np.zeros((self.frames, len(labels), 4), "<f4")
        rows[..., 3] = INVALID
        rows[:, : self._points] = np.frombuffer(given, "<f4").reshape(self.frames, self._points, 4)
        places, data_at = self._places, self._data_at
        self._file.close()
        try:
            write_bytes(self._path, self._begin(labels) + rows.tobytes())
            self._points = len(labels)
        except InputError:
            self._places, self._data_at = places, data_at
            raise
        finally:
            self._file = open(self._path, "r+b", buffering=0)  # noqa: SIM115  # open until close

    def append(self, points: NDArray[np.float64], error: NDArray[np.float64], cameras: NDArray[np.int64]) -> None:
        """Add frames.

        Args:
            points: (F, N, 3) mm; NaN = not seen.
            error: (F, N) mm, expected errors of the points.
            cameras: (F, N) bits: which of the first seven cameras saw the point.

        Raises:
            OSError: the frames cannot be written; the file holds the frames so far.
        """
        valid = np.asarray(np.isfinite(points).all(-1))
        steps = np.ceil(np.where(valid, error, 0) / self._scale).clip(1, MOST_BYTE)  # 0 means: not measured
        rows = np.empty((*points.shape[:2], 4), "<f4")
        rows[..., :3] = np.where(valid[..., None], points, 0.0)
        rows[..., 3] = np.where(valid, 256 * (cameras & (2**MASKED_CAMERAS - 1)) + steps, INVALID)
        self._file.seek(0, os.SEEK_END)
        self._write(rows.tobytes())
        self.frames += len(points)
        for place, count in self._frame_counts():
            self._file.seek(place)  # after the frames that it counts
            self._write(count)

    def close(self) -> None:
        """Fill the last block with missing points, since some readers take it for frames, and close."""
        if not self._file.closed:
            with contextlib.suppress(OSError):  # the points can be read without it
                self._file.seek(0, os.SEEK_END)
                self._write(MISSING * (-self._file.tell() % BLOCK // len(MISSING)))
            self._file.close()

    def _write(self, content: bytes) -> None:
        write_whole(self._file.fileno(), content, self._path)


def _parameters(labels: Sequence[str], rate: float, scale: float) -> tuple[bytes, dict[str, int]]:
    """The parameter section of a file without frames, and the offsets of the values in it."""
    groups: dict[str, dict[str, tuple[int, tuple[int, ...], bytes]]] = {
        "POINT": {
            "USED": _integers(len(labels)),
            "SCALE": _real(-scale),
            "RATE": _real(rate),
            "DATA_START": _integers(0),
            "FRAMES": _integers(0),
            "LONG_FRAMES": _real(0.0),
            "UNITS": _text("mm"),
            **_labels("LABELS", labels),
            **_labels("DESCRIPTIONS", labels),  # some readers need them
        },
        "ANALOG": {"USED": _integers(0), "GEN_SCALE": _real(1.0), "RATE": _real(0.0)},
        "TRIAL": {
            "ACTUAL_START_FIELD": _integers(1, 0),
            "ACTUAL_END_FIELD": _integers(0, 0),
            "CAMERA_RATE": _real(rate),
        },
        "MANUFACTURER": {"COMPANY": _text("imgcal"), "SOFTWARE": _text("imgcal")},
    }
    section, places, last = bytearray(4), {}, 0
    for number, (group, parameters) in enumerate(groups.items(), start=1):
        section += struct.pack("bb", len(group), -number) + group.encode()
        last = len(section)
        section += struct.pack("<HB", 3, 0)  # offset of the next entry, no description
        for name, (kind, sizes, values) in parameters.items():
            section += struct.pack("bb", len(name), number) + name.encode()
            last = len(section)
            body = struct.pack("bB", kind, len(sizes)) + bytes(sizes)
            places[f"{group}:{name}"] = last + 2 + len(body)
            section += struct.pack("<H", 2 + len(body) + len(values) + 1) + body + values + b"\0"
    struct.pack_into("<H", section, last, 0)  # no next entry
    return bytes(section), places


def _integers(*values: int) -> tuple[int, tuple[int, ...], bytes]:
    """Encode 16-bit integers."""
    sizes = () if len(values) == 1 else (len(values),)
    return INTEGER, sizes, struct.pack(f"<{len(values)}H", *values)


def _real(value: float) -> tuple[int, tuple[int, ...], bytes]:
    return REAL, (), struct.pack("<f", value)


def _text(value: str) -> tuple[int, tuple[int, ...], bytes]:
    return CHARACTER, (len(value),), value.encode("ascii", "replace")


def _texts(values: Sequence[str]) -> tuple[int, tuple[int, ...], bytes]:
    """Encode texts, padded with blanks to one length."""
    width = min(max(map(len, values)), MOST_LABELS)
    cells = [value.encode("ascii", "replace")[:width].ljust(width) for value in values]
    return CHARACTER, (width, len(values)), b"".join(cells)


def _labels(name: str, values: Sequence[str]) -> dict[str, tuple[int, tuple[int, ...], bytes]]:
    """Encode labels in as many parameters as needed: NAME, NAME2, ..."""
    parts = [values[at : at + MOST_LABELS] for at in range(0, len(values), MOST_LABELS)]
    return {f"{name}{number if number > 1 else ''}": _texts(part) for number, part in enumerate(parts, start=1)}
