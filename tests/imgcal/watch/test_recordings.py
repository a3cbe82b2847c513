from pathlib import Path

import cv2
import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.io import read_rig
from imgcal.types import BlobFlag, Detections
from imgcal.watch import BlobTable, Videos, holds_videos

RIG = read_rig("T4")


def write_video(path: Path, levels, rate=10.0):
    path.parent.mkdir(exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), rate, (32, 24), False)
    for level in levels:
        writer.write(np.full((24, 32), level, np.uint8))
    writer.release()


def seen(source):
    return [(e.camera, round(e.time, 3), int(e.content[0, 0]), e.snapshot) for e in source.items()]


def test_frames_of_one_number_and_one_time(tmp_path):
    write_video(tmp_path / "frames" / "cam01.avi", [10, 11])
    write_video(tmp_path / "frames" / "cam03.mkv", [30, 31])
    assert holds_videos(tmp_path) and not holds_videos(tmp_path / "frames")
    assert seen(Videos(tmp_path, RIG)) == [
        ("cam01", 0.0, 10, "0"), ("cam03", 0.0, 30, "0"), ("cam01", 0.1, 11, "1"), ("cam03", 0.1, 31, "1"),
    ]  # fmt: skip


def test_videos_that_differ_go_by_their_time_stamps_where_told_so(tmp_path):
    write_video(tmp_path / "frames" / "cam01.avi", [10, 11, 12, 13], 10.0)
    write_video(tmp_path / "frames" / "cam02.avi", [20, 22], 5.0)
    with pytest.raises(InputError, match="found 2 frames, and 4"):
        seen(Videos(tmp_path, RIG))
    assert [value[:3] for value in seen(Videos(tmp_path, RIG, differ=True))] == [
        ("cam01", 0.0, 10), ("cam02", 0.0, 20), ("cam01", 0.1, 11), ("cam01", 0.2, 12), ("cam02", 0.2, 22),
        ("cam01", 0.3, 13),
    ]  # fmt: skip


def test_videos_of_another_rate_are_noticed_while_they_are_read(tmp_path):
    write_video(tmp_path / "frames" / "cam01.avi", range(8), 10.0)
    write_video(tmp_path / "frames" / "cam02.avi", range(8), 11.0)
    with pytest.raises(InputError, match="found frame 6 at"):
        seen(Videos(tmp_path, RIG))


def test_a_table_of_blobs_tells_of_cameras_that_see_nothing():
    flags = np.array([0, 0, 0, BlobFlag.BORDER], dtype=np.uint8)
    blobs = Detections(
        uv=np.array([[5.0, 6.0], [1.0, 2.0], [3.0, 4.0], [0.0, 0.0]]), sigma=np.full(4, 0.1),
        camera=np.array([1, 0, 0, 0]), snapshot=np.array([0, 1, 0, 0]), fiducial=np.full(4, -1),
        radius=np.full(4, np.nan), flags=flags, camera_names=("a", "b", "never"), snapshot_names=("x", "y"),
    )  # fmt: skip
    found = [(e.camera, e.time, e.snapshot, e.content.uv.tolist()) for e in BlobTable(blobs, 10.0).items()]
    assert found == [
        ("a", 0.0, "x", [[3, 4]]), ("b", 0.0, "x", [[5, 6]]), ("a", 0.1, "y", [[1, 2]]), ("b", 0.1, "y", []),
    ]  # fmt: skip
