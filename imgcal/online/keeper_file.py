"""The state file of a rig that is kept calibrated: a readable part, and everything needed to resume exactly."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imgcal.errors import InputError
from imgcal.io import object_text, rig_text, write_text
from imgcal.messages import shorten
from imgcal.online.events import iso_time, snapshot_name
from imgcal.online.state_document import StateReader, StateWriter
from imgcal.types import CalibrationObject, CameraRig

FORMAT = "imgcal-keeper/10"
"""Raise the number when a key or type of `state_document` changes; a state of another version is not read."""
MOST_BYTES = 2**28


@dataclass(frozen=True)
class KeeperFile:
    """A keeper's state at one moment, made within milliseconds; `write` may run in another thread meanwhile."""

    time: float
    snapshot: int
    sentence: str
    cameras: dict[str, str]
    rig: CameraRig
    factory: CameraRig
    obj: CalibrationObject
    state: dict[str, Any]  # plain values that refer to ...
    tables: StateWriter  # ... the arrays and beliefs in here
    progress: dict[str, Any] | None = None  # the caller's

    def text(self) -> str:
        """Content of the file: JSON, the readable part first."""
        readable = {
            "format": FORMAT,
            "time": iso_time(self.time),
            "snapshot": snapshot_name(max(self.snapshot, 0)),
            "sentence": self.sentence,
            "cameras": self.cameras,
            "progress": self.progress,
            "rig": rig_text(self.rig).splitlines(),
            "factory": rig_text(self.factory).splitlines(),
            "object": object_text(self.obj).splitlines(),
        }
        state = json.dumps({**self.state, **self.tables.tables()}, allow_nan=False)
        start = json.dumps({**readable, "sha256": _digest(state)}, indent=1, ensure_ascii=False)[:-2]
        return f'{start},\n "state": {state}\n}}\n'

    def write(self, path: str | Path) -> None:
        """Replace the file atomically.

        Raises:
            InputError: the file cannot be written.
        """
        write_text(path, self.text())


def _digest(state: str) -> str:
    return hashlib.sha256(state.encode()).hexdigest()


def read_state(path: str | Path) -> tuple[dict[str, Any], StateReader]:
    """Read a keeper's state: plain values, and a reader for them.

    Raises:
        InputError: one line with the file, what was found and what was expected.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise InputError(
                f"{path}: no such file, expected the state of a running rig (RigKeeper.save, imgcal watch)"
            )
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path}: found {path.stat().st_size:,} bytes, expected at most {MOST_BYTES:,}")
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    try:
        values = json.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON: {shorten(str(error))}") from error
    found = values.get("format") if isinstance(values, dict) else None
    if found != FORMAT and isinstance(found, str) and found.startswith(FORMAT[: FORMAT.index("/") + 1]):
        age = "earlier" if (len(found), found) < (len(FORMAT), FORMAT) else "later"
        raise InputError(
            f"{path}: state files from {age} versions cannot be resumed: found "
            f'{shorten(found)}, expected {FORMAT}; the file holds the last rig as "rig"'
        )
    if found != FORMAT:
        raise InputError(f'{path}: found format {shorten(repr(found))}, expected "{FORMAT}"')
    state = values.get("state")
    if not isinstance(state, dict):
        raise InputError(f"{path}: found no state of a running rig (RigKeeper.save, imgcal watch)")
    try:
        if _digest(json.dumps(state)) != values.get("sha256"):
            raise ValueError("its sha256 does not match")
        return state, StateReader(state)
    except (ValueError, RecursionError) as error:
        raise unusable_error(path, error) from error


def unusable_error(path: str | Path, error: Exception) -> InputError:
    """Make the error for a file that was changed since it was written."""
    return InputError(f"{path}: the state was changed since it was written, or is damaged ({shorten(str(error))})")
