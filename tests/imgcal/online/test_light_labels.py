"""Lights that walk through a room of ten cameras, which stand where they are known to stand, but for one of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.errors import RefusedError
from imgcal.online.keeper_memory import KeeperMemory
from imgcal.online.light_labels import label_lights
from imgcal.synthesis import simulate_volume, true_detections
from imgcal.types import CalibrationObject, Detections

BUMPED = 4


@pytest.fixture(scope="module")
def seen() -> tuple[imgcal.CameraRig, Detections]:
    """A rig, and what it sees of a wand's four markers in six snapshots, with noise; labels are the true ones."""
    rig, wand = imgcal.load_rig("room10"), imgcal.load_object("wand4")
    truth = simulate_volume(rig, wand, 6, torch.Generator().manual_seed(0), None)
    blobs = true_detections(truth)
    noise = np.random.default_rng(0).normal(size=blobs.uv.shape)
    return rig, replace(blobs, uv=blobs.uv + 0.1 * noise, sigma=np.full(len(blobs), 0.1))


def memory_of(rig: imgcal.CameraRig) -> KeeperMemory:
    return KeeperMemory.from_factory(rig, CalibrationObject.unknown(most=8), None, imgcal.PipelineOptions())


def shifted(blobs: Detections, by: tuple[float, float]) -> Detections:
    """What is seen once the camera `BUMPED` has turned."""
    return replace(blobs, uv=blobs.uv + np.where(blobs.camera[:, None] == BUMPED, by, 0.0))


def pairs(found: Detections, truth: Detections) -> set[tuple[int, int]]:
    """Which number goes with which marker."""
    rows = found.fiducial >= 0
    return set(zip(found.fiducial[rows].tolist(), truth.fiducial[rows].tolist(), strict=True))


def test_blobs_of_one_light_have_one_number(seen) -> None:
    rig, blobs = seen
    for snapshot in range(6):
        memory = memory_of(rig)
        assert memory.lights is not None
        given = blobs.of_snapshots(snapshot, snapshot + 1)
        checked, astray = label_lights(memory, memory.lights, given)
        found = pairs(checked.blobs, given)
        assert len(found) == len({number for number, _ in found}) == len({marker for _, marker in found})
        assert checked.labels > 0.9 * len(given)
        assert not checked.off.any()
        assert not astray
        assert checked.usual < 0.2
        named = memory.predicted(checked.rig_from_object)[checked.blobs.camera, checked.blobs.fiducial]
        rows = checked.blobs.fiducial >= 0
        assert float(np.median(np.linalg.norm(named[rows] - given.uv[rows], axis=1))) < 0.3


@pytest.mark.parametrize("by", [(6.0, 2.0), (-20.0, 30.0)])
def test_a_camera_that_was_bumped_is_off_and_its_labels_are_right(seen, by) -> None:
    rig, blobs = seen
    memory, told = memory_of(rig), list[bool]()
    assert memory.lights is not None
    for snapshot in range(6):
        memory.time = 10.0 * snapshot  # lights are elsewhere then
        given = shifted(blobs.of_snapshots(snapshot, snapshot + 1), by)
        checked, _ = label_lights(memory, memory.lights, given)
        found = pairs(checked.blobs, given)
        assert len(found) == len({number for number, _ in found})
        assert set(np.flatnonzero(checked.off).tolist()) <= {BUMPED}
        if (given.camera == BUMPED).sum() > 1:
            told.append(bool(checked.off[BUMPED]))
            assert np.linalg.norm(memory.lights.shift[BUMPED] - by) < 0.1 * np.linalg.norm(by)
    assert told == [False] + [True] * (len(told) - 1)  # a shift that is seen again is none by chance
    assert len(told) > 2


def test_what_no_three_cameras_agree_on_is_refused(seen) -> None:
    rig, blobs = seen
    memory = memory_of(rig)
    assert memory.lights is not None
    given = blobs.of_snapshots(0, 1)
    two = given.select(given.camera < 2)
    with pytest.raises(
        RefusedError, match=r"found no light on which three cameras agree: moving blobs are seen by [12] cameras?"
    ):
        label_lights(memory, memory.lights, two)
