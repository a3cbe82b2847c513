"""What `calibrate` tells about blobs, labels, outliers and cameras that moved."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from imgcal.cli.main import main
from imgcal.io import load_detections, load_object, save_detections, save_object, save_rig
from imgcal.types import BlobFlag
from scripts.benchmarks import camera_faults as damage

CAMERA = 3


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Folder with rig and object; function that writes blobs there and calibrates."""
    folder = tmp_path_factory.mktemp("room")
    rig, wand, truth = damage.wand_in_a_room(20, 1)
    save_rig(rig, folder / "rig.yaml")
    save_object(wand, folder / "wand.csv")

    def run(table, *more):
        save_detections(table, folder / "blobs.csv")
        arguments = ["calibrate", str(folder / "blobs.csv"), "--rig", str(folder / "rig.yaml")]
        code = main([*arguments, "--object", str(folder / "wand.csv"), "--out", str(folder / "out"), *more])
        return code, json.loads((folder / "out" / "result.json").read_text())

    moved = damage.changed_from(truth, wand, CAMERA, 12, lambda r: damage.turned(r, CAMERA, 0.3))
    return folder, run, truth, moved


def test_blobs_labels_and_outliers_are_counted(room):
    _, run, truth, _ = room
    table = damage.blobs(truth, labelled=True)
    bad = np.flatnonzero((table.camera == CAMERA) & (table.fiducial >= 0) & (table.snapshot % 5 == 0))
    table.uv[bad] += (9.0, -7.0)
    code, result = run(table, "--no-report")
    assert code == 0
    assert {move["camera"] for move in result["moved"]} == set(result["motion"]["cameras_moved"])
    assert all(move["snapshot"] is None for move in result["moved"])  # none during the capture
    own = result["per_camera"]["cam04"]
    assert own["blobs"] == int((table.camera == CAMERA).sum())
    assert own["labelled"] == int(((table.camera == CAMERA) & (table.fiducial >= 0)).sum())
    assert own["outliers"] == len(bad) and own["points"] == own["labelled"] - own["outliers"]
    assert list(result["per_snapshot"]) == [f"{s:05d}" for s in range(20)]
    assert result["per_snapshot"]["00005"]["outliers"] == int((table.snapshot[bad] == 5).sum())
    for name in ("blobs", "labelled", "outliers"):
        sums = (sum(part[name] for part in result[key].values()) for key in ("per_camera", "per_snapshot"))
        assert len(set(sums)) == 1


def test_labels_can_be_written_and_read_again(room):
    folder, run, truth, _ = room
    table = damage.blobs(truth)
    code, first = run(table, "--no-report", "--labelled", str(folder / "labelled.csv.gz"))
    assert code == 0
    found = load_detections(folder / "labelled.csv.gz")
    assert len(found) == len(table)
    assert (found.fiducial >= 0).sum() == sum(part["labelled"] for part in first["per_camera"].values())
    code, second = run(found, "--no-report")
    assert code == 0 and second["identity"] == "coded"
    assert second["rms_px_after"] == pytest.approx(first["rms_px_after"], rel=1e-6)


def test_outliers_are_marked_in_the_table(room):
    folder, run, truth, _ = room
    table = damage.blobs(truth, labelled=True)
    bad = np.flatnonzero(table.fiducial >= 0)[::97]
    table.uv[bad] += (9.0, -7.0)
    assert run(table, "--no-report", "--labelled", str(folder / "labelled.csv"))[0] == 0
    found = load_detections(folder / "labelled.csv")
    assert np.array_equal(np.flatnonzero(found.flags & BlobFlag.OUTLIER), bad)
    assert found.usable.all()


@pytest.mark.parametrize(
    ("file", "expected"),
    [
        ("nowhere/x.csv", "an existing folder"),
        ("blobs.csv", "another file"),
        ("out/rig.yaml", "rig.yaml is written to --out"),
        ("out/object.csv", "object.csv is written to --out"),  # which is not there now, and may be
    ],
)
def test_a_table_that_cannot_be_written_is_said_before_any_work(room, file, expected, capsys):
    folder, run, truth, _ = room
    run(damage.blobs(truth), "--no-report")
    before = content(folder / "out")
    capsys.readouterr()
    assert run(damage.blobs(truth), "--no-report", "--labelled", str(folder / file))[0] == 2
    assert expected in capsys.readouterr().err
    assert content(folder / "out") == before


def test_a_result_is_not_replaced_where_the_table_cannot_be_written(room, capsys):
    folder, run, truth, _ = room
    table = damage.blobs(truth)
    assert run(table, "--no-report")[0] == 0
    before = content(folder / "out")
    capsys.readouterr()
    long = folder / f"{'x' * 245}.csv"  # as long as names may be: the file beside it that would replace it is longer
    assert run(table, "--no-report", "--labelled", str(long))[0] == 2
    assert f"{long}: cannot be written" in capsys.readouterr().err
    assert content(folder / "out") == before


def content(folder):
    """Every file below a folder, as it is."""
    return {path.name: path.read_bytes() for path in folder.rglob("*")}


def test_a_camera_that_moved_is_in_the_result_of_the_refusal(room, capsys):
    _, run, _, moved = room
    code, result = run(damage.blobs(moved), "--no-report")
    assert code == 3 and result["status"] == "refused"
    (move,) = result["moved"]
    assert (move["camera"], move["snapshot"], move["kind"], move["unit"]) == ("cam04", "00012", "rotation", "deg")
    assert abs(move["size"] - 0.3) < 5 * move["sigma"] + 0.01
    said = capsys.readouterr().err
    assert "camera cam04 moved before snapshot 00012" in said and "--after-last-move" in said
    assert "PipelineOptions" not in said and "PipelineOptions" not in result["reason"]
    assert result["per_camera"]["cam04"]["blobs"] > 0


def test_the_rig_since_the_last_move(room, capsys):
    folder, run, _, moved = room
    code, result = run(damage.blobs(moved), "--after-last-move")
    assert code == 0 and result["status"] == "ok"
    assert result["snapshots_used"] == 8 and result["snapshots_rejected"] == 12
    assert result["rejected"]["00011"] == "taken before a camera moved"
    assert [move["camera"] for move in result["moved"] if move["snapshot"] is not None] == ["cam04"]
    assert "camera cam04 moved before snapshot 00012" in capsys.readouterr().out
    assert "During the capture camera cam04 moved before snapshot 00012" in (folder / "out" / "report.html").read_text()


def test_a_camera_with_blobs_beside_their_places_is_noted(room, capsys):
    folder, run, truth, _ = room
    table = damage.blobs(truth, labelled=True)
    astray = (table.camera == CAMERA) & (table.snapshot % 3 == 0)
    table.uv[astray] = np.random.default_rng(0).uniform(100, 900, (int(astray.sum()), 2))
    table.fiducial[:] = -1
    assert run(table)[0] == 0
    assert "note: camera cam04: " in capsys.readouterr().err
    assert re.search(r"cam04: \d+ blobs may be fiducials", (folder / "out" / "report.html").read_text())


def test_the_report_of_a_refusal_for_a_move_is_about_that_move(room):
    folder, run, _, moved = room
    code, _ = run(damage.blobs(moved, clutter=3.0))
    page = (folder / "out" / "report.html").read_text()
    assert code == 3 and "Fasten what has moved" in page
    assert "no camera was exchanged" not in page and "Capture more snapshots, the whole object" not in page
    assert f"{moved.uv.shape[0] - 12} / {moved.uv.shape[0]}" in page and "snapshots since the last move" in page
    labelled = re.findall(r"([0-9]+) blobs, [0-9]+ %", page)
    assert len(labelled) == 10 and max(map(int, labelled)) <= 4 * moved.uv.shape[0]  # clutter is no coverage


def test_a_camera_bumped_before_the_last_snapshot_is_in_the_result_and_on_the_terminal(room, capsys):
    folder, run, truth, _ = room
    last = len(truth.uv) - 1
    wand = load_object("wand4")
    late = damage.changed_from(truth, wand, CAMERA, last, lambda r: damage.turned(r, CAMERA, 0.5))
    code, result = run(damage.blobs(late))
    said = "camera cam04 stopped fitting at snapshot"
    assert code == 0 and result["doubtful"] == [{"camera": "cam04", "snapshots": [f"{last:05d}"]}]
    assert said in capsys.readouterr().err and said[1:] in (folder / "out" / "report.html").read_text()


def documented_keys():
    """Keys in the table of docs/files.md."""
    page = (Path(__file__).parents[3] / "docs" / "files.md").read_text()
    rows = re.findall(r"^\| (`.*?`) \|", page.partition("## Results")[2], re.MULTILINE)
    return {key for row in rows for key in re.findall(r"`(\w+)`", row)}


def test_every_key_of_a_result_is_documented_and_there(room):
    _, run, truth, moved = room
    code, result = run(damage.blobs(truth, labelled=True), "--no-report")
    assert code == 0 and set(result) == documented_keys()
    code, refused = run(damage.blobs(moved), "--no-report")
    assert code == 3 and set(refused) == documented_keys()
