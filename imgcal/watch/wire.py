"""Messages from other processes: blobs as one line of JSON, frames as a line of JSON followed by the pixels."""

from __future__ import annotations

from typing import Any

import numpy as np

from imgcal.errors import InputError
from imgcal.io import DEFAULT_SIGMA, read_json
from imgcal.messages import list_names, shorten
from imgcal.types import limits
from imgcal.watch.exposures import CameraBlobs, Exposure

LONGEST_LINE = 2**22  # bytes
BLOB_KEYS = {"camera", "time", "uv", "sigma", "radius"}
FRAME_KEYS = {"camera", "time", "width", "height", "type"}
PIXEL_TYPES: dict[str, np.dtype[Any]] = {"uint8": np.dtype("<u1"), "uint16": np.dtype("<u2")}


def exposure_from_json(text: str | bytes) -> Exposure:
    """Read blobs of one camera at one moment.

    Args:
        text: `{"camera": "cam01", "time": 12.5, "uv": [[u, v], ...]}`, and, if known, `sigma` and `radius` of all
            blobs (one number) or of each (a list): seconds and pixels. No blobs: `"uv": []`.

    Raises:
        InputError: any other format.

    Examples:
        >>> exposure_from_json('{"camera": "cam01", "time": 12.5, "uv": [[100, 50.5]], "sigma": 0.08}').content.sigma
        array([0.08])
    """
    entry = _mapping(text, BLOB_KEYS, {"camera", "time", "uv"})
    blobs = CameraBlobs.of(entry["uv"], entry.get("sigma", DEFAULT_SIGMA), entry.get("radius"))
    return Exposure(entry["camera"], entry["time"], blobs)


def exposure_from_pixels(header: str | bytes, pixels: bytes | memoryview) -> Exposure:
    """Read a frame of one camera.

    Args:
        header: `{"camera": "cam01", "time": 12.5, "width": 1280, "height": 1024, "type": "uint8"}`; the type may also
            be uint16, little-endian.
        pixels: row by row from the top, without gaps.

    Raises:
        InputError: any other format.

    Examples:
        >>> header = '{"camera": "cam01", "time": 12.5, "width": 3, "height": 2, "type": "uint8"}'
        >>> exposure_from_pixels(header, bytes(6)).content.shape
        (2, 3)
    """
    entry = _mapping(header, FRAME_KEYS, FRAME_KEYS)
    width, height, kind = (entry[key] for key in ("width", "height", "type"))
    if not all(isinstance(side, int) and 0 < side <= limits.LONGEST_SIDE for side in (width, height)):
        raise InputError(f"found {width!r} x {height!r} pixels, expected whole numbers up to {limits.LONGEST_SIDE:,}")
    if kind not in tuple(PIXEL_TYPES):  # compares without hashing, so lists are allowed
        raise InputError(f"type: found {shorten(repr(kind))}, expected {' or '.join(PIXEL_TYPES)}")
    expected = width * height * PIXEL_TYPES[kind].itemsize
    if len(pixels) != expected:
        raise InputError(f"{entry['camera']}: found {len(pixels):,} bytes of pixels, expected {expected:,}")
    frame: Any = np.frombuffer(pixels, PIXEL_TYPES[kind]).reshape(height, width)
    return Exposure(entry["camera"], entry["time"], frame)


def _mapping(text: str | bytes, allowed: set[str], needed: set[str]) -> dict[str, Any]:
    if len(text) > LONGEST_LINE:
        raise InputError(f"found {len(text):,} bytes, expected a line of JSON of at most {LONGEST_LINE:,}")
    try:
        entry = read_json(text.decode() if isinstance(text, bytes) else text)
    except ValueError as error:  # also if it is not UTF-8
        raise InputError(f"found {shorten(repr(text))}, expected a line of JSON: {error}") from error
    if not isinstance(entry, dict) or not needed <= set(entry) <= allowed:
        found = list_names(map(str, entry)) or "no keys" if isinstance(entry, dict) else shorten(repr(entry))
        optional = allowed - needed
        may = f", optional {list_names(sorted(optional))}" if optional else ""
        raise InputError(f"found {found}, expected the keys {list_names(sorted(needed))}{may}")
    time = entry["time"]
    if not isinstance(entry["camera"], str) or isinstance(time, bool) or not isinstance(time, int | float):
        found = f"{shorten(repr(entry['camera']))} and {shorten(repr(time))}"
        raise InputError(f"found camera and time {found}, expected a name and seconds")
    try:
        entry["time"] = float(time)
    except OverflowError as error:
        raise InputError(f"found the time {shorten(str(time))}, expected seconds") from error
    return entry
