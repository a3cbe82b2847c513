"""Checks of the detector's input frames and masks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.io import grey_frame

Frame = NDArray[np.uint8] | NDArray[np.uint16]  # (H, W) grey values


def check_frame(frame: object, camera: str) -> Frame:
    """Return `frame` as a grey (H, W) image of 8 or 16 bit, also from equal channels; explain why if it is none."""
    if not isinstance(frame, np.ndarray):
        raise InputError(f"camera {camera}: found a {type(frame).__name__}, expected a NumPy array (H, W)")
    if frame.dtype.newbyteorder("=") not in (np.uint8, np.uint16):
        raise InputError(f"camera {camera}: found {frame.dtype} grey values, expected uint8 or uint16")
    frame = grey_frame(frame, f"camera {camera}")
    if min(frame.shape) < 16:
        raise InputError(
            f"camera {camera}: found a frame of {frame.shape[1]} x {frame.shape[0]}, expected at least 16 x 16"
        )
    return frame


def check_mask(mask: object, frame: Frame, camera: str) -> NDArray[np.bool_]:
    """Return `mask` as bool (H, W), true inside known reflections."""
    if not isinstance(mask, np.ndarray) or mask.shape != frame.shape:
        found = mask.shape if isinstance(mask, np.ndarray) else type(mask).__name__
        raise InputError(f"camera {camera}: found a mask of shape {found}, expected that of the frame, {frame.shape}")
    return mask if mask.dtype == np.bool_ else mask != 0


def full_scale(frame: Frame, bit_depth: int | None, camera: str) -> int:
    """Largest grey value that the frame can hold: 2 ** bit_depth - 1."""
    if bit_depth is None:
        if frame.dtype == np.uint8:
            return 255
        brightest = int(frame.max())
        return next(2**bits - 1 for bits in (10, 12, 14, 16) if brightest < 2**bits)
    if frame.dtype == np.uint8 and bit_depth > 8:
        raise InputError(f"camera {camera}: found a frame of 8 bit, expected {bit_depth} bit, the given bit depth")
    scale = 2**bit_depth - 1
    if frame.dtype == np.uint16 and (brightest := int(frame.max())) > scale:
        raise InputError(
            f"camera {camera}: found a grey value of {brightest}, expected at most {scale} ({bit_depth} bit)"
        )
    return scale
