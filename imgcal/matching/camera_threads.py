"""Work on all cameras at once, in threads: for what lets go of the interpreter, as OpenCV and compiled functions do."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

Result = TypeVar("Result")


def each_camera(function: Callable[[int], Result], cameras: Iterable[int]) -> list[Result]:
    """Call a function for each camera and give the results in order.

    The threads, one a core, begin with the first call and end with the process. A function that is called must not call
    this one.

    Examples:
        >>> each_camera(lambda camera: camera**2, [3, 0, 2])
        [9, 0, 4]
    """
    return list(_pool(os.getpid()).map(function, cameras))


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Make the threads of a process: one that was forked has none of its parent's."""
    return ThreadPoolExecutor(os.cpu_count() or 1, f"cameras-{process}")
