"""Keep freed memory in the process, since every snapshot needs it again."""

from __future__ import annotations

import ctypes

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # as glibc's malloc.h numbers them
KEPT, LARGEST = 256 << 20, 32 << 20  # bytes: that are free and kept, and of an array that is


def keep_memory() -> bool:
    """Let the allocator keep what was freed, and tell whether it does: glibc's can.

    Networks and maps make arrays of some megabytes for every snapshot. Given back each time, their pages are new each
    time, and the kernel takes longer to clear them than the arithmetic takes.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library, or Windows
        return False
    return bool(mallopt(TRIM_THRESHOLD, KEPT) and mallopt(MMAP_THRESHOLD, LARGEST))
