import json
import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import read_frame, write_frame
from imgcal.synthesis import simulate_truth, true_detections
from imgcal.watch import (
    ADAPTED,
    ADAPTED_CARD,
    LEARNING,
    BlobTable,
    CameraBlobs,
    EarlierRun,
    Exposure,
    FileStamp,
    Folder,
    Known,
    Progress,
    TimedSnapshot,
    Watch,
)
from tests.imgcal.watch.states import OBJECT, RIG, KeeperOfStates

SOURCE = "/data/capture"


@dataclass
class Recording:
    """A source of which nothing is read."""

    live: bool = False

    def items(self):
        raise AssertionError("begun")


def table(*names, rate=30.0):
    blobs = true_detections(simulate_truth(RIG, OBJECT, len(names), torch.Generator().manual_seed(0), None))
    return BlobTable(replace(blobs, snapshot_names=names), rate)


def leave(folder, **progress):
    """Write what an earlier run leaves: 9 s into `SOURCE`, after snapshot 10 and 300 bytes of events."""
    entry = {"time": 9.0, "name": "10", "logged": 300, "snapshot": 8, "source": SOURCE} | progress
    (folder / "state.json").write_text(json.dumps({"progress": entry}))
    return folder / "state.json"


@pytest.mark.parametrize("source", [Recording(), Recording(live=True), Folder(Path("capture"), RIG), table("10")])
def test_nothing_applies_where_nothing_was_left(source, tmp_path):
    assert EarlierRun.find(tmp_path, source, SOURCE) == EarlierRun()


@pytest.mark.parametrize("source", [Recording(), Recording(live=True), Folder(Path("capture"), RIG), table("10")])
def test_a_state_without_a_position_is_resumed_and_all_is_read(source, tmp_path):
    (tmp_path / "state.json").write_text('{"progress": null}')
    assert EarlierRun.find(tmp_path, source, SOURCE) == EarlierRun(tmp_path / "state.json")


@pytest.mark.parametrize("noted", [SOURCE, None])
@pytest.mark.parametrize(
    ("source", "keep_all", "expected"),
    [
        (Recording(), False, EarlierRun(known=Known(9.0, "10"), logged=300, snapshot=8)),
        (Recording(live=True), False, EarlierRun()),
        (Recording(live=True), True, EarlierRun(known=Known(9.0, "10"), logged=300, snapshot=8)),
        (Folder(Path("capture"), RIG), False, EarlierRun(after="10", logged=300, snapshot=8)),
        (Folder(Path("capture"), RIG), True, EarlierRun(after="10", logged=300, snapshot=8)),
        (table("9", "10", "11"), False, EarlierRun(known=Known(9.0, "10"), logged=300, snapshot=8)),
        (table("a", "b"), False, EarlierRun(known=Known(9.0), logged=300, snapshot=8)),
    ],
)
def test_the_same_source_continues_after_the_last_snapshot(source, keep_all, expected, noted, tmp_path):
    state = leave(tmp_path, source=noted)
    assert EarlierRun.find(tmp_path, source, SOURCE, keep_all) == replace(expected, state=state)


@pytest.mark.parametrize(
    ("source", "keep_all", "expected"),
    [
        (Recording(), False, EarlierRun(known=Known(9.0, another=True))),
        (Recording(live=True), False, EarlierRun()),
        (Recording(live=True), True, EarlierRun(known=Known(9.0, another=True))),
        (Folder(Path("capture"), RIG), False, EarlierRun()),
        (table("9", "10", "11"), False, EarlierRun(known=Known(9.0, another=True))),
    ],
)
def test_another_source_is_read_in_full_and_no_event_is_removed(source, keep_all, expected, tmp_path):
    state = leave(tmp_path)
    assert EarlierRun.find(tmp_path, source, "/data/other", keep_all) == replace(expected, state=state)


def test_a_state_of_a_version_that_noted_no_events_keeps_them_all(tmp_path):
    state = leave(tmp_path, logged=None)
    assert EarlierRun.find(tmp_path, Recording(), SOURCE) == EarlierRun(state, Known(9.0, "10"), snapshot=8)


def test_a_table_at_another_rate_is_refused_unless_it_is_another_table(tmp_path):
    leave(tmp_path, rate=30.0)
    assert EarlierRun.find(tmp_path, table("10"), SOURCE).known == Known(9.0, "10")
    assert EarlierRun.find(tmp_path, table("10", rate=60.0), "/data/other").known == Known(9.0, another=True)
    with pytest.raises(InputError, match=r"--rate: found 60, expected 30 as in .*state\.json"):
        EarlierRun.find(tmp_path, table("10", rate=60.0), SOURCE)


def test_adapted_networks_are_found_whatever_the_source(tmp_path):
    (tmp_path / LEARNING / ADAPTED).mkdir(parents=True)
    (tmp_path / LEARNING / ADAPTED / ADAPTED_CARD).touch()
    found = EarlierRun.find(tmp_path, Recording(), SOURCE)
    assert found == EarlierRun(networks=found.networks) and found.networks is not None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        "[1]",
        '{"progress": {"time": "x", "name": null}}',
        '{"progress": {"time": 1, "name": 2}}',
        "[" * 5000,
        '{"progress": {"time": 1, "name": "a", "files": [1]}}',
        '{"progress": {"time": 1, "name": "a", "files": {"cam01": [1]}}}',
    ],
)
def test_progress_that_is_none_of_ours(text, tmp_path):
    (tmp_path / "state.json").write_text(text)
    for load in (Progress.load, lambda folder: EarlierRun.find(folder, Recording(), SOURCE)):
        with pytest.raises(InputError, match=r"state\.json: found"):
            load(tmp_path)


SMALL = RIG.resized(torch.tensor([64, 34]))


def fill(folder, names=("9", "10", "11"), seed=0, seconds=1.7e9):
    """Write frames that end so many seconds after 1970."""
    draw = np.random.default_rng(seed)
    for camera in SMALL.camera_names:
        (folder / "frames" / camera).mkdir(parents=True)
        for name in names:
            path = folder / "frames" / camera / f"{name}.png"
            write_frame(path, draw.integers(0, 255, (34, 64), dtype=np.uint8))
            os.utime(path, (1e9, seconds))
    return folder


def leave_after_reading(folder, out):
    """Leave what a run has noted that read a folder of frames up to snapshot 10."""
    paths = {name: folder / "frames" / name / "10.png" for name in SMALL.camera_names[1:]}  # that of one came late
    stamps = {name: FileStamp.of(path.name, read_frame(path)) for name, path in paths.items()}
    out.mkdir()
    return leave(out, source=str(folder), files=stamps, time=1.7e9)


@pytest.mark.parametrize("copied", [False, True])
def test_a_folder_that_was_moved_is_the_same_source(copied, tmp_path):
    there, out, here = fill(tmp_path / "there"), tmp_path / "out", tmp_path / "here"
    state = leave_after_reading(there, out)
    shutil.copytree(there, here, copy_function=shutil.copyfile) if copied else there.rename(here)
    assert EarlierRun.find(out, Folder(here, SMALL), str(here)) == EarlierRun(state, after="10", logged=300, snapshot=8)


def draw_anew(path):
    write_frame(path, np.zeros((34, 64), np.uint8))


@pytest.mark.parametrize("change", [draw_anew, lambda path: path.write_bytes(b"another"), Path.unlink])
def test_a_folder_that_only_has_the_same_names_is_another_source(change, tmp_path):
    there, out, here = fill(tmp_path / "there"), tmp_path / "out", tmp_path / "here"
    state = leave_after_reading(there, out)
    there.rename(here)
    assert EarlierRun.find(out, Folder(here, SMALL), str(here)).after == "10"
    change(here / "frames" / SMALL.camera_names[-1] / "10.png")
    assert EarlierRun.find(out, Folder(here, SMALL), str(here)) == EarlierRun(state)


def find_in(folder, out):
    return EarlierRun.find(out, Folder(folder, SMALL), str(folder))


@pytest.mark.parametrize("names", [("9", "10", "11"), ("1", "2")])
def test_new_frames_in_the_same_place_are_another_source(names, tmp_path):
    folder, out = fill(tmp_path / "capture"), tmp_path / "out"
    state = leave_after_reading(folder, out)
    assert find_in(folder, out) == EarlierRun(state, after="10", logged=300, snapshot=8)
    shutil.rmtree(folder)
    assert find_in(fill(folder, names, seed=1, seconds=1.7e9 + 60), out) == EarlierRun(state)


@pytest.mark.parametrize("left", [(), ("9",), ("11",), ("9", "11")])  # by --remove, or by whoever tidies up
def test_frames_that_were_read_may_be_gone(left, tmp_path):
    folder, out = fill(tmp_path / "capture"), tmp_path / "out"
    state = leave_after_reading(folder, out)
    for path in folder.glob("frames/*/*.png"):
        if path.stem not in left:
            path.unlink()
    assert find_in(folder, out) == EarlierRun(state, after="10", logged=300, snapshot=8)


def test_a_folder_is_another_source_where_its_files_were_not_noted(tmp_path):
    state = leave(tmp_path)
    assert EarlierRun.find(tmp_path, Folder(fill(tmp_path / "here"), SMALL), "/here") == EarlierRun(state)


def test_the_loop_notes_the_files_of_the_last_snapshot(tmp_path):
    stamp = FileStamp("7.png", 1_700_000_000)
    exposures = {
        "cam01": Exposure("cam01", 1.0, CameraBlobs.of([]), "7", stamp),
        "cam02": Exposure("cam02", 1.0, CameraBlobs.of([]), "7"),
    }
    with Watch(KeeperOfStates(), tmp_path) as loop:
        loop.process(TimedSnapshot(1.0, exposures, "7"))
    assert Progress.load(tmp_path) == Progress(1.0, "7", logged=0, files={"cam01": stamp})
