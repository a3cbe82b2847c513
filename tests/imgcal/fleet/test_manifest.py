import datetime
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet
import pytest

import imgcal
from imgcal.fleet import Manifest, Settings, write_manifest
from imgcal.fleet.job import process
from imgcal.fleet.manifest import _base_folder


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


def test_a_device_may_be_any_text_or_number(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("capture,device\na,NA\nb,null\nc,0\nd,\n")
    assert [item.device for item in items(tmp_path / "m.csv")] == ["NA", "null", "0", ""]
    pyarrow.parquet.write_table(pa.table({"capture": ["a", "b"], "device": [0, None]}), tmp_path / "m.parquet")
    assert [item.device for item in items(tmp_path / "m.parquet")] == ["0", ""]


def test_names_of_shipped_files_beside_a_table_at_an_address() -> None:
    for name in ("T4", "asymmetric8", "sample:O10"):
        assert _base_folder("s3://bucket/fleet/m.csv", name) == name
    assert _base_folder("s3://bucket/fleet/m.csv", "frames") == "s3://bucket/fleet/frames"


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
    assert two.fault == "row 1: found no capture, expected one in its column"
    assert (
        items(tmp_path / "m.csv")[0].fault == "row 0: found no rig, expected one in its column, or --rig for all rows"
    )


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("m.csv", b"frames,rig\na,b\n", "expected capture among them"),
        ("m.csv", b"capture,rig\na,b\na,b,c\n", "found 3 cells in line 3, expected 2 as in the first line"),
        ("m.csv", b"", "found an empty file, expected a CSV table"),
        ("m.csv", b"capture\nM\xfcller.csv\n", "found bytes in line 2 that are not UTF-8 text"),
        ("m.csv", b"capture,x\na," + b"x" * 3_000_000 + b"\n", "found a line of a megabyte or more"),
        ("m.parquet", b"capture\na\n", "found another kind of file, or the end is missing, expected a Parquet table"),
        ("m.parquet", b"", "found an empty file, expected a Parquet table"),
    ],
)
def test_a_table_that_is_none(tmp_path: Path, name: str, content: bytes, expected: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(imgcal.InputError, match=expected):
        items(tmp_path / name)
    if name.endswith(".parquet"):
        with pytest.raises(imgcal.InputError, match=expected):
            Manifest(str(tmp_path / name)).count()


def test_damage_within_a_parquet_table_is_one_line(tmp_path: Path) -> None:
    pyarrow.parquet.write_table(pa.table({"capture": ["a"] * 100_000}), tmp_path / "m.parquet")
    content = bytearray((tmp_path / "m.parquet").read_bytes())
    content[50:80] = b"\xff" * 30
    (tmp_path / "m.parquet").write_bytes(content)
    with pytest.raises(imgcal.InputError, match="found something else, or damage, expected a Parquet table"):
        items(tmp_path / "m.parquet")


def test_a_cell_that_is_no_number_ends_nothing_however_late_it_comes(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("capture,temperature\n" + "a.csv,20.5\n" * 200_000 + "b.csv,hot\n")
    found = items(tmp_path / "m.csv", rig="T4", object="cube8")
    assert len(found) == 200_001 and found[199_999].given == (("temperature", 20.5),)
    assert found[-1].given == () and found[-1].fault is None


@pytest.mark.parametrize("time", ["inf", "-inf", "1e18", "-1e14", "99999999999999999999999", "2026-13-01"])
def test_a_time_out_of_range_is_a_fault_of_its_row(time: str, tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(f"capture,time\na.csv,{time}\nb.csv,2026-01-02\n")
    one, two = items(tmp_path / "m.csv", rig="T4", object="cube8")
    assert one.fault.startswith("row 0: found time") and one.time is None
    assert two.fault is None
    assert process(one, Settings())["status"] == "unusable"


@pytest.mark.parametrize("hours", ["-1e5", "-1", "1e9"])
def test_an_impossible_age_is_a_fault_of_its_row(hours: str, tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(f"capture,hours\na.csv,{hours}\nb.csv,0\n")
    one, two = items(tmp_path / "m.csv", rig="T4", object="cube8")
    assert one.fault == f"row 0: hours: found {float(hours):g}, expected 0 to 1e+06 h"
    assert two.fault is None and two.given == (("hours", 0.0),)
    assert process(one, Settings())["status"] == "unusable"


@pytest.mark.parametrize(
    ("column", "value", "fault"),
    [
        ("time", datetime.date(2026, 1, 2), None),
        ("time", datetime.timedelta(3), "found time"),
        ("time", {"a": 1}, "found time"),
        ("capture", b"a\xff", "found capture"),
        ("device", ["a"], "found device"),
        ("capture", "a" * 5000 + ".csv", None),
        ("capture", "a\0b", None),
    ],
)
def test_a_value_of_any_type_ends_nothing(column: str, value: object, fault: str | None, tmp_path: Path) -> None:
    pyarrow.parquet.write_table(pa.table({"capture": ["a"]} | {column: [value]}), tmp_path / "m.parquet")
    (item,) = items(tmp_path / "m.parquet", rig="T4", object="cube8")
    assert (item.fault is None) == (fault is None) and (fault or "") in (item.fault or "")
    assert process(item, Settings())["status"] == "unusable"


def test_a_missing_manifest(tmp_path: Path) -> None:
    with pytest.raises(imgcal.InputError, match="cannot be read"):
        items(tmp_path / "none.csv")
