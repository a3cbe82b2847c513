import gzip
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imgcal.errors import InputError
from imgcal.io import DEFAULT_SIGMA, csv_file, load_detections, load_object, read_rig, save_detections
from imgcal.io.csv_file import CHUNK, Chunk
from imgcal.types import CalibrationObject, Detections

COLUMNS = ("uv", "sigma", "camera", "snapshot", "fiducial", "radius", "flags")


def make_detections(count: int, seed: int = 0, labelled: bool = True) -> Detections:
    """Make `count` blobs with different (snapshot, camera, fiducial), in which every name occurs in order."""
    rng = np.random.default_rng(seed)
    row = np.arange(count)
    return Detections(
        uv=rng.uniform(0, 1000, (count, 2)),
        sigma=rng.uniform(0.01, 0.2, count),
        camera=row // 2 % 3,
        snapshot=row // 6,
        fiducial=np.where(rng.random(count) < 0.8, row % 2, -1) if labelled else np.full(count, -1),
        radius=np.where(rng.random(count) < 0.5, rng.uniform(1, 5, count), np.nan),
        flags=rng.integers(0, 16, count).astype(np.uint8),
        camera_names=("cam01", "cam02", "a, b"),
        snapshot_names=tuple(f"{i} s" for i in range((count + 5) // 6)),
    )


def assert_same(first: Detections, second: Detections) -> None:
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(first, column), getattr(second, column), strict=True)
    assert first.camera_names == second.camera_names
    assert first.snapshot_names == second.snapshot_names


@pytest.mark.parametrize("name", ["d.csv", "d.csv.gz"])
@pytest.mark.parametrize("count", [6, CHUNK, CHUNK + 1, 2 * CHUNK + 6])
def test_round_trip_is_exact(name: str, count: int, tmp_path: Path) -> None:
    detections = make_detections(count)
    save_detections(detections, tmp_path / name)
    assert_same(load_detections(tmp_path / name), detections)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 2), min_size=6, max_size=12))
def test_any_plausible_coordinate_survives(
    tmp_path_factory: pytest.TempPathFactory, uv: list[tuple[float, float]]
) -> None:
    detections = replace(make_detections(len(uv), labelled=False), uv=np.array(uv))
    path = tmp_path_factory.getbasetemp() / "d.csv"
    save_detections(detections, path)
    assert_same(load_detections(path), detections)


def test_equal_content_gives_equal_bytes(tmp_path: Path) -> None:
    for name in ("a.csv.gz", "b.csv.gz"):
        save_detections(make_detections(50), tmp_path / name)
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()


def test_minimal_file_and_defaults(tmp_path: Path) -> None:
    path = tmp_path / "d.csv"
    path.write_text("snapshot,camera,u,v\n10,B,1,2\n2,A,3,4\n\n10,A,5,6\n")
    detections = load_detections(path)
    assert detections.snapshot_names == ("10", "2")  # file order, not sorted
    assert detections.camera_names == ("B", "A")
    assert detections.snapshot.tolist() == [0, 1, 0]
    assert detections.camera.tolist() == [0, 1, 1]
    assert (detections.sigma == DEFAULT_SIGMA).all()
    assert (detections.fiducial == -1).all()
    assert np.isnan(detections.radius).all()
    assert (detections.flags == 0).all()


def test_cameras_come_from_the_rig(tmp_path: Path) -> None:
    path = tmp_path / "d.csv"
    path.write_text("snapshot,camera,u,v\n0,cam03,1,2\n0,cam01,-0.5,1087.5\n")
    rig = read_rig("O10")
    detections = load_detections(path, rig)
    assert detections.camera_names == rig.camera_names
    assert detections.camera.tolist() == [2, 0]


HEAD = "snapshot,camera,u,v,sigma,fiducial\n0,cam01,1,2,0.1,0\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "found an empty file"),
        (b"snapshot,camera,u,v\n", "found a header and no rows"),
        (b"snapshot,camera,u\n0,a,1\n", "found no column v"),
        (b"snapshot,camera,u,v,sgima\n0,a,1,2,3\n", "unknown column 'sgima', nearest: sigma"),
        (b"\x89PNG\r\n\x1a\n\x00\xff\xfe", "not a text file"),
        (b"\x1f\x8bjunk" * 10, "compressed file is damaged"),
        (gzip.compress(HEAD.encode() * 50, mtime=0)[:40], "compressed file is truncated"),
        (HEAD + "0,cam01,nan,2,0.1,1\n", "line 3: u: found nan, expected a finite pixel"),
        (HEAD + "0,cam01,1,x,0.1,1\n", "line 3: v: found 'x'"),
        (HEAD + "0,cam01,1,2,0,1\n", "line 3: sigma: found 0, expected a standard deviation > 0"),
        (HEAD + "0,cam01,1,2,,1\n", "line 3: sigma: found ''"),
        (HEAD + "0,cam01,1,2,0.1\n", "line 3: found 5 cells, expected 6"),
        (HEAD + "0,cam1,1,2,0.1,1\n", r"line 3: camera: found 'cam1' \(this file: cam01, cam1\).*cam02.*nearest"),
        (HEAD + "0,,1,2,0.1,1\n", "line 3: camera: found ''"),
        (HEAD + ",cam01,1,2,0.1,1\n", "line 3: snapshot: found an empty cell"),
        *[(HEAD + f"{name},cam01,1,2,0.1,1\n", "line 3: snapshot: found .*expected a name that can be a file name")
          for name in ("../../x", "/abs/x", "a/b", "..", ".hidden", "a\\b", " a", "a\x1b[31m", "x" * 300)],
        (HEAD + "0,cam01,1e7,2,0.1,1\n", r"line 3: u: found 1e7"),
        (HEAD + "0,cam01,1,2,1e-300,1\n", r"line 3: sigma: found 1e-300"),
        (HEAD + "0,cam01,1,2,1e300,1\n", r"line 3: sigma: found 1e300"),
        (HEAD + "0" * 2_000_000 + ",cam01,1,2,0.1,1\n", "a line of more than"),
        (HEAD + "," * 100_000 + "\n", "found 100001 cells"),
        (HEAD + "0,cam01,1,2,0.1,8\n", "line 3: fiducial: found 8, expected a row of the object, 0 to 7"),
        (HEAD + "0,cam01,1,2,0.1,-2\n", "line 3: fiducial: found -2"),
        (HEAD + "0,cam01,1,2,0.1,inf\n", "line 3: fiducial: found inf"),
        (HEAD + "0,cam01,1,2,0.1,1.5\n", r"line 3: fiducial: found 1\.5"),
        (HEAD + "1,cam01,1,2,0.1,0\n\n0,cam01,9,2,0.1,0\n",
         "line 5: found fiducial 0 again for camera cam01 in snapshot 0"),
        (HEAD + "0,cam01,2060,2,0.1,1\n", r"line 3: found \(2060, 2\), expected a pixel of the 2048x1088 image"),
        (HEAD + "0,cam01,2,-7,0.1,1\n", r"line 3: found \(2, -7\)"),
        ("snapshot,camera,u,v\n0,cam01,0.5,0.25\n0,cam02,0.75,1\n",
         r"found u and v between 0.25 and 1 in all rows \(normalized by .*\), expected pixels"),
    ],
)  # fmt: skip
def test_bad_files_give_one_clear_line(content: str | bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=message) as caught:
        load_detections(path, read_rig("O10"), fiducials=8)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_compressed_file_that_unpacks_to_a_flood_is_left_soon(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "d.csv.gz"
    path.write_bytes(gzip.compress(b"snapshot,camera,u,v\n" + b"0,cam01,1.5,2.5\n" * 2_000_000))
    read = []
    numbers = Chunk.numbers
    monkeypatch.setattr(Chunk, "numbers", lambda *given: read.append(1) or numbers(*given))
    with pytest.raises(InputError, match=r"bytes and more, compressed to [\d,]+, expected at most 100 times"):
        load_detections(path)
    assert len(read) * CHUNK < 2_500_000  # of 4,000,000 numbers


def test_a_flood_of_blank_lines_is_left_soon(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(csv_file, "MOST_ROWS", 3 * CHUNK)
    (tmp_path / "d.csv").write_text("snapshot,camera,u,v\n0,cam01,1.5,2.5\n" + "\n" * 4 * CHUNK)
    with pytest.raises(InputError, match="more than 3,000 rows"):
        load_detections(tmp_path / "d.csv")


def test_more_rows_than_can_be(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(csv_file, "MOST_ROWS", 3 * CHUNK)
    (tmp_path / "d.csv").write_text("snapshot,camera,u,v\n" + "0,cam01,1.5,2.5\n" * 4 * CHUNK)
    with pytest.raises(InputError, match="more than 3,000 rows"):
        load_detections(tmp_path / "d.csv")


def test_line_numbers_are_right_in_later_chunks(tmp_path: Path) -> None:
    path = tmp_path / "d.csv"
    rows = [f"{i},cam01,1,2\n" for i in range(CHUNK + 10)]
    rows[CHUNK + 4] = "7,cam01,oops,2\n"
    path.write_text("snapshot,camera,u,v\n\n" + "".join(rows))
    with pytest.raises(InputError, match=f"line {CHUNK + 7}: u: found 'oops'"):
        load_detections(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv: cannot be read: No such file"):
        load_detections(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda blobs: {"uv": blobs.uv * np.nan}, "uv: found .*nan"),
        (lambda blobs: {"sigma": blobs.sigma * 0}, "sigma: found 0.0 in row 0"),
        (lambda blobs: {"radius": blobs.radius - 10}, "radius: found -"),
        (lambda blobs: {"fiducial": blobs.fiducial - 5}, "fiducial: found -"),
        (lambda blobs: {"snapshot_names": ("0",) * len(blobs.snapshot_names)}, "the snapshot name 0 more than once"),
        (lambda blobs: {"camera_names": ("a", "a", "b")}, "the camera name a more than once"),
        (lambda blobs: vars(blobs.select(np.zeros(0, int))), "no blob in any camera"),
    ],
)
def test_blobs_that_could_not_be_read_again_are_not_written(change: Any, found: str, tmp_path: Path) -> None:
    blobs = make_detections(30)
    with pytest.raises(InputError, match=rf"new\.csv: not written: .*{found}"):
        save_detections(replace(blobs, **change(blobs)), tmp_path / "new.csv")
    assert not list(tmp_path.iterdir())


def test_an_object_says_what_labels_mean(tmp_path: Path) -> None:
    rig, obj = read_rig("T4"), load_object("cube8")
    (tmp_path / "d.csv").write_text("snapshot,camera,u,v,fiducial\n0,cam01,5,5,8\n")
    with pytest.raises(InputError, match="fiducial: found 8"):
        load_detections(tmp_path / "d.csv", rig, obj)
    with pytest.raises(InputError, match="rig: found 'T4', expected a CameraRig"):
        load_detections(tmp_path / "d.csv", "T4", obj)


@pytest.mark.parametrize("names", [(("a\nb",), ("0",)), (("a",), ("../0",))])
def test_names_that_could_not_be_read_again_are_not_written(
    names: tuple[tuple[str], tuple[str]], tmp_path: Path
) -> None:
    detections = replace(make_detections(2), camera_names=names[0], snapshot_names=names[1])
    with pytest.raises(InputError, match=r"new\.csv: not written: found"):
        save_detections(detections, tmp_path / "new.csv")
    assert not (tmp_path / "new.csv").exists()


def test_labels_are_written_as_the_object_calls_them(tmp_path: Path) -> None:
    obj = replace(load_object("wand4"), labels=(7, 8, 9, 11))
    path = tmp_path / "blobs.csv"
    path.write_text("snapshot,camera,u,v,fiducial\n0,a,1,2,11\n0,a,3,4,7\n0,a,5,6,\n")
    found = load_detections(path, fiducials=obj.rows)
    assert found.fiducial.tolist() == [3, 0, -1]
    save_detections(found, tmp_path / "again.csv", obj)
    assert_same(load_detections(tmp_path / "again.csv", fiducials=obj.rows), found)


def test_labels_of_several_objects_name_their_object(tmp_path: Path) -> None:
    both = CalibrationObject.of_several([load_object("wand4"), replace(load_object("wand4"), labels=(7, 8, 9, 11))])
    path = tmp_path / "blobs.csv"
    path.write_text("snapshot,camera,u,v,object,fiducial\n0,a,1,2,wand4,3\n0,a,3,4,wand4-2,9\n0,a,5,6,,\n")
    found = load_detections(path, fiducials=both.rows)
    assert found.fiducial.tolist() == [3, 6, -1]
    save_detections(found, tmp_path / "again.csv", both)
    assert load_detections(tmp_path / "again.csv", fiducials=both.rows).fiducial.tolist() == [3, 6, -1]
    for rows, message in (
        ("0,a,1,2,cube8,3", "object: found 'cube8', expected the object of each labelled blob: wand4, wand4-2"),
        ("0,a,1,2,wand4-2,3", "fiducial: found 3, expected a fiducial of object wand4-2"),
    ):
        path.write_text(f"snapshot,camera,u,v,object,fiducial\n{rows}\n")
        with pytest.raises(InputError, match=message):
            load_detections(path, fiducials=both.rows)
    path.write_text("snapshot,camera,u,v,object,fiducial\n0,a,1,2,one,3\n0,a,3,4,two,3\n")
    with pytest.raises(InputError, match="labels of several objects"):
        load_detections(path, fiducials=4)
