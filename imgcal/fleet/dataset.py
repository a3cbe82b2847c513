"""The results of a fleet: a Parquet dataset, partitioned by day, to which whole files are added and none is changed."""

from __future__ import annotations

import contextlib
import datetime
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imgcal.errors import InputError
from imgcal.fleet.job import TRANSIENT
from imgcal.fleet.manifest import short_reason
from imgcal.io import write_text

FOLDER, LOCK = "results", ".lock"
NO_DAY = "unknown"
ROWS, SECONDS = 4096, 30.0
"""Rows that are written together, and how long they may wait: what a kill can cost."""


def schema() -> Any:
    """Columns of the dataset; those from `cameras` on are null where the status is not `ok`."""
    import pyarrow as pa

    numbers, text = pa.list_(pa.float64()), pa.string()
    return pa.schema([
        ("item", text), ("key", text), ("device", text), ("time", pa.timestamp("us", "UTC")), ("capture", text),
        ("rig", text), ("object", text), ("given", pa.map_(text, pa.float64())), ("status", text), ("reason", text),
        ("seconds", pa.float64()), ("cpu_seconds", pa.float64()), ("written", pa.timestamp("us", "UTC")),
        ("cameras", pa.list_(text)), ("lenses", pa.list_(text)), ("parameters", pa.list_(text)), ("identity", text),
        ("offset", numbers), ("std", numbers), ("prior_std", numbers), ("unit", numbers),
        ("whitened_offset", numbers), ("information_factor", pa.list_(pa.float64())), ("inflation", pa.float64()),
        ("rms_px", pa.float64()), ("chi2_per_dof", pa.float64()), ("snapshots", pa.int32()), ("labels", pa.int32()),
        ("outliers", pa.int32()), ("moved", pa.list_(text)), ("rig_file", text),
    ])  # fmt: skip


@dataclass
class Keys:
    """Which captures are done: 8 bytes each, so that millions fit."""

    done: NDArray[np.uint64] = field(default_factory=lambda: np.empty(0, np.uint64))  # sorted
    new: set[int] = field(default_factory=set)

    def add(self, keys: Sequence[str]) -> None:
        """Remember keys."""
        self.new.update(_short(key) for key in keys if key)
        if len(self.new) > 65536:
            self.done = np.union1d(self.done, np.fromiter(self.new, np.uint64, len(self.new)))
            self.new = set()

    def __contains__(self, key: str) -> bool:
        if not key:
            return False
        short = _short(key)
        place = int(np.searchsorted(self.done, np.uint64(short)))
        return short in self.new or (place < len(self.done) and int(self.done[place]) == short)

    def __len__(self) -> int:
        return len(self.done) + len(self.new)

    def freeze(self) -> Keys:
        """Copy for other processes."""
        return Keys(np.union1d(self.done, np.fromiter(self.new, np.uint64, len(self.new))))


def _short(key: str) -> int:
    return int(key[:16], 16)


@dataclass(frozen=True)
class Dataset:
    """A folder of results."""

    out: Path

    @property
    def folder(self) -> Path:
        """Where the Parquet files are."""
        return self.out / FOLDER

    @contextlib.contextmanager
    def open_writer(self) -> Iterator[Writer]:
        """Add to the dataset under a lock.

        Raises:
            InputError: the folder cannot be written, or another run is writing to it.
        """
        from filelock import FileLock, Timeout

        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = FileLock(self.out / LOCK, timeout=0)
            lock.acquire()
        except Timeout as error:
            raise InputError(
                f"{self.out}: another run is writing to it: wait until it ends, or choose another folder"
            ) from error
        except OSError as error:
            raise InputError(f"{self.out}: cannot be written: {short_reason(error)}") from error
        writer = Writer(self)
        try:
            for left in self.folder.glob("day=*/.*.part"):
                left.unlink(missing_ok=True)  # of a run that was killed
            yield writer
        finally:
            try:
                writer.flush()
            finally:
                lock.release()

    def write_rigs(self, folder: Path) -> None:
        """Write the rig file of every recalibrated capture that kept one: FOLDER/<device>-<item>.yaml.

        The file of a capture that no longer has one is deleted.
        """
        folder.mkdir(parents=True, exist_ok=True)
        columns = self.latest(("device", "status", "rig_file")).to_pydict()
        for item, device, text in zip(columns["item"], columns["device"], columns["rig_file"], strict=True):
            name = "".join(c if c.isalnum() or c in "-_" else "_" for c in device)[:60]
            path = folder / f"{name}-{item[:8]}.yaml"
            if text is None:
                path.unlink(missing_ok=True)
            else:
                write_text(path, text)

    def files(self) -> list[Path]:
        """All files, oldest first."""
        return sorted(self.folder.glob("day=*/*.parquet"), key=lambda path: path.name)

    def keys(self, *, again: bool = False, rigs: bool = False) -> Keys:
        """Read which captures are done: those whose latest result belongs to their content.

        Args:
            again: those that failed for a reason which may be gone are not.
            rigs: those without their rig file are not.
        """
        items, keys, done = [np.empty(0, np.uint64)], [np.empty(0, np.uint64)], [np.empty(0, np.bool_)]
        for path in self.files():
            columns = self._read(path, ["item", "key", "status", *(["rig_file"] if rigs else [])])
            key, status = columns["key"].to_pylist(), columns["status"].to_pylist()
            items.append(np.array([_short(item) for item in columns["item"].to_pylist()], np.uint64))
            keys.append(np.array([_short(one) if one else 0 for one in key], np.uint64))
            left = [not one or (again and what in TRANSIENT) for one, what in zip(key, status, strict=True)]
            if rigs:
                without = columns["rig_file"].is_null().to_pylist()
                left = [some or (lost and what == "ok") for some, lost, what in zip(left, without, status, strict=True)]
            done.append(~np.array(left, np.bool_))
        # A capture that has changed back is done again: its latest result counts, whatever came before.
        item, key, is_done = (np.concatenate(parts)[::-1] for parts in (items, keys, done))
        _, latest = np.unique(item, return_index=True)
        return Keys(np.unique(key[latest][is_done[latest]]))

    def latest(self, columns: Sequence[str] | None = None) -> Any:
        """Read the latest result of each row of the manifest as an Arrow table; `columns`: only these.

        Raises:
            InputError: there are no results, or a file cannot be read.
        """
        import pyarrow as pa

        wanted = None if columns is None else [*dict.fromkeys(("item", *columns))]
        tables = [self._read(path, wanted) for path in self.files()]
        if not tables:
            raise InputError(f"{self.folder}: found no results, expected those of a run of `imgcal fleet`")
        # Older files may lack a column, or be less precise.
        table = pa.concat_tables(tables, promote_options="permissive")
        last: dict[str, int] = {item: row for row, item in enumerate(table["item"].to_pylist())}
        return table.take(sorted(last.values()))

    def _read(self, path: Path, columns: Sequence[str] | None) -> Any:
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            with open(path, "rb") as file:  # alone: names of folders are no columns
                return pq.ParquetFile(file).read(None if columns is None else list(columns))
        except (OSError, pa.ArrowException) as error:
            raise InputError(
                f"{path}: cannot be read: {short_reason(error)}; expected results of `imgcal fleet`"
            ) from error


class Writer:
    """Gathers rows and writes them, a file for each day among them."""

    def __init__(self, dataset: Dataset) -> None:
        """Start empty; `Dataset.written` makes one."""
        self.dataset = dataset
        self._rows: list[dict[str, Any]] = []

    @cached_property
    def _schema(self) -> Any:
        return schema()

    def add(self, rows: Sequence[dict[str, Any]]) -> None:
        """Take rows; they are safe after the next `flush`."""
        self._rows += rows

    @property
    def waiting(self) -> int:
        """Rows that are not written yet."""
        return len(self._rows)

    def flush(self) -> None:
        """Write what is waiting.

        Raises:
            InputError: it cannot be written, for want of space for example; the rows wait on.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        days: dict[str, list[dict[str, Any]]] = {}
        now = datetime.datetime.now(datetime.UTC)
        for row in self._rows:
            days.setdefault(_day(row), []).append(row | {"written": now})
        for day, rows in days.items():
            folder = self.dataset.folder / f"day={day}"
            name = f"{now:%Y%m%dT%H%M%S%f}-{secrets.token_hex(4)}"
            part = folder / f".{name}.part"
            try:
                folder.mkdir(exist_ok=True)
                pq.write_table(pa.Table.from_pylist(rows, self._schema), part, compression="zstd")
                part.replace(folder / f"{name}.parquet")
            except OSError as error:
                with contextlib.suppress(OSError):
                    part.unlink(missing_ok=True)
                raise InputError(
                    f"{folder}: cannot be written: {short_reason(error)}; {self.waiting} results were not saved"
                ) from error
            self._rows = [row for row in self._rows if _day(row) != day]


def _day(row: dict[str, Any]) -> str:
    return NO_DAY if row["time"] is None else row["time"].date().isoformat()
