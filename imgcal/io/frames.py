"""Reading and writing single grey frames: PNG, TIFF (several pages), other images, video."""

from __future__ import annotations

import contextlib
import math
import os
import struct
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.io.atomic import write_bytes
from imgcal.io.image_headers import PNG_SIGNATURE, Size, check_pixels, has_kind, image_size, tiff_pages
from imgcal.io.names import check_regular, read_bytes

_lock = threading.Lock()
_within = 0  # decodings that are under way, in any thread
_kept = -1  # standard error meanwhile
Frame = NDArray[np.uint8] | NDArray[np.uint16]  # (H, W) grey
TIFF_SUFFIXES = frozenset({".tif", ".tiff"})
IMAGE_SUFFIXES = frozenset({".png", ".bmp", ".pgm", ".jpg", ".jpeg"}) | TIFF_SUFFIXES
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mkv", ".mov"})
VIDEO_PROPERTIES = (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
JPEG_SUFFIXES = frozenset({".jpg", ".jpeg"})
JPEG_END, END_OF_JPEG = b"\xff\xd9", 2**16  # some cameras write a few bytes behind it
LOSSY_SUFFIXES = JPEG_SUFFIXES | VIDEO_SUFFIXES
LOSSY_TOLERANCE = 4  # grey levels by which lossy compression may tear the channels of a grey frame apart
LARGEST_IMAGE_FILE = 2**30  # bytes
LEAST_OF_A_FRAME = 4  # bytes that a frame takes in a video, at least
USUAL_RATE = 30.0  # frames a second of a video that does not say


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


def count_frames(path: Path) -> int:
    """Count the pages of a TIFF or the frames of a video; any other image has one.

    Raises:
        InputError: the file cannot be read or is truncated.
    """
    suffix = path.suffix.lower()
    if suffix in TIFF_SUFFIXES:
        try:
            return len(tiff_pages(path))
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if suffix in VIDEO_SUFFIXES:
        with Video(path) as video:
            return video.count
    return 1


def read_frame(path: str | Path, page: int = 0, size: Size | None = None) -> Frame:
    """Read a grey image of 8 or 16 bit.

    Pixels are returned as they are stored: an orientation for display (TIFF, Exif) is ignored.

    Args:
        path: image file.
        page: of a TIFF with several.
        size: width and height that it must have, known before anything is decoded; None = any plausible.

    Returns:
        (H, W) uint8 or uint16.

    Raises:
        InputError: unreadable or truncated file, another size or kind of image, true colours, transparency, or values
            that are not 8 or 16 bit.
    """
    path = Path(path)
    image: Any = None
    try:
        if path.suffix.lower() in TIFF_SUFFIXES:
            pages = tiff_pages(path)
            if page < len(pages):
                _require_size(path, pages[page].size, size)
            with silence_stderr():
                found, images = cv2.imreadmulti(str(path), start=page, count=1, flags=cv2.IMREAD_UNCHANGED)
            image = _as_stored(images[0], pages[page].orientation) if found and images else None
        else:
            content = _content(path)
            _require_size(path, image_size(path.suffix.lower(), content), size)
            with silence_stderr():
                image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except cv2.error as error:
        raise InputError(f"{path}: cannot be decoded: {error.err or 'not an image'}") from error
    if image is None:
        raise InputError(f"{path}: found a damaged or truncated file, expected a {path.suffix[1:].upper()} image")
    return _grey(image, path)


def _as_stored(image: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Undo the turn (TIFF 6.0, Orientation) by which OpenCV makes the first pixel of a TIFF the one at the top left."""
    rows = slice(None, None, -1 if orientation in (3, 4, 7, 8) else 1)
    columns = slice(None, None, -1 if orientation in (2, 3, 6, 7) else 1)
    turned = image[rows, columns]
    return np.ascontiguousarray(turned.swapaxes(0, 1) if orientation >= 5 else turned)


def write_frame(path: str | Path, frame: Frame) -> None:
    """Write a grey frame as PNG, without loss and in one step.

    Args:
        path: file name that ends in .png, in an existing folder.
        frame: (H, W) uint8 or uint16.

    Raises:
        InputError: the file cannot be written, or the frame is of another kind.

    Examples:
        >>> import numpy as np
        >>> write_frame("frame.png", np.full((4, 6), 1000, dtype=np.uint16))
        >>> read_frame("frame.png").shape, int(read_frame("frame.png").max())
        ((4, 6), 1000)
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise InputError(f"{path}: found the suffix {path.suffix!r}, expected .png")
    if frame.ndim != 2 or frame.dtype not in (np.uint8, np.uint16) or not frame.size:
        raise InputError(f"{path}: found a frame {frame.shape} of {frame.dtype}, expected (H, W) of uint8 or uint16")
    encoded, content = cv2.imencode(".png", frame)
    if not encoded:
        raise InputError(f"{path}: a frame {frame.shape} of {frame.dtype} cannot be encoded as PNG")
    write_bytes(path, content.tobytes())


def write_image(path: str | Path, image: NDArray[np.uint8]) -> None:
    """Write a colour image (H, W, 3), red first, as PNG in one step.

    Raises:
        InputError: the image cannot be encoded, or the file cannot be written.
    """
    encoded, content = cv2.imencode(".png", image[..., ::-1])
    if not encoded:
        raise InputError(f"{path}: an image {image.shape} of {image.dtype} cannot be encoded as PNG")
    write_bytes(path, content.tobytes())


class Video:
    """A grey video that is read forwards; a context manager.

    `count` frames, `rate` of them a second; `seconds` is when the frame that was read last was taken, by the time
    stamps of the file, which some formats (AVI) make of the number of the frame.

    Raises:
        InputError: on opening, when the file is no video; on reading, when it ends before its announced length.
    """

    def __init__(self, path: Path) -> None:
        """Open a file.

        Raises:
            InputError: the file is no video.
        """
        self.path = path
        check_regular(path)
        try:
            with open(path, "rb") as file:
                start = file.read(8)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
        if not has_kind(path.suffix.lower(), start):  # a list of other files, for example, would be followed
            raise InputError(f"{path}: found a damaged or empty file, expected a video")
        with silence_stderr():
            self._capture = cv2.VideoCapture(str(path))
            announced, rate, *size = (self._capture.get(name) for name in VIDEO_PROPERTIES)
        try:
            self.count = int(announced) if self._capture.isOpened() and math.isfinite(announced) else 0
            if self.count <= 0:
                raise InputError(f"{path}: found a damaged or empty file, expected a video")
            if self.count > path.stat().st_size // LEAST_OF_A_FRAME:
                found = f"{self.count:,} frames announced in {path.stat().st_size:,} bytes"
                raise InputError(f"{path}: found {found}, expected a video")
            check_pixels(path, (int(size[0]), int(size[1])))
        except InputError:
            self._capture.release()
            raise
        self.rate = rate if math.isfinite(rate) and rate > 0 else USUAL_RATE
        self.seconds = 0.0
        self._next = 0

    def __enter__(self) -> Video:
        return self

    def __exit__(self, *_: object) -> None:
        self._capture.release()

    def read(self, index: int) -> Frame:
        """Read a frame (H, W); indices must grow from call to call.

        Raises:
            InputError: the video ends before its announced length, or is not grey.
            ValueError: the frame has been passed already.
        """
        if index < self._next:
            raise ValueError(f"{self.path}: frame {index} after frame {self._next - 1}; a video is read forwards")
        good, image = True, None
        with silence_stderr():
            while good and self._next < index:
                good = self._capture.grab()
                self._next += 1
            if good:
                good, image = self._capture.read()
                self._next += 1
        if not good or image is None:
            raise InputError(f"{self.path}: found {self._next - 1} readable frames, expected {self.count} (truncated)")
        self.seconds = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        return _grey(image, self.path)


def grey_frame(image: NDArray[Any], where: str, tolerance: float = LOSSY_TOLERANCE) -> Frame:
    """Take the one channel of a grey image, in this machine's byte order; an image in true colours is rejected.

    Args:
        image: (H, W), (H, W, 1), (H, W, 3) or, where it is opaque, (H, W, 4); uint8 or uint16.
        where: what a message begins with: the file or the camera.
        tolerance: grey levels by which channels may differ: lossy compression tears them apart.

    Raises:
        InputError: true colours, transparency, masked pixels, another type or shape.

    Examples:
        >>> grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
        >>> bool((grey_frame(np.stack([grey] * 3, axis=-1), "camera left") == grey).all())
        True
    """
    if not image.dtype.isnative:
        image = image.astype(image.dtype.newbyteorder("="))
    if np.ma.is_masked(image):
        raise InputError(f"{where}: found a masked array, expected a plain one, and known reflections in `masks`")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{where}: found pixels of type {image.dtype}, expected 8 or 16 bit whole numbers")
    if image.ndim == 2:
        return np.asarray(image)
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        raise InputError(f"{where}: found a frame of shape {image.shape}, expected grey (H, W)")
    if image.shape[2] == 1:
        return np.asarray(image[..., 0])
    if image.shape[2] == 4 and (image[..., 3] != np.iinfo(image.dtype).max).any():
        raise InputError(f"{where}: found a transparent image, expected grey")
    channels: Any = cv2.split(image[..., :3])
    first, green, third = channels
    apart = max(float(cv2.norm(green, other, cv2.NORM_INF)) for other in (first, third))
    if apart > tolerance:
        raise InputError(f"{where}: found a colour image (channels differ by up to {apart:.0f}), expected grey")
    return np.asarray(green)


def _grey(image: Any, path: Path) -> Frame:
    """Check the type of a decoded image and take the one channel that a grey image has."""
    return grey_frame(image, str(path), LOSSY_TOLERANCE if path.suffix.lower() in LOSSY_SUFFIXES else 0)


def _content(path: Path) -> bytes:
    """Read an image file of the kind that its suffix names."""
    content = read_bytes(path, LARGEST_IMAGE_FILE)
    suffix = path.suffix.lower()
    if not content:
        raise InputError(f"{path}: found an empty file, expected an image")
    if not has_kind(suffix, content):
        raise InputError(f"{path}: found a file of another kind, expected a {suffix[1:].upper()} image")
    if suffix in JPEG_SUFFIXES and JPEG_END not in content[-END_OF_JPEG:]:
        raise InputError(f"{path}: found a truncated JPEG of {len(content)} bytes, expected its end")
    return _necessary_chunks(path, content) if suffix == ".png" else content


def _require_size(path: Path, found: Size | None, expected: Size | None) -> None:
    if found is None:
        raise InputError(f"{path}: found a damaged or truncated header, expected a {path.suffix[1:].upper()} image")
    if expected is not None and found != expected:
        raise InputError(f"{path}: found {found[0]}x{found[1]} pixels, expected {expected[0]}x{expected[1]}")
    check_pixels(path, found)


def _necessary_chunks(path: Path, content: bytes) -> bytes:
    """Walk the chunks of a PNG: some decoders silently fill the missing part of a truncated one.

    Returns:
        The PNG without the chunks that are not needed for its pixels: remarks, profiles, animations.
    """
    position, kind, kept = len(PNG_SIGNATURE), b"", [memoryview(PNG_SIGNATURE)]
    while kind != b"IEND":
        header = content[position : position + 8]
        if len(header) < 8:
            raise InputError(f"{path}: found a truncated PNG of {len(content)} bytes, expected an IEND chunk")
        length, kind = struct.unpack(">I4s", header)
        end = position + 8 + length
        checksum = content[end : end + 4]
        if len(checksum) < 4:
            raise InputError(f"{path}: found a truncated PNG of {len(content)} bytes, expected {end + 4} or more")
        if zlib.crc32(memoryview(content)[position + 4 : end]) != int.from_bytes(checksum, "big"):
            raise InputError(f"{path}: found a damaged PNG (checksum of chunk {kind!r} is wrong)")
        if kind[:1].isupper() or kind == b"tRNS":
            kept.append(memoryview(content)[position : end + 4])
        position = end + 4
    return content if sum(map(len, kept)) == len(content) else b"".join(kept)
