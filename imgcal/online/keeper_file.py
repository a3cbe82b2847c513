"""The file of a rig that is kept calibrated: what people want to read, and all that is needed to go on exactly."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imgcal.errors import InputError
from imgcal.io import object_text, rig_text, write_text
from imgcal.messages import shortened
from imgcal.online.events import iso_time, snapshot_name
from imgcal.online.memory import Frozen, Thawed
from imgcal.types import CalibrationObject, CameraRig

FORMAT = "imgcal-keeper/5"
"""Another number whenever what is remembered is laid out anew: nobody can go on from a state of another version."""
MOST_BYTES = 2**28


@dataclass(frozen=True)
class KeeperFile:
    """A keeper at one moment. Made within milliseconds; `write` may run in another thread, while the keeper goes on."""

    time: float
    snapshot: int
    sentence: str
    cameras: dict[str, str]
    rig: CameraRig
    factory: CameraRig
    obj: CalibrationObject
    memory: Frozen
    progress: dict[str, Any] | None = None  # of whoever saves it

    def text(self) -> str:
        """What the file holds: JSON, the part for people first."""
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
        memory = json.dumps(self.memory.plain(), allow_nan=False)
        return f'{json.dumps(readable, indent=1, ensure_ascii=False)[:-2]},\n "memory": {memory}\n}}\n'

    def write(self, path: str | Path) -> None:
        """Replace the file in one step.

        Raises:
            InputError: it cannot be written.
        """
        write_text(path, self.text())


def read_memory(path: str | Path) -> dict[str, Any]:
    """Read what a keeper remembers.

    Raises:
        InputError: one line with the file, what was found and what was expected.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise InputError(f"{path}: found no such file, expected the state of a rig that is kept calibrated")
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path}: found {path.stat().st_size:,} bytes, expected at most {MOST_BYTES:,}")
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    try:
        values = json.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON: {shortened(str(error))}") from error
    found = values.get("format") if isinstance(values, dict) else None
    if found != FORMAT and isinstance(found, str) and found.startswith(FORMAT[: FORMAT.index("/") + 1]):
        raise InputError(
            f"{path}: found the state of another version of imgcal ({shortened(found)}), expected {FORMAT}: it "
            'cannot be gone on with; the rig that it knew stands in it as "rig"'
        )
    if found != FORMAT:
        raise InputError(f'{path}: found format {shortened(repr(found))}, expected "{FORMAT}"')
    try:
        memory = Thawed(values.get("memory")).value
    except (ValueError, RecursionError) as error:
        raise unusable(path, error) from error
    if not isinstance(memory, dict):
        raise InputError(f"{path}: found no memory, expected that of a rig that is kept calibrated")
    return memory


def unusable(path: str | Path, error: Exception) -> InputError:
    """Say that a file was changed since it was written."""
    return InputError(f"{path}: found a memory that was not written here ({shortened(str(error))})")
