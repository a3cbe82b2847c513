"""A camera that shows an old image again has sent nothing: it is neither late nor has it moved."""

from dataclasses import replace

import numpy as np
import pytest

import imgcal
from imgcal.online import RigKeeper
from imgcal.online.copied_images import CopiedImages
from imgcal.types import Detections
from scripts.benchmarks.rig_streams import Conditions, Stream

RATE = 20.0
STUCK = 2  # number of the camera


def test_a_camera_that_is_stuck_for_a_while_is_neither_late_nor_moved() -> None:
    """It was told to be late by up to 0.2 s, and then lost for good."""
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 1, Conditions(rate=RATE))
    events, kept = [], None
    with RigKeeper(imgcal.load_rig("T4"), made.obj) as keeper:
        for number in range(int(9 * RATE)):
            blobs, time = made.snapshot(number), number / RATE
            if 80 < number <= 90 and kept is not None:
                blobs = Detections.join([blobs.select(blobs.camera != STUCK), kept])
                blobs = replace(blobs, snapshot=np.zeros_like(blobs.snapshot), snapshot_names=blobs.snapshot_names[:1])
            else:
                kept = blobs.select(blobs.camera == STUCK)
            state = keeper.update(blobs, time)
            events += [event.kind for event in state.events]
            if number == 88:
                assert STUCK not in state.detections.camera
    assert not events and set(state.cameras.values()) == {"ok"}


def test_a_camera_that_stays_stuck_is_told_to_send_nothing_new() -> None:
    rig = imgcal.load_rig("T4")
    made, events, kept = Stream(rig, imgcal.load_object("asymmetric8"), 1, Conditions(rate=RATE)), [], None
    with RigKeeper(rig, made.obj) as keeper:
        for number in range(200):
            blobs = made.snapshot(number)
            if 80 < number < 150 and kept is not None:
                blobs = Detections.join([blobs.select(blobs.camera != STUCK), kept])
                blobs = replace(blobs, snapshot=np.zeros_like(blobs.snapshot), snapshot_names=blobs.snapshot_names[:1])
            else:
                kept = blobs.select(blobs.camera == STUCK)
            state = keeper.update(blobs, number / RATE)
            events += state.events
    assert [(event.kind, event.camera) for event in events] == [("camera_lost", "cam03"), ("camera_back", "cam03")]
    assert events[0].message.startswith("cam03 sends nothing usable when the other cameras do")
    assert set(state.cameras.values()) == {"ok"}


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_an_object_at_rest_before_noiseless_cameras_is_seen(noise: float) -> None:
    rng = np.random.default_rng(0)
    made = Stream(imgcal.load_rig("T4"), imgcal.load_object("asymmetric8"), 1, Conditions(rate=RATE))
    blobs, copies = made.snapshot(0), CopiedImages()
    for _ in range(3):
        shown = replace(blobs, uv=blobs.uv + noise * rng.standard_normal(blobs.uv.shape))
        assert copies.leave_out(shown) is shown
    assert copies.leave_out(blobs.select(np.zeros(len(blobs), dtype=bool))).uv.shape == (0, 2)
