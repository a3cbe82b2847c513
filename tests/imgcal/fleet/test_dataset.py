import errno
from pathlib import Path
from typing import Any

import pytest

import imgcal
from imgcal.fleet import Dataset, Item
from imgcal.fleet.dataset import Keys
from imgcal.fleet.job import failed_row


def row(number: int, status: str = "ok", time: float | None = 0.0, key: str | None = None) -> dict[str, Any]:
    item = Item(number, f"{number}.csv", "T4", "cube8", f"d{number}", time)
    return failed_row(item, status, "") | {"key": f"{number:016x}{0:016x}" if key is None else key}


def test_keys_in_little_memory() -> None:
    keys = Keys()
    some = [f"{i * 2654435761 % 2**64:016x}{'0' * 16}" for i in range(70000)]
    keys.add(some[:69990])
    assert len(keys) == 69990 and all(key in keys for key in some[:69990:997])
    assert not any(key in keys for key in some[69990:]) and "" not in keys
    assert keys.freeze().done.nbytes == 8 * 69990 and some[69989] in keys.freeze()


def test_rows_by_day_and_the_last_word_counts(tmp_path: Path) -> None:
    dataset = Dataset(tmp_path)
    with dataset.open_writer() as writer:
        writer.add([row(1), row(2, "crashed"), row(3, time=None)])
    with dataset.open_writer() as writer:
        writer.add([row(2, "ok")])
    assert {path.parent.name for path in dataset.files()} == {"day=1970-01-01", "day=unknown"}
    latest = dataset.latest(("device", "status")).to_pydict()
    assert dict(zip(latest["device"], latest["status"], strict=True)) == {"d1": "ok", "d2": "ok", "d3": "ok"}
    assert len(dataset.keys()) == 3


def test_files_of_an_older_version_lack_a_column(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    dataset = Dataset(tmp_path)
    with dataset.open_writer() as writer:
        writer.add([row(1)])
    (path,) = dataset.files()
    pq.write_table(pq.ParquetFile(path).read().drop_columns(["cpu_seconds"]), path)
    with dataset.open_writer() as writer:
        writer.add([row(2)])
    for table in (dataset.latest(), dataset.latest(("device", "cpu_seconds"))):
        rows = {one["device"]: one["cpu_seconds"] for one in table.to_pylist()}
        assert rows == {"d1": None, "d2": 0.0}


def test_what_may_go_better_next_time_is_not_done(tmp_path: Path) -> None:
    dataset = Dataset(tmp_path)
    with dataset.open_writer() as writer:
        writer.add([row(1, "timed_out"), row(2, "refused")])
    assert len(dataset.keys()) == 2 and len(dataset.keys(again=True)) == 1


def test_two_runs_into_one_folder(tmp_path: Path) -> None:
    dataset = Dataset(tmp_path)
    with dataset.open_writer(), pytest.raises(imgcal.InputError, match="another run"), Dataset(tmp_path).open_writer():
        pass
    with dataset.open_writer():
        pass


def test_a_full_disk_loses_nothing_that_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pyarrow.parquet as pq

    dataset, write = Dataset(tmp_path), pq.write_table
    with dataset.open_writer() as writer:
        writer.add([row(1)])

    def full(table: Any, path: Path, **options: Any) -> None:
        write(table, path, **options)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pq, "write_table", full)
    with pytest.raises(imgcal.InputError, match="No space left"), dataset.open_writer() as writer:
        writer.add([row(2)])
    assert dataset.latest(("device",)).to_pydict()["device"] == ["d1"]
    assert not list(tmp_path.rglob("*.part"))


def test_what_a_killed_run_left_is_swept(tmp_path: Path) -> None:
    left = tmp_path / "results" / "day=unknown" / ".x.part"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"PAR1")
    with Dataset(tmp_path).open_writer():
        assert not left.exists()
    with pytest.raises(imgcal.InputError, match="found no results"):
        Dataset(tmp_path).latest()
