"""Where a fit starts must not decide where it ends."""

import numpy as np
import pytest
import torch

from imgcal.labelling import label
from imgcal.pipeline import calibrate, fit_labelled
from imgcal.simulation import simulate_truth, true_detections
from imgcal.synthesis import PhysicalDrift


def two_captures(rig, obj, noise=0.05):
    """Labelled detections of two snapshots of one drifted rig."""
    truth = simulate_truth(rig, obj, 2, torch.Generator().manual_seed(3), PhysicalDrift())
    table = true_detections(truth)
    table.uv[:] += noise * np.random.default_rng(3).standard_normal(table.uv.shape)
    table.sigma[:] = 0.05
    return table.of_snapshots(0, 1), table.of_snapshots(1, 2)


@pytest.mark.parametrize("noise", [0.05, 0.3])  # as the blobs say, and six times as much
def test_the_latest_result_is_a_start_and_no_more(noise, o10, asymmetric8):
    before, now = two_captures(o10, asymmetric8, noise)
    latest = calibrate(before, o10, asymmetric8)
    labelled = label(now, o10, asymmetric8)
    fresh = fit_labelled(labelled, o10, asymmetric8)
    followed = fit_labelled(labelled, o10, asymmetric8, latest=latest)
    assert torch.equal(followed.observations.seen, fresh.observations.seen)
    assert followed.model_error == pytest.approx(fresh.model_error, rel=0.05)
    shift = followed.rig.difference(fresh.rig).abs() / fresh.problem.spread[0]
    assert shift.max() < 0.02  # standard deviations of the prior: the solver stops where the cost falls by 1e-4


def test_the_latest_result_gives_way_where_a_label_does_not_fit(o10, asymmetric8):
    before, now = two_captures(o10, asymmetric8)
    latest = calibrate(before, o10, asymmetric8)
    now.uv[[5, 30, 61]] += (9.0, -7.0)
    labelled = label(now, o10, asymmetric8)
    fresh = fit_labelled(labelled, o10, asymmetric8)
    followed = fit_labelled(labelled, o10, asymmetric8, latest=latest)
    assert fresh.outliers >= 3
    assert torch.equal(followed.observations.seen, fresh.observations.seen)
    torch.testing.assert_close(followed.rig.focal_length, fresh.rig.focal_length)
