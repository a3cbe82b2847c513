import csv
import json
import os

import pytest

from imgcal.errors import InputError
from imgcal.watch import PoseFile, forget_rows
from imgcal.watch.poses import COLUMNS
from tests.imgcal.watch.test_poses import record


def written(path, *numbers):
    file = PoseFile(path)
    for number in numbers:
        file.send(record(number, "no_object" if number == 1 else "ok"))
    file.close()


@pytest.mark.parametrize("name", ["poses.csv", "poses.JSONL"])
def test_poses_are_appended_and_half_a_line_is_cut_off(tmp_path, name):
    path = tmp_path / name
    written(path, 0, 1)
    whole = path.read_bytes()
    path.write_bytes(whole + whole[-20:-1])  # as after a kill
    written(path, 2)
    text = path.read_text()
    assert text.encode().startswith(whole)
    if name.endswith("csv"):
        rows = list(csv.DictReader(text.splitlines()))
        assert tuple(rows[0]) == COLUMNS and [row["tx_mm"] for row in rows] == ["1", "", "2"]
    else:
        rows = [json.loads(line) for line in text.splitlines()]
        assert [None if r["covariance"] is None else r["rig_from_object"][0][3] for r in rows] == [1.0, None, 2.0]
    assert [int(row["snapshot"]) for row in rows] == [0, 1, 2]


@pytest.mark.parametrize("name", ["poses.csv", "poses.jsonl"])
def test_rows_after_a_snapshot_are_removed_but_none_of_an_earlier_run(tmp_path, name):
    path = tmp_path / name
    written(path, 7, 8)
    known = path.stat().st_size
    written(path, 0, 1, 2, 3)
    whole = path.read_bytes()
    forget_rows(path, known, 3)
    assert path.read_bytes() == whole
    forget_rows(path, known, 1)
    kept = path.read_text().splitlines()
    assert len(kept) == 4 + name.endswith("csv") and whole.startswith("".join(f"{line}\n" for line in kept).encode())
    forget_rows(path, 10**6, 0)
    forget_rows(tmp_path / "nowhere.csv", 0, 0)
    assert len(path.read_text().splitlines()) == len(kept)
    forget_rows(path, known - 5, 0)  # no row ends there: this is another file
    assert len(path.read_text().splitlines()) == len(kept)
    path.write_bytes(whole + b"0.5,nonsense\n")
    forget_rows(path, len(whole), 10**6)
    assert path.read_bytes() == whole


def test_files_that_are_none_of_ours_are_left_alone(tmp_path):
    for name, content in (("a.csv", "camera,u,v\n1,2,3\n"), ("a.jsonl", '{"event": "moved"}\n')):
        (tmp_path / name).write_text(content)
        with pytest.raises(InputError, match=r"found .* expected a new file or"):
            PoseFile(tmp_path / name)
        assert (tmp_path / name).read_text() == content
    with pytest.raises(InputError, match=r"ends in \.csv, \.jsonl, \.c3d or \.trc"):
        PoseFile(tmp_path / "poses.txt")
    with pytest.raises(InputError, match="cannot be written"):
        PoseFile(tmp_path / "nowhere" / "poses.csv")


def test_a_full_disk_leaves_no_half_line(tmp_path, monkeypatch):
    path = tmp_path / "poses.csv"
    file = PoseFile(path)
    file.send(record(0))
    before, write = path.read_bytes(), os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: write(descriptor, data[:7]))
    with pytest.raises(OSError, match="7 of"):
        file.send(record(1))
    monkeypatch.undo()
    assert path.read_bytes() == before
    file.close()
