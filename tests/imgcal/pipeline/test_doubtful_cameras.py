"""A camera that stops fitting at the end of a capture is named, since it is too early to call it a bump."""

import numpy as np
import pytest

from imgcal.pipeline import calibrate
from scripts.benchmarks import camera_faults as damage

CAMERA, NAME = 3, "cam04"
MAKE = {"room": damage.wand_in_a_room, "ring": damage.object_before_a_ring}


def bumped(kind, first, degrees, snapshots=12, **what):
    rig, obj, truth = MAKE[kind](snapshots, 1)
    truth = damage.changed_from(truth, obj, CAMERA, first, lambda r: damage.turned(r, CAMERA, degrees))
    return damage.blobs(truth, 1, **what), rig, obj


@pytest.mark.parametrize("labelled", [False, True])
@pytest.mark.parametrize(("kind", "degrees"), [("room", 0.3), ("room", 1.0), ("ring", 0.2), ("ring", 2.0)])
def test_a_camera_that_is_bumped_before_the_last_snapshot_is_named(kind, degrees, labelled):
    table, rig, obj = bumped(kind, 11, degrees, labelled=labelled)
    result = calibrate(table, rig, obj)
    (found,) = result.doubtful
    assert (found.camera, found.snapshots) == (NAME, ("00011",)) and result.moved == ()
    assert "cam04 stopped fitting at snapshot 00011: bumped, or mislabelled" in str(found)


def test_a_camera_that_sees_the_object_no_more_is_named_by_its_last_snapshots():
    table, rig, obj = bumped("ring", 8, 1.0)
    table = table.select(~((table.camera == CAMERA) & (table.snapshot > 8)))
    (found,) = calibrate(table, rig, obj).doubtful
    assert (found.camera, found.snapshots) == (NAME, ("00008",))


@pytest.mark.parametrize("kind", MAKE)
@pytest.mark.parametrize("what", ["steady", "hidden", "in between", "clutter"])
def test_cameras_that_fit_at_the_end_are_not_named(kind, what):
    if what == "in between":  # off once, and right again: the rig is as it is now
        table, rig, obj = bumped(kind, 6, 1.0)
        sound, _, _ = bumped(kind, 12, 1.0)
        table = damage.joined(table.select(table.snapshot == 6), sound.select(sound.snapshot != 6))
        table = table.select(np.argsort(table.snapshot, kind="stable"))
    else:
        table, rig, obj = bumped(kind, 12, 1.0, labelled=True, clutter=1.0)
        if what != "steady":  # nothing but false blobs is left in the last snapshot
            table = table.select((table.camera != CAMERA) | (table.snapshot < 11) | (table.fiducial < 0))
        if what != "clutter":
            table = table.select((table.camera != CAMERA) | (table.snapshot < 11) | (table.fiducial >= 0))
        table.fiducial[:] = -1
    assert calibrate(table, rig, obj).doubtful == ()
