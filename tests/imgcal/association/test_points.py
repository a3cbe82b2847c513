"""A light among false blobs, without labels: nothing is labelled wrongly, and what cannot be is refused."""

from dataclasses import replace

import numpy as np
import pytest

from imgcal.association import identify
from imgcal.errors import RefusedError
from imgcal.pipeline import calibrate
from imgcal.types import CalibrationObject, RigPrior
from tests.imgcal.association.stick_scenes import PAIR, capture

LIGHT = ((0.0, 0.0, 0.0),)


@pytest.mark.parametrize(("points", "snapshots"), [(LIGHT, 40), (PAIR, 12)])
def test_labels_among_false_blobs_are_right(points, snapshots):
    rig, obj, blobs, true = capture(points, snapshots)
    result = calibrate(blobs, rig, obj)
    labels = result.labelled_detections.fiducial
    given = labels >= 0
    assert given.sum() > 0.6 * (true >= 0).sum()
    kept = given & (result.labelled_detections.flags == blobs.flags)
    assert (true[kept] >= 0).all()
    for snapshot in range(snapshots):  # a stick may be held either way, but alike in all cameras
        rows = kept & (blobs.snapshot == snapshot)
        same, turned = labels[rows] == true[rows], labels[rows] == len(points) - 1 - true[rows]
        assert same.all() or (len(obj.symmetries) > 1 and turned.all())
    assert float(result.rms) < 0.12


def test_two_lights_are_no_single_light():
    rig, obj, blobs, _ = capture(PAIR, 8, false=0)
    light = CalibrationObject(obj.points[:1], obj.colours[:1])
    with pytest.raises(RefusedError, match="another place"):
        calibrate(blobs, rig, light)


def test_false_blobs_alone_are_no_light():
    rig, obj, blobs, true = capture(LIGHT, 8, false=6)
    noise = blobs.select(true < 0)
    std = RigPrior().std(rig)
    for snapshot in range(8):
        one = noise.select(noise.snapshot == snapshot)
        one = replace(one, snapshot=np.zeros(len(one), dtype=np.int64), snapshot_names=("0",))
        assert not identify(one, rig, obj, std).accepted
