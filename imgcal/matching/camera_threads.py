"""Threads that process all cameras at once, for functions that release the GIL, such as OpenCV and compiled ones."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

Result = TypeVar("Result")


def each_camera(function: Callable[[int], Result], cameras: Iterable[int]) -> list[Result]:
    """Call a function for each camera and return the results in order.

    The threads, one per core, start with the first call and end with the process. The function must not call
    `each_camera` itself.

    Examples:
        >>> each_camera(lambda camera: camera**2, [3, 0, 2])
        [9, 0, 4]
    """
    return list(_pool(os.getpid()).map(function, cameras))


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Create the threads of a process; a forked process does not inherit its parent's."""
    return ThreadPoolExecutor(os.cpu_count() or 1, f"cameras-{process}")
