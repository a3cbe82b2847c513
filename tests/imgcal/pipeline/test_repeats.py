"""Exact copies of blobs are found, left out and reported; merely similar ones stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.pipeline.repeats import Repeats, drop_repeats
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import CalibrationObject, CameraRig, Detections


@pytest.fixture(scope="module")
def capture() -> tuple[Detections, CameraRig, CalibrationObject]:
    """Six snapshots of four cameras with labels, 0.05 px of noise."""
    rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    truth = simulate_truth(rig, obj, 6, torch.Generator().manual_seed(1), PhysicalDrift())
    blobs = true_detections(truth)
    noise = np.random.default_rng(1).normal(scale=0.05, size=blobs.uv.shape)
    return replace(blobs, uv=blobs.uv + noise, sigma=np.full(len(blobs), 0.05)), rig, obj


def stalled(blobs: Detections, times: int) -> Detections:
    """Each snapshot several times, one after the other."""
    count = len(blobs.snapshot_names)
    parts = [replace(blobs, snapshot=times * blobs.snapshot + k) for k in range(times)]
    columns = ("uv", "sigma", "camera", "snapshot", "fiducial", "radius", "flags")
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in columns}
    return replace(blobs, **joined, snapshot_names=tuple(f"{k:05d}" for k in range(times * count)))


def test_a_capture_without_copies_stays_as_it_is(capture) -> None:
    blobs, *_ = capture
    left, found = drop_repeats(blobs)
    assert left is blobs
    assert found == Repeats()
    assert str(found) == ""


def test_a_stalled_grabber_says_as_much_as_one_image_each(capture) -> None:
    blobs, rig, obj = capture
    alone, again = imgcal.calibrate(blobs, rig, obj), imgcal.calibrate(stalled(blobs, 5), rig, obj)
    assert torch.allclose(again.rig.focal_length, alone.rig.focal_length, atol=1e-6)
    assert again.predicted_error.median_px == pytest.approx(alone.predicted_error.median_px, rel=1e-3)
    assert len(again.repeats.snapshots) == 24 and again.repeats.images == 96
    assert "24 whole snapshots" in str(again.repeats)
    assert again.labelled.used == [0, 5, 10, 15, 20, 25]
    assert again.labelled.snapshots[7].reason == "a copy of snapshot 00005"


def test_rows_that_stand_twice_count_once(capture) -> None:
    blobs, *_ = capture
    unlabelled = replace(blobs, fiducial=np.full(len(blobs), -1))
    twice = unlabelled.select(np.repeat(np.arange(len(blobs)), 2))
    left, found = drop_repeats(twice)
    assert found == Repeats(rows=len(blobs))
    assert np.array_equal(left.uv, blobs.uv)
    assert str(found) == f"{len(blobs)} blobs are listed twice: these copies are left out"


def test_one_camera_that_stands_still(capture) -> None:
    blobs, *_ = capture
    uv = blobs.uv.copy()
    first = (blobs.snapshot == 2) & (blobs.camera == 1)
    uv[(blobs.snapshot == 3) & (blobs.camera == 1)] = uv[first]
    left, found = drop_repeats(replace(blobs, uv=uv))
    assert found == Repeats(copies=((3, blobs.camera_names[1]),)) and found.images == 1
    assert not ((left.snapshot == 3) & (left.camera == 1)).any()
    assert len(left) == len(blobs) - first.sum()


def test_order_of_rows_does_not_matter(capture) -> None:
    blobs, *_ = capture
    many = stalled(blobs, 2)
    mixed = many.select(np.random.default_rng(3).permutation(len(many)))
    assert drop_repeats(mixed)[1] == drop_repeats(many)[1]


def test_a_reflection_at_rest_is_no_copy(capture) -> None:
    blobs, *_ = capture
    one = blobs.select(np.flatnonzero(blobs.camera == 0)[[0, -1]])
    still = replace(one, uv=np.tile(one.uv[:1], (2, 1)))
    assert drop_repeats(still)[1] == Repeats()


@pytest.mark.parametrize("name", ["asymmetric8", "lights"])
def test_one_cameras_frames_under_two_names_are_refused(capture, name) -> None:
    blobs, rig, _ = capture
    if name == "lights":  # one blob an image
        blobs = blobs.select(blobs.fiducial == 0)
        blobs = replace(blobs, fiducial=np.full(len(blobs), -1))
    own = blobs.select(blobs.camera != 2)
    copy = blobs.select(blobs.camera == 1)
    columns = ("uv", "sigma", "snapshot", "fiducial", "radius", "flags")
    joined = {name: np.concatenate([getattr(own, name), getattr(copy, name)]) for name in columns}
    camera = np.concatenate([own.camera, np.full(len(copy), 2)])
    both = replace(own, camera=camera, **joined)
    with pytest.raises(imgcal.RefusedError, match="cameras cam02, cam03: found identical images in 6 snapshots"):
        imgcal.calibrate(both, rig, imgcal.load_object(name))


def test_one_identical_image_of_two_cameras_is_left_to_the_other_checks(capture) -> None:
    blobs, *_ = capture
    uv = blobs.uv.copy()
    first, second = ((blobs.snapshot == 2) & (blobs.camera == c) for c in (1, 2))
    count = min(first.sum(), second.sum())
    keep = np.ones(len(blobs), dtype=np.bool_)
    for own in (first, second):
        keep[np.flatnonzero(own)[count:]] = False
    uv[np.flatnonzero(second)[:count]] = uv[np.flatnonzero(first)[:count]]
    assert drop_repeats(replace(blobs, uv=uv).select(keep))[1] == Repeats()


def test_nothing_at_all(capture) -> None:
    blobs, *_ = capture
    nothing = blobs.select(np.zeros(len(blobs), dtype=np.bool_))
    assert drop_repeats(nothing) == (nothing, Repeats())
