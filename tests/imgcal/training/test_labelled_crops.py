from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.io import data_path, open_capture
from imgcal.synthesis import simulate_truth, true_detections
from imgcal.training import FrameDataset, cut_labelled, split
from tests.imgcal.shuffled import shuffled


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


def test_bars_are_learned_where_their_light_is(sample) -> None:
    """A detector of spots finds an end of each bar, 7 to 20 pixels from its middle."""
    frames, blobs, rig, obj = sample
    random, table = np.random.default_rng(0), imgcal.score(blobs, rig, obj).labelled.detections
    table = table.select(table.fiducial >= 0)
    shown = {number: {name: np.full_like(frame, 20) for name, frame in each.items()} for number, each in frames.items()}
    found = replace(table, uv=table.uv.copy())
    for row, (place, size) in enumerate(zip(table.uv, table.radius, strict=True)):
        frame = shown[int(table.snapshot[row])][rig.camera_names[table.camera[row]]]
        angle = random.uniform(0, np.pi)
        along = 2 * size * np.array([np.cos(angle), np.sin(angle)])
        ends = np.rint(16 * np.stack((place - along, place + along))).astype(int).tolist()
        cv2.line(frame, *ends, 150, max(int(size / 2), 2), cv2.LINE_AA, 4)
        found.uv[row] += along * random.choice((-1, 1))
    crops, patches = cut_labelled(shown.get, found, rig, obj)
    assert crops.seen.sum() > 0.9 * crops.asked.sum()
    assert len(patches) > 2 * len(table)
    light = patches.light.float().clamp(min=0)
    near = torch.arange(24) - 11.5
    centre = torch.stack([(light.sum(axis) * near).sum(1) for axis in (1, 2)], 1) / light.sum((1, 2))[:, None]
    assert (centre - patches.offset).norm(dim=1).median() < 0.3


def test_a_snapshot_that_no_pose_fits_gives_no_crops_and_the_others_do(o10) -> None:
    wand = imgcal.load_object("wand4")
    truth = simulate_truth(o10, wand, 6, torch.Generator().manual_seed(0), None)
    table = shuffled(true_detections(truth), [2])
    frames = {name: np.zeros(size[::-1], dtype=np.uint8)
              for name, size in zip(o10.camera_names, o10.image_size.tolist(), strict=True)}  # fmt: skip
    for row in np.flatnonzero(table.fiducial >= 0):
        cv2.circle(frames[o10.camera_names[table.camera[row]]], np.rint(table.uv[row]).astype(int).tolist(), 6, 200, -1)
    crops, _ = cut_labelled(lambda _: frames, table, truth.rig, wand)
    assert set(crops.snapshot.tolist()) == {0, 1, 3, 4, 5}


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


@pytest.mark.parametrize("snapshots", [5, 6, 12, 19, 20, 100, 1000])
def test_snapshots_that_are_held_out_have_no_neighbours_among_the_others(snapshots) -> None:
    train, held_out = split(made(snapshots, 2), snapshots, 2)
    learnt, kept = set(train.snapshot.tolist()), set(held_out.snapshot.tolist())
    assert learnt.isdisjoint(kept)
    assert 0.1 * snapshots <= len(kept) <= 0.3 * snapshots
    assert len(learnt) >= 0.4 * snapshots
    assert min(abs(a - b) for a in learnt for b in kept) > 1


def test_a_single_camera_and_snapshot_cannot_be_split() -> None:
    with pytest.raises(RefusedError, match="crops: found 0 for training and 1 held out in 1 snapshot of 1 camera,"):
        split(made(1, 1), 1, 1)


def test_another_rig_gives_no_labels(sample) -> None:
    frames, blobs, rig, obj = sample
    other = replace(rig, focal_length=rig.focal_length * 1.5)
    with pytest.raises(RefusedError):
        harvest(frames.get, blobs, other, obj)
