from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.io import data_path, open_capture
from imgcal.training import FrameDataset, cut_labelled, split


def harvest(frames, detections, rig, obj) -> tuple[FrameDataset, FrameDataset]:
    """Crops to learn from, and held out."""
    crops, _ = cut_labelled(frames, detections, rig, obj)
    return split(crops, len(detections.snapshot_names), rig.num_cameras)


@pytest.fixture(scope="module")
def sample():
    """The shipped capture, calibrated: frames by snapshot, blobs, rig, object."""
    folder = data_path("samples", "O10")
    rig = imgcal.load_rig(folder / "truth" / "rig.yaml")
    capture = open_capture(folder, rig)
    frames = dict(enumerate(shown for _, shown in capture.snapshots()))
    return frames, imgcal.detect(capture.frames()), rig, imgcal.load_object(folder / "object.csv")


def test_markers_are_bright_where_the_rig_has_them(sample) -> None:
    frames, blobs, rig, obj = sample
    train, held_out = harvest(frames.get, blobs, rig, obj)
    assert len(train) > 3 * len(held_out) / 2 > 0
    for part in (train, held_out):
        rows, markers = part.seen.nonzero(as_tuple=True)
        column, row = part.place[rows, markers].round().long().clamp(0, 95).unbind(-1)
        light = part.crops[rows, row, column].float()
        assert light.median() == pytest.approx(1.0, abs=0.15)
        assert (light > 0.3).float().mean() > 0.95
        assert part.crops.float().nanmedian().abs() < 0.05  # the ground
        assert (part.seen <= part.asked).all()
        assert part.seen.sum() > 0.9 * part.asked.sum()
    # Of four snapshots, cameras are held out.
    assert set(train.camera.tolist()).isdisjoint(held_out.camera.tolist())


def test_patches_have_their_markers_where_they_say(sample) -> None:
    frames, blobs, rig, obj = sample
    crops, patches = cut_labelled(frames.get, blobs, rig, obj)
    assert len(patches) > 2 * 0.9 * int(crops.seen.sum()) / 3
    light = patches.light.float().clamp(min=0)
    near = torch.arange(24) - 11.5
    bright = light * ((near[None, None] - patches.offset[:, :1, None]).abs() < 5)
    bright = bright * ((near[None, :, None] - patches.offset[:, 1:, None]).abs() < 5)
    total = bright.sum((1, 2))
    centre = torch.stack(((bright.sum(1) * near).sum(1), (bright.sum(2) * near).sum(1)), 1) / total[:, None]
    assert (centre - patches.offset).norm(dim=1).median() < 0.3
    assert patches.offset.abs().max() > 2  # not always in the middle


def test_a_marker_that_the_frame_does_not_show_is_not_seen(sample) -> None:
    frames, blobs, rig, obj = sample
    pose = imgcal.score(blobs, rig, obj)
    seen = pose.labelled.detections
    row = int(np.flatnonzero((seen.snapshot == 0) & (seen.camera == 2) & (seen.fiducial == 4))[0])
    u, v = seen.uv[row].round().astype(int)
    frame = frames[0]["cam03"].copy()
    frame[v - 15 : v + 16, u - 15 : u + 16] = np.median(frame)
    shown = {**frames, 0: {**frames[0], "cam03": frame}}
    without = blobs.select(~((seen.snapshot == 0) & (seen.camera == 2) & (np.abs(seen.uv - (u, v)).max(1) < 15)))
    train, _ = harvest(shown.get, without, rig, obj)
    there = (train.snapshot == 0) & (train.camera == 2)
    assert train.asked[there, 4].all() and not train.seen[there, 4].any()
    assert train.seen[there, 3].all()


def test_markers_of_any_shape_are_seen_where_they_recur(sample) -> None:
    """Rings, which have no light in their middle and which no fit of a spot measures."""
    frames, blobs, rig, obj = sample
    found = imgcal.score(blobs, rig, obj).labelled
    u, v = np.meshgrid(np.arange(-20, 21), np.arange(-20, 21))
    far = np.hypot(u, v)
    shown = {number: {name: np.full_like(frame, 20) for name, frame in each.items()} for number, each in frames.items()}
    table = found.detections
    for row in np.flatnonzero(table.fiducial >= 0):
        frame = shown[int(table.snapshot[row])][rig.camera_names[table.camera[row]]]
        column, line = table.uv[row].round().astype(int)
        size = 1.6 * table.radius[row]
        window = frame[line - 20 : line + 21, column - 20 : column + 21]
        if window.shape == far.shape:
            window[abs(far - size) < 0.3 * size] = 150
    train, held_out = harvest(shown.get, blobs, rig, obj)
    for part in (train, held_out):
        assert part.seen.sum() > 0.8 * part.asked.sum()
        light = part.crops.float().flatten(1).nan_to_num().amax(1)
        assert light.median() == pytest.approx(1.0, abs=0.2)


def made(snapshots: int, cameras: int) -> FrameDataset:
    """Crops of every camera in every snapshot, with nothing in them."""
    snapshot, camera = (
        n.flatten() for n in torch.meshgrid(torch.arange(snapshots), torch.arange(cameras), indexing="ij")
    )
    empty = torch.zeros(len(snapshot), 1)
    return FrameDataset(
        torch.zeros(len(snapshot), 2, 2).half(), torch.zeros(len(snapshot), 1, 2), empty, empty, empty, empty > 0,
        empty > 0, camera, snapshot,
    )  # fmt: skip


@pytest.mark.parametrize("snapshots", [5, 12, 100, 1000])
def test_snapshots_that_are_held_out_have_no_neighbours_among_the_others(snapshots) -> None:
    train, held_out = split(made(snapshots, 2), snapshots, 2)
    learnt, kept = set(train.snapshot.tolist()), set(held_out.snapshot.tolist())
    assert learnt.isdisjoint(kept)
    assert 0.1 * snapshots <= len(kept) <= 0.3 * snapshots
    if snapshots >= 100:
        gap = min(abs(a - b) for a in learnt for b in kept)
        assert gap > 1


def test_a_single_camera_and_snapshot_cannot_be_split() -> None:
    with pytest.raises(RefusedError, match="0 training crops and 1 held-out crop in 1 snapshot of 1 camera,"):
        split(made(1, 1), 1, 1)


def test_another_rig_gives_no_labels(sample) -> None:
    frames, blobs, rig, obj = sample
    other = replace(rig, focal_length=rig.focal_length * 1.5)
    with pytest.raises(RefusedError):
        harvest(frames.get, blobs, other, obj)
