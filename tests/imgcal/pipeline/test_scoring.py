import pytest
import torch

from imgcal.association import PipelineOptions
from imgcal.errors import RefusedError
from imgcal.io import load_object, read_rig
from imgcal.pipeline import rms_length, score
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from tests.imgcal.lensed import KINDS, lensed
from tests.imgcal.shuffled import shuffled


def test_a_score_needs_no_prior(o10, asymmetric8):
    truth = simulate_truth(o10, asymmetric8, 6, torch.Generator().manual_seed(0), PhysicalDrift())
    table = true_detections(truth)
    assert score(table, truth.rig, asymmetric8).distances.max() < 1e-6
    assert score(table, o10, asymmetric8, PipelineOptions()).distances.mean() > 1


@pytest.mark.parametrize("lens", KINDS)
def test_rigs_of_other_lenses_are_scored(asymmetric8, lens):
    factory = lensed(read_rig("T4"), lens)
    truth = simulate_truth(factory, asymmetric8, 4, torch.Generator().manual_seed(1), PhysicalDrift())
    table = true_detections(truth)
    assert score(table, truth.rig, asymmetric8).distances.max() < 1e-6
    assert score(table, factory, asymmetric8).distances.mean() > 5


def test_the_rms_is_of_lengths_and_of_what_was_seen():
    residual = torch.tensor([[3.0, 4.0], [0.0, 1.0], [100.0, 100.0]])
    assert rms_length(residual, torch.tensor([True, True, False])) == pytest.approx((26 / 2) ** 0.5)
    assert rms_length(residual, torch.zeros(3, dtype=torch.bool)) is None


def test_a_snapshot_that_no_pose_fits_is_left_out_and_the_others_are_scored(o10):
    wand = load_object("wand4")
    truth = simulate_truth(o10, wand, 6, torch.Generator().manual_seed(0), None)
    table = true_detections(truth)
    found = score(shuffled(table, [2]), truth.rig, wand)
    assert found.labelled.used == [0, 1, 3, 4, 5] and found.distances.max() < 1e-6
    assert "no pose" in found.labelled.snapshots[2].reason
    assert (found.labelled.detections.fiducial[table.snapshot == 2] == -1).all()
    with pytest.raises(RefusedError, match="no pose of the object fits what the cameras see in 1 of 1 snapshots"):
        score(shuffled(table, [2]).of_snapshots(2, 3), truth.rig, wand)
