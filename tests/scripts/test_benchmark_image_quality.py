"""The benchmark of alarms about image quality: its world, its labels, and how delays are counted."""

import numpy as np
import pytest

from imgcal.online import Event
from scripts.benchmarks.image_quality import CAMERA, SPOILT_AT, World, counted, delays, labelled, nearest_labels


def test_the_world_has_labels_that_fit_and_only_its_camera_gets_worse():
    good, bad = (next(World(1, fault, spoilt_at=0.0).states(1 / 15)) for fault in ("none", "defocused"))
    blobs = good.detections
    off = blobs.uv - good.predicted[blobs.camera, blobs.fiducial]
    assert len(blobs) > 40 and np.abs(off / blobs.sigma[:, None]).max() < 10
    ratio = bad.detections.radius / blobs.radius
    assert ratio[blobs.camera == CAMERA] == pytest.approx(1.25) and ratio[blobs.camera != CAMERA] == pytest.approx(1.0)


def test_blobs_are_labelled_where_they_are_near():
    state = next(World(1).states(1 / 15))
    assert (nearest_labels(state.detections, state.predicted).fiducial == state.detections.fiducial).mean() > 0.9
    assert (nearest_labels(state.detections, state.predicted + 50.0).fiducial < 0).mean() > 0.9


def test_delays_and_false_alarms_are_counted():
    def event(seconds, kind, camera):
        return Event(1.7e9 + seconds, 0, kind, camera)

    events = [event(190.0, "dirty", "cam04"), event(195.0, "dirty", "cam01"), event(3.0, "defocused", "cam04")]
    assert delays(events, "dirty", SPOILT_AT) == {"seconds": 10.0, "false": 2}
    assert delays([], "dirty", SPOILT_AT) == {"seconds": None, "false": 0}
    assert counted(events)["dirty"] == 2 and counted(events)["defocused"] == 1


@pytest.mark.benchmark
def test_smoke():
    assert labelled(0, "none", 60.0) == []
