"""Resources of the machine that this process may use."""

import os


def usable_cores() -> int:
    """Count the cores that this process may use; all cores on systems that do not report this (macOS, Windows).

    Examples:
        >>> usable_cores() >= 1
        True
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
