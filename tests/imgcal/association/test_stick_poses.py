"""Unlabelled sticks among false blobs: no wrong labels, and impossible cases are refused."""

import pytest
import torch

from imgcal.association import PipelineOptions, Tracker, identify
from imgcal.association.blobs import gather
from imgcal.association.stick_poses import fit_sticks
from imgcal.association.verification import Known, Scene, rig_and_pose
from imgcal.pipeline import calibrate
from imgcal.types import CalibrationObject, RigPrior
from tests.imgcal.association.stick_scenes import PAIR, TRIPLE, capture, one_snapshot


@pytest.mark.parametrize("points", [PAIR, TRIPLE])
def test_labels_among_false_blobs_are_right(points):
    rig, obj, blobs, true = capture(points, 6)
    tracker, found = Tracker(rig, obj, PipelineOptions()), 0
    for snapshot in range(6):
        one, labels = one_snapshot(blobs, snapshot), true[blobs.snapshot == snapshot]
        identity, given = tracker.decide(one, str(snapshot))
        named = given >= 0
        found += int(named.sum())
        turned = len(points) - 1 - labels[named] if len(obj.symmetries) > 1 else labels[named]
        assert (labels[named] >= 0).all()
        assert (given[named] == labels[named]).all() or (given[named] == turned).all()
        assert identity.status in ("unique", "ambiguous", "refused")
    assert found > 0.5 * (true >= 0).sum()


def test_a_capture_of_a_stick_among_false_blobs_is_labelled_rightly():
    rig, obj, blobs, true = capture(PAIR, 12)
    result = calibrate(blobs, rig, obj)
    labels = result.labelled_detections.fiducial
    kept = (labels >= 0) & (result.labelled_detections.flags == blobs.flags)
    assert (labels >= 0).sum() > 0.6 * (true >= 0).sum()
    assert (true[kept] >= 0).all()
    for snapshot in range(12):  # a stick may be held either way, but alike in all cameras
        rows = kept & (blobs.snapshot == snapshot)
        assert (labels[rows] == true[rows]).all() or (labels[rows] == 1 - true[rows]).all()
    assert float(result.rms) < 0.12


def test_false_blobs_alone_are_no_stick():
    rig, obj, blobs, true = capture(TRIPLE, 4, false=6)
    noise = blobs.select(true < 0)
    for snapshot in range(4):
        assert not identify(one_snapshot(noise, snapshot), rig, obj, RigPrior().std(rig)).accepted


def test_one_camera_alone_knows_no_stick():
    rig, obj, blobs, _ = capture(PAIR, 1)
    one = one_snapshot(blobs.select(blobs.camera == 0), 0)
    assert not identify(one, rig, obj, RigPrior().std(rig)).accepted


def test_the_stick_is_where_its_markers_are():
    rig, obj, blobs, true = capture(TRIPLE, 1, false=0)
    scene = Scene(gather(one_snapshot(blobs, 0), rig), Known(obj, rig, RigPrior().std(rig)))
    fits = fit_sticks(scene, seed=0)
    assert fits is not None
    assert (scene.blobs.to_rows(fits.labels[0]) == true).mean() > 0.9
    _, pose = rig_and_pose(scene, fits, 0)
    places = pose.apply(obj.points)
    assert torch.allclose((places[2] - places[0]).norm(), torch.tensor(500.0, dtype=torch.float64))


def test_stick_of_another_length_is_refused():
    rig, obj, blobs, _ = capture(PAIR, 1, false=0)
    longer = CalibrationObject(2 * obj.points, obj.colours)
    assert not identify(one_snapshot(blobs, 0), rig, longer, RigPrior().std(rig)).accepted
