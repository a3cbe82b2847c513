"""Code shared by the commands: ranges, start poses, excluded cameras, output folders."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from imgcal.cli import common as module
from imgcal.cli.common import (
    check_folder,
    drop_cameras,
    parse_range,
    progress,
    read_detections,
    select_cameras,
    start_pose,
)
from imgcal.detection import DetectionOptions
from imgcal.errors import InputError
from imgcal.io import open_capture
from imgcal.synthesis import simulate_truth, true_detections


@pytest.mark.parametrize(
    ("text", "expected"),
    [(None, (0, None)), (":", (0, None)), ("3:", (3, None)), (":7", (0, 7)), ("2:5", (2, 5)), ("007:010", (7, 10))],
)
def test_ranges(text, expected) -> None:
    assert parse_range(text) == expected


@pytest.mark.parametrize("text", ["", "5", "a:b", "-1:3", "1:2:3", "5:5", "7:2", "1.5:3", "9" * 19 + ":", " 1:2"])
def test_what_is_no_range(text) -> None:
    with pytest.raises(InputError, match="--snapshots: found"):
        parse_range(text)


def test_detections_are_taken_by_snapshots(o10, asymmetric8) -> None:
    table = true_detections(simulate_truth(o10, asymmetric8, 4, torch.Generator().manual_seed(0), None))
    some, frames = read_detections(table, "1:3", DetectionOptions())
    assert some.snapshot_names == table.snapshot_names[1:3] and not frames
    np.testing.assert_array_equal(some.uv, table.uv[(table.snapshot == 1) | (table.snapshot == 2)])
    assert read_detections(table, "2:99", DetectionOptions())[0].snapshot_names == table.snapshot_names[2:]
    with pytest.raises(InputError, match="found 4:, expected a range within the 4 snapshots"):
        read_detections(table, "4:", DetectionOptions())


def test_blobs_are_found_in_the_frames_of_a_capture(workplace) -> None:
    capture = open_capture(workplace.capture)
    found, frames = read_detections(capture, "1:", DetectionOptions())
    assert found.snapshot_names == capture.snapshot_names[1:] and len(found.snapshot_names) == 2
    assert set(frames) == set(capture.camera_names)
    assert len(found) > 40 and (found.fiducial == -1).all() and set(found.snapshot) == {0, 1}


def test_progress_yields_everything_whatever_shows_it(capsys) -> None:
    assert list(progress(iter("abc"), 3, "letters")) == ["a", "b", "c"]
    assert capsys.readouterr().err == ""  # no terminal


def test_without_a_terminal_progress_is_a_line_a_minute(capsys, monkeypatch) -> None:
    now = iter([30.0, 91.0, 92.0, 95.0])  # of each advance
    monkeypatch.setattr(module.time, "monotonic", lambda: next(now))
    for _ in progress(range(4), 4, "letters"):
        pass
    assert capsys.readouterr().err == "letters: 2 of 4\n"


def test_a_start_pose_is_a_rotation_vector_and_a_shift() -> None:
    assert start_pose(None) is None
    pose = start_pose((0.0, 0.0, math.pi / 2, 1.0, 2.0, 3.0))
    torch.testing.assert_close(
        pose.apply(torch.tensor([[1.0, 0, 0]]).double()), torch.tensor([[1.0, 3.0, 3.0]]).double()
    )
    with pytest.raises(InputError, match=r"--start-pose: found .*nan.* expected six finite numbers"):
        start_pose((0.0, math.nan, 0.0, 0.0, 0.0, 0.0))


def test_cameras_are_left_out_of_rigs_and_tables(o10, asymmetric8) -> None:
    rig = drop_cameras(o10, ("cam02", "cam09"))
    assert rig.num_cameras == 8 and "cam02" not in rig.camera_names
    table = true_detections(simulate_truth(o10, asymmetric8, 2, torch.Generator().manual_seed(0), None))
    some = select_cameras(table, rig)
    assert some.camera_names == rig.camera_names
    names = np.array(table.camera_names)[table.camera]
    kept = np.isin(names, rig.camera_names)
    np.testing.assert_array_equal(np.array(some.camera_names)[some.camera], names[kept])
    np.testing.assert_array_equal(some.uv, table.uv[kept])
    assert len(select_cameras(table.select(np.zeros(len(table), bool)), rig)) == 0


def test_all_cameras_cannot_be_left_out(o10) -> None:
    assert drop_cameras(o10, ("cam02", "cam11")).num_cameras == 9  # of the input: checked where that is read
    with pytest.raises(InputError, match="found all 10 cameras"):
        drop_cameras(o10, o10.camera_names)


def test_a_file_in_the_place_of_a_folder_is_refused(tmp_path: Path) -> None:
    check_folder(tmp_path / "not" / "yet" / "there")
    assert not (tmp_path / "not").exists()
    (tmp_path / "file").touch()
    for path, expected in ((tmp_path / "file", "found a file"), (tmp_path / "file" / "below", "file is a file")):
        with pytest.raises(InputError, match=f"{expected}, expected a folder to write to"):
            check_folder(path)
