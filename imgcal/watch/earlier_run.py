"""What an earlier run left in its folder, and what of that applies to the source of this run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from imgcal.errors import InputError
from imgcal.io import read_json
from imgcal.watch.exposures import FileStamp, Source
from imgcal.watch.folder import Folder
from imgcal.watch.learning import adapted_networks
from imgcal.watch.recordings import BlobTable
from imgcal.watch.rig_files import STATE
from imgcal.watch.synchronization import TimedSnapshot


@dataclass(frozen=True)
class Progress:
    """Position in a source."""

    time: float  # s, time of the last snapshot
    name: str | None = None  # its name, if the source names snapshots
    era: int = 0  # number of joint jumps of all clocks before it
    first: int | None = None  # digest of the first snapshot of the source that shows anything; None = unknown
    logged: int | None = None  # size of events.jsonl at that time, in bytes
    tables: Mapping[str, int] = field(default_factory=dict)  # the same of tables of poses, by path; rows may follow
    snapshot: int = 0  # number of the last snapshot's update
    source: str | None = None  # identity of the source; None = unknown
    rate: float | None = None  # snapshots per second of a source without times
    files: Mapping[str, FileStamp] = field(default_factory=dict)  # of the last snapshot, by camera, if it has files

    @classmethod
    def load(cls, folder: Path) -> Progress | None:
        """Read it from the state file, so that both are consistent; None = there is none.

        Raises:
            InputError: the file is not a state file.
        """
        path = folder / STATE
        if not path.is_file():
            return None
        try:
            entry = read_json(path.read_text())["progress"]
            if entry is None:
                return None
            time, name, logged = float(entry["time"]), entry["name"], entry.get("logged")
            source, rate, first = entry.get("source"), entry.get("rate"), entry.get("first")
            if not all(text is None or isinstance(text, str) for text in (name, source)):
                raise ValueError("a name is not text")
            if not all(number is None or isinstance(number, int) for number in (logged, first)):
                raise ValueError("a length or digest is not a number")
            files = {
                camera: FileStamp(str(file), int(content))
                for camera, (file, content) in dict(entry.get("files", ())).items()
            }
            rate = None if rate is None else float(rate)
            tables = {str(path): int(size) for path, size in dict(entry.get("tables", ())).items()}
            era, snapshot = int(entry.get("era", 0)), int(entry.get("snapshot", 0))
            return cls(time, name, era, first, logged, tables, snapshot, source, rate, files)
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise InputError(f"{path}: found something that imgcal watch did not write") from error


@dataclass(frozen=True)
class Known:
    """How much of a recording an earlier run has processed."""

    time: float  # s, time of the last snapshot
    name: str | None = None  # its name, if the recording names snapshots
    era: int = 0  # number of joint jumps of all clocks before it
    first: int | None = None  # digest of the first snapshot that shows anything, to be compared; None = decided
    another: bool = False  # that was another recording: this one must be later
    mismatch: str | None = None  # why the same recording cannot be resumed

    @property
    def is_same(self) -> bool:
        """Whether this surely is that recording."""
        return self.first is None and not self.another

    def compare(self, first: int) -> Known:
        """Decide whether this is that recording, given the digest of its first snapshot that shows anything.

        Raises:
            InputError: it is, and cannot be resumed.
        """
        if self.first is None:
            return self
        if self.first == first and self.mismatch is not None:
            raise InputError(self.mismatch)
        return replace(self, first=None, another=self.first != first)

    def includes(self, snapshot: TimedSnapshot) -> bool:
        """Tell whether a snapshot was processed: all up to the one of that name, or otherwise of that time.

        Raises:
            InputError: the snapshot is of another recording, and not later.
        """
        if self.another:
            if snapshot.time > self.time:
                return False
            raise InputError(
                f"found a different recording that begins at {snapshot.time:.9g} s, expected one "
                f"after {self.time:.9g} s; --fresh starts over"
            )
        return self._is_named(snapshot) or (snapshot.era, snapshot.time) <= (self.era, self.time)

    def ends_with(self, snapshot: TimedSnapshot) -> bool:
        """Tell whether this is the last processed snapshot."""
        return self._is_named(snapshot) and snapshot.name == self.name

    def _is_named(self, snapshot: TimedSnapshot) -> bool:
        return self.name is not None and snapshot.name is not None


@dataclass(frozen=True)
class EarlierRun:
    """What of an earlier run applies to this one. `EarlierRun()`: nothing, as in an empty folder or with `--fresh`."""

    state: Path | None = None  # state file to restore the rig from
    known: Known | None = None  # how much of this recording has been processed
    after: str | None = None  # name of the last processed snapshot of this folder of frames
    logged: int | None = None  # bytes of events.jsonl to keep: what follows will be reported again; None = all
    tables: Mapping[str, int] = field(default_factory=dict)  # the same of tables of poses, by path ...
    snapshot: int = 0  # ... if it is of later snapshots than this one
    networks: tuple[str, str] | None = None  # adapted ones: folders, as `adapted_networks` names them

    @classmethod
    def find(cls, folder: Path, source: Source, identity: str, keep_all: bool = False) -> EarlierRun:
        """Read what is in the output folder, and decide what applies to this source.

        Args:
            folder: output folder.
            source: what is to be read, not begun.
            identity: names the source, as in `Progress.source`.
            keep_all: treat a live source as a recording.

        Returns:
            What applies. If `known.first` is given, only if the source begins with such a snapshot.

        Raises:
            InputError: the state file is not one.
        """
        state, progress = folder / STATE, Progress.load(folder)
        run = cls(state if state.is_file() else None, networks=adapted_networks(folder))
        if progress is None:
            return run
        same = progress.source in (None, identity)  # earlier versions did not note it
        if isinstance(source, Folder):  # skips files by their names
            same = _is_continued(progress, source, same)
            return replace(run._going_on(progress), after=progress.name) if same else run
        if source.live and not keep_all:  # nothing comes twice: what it sent since the last save is lost
            return run
        known = _find_position(progress, source, state)
        if known.first is None and not same:
            return replace(run, known=Known(progress.time, another=True))
        if known.first is None and known.mismatch is not None:
            raise InputError(known.mismatch)
        return replace(run._going_on(progress), known=known)

    def _going_on(self, progress: Progress) -> EarlierRun:
        return replace(self, logged=progress.logged, tables=progress.tables, snapshot=progress.snapshot)

    def as_another(self) -> EarlierRun:
        """What applies to another recording than that of the earlier run: nothing will be reported again."""
        return replace(self, logged=None, tables={})


def _is_continued(progress: Progress, folder: Folder, same_place: bool) -> bool:
    """Tell whether a folder holds what was read, perhaps at another place; at the same one, frames may be gone."""
    count, (kept, missing) = len(progress.files), folder.compare(progress.files)
    if not same_place:
        return kept == count > 0
    if progress.name is None or kept or missing < count or not count:
        return kept + missing == count
    return not folder.begins_anew(progress.name, progress.time)


def _find_position(progress: Progress, source: Source, state: Path) -> Known:
    """Find how much of the same recording has been processed: by name; by time where the name no longer exists."""
    known = Known(progress.time, progress.name, progress.era, progress.first)
    if not isinstance(source, BlobTable):
        return known
    if progress.rate not in (None, source.rate):
        found = f"--rate: found {source.rate:g}, expected {progress.rate:g} as in {state}"
        known = replace(known, mismatch=f"{found}; --fresh starts over")
    return known if progress.name in source.blobs.snapshot_names else replace(known, name=None)
