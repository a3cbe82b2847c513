"""A refusal says so if labels were given in part only."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.errors import RefusedError
from imgcal.io import load_object, read_rig
from imgcal.pipeline import calibrate, calibrate_from_scratch, score
from imgcal.pipeline.partial_labels import describe_missing_labels
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections

RIG, OBJECT = read_rig("T4"), load_object("asymmetric8")


@pytest.fixture(scope="module")
def blobs():
    return true_detections(simulate_truth(RIG, OBJECT, 12, torch.Generator().manual_seed(0), PhysicalDrift()))


def without_labels(blobs, rows):
    return replace(blobs, fiducial=np.where(rows, -1, blobs.fiducial))


def test_what_lacks_labels_is_named(blobs) -> None:
    camera, snapshot = blobs.camera, blobs.snapshot
    assert describe_missing_labels(blobs) == ""
    assert describe_missing_labels(without_labels(blobs, snapshot >= 0)) == ""
    assert "4 of 12 snapshots have none;" in describe_missing_labels(without_labels(blobs, snapshot >= 8))
    assert "camera cam03 has none;" in describe_missing_labels(without_labels(blobs, camera == 2))
    both = describe_missing_labels(without_labels(blobs, (snapshot >= 8) | (camera == 2) | (camera == 0)))
    assert "4 of 12 snapshots have none, cameras cam01, cam03 have none;" in both
    assert describe_missing_labels(without_labels(blobs, blobs.fiducial == 5)) == ""  # false blobs have none
    empty = blobs.select((snapshot != 3) & (camera != 1))  # nothing seen is nothing to label
    assert describe_missing_labels(empty) == ""


def test_a_refusal_says_which_camera_has_no_labels(blobs) -> None:
    given = without_labels(blobs, blobs.camera == 2)
    expected = "labels are given in part only: camera cam03 has none; .* give all labels, or none$"
    with pytest.raises(RefusedError, match=f"^camera cam03: the other cameras put .*; {expected}") as found:
        calibrate(given, RIG, OBJECT)
    assert "--without cam03; labels are given in part only" in found.value.for_command
    assert found.value.reason.endswith("give all labels, or none")
    with pytest.raises(RefusedError, match=f"cannot be placed .*; {expected}"):
        calibrate_from_scratch(given, RIG, OBJECT)


def test_a_refusal_with_a_cause_says_it_too_and_one_of_whole_labels_does_not(blobs) -> None:
    small = replace(OBJECT, points=OBJECT.points / 1000)
    for refuse in (calibrate, score):
        with pytest.raises(RefusedError, match=r"as if it were in metres.*6 of 12 snapshots have none") as found:
            refuse(without_labels(blobs, blobs.snapshot >= 6), RIG, small)
        assert isinstance(found.value.__cause__, RefusedError)
        with pytest.raises(RefusedError) as whole:
            refuse(blobs, RIG, small)
        assert "labels are given" not in str(whole.value)
