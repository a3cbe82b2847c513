"""Headers of image files, read before decoding: kind and size.

A decoder asks for memory as the header says, and takes a file for what its first bytes say, whatever its name.
"""

from __future__ import annotations

import functools
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from imgcal.errors import InputError
from imgcal.io.names import check_regular
from imgcal.types import MOST_PIXELS

Size = tuple[int, int]  # width, height in pixels

MOST_PAGES = 1_000_000

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
SIGNATURES = {
    ".png": (PNG_SIGNATURE,),
    ".bmp": (b"BM",),
    ".pgm": (b"P2", b"P5"),
    ".jpg": (b"\xff\xd8\xff",),
    ".jpeg": (b"\xff\xd8\xff",),
    ".avi": (b"RIFF",),
    ".mkv": (b"\x1a\x45\xdf\xa3",),
}
MOVIE_ATOMS = frozenset({b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot"})  # bytes 4 to 8 of mp4 and mov

PGM_HEADER = re.compile(rb"P[25](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s")
JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # start-of-frame markers
TIFF_WIDTH, TIFF_HEIGHT, TIFF_BITS, TIFF_PHOTOMETRIC, TIFF_ORIENTATION, TIFF_SAMPLES = 256, 257, 258, 262, 274, 277
WHITE_IS_ZERO, BLACK_IS_ZERO = 0, 1


def has_kind(suffix: str, start: bytes) -> bool:
    """Tell whether the first bytes of a file are those of its suffix, in lower case."""
    if suffix in (".mp4", ".mov"):
        return start[4:8] in MOVIE_ATOMS
    return start.startswith(SIGNATURES[suffix])


def image_size(suffix: str, content: bytes) -> Size | None:
    """Find the size of a PNG, BMP, PGM or JPEG image; None when the header is damaged."""
    try:
        if suffix == ".png":
            width, height = struct.unpack(">II", content[16:24])
        elif suffix == ".bmp":
            old = content[14:18] == b"\x0c\0\0\0"
            width, height = struct.unpack("<HH", content[18:22]) if old else struct.unpack("<ii", content[18:26])
        elif suffix == ".pgm":
            found = PGM_HEADER.match(content[: 2**16])
            width, height = map(int, found.groups()) if found else (0, 0)
        else:
            width, height = _jpeg_size(content)
    except struct.error:
        return None
    return (abs(width), abs(height)) if width and height else None


def check_pixels(path: Path, size: Size, samples: int = 1) -> None:
    """Raise `InputError` where an image is larger than any camera's."""
    width, height = size
    if width * height * samples > MOST_PIXELS:
        found = f"{width}x{height} pixels" + (f" of {samples} values" if samples > 1 else "")
        raise InputError(f"{path}: found {found}, expected at most {MOST_PIXELS:,}")


@dataclass(frozen=True)
class TiffPage:
    """One image of a TIFF, as it is stored."""

    size: Size  # (0, 0) where the page has none
    orientation: int  # 1 to 8, of its first row and column for display; 1 = top left


def tiff_pages(path: Path) -> tuple[TiffPage, ...]:
    """Walk the directories of a TIFF or BigTIFF: OpenCV silently counts only the pages before a truncation.

    Raises:
        InputError: another kind of file, truncated, with a page larger than any camera's image, or of more than 8 bit
            with zero for white: OpenCV inverts 8 bit only.

    Source: TIFF 6.0, section 2; BigTIFF has 8-byte offsets and 20-byte entries.
    """
    check_regular(path)
    state = path.stat()
    return _tiff_pages(path, state.st_size, state.st_mtime_ns)


@functools.lru_cache(maxsize=64)  # every page of a file is read by its own call
def _tiff_pages(path: Path, size: int, changed: int) -> tuple[TiffPage, ...]:
    with open(path, "rb") as file:
        magic = file.read(4)
        order = {b"II": "<", b"MM": ">"}.get(magic[:2], "")
        version = struct.unpack(order + "H", magic[2:])[0] if order and len(magic) == 4 else 0
        if version not in (42, 43):
            raise InputError(f"{path}: found {'a file of another kind' if magic else 'an empty file'}, expected TIFF")
        big = version == 43
        if big:
            file.read(4)
        offset_format, count_format = (order + "Q", order + "Q") if big else (order + "I", order + "H")
        offset, pages = _unpack(file, offset_format, path), dict[int, TiffPage]()
        while offset and offset not in pages:
            if offset > size:
                raise _truncated_error(path)
            file.seek(offset)
            entries = _unpack(file, count_format, path)
            if entries * 12 > size or len(pages) == MOST_PAGES:
                raise _truncated_error(path)
            pages[offset] = _read_page(path, file, entries, order, big)
            offset = _unpack(file, offset_format, path)
    return tuple(pages.values())


def _read_page(path: Path, file: BinaryIO, entries: int, order: str, big: bool) -> TiffPage:
    entry = 20 if big else 12
    content = file.read(entries * entry)
    if len(content) < entries * entry:
        raise _truncated_error(path)
    values = {TIFF_WIDTH: 0, TIFF_HEIGHT: 0, TIFF_SAMPLES: 1, TIFF_BITS: 1, TIFF_ORIENTATION: 1}
    values[TIFF_PHOTOMETRIC] = BLACK_IS_ZERO
    for start in range(0, len(content), entry):
        tag, kind = struct.unpack_from(order + "HH", content, start)
        if tag in values and kind in (3, 4, 16):  # short, long, long8; the value stands in the entry
            letter = {3: "H", 4: "I", 16: "Q"}[kind]
            if kind != 16 or big:
                values[tag] = struct.unpack_from(order + letter, content, start + (12 if big else 8))[0]
    size = values[TIFF_WIDTH], values[TIFF_HEIGHT]
    check_pixels(path, size, max(values[TIFF_SAMPLES], 1))
    if values[TIFF_PHOTOMETRIC] == WHITE_IS_ZERO and values[TIFF_BITS] > 8:
        raise InputError(f"{path}: found inverted grey values (WhiteIsZero), expected zero for black (BlackIsZero)")
    return TiffPage(size, values[TIFF_ORIENTATION])


def _unpack(file: BinaryIO, number_format: str, path: Path) -> int:
    content = file.read(struct.calcsize(number_format))
    if len(content) < struct.calcsize(number_format):
        raise _truncated_error(path)
    return int(struct.unpack(number_format, content)[0])


def _truncated_error(path: Path) -> InputError:
    return InputError(f"{path}: found a truncated TIFF of {path.stat().st_size} bytes, expected more")


def _jpeg_size(content: bytes) -> Size:
    """Walk the segments to the frame's header. Raises struct.error at the end of the content."""
    position = 2
    while True:
        mark, kind, length = struct.unpack(">BBH", content[position : position + 4])
        if mark != 0xFF:
            return 0, 0
        if kind == 0xFF:  # fill byte
            position += 1
            continue
        if kind in JPEG_SIZES:
            height, width = struct.unpack(">HH", content[position + 5 : position + 9])
            return width, height
        position += 2 + length
