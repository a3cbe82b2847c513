from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import PipelineOptions, Tracker
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections


@pytest.fixture(scope="module")
def seen(o10, asymmetric8):
    truth = simulate_truth(o10, asymmetric8, 2, torch.Generator().manual_seed(5), PhysicalDrift())
    return true_detections(truth)


def unlabelled(seen, snapshot):
    blobs = seen.of_snapshots(snapshot, snapshot + 1)
    return replace(blobs, fiducial=np.full(len(blobs), -1))


def test_an_accepted_snapshot_teaches_the_rig_and_the_pose(seen, o10, asymmetric8):
    tracker = Tracker(o10, asymmetric8, PipelineOptions())
    before = tracker.prior_std.clone()
    snapshot, labels = tracker.decide(unlabelled(seen, 0), "first")
    assert snapshot.status == "unique" and (labels == seen.fiducial[:80]).all()
    assert bool((tracker.prior_std <= before).all()) and bool((tracker.prior_std < 0.9 * before).any())
    again, _ = tracker.decide(unlabelled(seen, 0), "again")
    assert again.status == "by_tracking"


def test_too_few_fiducials_teach_nothing(seen, o10, asymmetric8):
    tracker = Tracker(o10, asymmetric8, PipelineOptions(least_fiducials=9))
    snapshot, _ = tracker.decide(unlabelled(seen, 0), "first")
    assert snapshot.status == "refused" and "too few fiducials" in snapshot.reason
    assert tracker.pose is None and not tracker.accepted
