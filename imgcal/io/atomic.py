"""Writing files so that a reader sees the old content or the new one, never a part."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from imgcal.errors import InputError


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """Open a temporary file in the folder of `path` that takes its place when the block ends without an exception.

    Args:
        path: the file to write. Its folder must exist.

    Yields:
        A binary file, open for writing.

    Raises:
        InputError: the folder is missing or not writable, or `path` is a folder or a device.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        # A rename would replace even /dev/null.
        raise InputError(f"{path}: found a folder or device, expected a file that can be written")
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with open(temporary, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):  # the first error is reported already
            temporary.unlink(missing_ok=True)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Replace a file by `content` in one step."""
    with replacing(path) as file:
        file.write(content)


def write_text(path: str | Path, content: str) -> None:
    """Replace a file by `content`, in UTF-8, in one step."""
    write_bytes(path, content.encode())
