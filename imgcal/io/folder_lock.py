"""A folder that one process owns while it works there: no other process writes between its files."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from imgcal.errors import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

TAKEN = {errno.EWOULDBLOCK, errno.EACCES}


@contextlib.contextmanager
def holding(folder: str | Path) -> Iterator[Path]:
    """Make a folder if need be, and lock it until the block ends.

    The lock is the system's: it ends with the process, however that ends, and leaves no file. Windows and some network
    shares have none; there no process is kept out. Folders that were made and stay empty are removed.

    Yields:
        The folder.

    Raises:
        InputError: it cannot be made, or another process, or another block of this one, holds it.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as parent:
        ...     with holding(Path(parent) / "out") as folder:
        ...         folder.is_dir()
        ...     folder.exists()
        True
        False
    """
    folder = Path(folder)
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made: {error.strerror or error}") from error
    try:
        with _lock(folder):
            yield folder
    finally:
        for made in missing:
            with contextlib.suppress(OSError):
                made.rmdir()  # only where it is empty


@contextlib.contextmanager
def _lock(folder: Path) -> Iterator[None]:
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in TAKEN:
                raise InputError(f"{folder}: another imgcal is using this folder: choose another one") from error
        yield
    finally:
        os.close(descriptor)
