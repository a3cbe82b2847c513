"""Several known objects in one capture: each blob goes to one object at most, and nothing is guessed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import Associations, IdentityOptions, PipelineOptions, Tracker, associate
from imgcal.association.several_objects import place_objects
from imgcal.association.tracker import LearntRig
from imgcal.pipeline import calibrate
from imgcal.types import CalibrationObject, MovedError
from tests.imgcal.association.stick_scenes import BODY, PAIR, one_snapshot, several

WAND = ((160.0, 0.0, 0.0), (0.0, 0.0, 0.0), (-80.0, 0.0, 20.0), (0.0, -120.0, 0.0), (0.0, -240.0, 50.0))


def wrong(found: Associations, true, obj: CalibrationObject) -> int:
    """Labels of clutter, or of another object than a row says."""
    labels = found.detections.fiducial
    named = labels >= 0
    return int((true[named] < 0).sum() + (obj.part_of[labels[named]] != obj.part_of[true[named]]).sum())


def test_two_objects_are_told_apart_and_no_blob_has_two():
    rig, obj, blobs, true = several([BODY, WAND], 4)
    found = associate(blobs, rig, obj)
    assert wrong(found, true, obj) == 0
    assert (found.detections.fiducial >= 0).sum() > 0.6 * (true >= 0).sum()
    assert len(found.used) >= 6
    assert {found.snapshots[row].part for row in found.used} == {0, 1}
    # Rows are of moments, in order, and blobs are where their labels are.
    assert (np.diff(found.moments) >= 0).all()
    labels = found.detections.fiducial
    row = found.detections.snapshot[labels >= 0]
    part = np.array([snapshot.part for snapshot in found.snapshots])
    assert (part[row] == obj.part_of[labels[labels >= 0]]).all()
    assert (found.by_moment().snapshot == blobs.snapshot).all()


def test_two_equal_objects_have_disjoint_labels():
    rig, obj, blobs, true = several([BODY, BODY], 3)
    found = associate(blobs, rig, obj)
    labels = found.detections.fiducial
    named = labels >= 0
    assert len(found.used) >= 5
    assert (true[named] >= 0).all()
    assert (labels[named] % len(BODY) == true[named] % len(BODY)).all()
    for row in found.used:  # a row is one of the two, whichever
        own = named & (found.detections.snapshot == row)
        assert len(np.unique(true[own] // len(BODY))) == 1


def test_one_object_told_twice_is_found_once():
    rig, single, blobs, _ = several([BODY], 2)
    both = CalibrationObject.of_several([single, single])
    found = associate(blobs, rig, both)
    assert len(found.used) == 2
    assert len(set(found.moments[found.used])) == 2


def test_an_object_that_may_be_either_of_two_places_is_refused():
    rig, both, blobs, _ = several([BODY, BODY], 1, seed=3, false=0)  # both are seen equally well
    options = PipelineOptions(identity=IdentityOptions(others_in_view=True))
    part = both.parts[0]
    tracker = Tracker(rig, part, options, learnt=LearntRig(rig, part, options, 64))
    rows, reason = place_objects([tracker], [0], one_snapshot(blobs, 0), "0", 0)
    assert not rows
    assert "another place" in reason


def test_a_stick_beside_an_object_that_is_not_found_is_left_out():
    rig, obj, blobs, true = several([BODY, PAIR], 2)
    only_stick = blobs.select(true >= len(BODY))
    options = PipelineOptions()
    learnt = LearntRig(rig, obj, options, 64)
    trackers = [Tracker(rig, part, options, learnt=learnt, first=f) for part, f in zip(obj.parts, (0, 5), strict=True)]
    rows, _ = place_objects(trackers, [0, 1], one_snapshot(only_stick, 0), "0", 0)
    assert not rows


def test_labels_of_the_input_make_rows():
    rig, obj, blobs, true = several([BODY, PAIR], 2, false=1)
    found = associate(replace(blobs, fiducial=true), rig, obj)
    assert found.identity == "coded"
    assert (found.detections.fiducial == true).all()
    assert found.part_of_rows.tolist() == [0, 1, 0, 1]
    assert found.before_rows.tolist() == [-1, -1, 0, 1]
    assert torch.equal(torch.from_numpy(found.columns(obj).sum((1, 2))), torch.tensor([5, 2, 5, 2]))
    repeated = found.repeat_unlabelled(obj)
    clutter = int((true < 0).sum())
    assert len(repeated) == len(blobs) + clutter


def test_a_rig_is_calibrated_from_two_objects_and_has_a_pose_of_each():
    rig, obj, blobs, _ = several([BODY, WAND], 6)
    result = calibrate(blobs, rig, obj.parts)
    assert float(result.rms) < 0.17
    assert 0.7 < float(result.chi2_per_dof) < 1.3
    poses = result.poses_by_object
    assert list(poses) == ["object0", "object1"]
    assert sum(map(len, poses.values())) == len(result.labelled.used) >= 9
    row = result.labelled.used[0]
    name, part = result.labelled.snapshots[row].name, obj.parts[result.labelled.snapshots[row].part]
    assert part.origin is not None
    there = poses[part.name][name].apply((part.points + part.origin).mean(0, keepdim=True))
    assert torch.allclose(there[0], result.rig_from_object.translation[0], atol=1e-6)


def test_a_camera_that_moves_is_named_where_objects_share_its_snapshots():
    rig, obj, blobs, true = several([BODY, WAND], 12, false=0)
    moved = (blobs.camera == 2) & (blobs.snapshot >= 6)
    uv = np.where(moved[:, None], blobs.uv + 12.0, blobs.uv)
    labelled = replace(blobs, uv=uv, fiducial=true)
    with pytest.raises(MovedError, match="cam03 moved before snapshot 00006"):
        calibrate(labelled, rig, obj.parts)
    since = calibrate(labelled, rig, obj.parts, PipelineOptions(after_last_move=True))
    assert set(since.labelled.moments[since.labelled.used]) == set(range(6, 12))
    assert [move.camera for move in since.moved] == ["cam03"]
