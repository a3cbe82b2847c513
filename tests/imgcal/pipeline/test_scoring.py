import pytest
import torch

from imgcal.association import PipelineOptions
from imgcal.io import read_rig
from imgcal.pipeline import rms_length, score
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from tests.imgcal.lensed import KINDS, lensed


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
