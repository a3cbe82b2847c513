import pytest
import torch

from imgcal.association import (
    PipelineOptions,
    accepted_observations,
    associate,
    fit_snapshot_poses,
    refuse_unfit,
)
from imgcal.errors import RefusedError
from imgcal.io import load_object
from imgcal.synthesis import simulate_truth, true_detections
from tests.imgcal.shuffled import shuffled


@pytest.fixture(scope="module")
def capture(o10):
    wand = load_object("wand4")
    return simulate_truth(o10, wand, 6, torch.Generator().manual_seed(0), None), wand


def labels(table, truth, wand):
    options = PipelineOptions().of_object(wand)
    labelled = associate(table, truth.rig, wand, options)
    observations, start = accepted_observations(labelled, truth.rig, wand)
    return labelled, fit_snapshot_poses(observations, truth.rig, wand, start, options.estimation)


def test_every_snapshot_is_fitted_on_its_own(capture):
    truth, wand = capture
    labelled, (poses, fits) = labels(shuffled(true_detections(truth), [2]), truth, wand)
    assert fits.tolist() == [True, True, False, True, True, True]
    off = (poses.translation - truth.rig_from_object.translation).norm(dim=-1)
    assert off[fits].max() < 1e-4
    assert refuse_unfit(labelled, fits, "score").used == [0, 1, 3, 4, 5]


def test_a_rig_that_fits_few_snapshots_is_refused(capture):
    truth, wand = capture
    labelled, (_, fits) = labels(shuffled(true_detections(truth), [2]).of_snapshots(2, 3), truth, wand)
    with pytest.raises(RefusedError, match="harvest: no pose of the object fits what the cameras see in 1 of 1"):
        refuse_unfit(labelled, fits, "harvest")
