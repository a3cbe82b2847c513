from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import PipelineOptions, Tracker, associate
from imgcal.synthesis import PhysicalDrift, arrange_rig, simulate_truth, simulate_volume, true_detections
from imgcal.types import CalibrationObject


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
    assert tracker.pose is None and not tracker.learnt.accepted


def test_snapshots_that_show_a_line_alone_teach_the_rig_nothing():
    """They say nothing of how the object is turned about that line: no rig can be estimated with them."""
    rig, bar = arrange_rig("ring", 6, 3000.0, height=1500.0), [(x, 0.0, 0.0) for x in (-200.0, -80.0, 0.0, 200.0)]
    points = torch.tensor([*bar, (0.0, -380.0, 0.0)], dtype=torch.float64)
    wand = CalibrationObject(points, torch.zeros_like(points))
    blobs = true_detections(simulate_volume(rig, wand, 6, torch.Generator().manual_seed(1), None))
    blobs = blobs.select((blobs.snapshot > 0) | (blobs.fiducial < 4))
    found = associate(replace(blobs, fiducial=np.full(len(blobs), -1)), rig, wand)
    right = found.detections.fiducial == blobs.fiducial
    assert right[blobs.snapshot > 0].mean() > 0.9
