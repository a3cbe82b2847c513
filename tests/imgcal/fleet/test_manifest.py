import datetime
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet
import pytest

import imgcal
from imgcal.fleet import Manifest, write_manifest


def items(path: Path, **kwargs: str) -> list[object]:
    return [item for batch in Manifest(str(path), **kwargs).batches(2) for item in batch]


def test_paths_times_and_numbers(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("")
    rows = [
        {"capture": "a.csv", "rig": "rig.yaml", "object": "cube8", "device": "17", "time": "2026-01-02",
         "temperature": 21},
        {"capture": "/b", "rig": "T4", "object": "sub/o.csv", "device": "x", "time": "86400", "temperature": None},
        {"capture": "s3://bucket/c", "rig": None, "object": None, "device": None, "time": None, "temperature": 0.5},
    ]  # fmt: skip
    write_manifest(tmp_path / "m.csv", rows)
    one, two, three = items(tmp_path / "m.csv", rig="O10", object="asymmetric8")
    assert (one.capture, one.rig, one.object) == (str(tmp_path / "a.csv"), str(tmp_path / "rig.yaml"), "cube8")
    assert (one.device, one.given) == ("17", (("temperature", 21.0),))
    assert one.time == datetime.datetime(2026, 1, 2, tzinfo=datetime.UTC).timestamp()
    assert (two.capture, two.rig, two.object) == ("/b", "T4", str(tmp_path / "sub/o.csv"))
    assert (two.time, two.given) == (86400.0, ())
    assert (three.capture, three.rig, three.device, three.time) == ("s3://bucket/c", "O10", "", None)
    assert [one.row, two.row, three.row] == [0, 1, 2]


def test_parquet_with_time_stamps(tmp_path: Path) -> None:
    moment = datetime.datetime(2026, 1, 2, 3, tzinfo=datetime.UTC)
    table = pa.table({"capture": ["a", "b"], "time": [moment, None]})
    pyarrow.parquet.write_table(table, tmp_path / "m.parquet")
    manifest = Manifest(str(tmp_path / "m.parquet"), "T4", "cube8")
    assert manifest.count() == 2
    assert [item.time for batch in manifest.batches(9) for item in batch] == [moment.timestamp(), None]


def test_a_row_that_cannot_be_used_says_so_and_ends_nothing(tmp_path: Path) -> None:
    write_manifest(tmp_path / "m.csv", [{"capture": "a", "time": "noon"}, {"capture": None, "time": None}])
    one, two = items(tmp_path / "m.csv", rig="T4", object="cube8")
    assert "row 0: found time 'noon'" in one.fault
    assert "row 1: found no capture" in two.fault
    assert "found no rig" in items(tmp_path / "m.csv")[0].fault or "noon" in items(tmp_path / "m.csv")[0].fault


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("m.csv", b"frames,rig\na,b\n", "expected capture among them"),
        ("m.csv", b"capture,rig\na,b,c\n", "no CSV table"),
        ("m.parquet", b"capture\na\n", "no Parquet table"),
    ],
)
def test_a_table_that_is_none(tmp_path: Path, name: str, content: bytes, expected: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(imgcal.InputError, match=expected):
        items(tmp_path / name)


def test_a_missing_manifest(tmp_path: Path) -> None:
    with pytest.raises(imgcal.InputError, match="cannot be read"):
        items(tmp_path / "none.csv")
