import os
import shutil
import threading
import time

import cv2
import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.io import read_rig, write_frame
from imgcal.watch import Exposure, Folder, SourceReader, Unreadable
from imgcal.watch import folder as module

RIG = read_rig("T4")
HEIGHT, WIDTH = 1088, 2048


@pytest.fixture
def rig():
    import torch

    return RIG.resized(torch.tensor([64, 34]))


def frame(level=0):
    return np.full((34, 64), level, np.uint8)


def put(folder, camera, name, level=0):
    (folder / "frames" / camera).mkdir(parents=True, exist_ok=True)
    write_frame(folder / "frames" / camera / f"{name}.png", frame(level))


def until(items, count):
    """The next items that are something."""
    found, ends = [], time.monotonic() + 90
    while len(found) < count:
        item = next(items)
        found += [] if item is None else [item]
        assert time.monotonic() < ends
    return found


def test_what_is_there_and_what_comes_in_the_order_of_names(tmp_path, rig):
    for name in ("10", "9"):
        for camera in ("cam02", "cam01"):
            put(tmp_path, camera, name, int(name))
    items = Folder(tmp_path, rig).items()
    found = until(items, 4)
    assert [(e.snapshot, e.camera, e.content[0, 0]) for e in found] == [
        ("9", "cam01", 9), ("9", "cam02", 9), ("10", "cam01", 10), ("10", "cam02", 10),
    ]  # fmt: skip
    put(tmp_path, "cam03", "11")  # a camera whose folder was not there
    (exposure,) = until(items, 1)
    assert (exposure.camera, exposure.snapshot) == ("cam03", "11")
    assert exposure.time == pytest.approx(time.time(), abs=5)


def test_what_was_there_before_is_a_recording_of_which_nothing_is_dropped(tmp_path, rig):
    names = [str(k) for k in range(30)]
    for name in names:
        for camera in rig.camera_names:
            put(tmp_path, camera, name)
    found = []
    with SourceReader(Folder(tmp_path, rig, until_idle=1.0), rig) as intake:
        time.sleep(0.5)  # nobody takes anything
        while not intake.ended:
            snapshot = intake.next(0.2)
            found += [] if snapshot is None else [snapshot]
    assert [s.name for s in found] == names and intake.dropped == 0
    assert all(len(s.exposures) == rig.num_cameras for s in found)


def test_what_comes_later_is_live(tmp_path, rig):
    put(tmp_path, "cam01", "1")
    source = Folder(tmp_path, rig)
    items = source.items()
    until(items, 1)
    assert not source.live
    next(items)
    assert source.live
    empty = Folder(tmp_path / "later", rig)
    (tmp_path / "later" / "frames").mkdir(parents=True)
    looks = empty.items()
    for _ in range(2):
        assert next(looks) is None
    assert empty.live


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".pgm", ".jpg"])
def test_no_frame_is_taken_while_it_is_written(suffix, tmp_path, rig):
    content = cv2.imencode(suffix, np.random.default_rng(0).integers(0, 255, (34, 64), np.uint8))[1].tobytes()
    path = tmp_path / "frames" / "cam01" / f"1{suffix}"
    path.parent.mkdir(parents=True)
    whole = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)

    def write():  # as over a slow network
        with open(path, "wb", buffering=0) as file:
            for start in range(0, len(content), len(content) // 6):
                file.write(content[start : start + len(content) // 6])
                time.sleep(0.04)

    writer = threading.Thread(target=write)
    writer.start()
    (exposure,) = until(Folder(tmp_path, rig).items(), 1)
    writer.join()
    assert isinstance(exposure, Exposure) and (exposure.content == whole).all()


def test_a_writer_that_pauses_is_waited_for_and_one_that_died_is_given_up(tmp_path, rig, monkeypatch):
    monkeypatch.setattr(module, "GIVEN_UP", 0.6)
    put(tmp_path, "cam01", "1")
    put(tmp_path, "cam02", "1")
    content = (tmp_path / "frames" / "cam01" / "1.png").read_bytes()
    for camera in ("cam01", "cam02"):
        (tmp_path / "frames" / camera / "2.png").write_bytes(content[:-20])
    items = Folder(tmp_path, rig).items()
    assert {e.snapshot for e in until(items, 2)} == {"1"}
    for _ in range(4):
        assert next(items) is None
    (tmp_path / "frames" / "cam01" / "2.png").write_bytes(content)
    first, second = until(items, 2)
    assert (first.camera, first.snapshot) == ("cam01", "2")
    assert isinstance(second, Unreadable) and second.camera == "cam02" and "truncated" in second.reason
    put(tmp_path, "cam02", "3")
    assert until(items, 1)[0].snapshot == "3"


def test_other_files_and_hidden_ones_are_not_looked_at(tmp_path, rig):
    put(tmp_path, "cam01", "1")
    for name in (".2.png", "2.png.part", "notes.txt"):
        (tmp_path / "frames" / "cam01" / name).write_bytes(b"junk")
    os.mkfifo(tmp_path / "frames" / "cam01" / "3.png")
    items = Folder(tmp_path, rig, until_idle=0.3).items()
    assert [e.snapshot for e in items if e is not None] == ["1"]


def test_snapshots_before_a_restart_are_not_read_again_and_what_is_saved_is_removed(tmp_path, rig):
    for name in ("8", "9", "10", "11"):
        put(tmp_path, "cam01", name)
    folder = Folder(tmp_path, rig, remove=True, after="9", until_idle=0.3)
    assert [e.snapshot for e in folder.items() if e is not None] == ["10", "11"]
    assert len(list(tmp_path.glob("frames/cam01/*"))) == 4  # 11 may still wait to be worked on
    folder.delete_read("10")
    assert sorted(path.name for path in tmp_path.glob("frames/cam01/*")) == ["11.png", "8.png", "9.png"]
    folder.delete_read("11")
    assert sorted(path.name for path in tmp_path.glob("frames/cam01/*")) == ["8.png", "9.png"]


def test_a_camera_s_name_in_its_files_is_not_part_of_the_snapshot_s(tmp_path, rig):
    for number in (8, 9, 10):
        for camera in ("cam01", "cam02"):
            put(tmp_path, camera, f"{camera}_{number}")
    folder = Folder(tmp_path, rig, remove=True, after="8", until_idle=0.3)
    assert folder.count_processed() == 1
    found = [(e.snapshot, e.camera) for e in folder.items() if e is not None]
    assert found == [("9", "cam01"), ("9", "cam02"), ("10", "cam01"), ("10", "cam02")]
    folder.delete_read("9")
    assert sorted(path.name for path in tmp_path.glob("frames/cam01/*")) == ["cam01_10.png", "cam01_8.png"]


def test_a_frame_that_cannot_be_deleted_keeps_no_other_and_is_tried_again(tmp_path, rig):
    for name in ("1", "2", "3"):
        put(tmp_path, "cam01", name)
    folder = Folder(tmp_path, rig, remove=True, until_idle=0.3)
    assert len([e for e in folder.items() if e is not None]) == 3
    cam01 = tmp_path / "frames" / "cam01"
    (cam01 / "1.png").rename(cam01 / "kept.png")
    (cam01 / "1.png" / "full").mkdir(parents=True)  # cannot be unlinked
    with pytest.raises(OSError, match=r"1\.png"):
        folder.delete_read("2")
    assert sorted(path.name for path in cam01.iterdir()) == ["1.png", "3.png", "kept.png"]
    shutil.rmtree(cam01 / "1.png")
    (cam01 / "kept.png").rename(cam01 / "1.png")
    folder.delete_read("2")
    assert [path.name for path in cam01.iterdir()] == ["3.png"]


def test_names_that_are_used_again_are_told_once(tmp_path, rig):
    """A ring of names was read once, and then ignored without a word."""
    for name in range(12):
        put(tmp_path, "cam01", str(name))
    items = Folder(tmp_path, rig).items()
    assert all(isinstance(item, Exposure) for item in until(items, 12))
    for name in (9, 10):
        put(tmp_path, "cam01", str(name), level=50)
        path = tmp_path / "frames" / "cam01" / f"{name}.png"
        os.utime(path, (time.time() + 60, time.time() + 60))
    (told,) = until(items, 1)
    assert isinstance(told, Unreadable) and told.camera == "cam01"
    assert told.reason.startswith(f"{tmp_path / 'frames' / 'cam01'}") and "has been written again" in told.reason
    put(tmp_path, "cam01", "12")
    (exposure,) = until(items, 1)
    assert exposure.snapshot == "12"


def test_what_is_remembered_is_bounded_and_nothing_is_read_twice(tmp_path, rig, monkeypatch):
    monkeypatch.setattr(module, "REMEMBERED", 4)
    items = Folder(tmp_path, rig).items()
    for name in range(20):
        put(tmp_path, "cam01", str(name))
        assert until(items, 1)[0].snapshot == str(name)
    assert [next(items) for _ in range(3)] == [None] * 3


def test_what_a_hurried_user_does(tmp_path, rig):
    put(tmp_path, "cam01", "1")
    with pytest.raises(InputError, match="no such folder"):
        next(Folder(tmp_path / "absent", rig).items())
    with pytest.raises(InputError, match="found the folders of cameras, expected a folder that holds"):
        next(Folder(tmp_path / "frames", rig).items())
    put(tmp_path, "cam1", "1")
    item = next(Folder(tmp_path, rig).items())
    assert isinstance(item, Unreadable) and "nearest: cam01" in item.reason
