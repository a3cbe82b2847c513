"""Writing files and folders so that a reader sees the old content or the new one, never a part.

A folder is filled beside its old content, in a hidden folder within it, and then published by renames. Its mark, such
as result.json or frames/, is the first to go and the last to come: where the mark is, everything belongs to it,
wherever the power failed.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

from imgcal.errors import InputError

PREFIX, OLD = ".unfinished-", ".old"
PREVIOUS = "previous"
"""Folder beside the files of a run without a result: what the last run with one wrote, one generation."""
DEAD_AFTER = 3600.0  # s without a new file: the run that was filling the folder has been killed


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


@contextlib.contextmanager
def publishing(folder: str | Path, names: Sequence[str], mark: str) -> Iterator[Path]:
    """Fill a folder in one step: what the block writes is published when it ends without an exception.

    Args:
        folder: made when it is not there; files of other names in it are left alone.
        names: of the files and folders that this writer may write. Old files of these names are removed even where
            the block writes no new ones; what the block writes beyond them is published, too.
        mark: one of `names`, which tells readers that the folder is complete.

    Yields:
        A new folder to write to.

    Raises:
        InputError: something cannot be written, or one of the names is a folder or device already. The old content
            is as it was.
    """
    folder = Path(folder)
    made = not folder.exists()
    stage = folder / f"{PREFIX}{secrets.token_hex(4)}"
    try:
        stage.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror or error}") from error
    try:
        _sweep(folder)
        yield stage
        _exchange(folder, stage, names, mark)
    except InputError as error:
        # Report errors for the path where the user expects the file.
        raise InputError(str(error).replace(str(stage), str(folder))) from error
    finally:
        if (folder / mark).exists() or not any((stage / OLD).glob("*")):  # all of the new, or of the old, is there
            shutil.rmtree(stage, ignore_errors=True)
        if made:
            with contextlib.suppress(OSError):
                folder.rmdir()  # only where nothing came of it


def keep_previous(folder: Path, stage: Path, names: Sequence[str]) -> None:
    """Move the files of an earlier run that will be replaced into the subfolder `previous`.

    They are published before anything is replaced: wherever the power fails, they are in the folder or below it.

    Args:
        folder: as for `publishing`.
        stage: what it yielded.
        names: files to keep, those that are there; what the subfolder held before is removed.
    """
    (stage / PREVIOUS).mkdir()
    for name in names:
        if (folder / name).is_file():
            _link(folder / name, stage / PREVIOUS / name)


def is_unfinished(folder: Path) -> bool:
    """Tell whether a run that fills this folder is still at work, or was killed."""
    return any(folder.glob(f"{PREFIX}*"))


def _exchange(folder: Path, stage: Path, names: Sequence[str], mark: str) -> None:
    """Move the old content out of the way and the new one in; on a failure put everything back."""
    others = sorted({path.name for path in stage.iterdir()} - {*names, PREVIOUS})
    ordered = [*others, *(name for name in names if name != mark), mark]
    for name in ordered:
        if (folder / name).exists() and not (folder / name).is_file():
            raise InputError(f"{folder / name}: found a folder or device, expected nothing or a file to replace")
    (stage / OLD).mkdir()
    away = [(folder / name, stage / OLD / name) for name in reversed(ordered) if os.path.lexists(folder / name)]
    moves = away + [(stage / name, folder / name) for name in ordered if (stage / name).exists()]
    if (stage / PREVIOUS).exists():
        kept = folder / PREVIOUS
        moves = [*([(kept, stage / OLD / PREVIOUS)] if kept.exists() else []), (stage / PREVIOUS, kept), *moves]
    begun: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            begun.append((source, target))
            os.replace(source, target)
    except BaseException as error:
        _undo(begun, stage)
        if isinstance(error, OSError):
            raise InputError(f"{target}: cannot be written: {error.strerror or error}") from error
        raise


def _link(file: Path, target: Path) -> None:
    """Link a file; copy it if the file system has no links."""
    try:
        os.link(file, target)
    except OSError:
        shutil.copy2(file, target)


def _undo(moves: list[tuple[Path, Path]], stage: Path) -> None:
    try:
        for source, target in reversed(moves):
            if not os.path.lexists(source):  # the last one may not have happened
                os.replace(target, source)
    except OSError as error:
        # Its mark is not back yet, so the folder does not count as complete.
        kept = f"what was there before is in {stage.name}/{OLD}"
        raise InputError(f"{stage.parent}: cannot be written: {error.strerror or error}; {kept}") from error


def _sweep(folder: Path) -> None:
    """Remove what a killed run left behind."""
    for left in folder.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):
            newest = max(path.lstat().st_mtime for path in (left, *left.rglob("*")))
            if time.time() - newest > DEAD_AFTER:
                shutil.rmtree(left)
