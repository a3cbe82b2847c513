from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.errors import InputError, RefusedError
from imgcal.labelling import label, matched_to_rig, to_observations
from imgcal.simulation import simulate_truth, true_detections
from imgcal.synthesis import PhysicalDrift


@pytest.fixture(scope="module")
def seen(o10, asymmetric8):
    """Four snapshots, noise-free, labelled."""
    return true_detections(simulate_truth(o10, asymmetric8, 4, torch.Generator().manual_seed(0), PhysicalDrift()))


def without_labels(detections):
    return replace(detections, fiducial=np.full(len(detections), -1))


def test_labels_are_found_again(seen, o10, asymmetric8):
    labelled = label(without_labels(seen), o10, asymmetric8)
    assert np.array_equal(labelled.detections.fiducial, seen.fiducial)
    assert labelled.identity == "unique"
    assert labelled.used == [0, 1, 2, 3]


def test_one_dark_snapshot_is_left_out(seen, o10, asymmetric8):
    labelled = label(without_labels(seen.select(seen.snapshot != 2)), o10, asymmetric8)
    assert labelled.used == [0, 1, 3]
    assert labelled.snapshots[2].status == "refused"
    assert "blobs" in labelled.snapshots[2].reason


def test_nothing_seen_is_refused(seen, o10, asymmetric8):
    with pytest.raises(RefusedError, match="4 of 4 snapshots"):
        label(without_labels(seen.select(seen.snapshot > 9)), o10, asymmetric8)


def test_cameras_are_put_in_the_order_of_the_rig(seen, o10):
    reordered = tuple(reversed(seen.camera_names))
    other = replace(seen, camera_names=reordered, camera=9 - seen.camera)
    assert np.array_equal(matched_to_rig(other, o10).camera, seen.camera)
    with pytest.raises(InputError, match="cam99"):
        matched_to_rig(replace(seen, camera_names=("cam99", *seen.camera_names[1:])), o10)


def test_observations_are_dense(seen, o10, asymmetric8):
    missing = seen.select(~((seen.camera == 3) & (seen.fiducial == 5)))
    observations = to_observations(missing, o10, asymmetric8)
    assert observations.uv.shape == (4, 10, 8, 2)
    assert int(observations.seen.sum()) == 4 * 79 and not observations.seen[:, 3, 5].any()
    row = np.flatnonzero((seen.snapshot == 2) & (seen.camera == 7) & (seen.fiducial == 1))[0]
    assert np.array_equal(observations.uv[2, 7, 1].numpy(), seen.uv[row])
