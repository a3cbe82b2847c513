"""One camera's data at one moment, as a source gives them, and the check whether they fit the rig."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.io import DEFAULT_SIGMA, MARGIN, Frame
from imgcal.messages import shorten
from imgcal.types import CameraRig, limits

MOST_BLOBS = 10_000
"""Maximum number of blobs of one camera at one moment."""
DIGESTED_ROWS = 4
"""Only every such row of a frame counts for its digest: every blob crosses one, and their noise differs anyway."""
LATEST = 1e11
"""Seconds since the epoch: later times are in another unit, such as nanoseconds."""


@dataclass(frozen=True)
class CameraBlobs:
    """The blobs that a camera saw. An empty set is data, too: the camera works and sees nothing."""

    uv: NDArray[np.float64]  # (K, 2) pixels
    sigma: NDArray[np.float64]  # (K,) pixels, one standard deviation of each axis
    radius: NDArray[np.float64]  # (K,) pixels; nan = unknown

    @classmethod
    def of(cls, uv: Any, sigma: Any = DEFAULT_SIGMA, radius: Any = None) -> CameraBlobs:
        """Make them from anything that NumPy accepts as numbers.

        Args:
            uv: (K, 2) pixels.
            sigma: (K,) pixels, or one number for all.
            radius: (K,) pixels, or one number for all; None = unknown.

        Raises:
            InputError: wrong shapes, not numbers, or values that no blob has.

        Examples:
            >>> CameraBlobs.of([[100.0, 50.5], [400.0, 300.0]]).sigma
            array([0.1, 0.1])
        """
        places = _numbers("uv", uv)
        if not places.size:
            places = places.reshape(0, 2)
        if places.ndim != 2 or places.shape[1] != 2 or len(places) > MOST_BLOBS:
            raise InputError(f"uv: found shape {places.shape}, expected (K, 2) with at most {MOST_BLOBS:,} blobs")
        count = len(places)
        blobs = cls(
            places,
            _column("sigma", sigma, count),
            np.full(count, np.nan) if radius is None else _column("radius", radius, count),
        )
        blobs._check("uv", blobs.uv, limits.PIXEL)
        blobs._check("sigma", blobs.sigma, limits.SIGMA)
        if radius is not None:
            blobs._check("radius", blobs.radius, limits.BLOB_RADIUS)
        return blobs

    def _check(self, name: str, values: NDArray[np.float64], plausible: limits.Range) -> None:
        wrong = ~((values >= plausible.low) & (values <= plausible.high))
        if wrong.any():
            raise InputError(f"{name}: found {values[wrong][0]:g}, expected {plausible}")


class FileStamp(NamedTuple):
    """What tells a frame from another in a file of the same name, wherever its folder lies."""

    name: str
    content: int  # see `frame_digest`

    @classmethod
    def of(cls, name: str, frame: Frame) -> FileStamp:
        """Make it from a frame (H, W) that was read from a file of this name."""
        return cls(name, frame_digest(frame))


@dataclass(frozen=True)
class Exposure:
    """A frame, or the blobs of one, with its time stamp."""

    camera: str
    time: float  # s since the epoch (or the start of a recording), by the camera's clock
    content: Frame | CameraBlobs
    snapshot: str | None = None  # name of its snapshot, if the source knows; None = match by time
    file: FileStamp | None = None  # its file, if it has one of its own


@dataclass(frozen=True)
class Unreadable:
    """Input that is not a valid exposure."""

    reason: str
    camera: str | None = None  # None = unknown


Item = Exposure | Unreadable | None
"""What a source yields: None = nothing has come for a while."""


class Source(Protocol):
    """A source of exposures."""

    @property
    def live(self) -> bool:
        """Whether it runs by itself, so that data not taken in time are dropped. A recording waits."""

    def items(self) -> Iterator[Item]:
        """Yield the data, and None at least ten times a second while there are none; end with the source."""


def frame_digest(frame: Frame) -> int:
    """Number that differs between frames (H, W) of other content; much quicker than to read one."""
    return zlib.crc32(np.ascontiguousarray(frame[::DIGESTED_ROWS]).data)


def check_exposure(exposure: Exposure, rig: CameraRig) -> Exposure:
    """Check that an exposure fits the rig.

    Raises:
        InputError: an unknown camera, an invalid time, a frame of another size, or blobs outside the image.
    """
    if exposure.camera not in rig.camera_names:
        raise InputError(f"found camera {shorten(exposure.camera)!r}, expected one of rig {rig.name}")
    if not 0 <= exposure.time < LATEST:  # also excludes nan
        raise InputError(f"{exposure.camera}: found the time {exposure.time:g}, expected seconds since the epoch")
    width, height = rig.image_size[rig.camera_names.index(exposure.camera)].tolist()
    content = exposure.content
    if isinstance(content, CameraBlobs):
        beyond = (content.uv < -0.5 - MARGIN) | (content.uv > np.array([width, height]) - 0.5 + MARGIN)
        if beyond.any():
            u, v = content.uv[beyond.any(axis=1)][0]
            raise InputError(f"{exposure.camera}: found ({u:g}, {v:g}), expected a pixel of its {width}x{height} image")
    elif content.ndim != 2 or content.dtype not in (np.uint8, np.uint16) or content.shape != (height, width):
        found = f"{'x'.join(map(str, content.shape[::-1]))} pixels of {content.dtype}"
        raise InputError(f"{exposure.camera}: found {found}, expected {width}x{height} of uint8 or uint16")
    return exposure


def _numbers(name: str, values: Any) -> NDArray[np.float64]:
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: found {shorten(repr(values))}, expected numbers") from error


def _column(name: str, values: Any, count: int) -> NDArray[np.float64]:
    column = _numbers(name, values)
    if column.shape not in ((), (count,)):
        raise InputError(f"{name}: found shape {column.shape}, expected one number or {count}")
    return np.array(np.broadcast_to(column, (count,)))
