"""A running rig starts with exactly the calibration's information."""

from dataclasses import replace

import pytest
import torch

import imgcal
from imgcal.estimation import camera_covariance, error_between
from imgcal.monitoring import belief_from_posterior, calibration_posterior, make_posterior
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from tests.imgcal.monitoring.made_snapshots import batch, made_snapshots


@pytest.fixture(scope="module")
def made():
    return made_snapshots()


@pytest.mark.parametrize("loose", [False, True])
def test_the_belief_has_the_covariance_of_the_estimate(made, loose: bool) -> None:
    _, obj, _, _ = made
    if loose:
        obj = replace(obj, tolerance=torch.full((8,), 0.3, dtype=torch.float64), scale_tolerance=1e-3)
    fit = batch(made, 6, obj)
    belief = belief_from_posterior(make_posterior(fit, obj), obj)
    expected = camera_covariance(fit, curved=False)
    scale = expected.diagonal().sqrt()
    assert torch.allclose(belief.covariance() / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-6)
    assert float(error_between(belief.rig, fit.rig).abs().max()) < 1e-12
    torch.testing.assert_close(belief.points_object, fit.points_object, atol=1e-9, rtol=0)


def test_of_another_object_it_says_what_it_knows_of_the_cameras(made) -> None:
    _, obj, _, _ = made
    loose = replace(obj, tolerance=torch.full((8,), 0.3, dtype=torch.float64))
    posterior = make_posterior(batch(made, 6, loose), loose)
    other = replace(obj, points=obj.points + torch.tensor([5.0, 0.0, 0.0]))
    known, belief = belief_from_posterior(posterior, loose), belief_from_posterior(posterior, other)
    assert len(belief.object_offset) == 0
    assert torch.allclose(belief.std(), known.std(), rtol=1e-6)


def test_for_several_objects_it_says_what_it_knows_of_the_cameras(made) -> None:
    _, obj, _, _ = made
    loose = replace(obj, tolerance=torch.full((8,), 0.3, dtype=torch.float64))
    posterior = make_posterior(batch(made, 6, loose), loose)
    watched = imgcal.CalibrationObject.of_several([loose, imgcal.load_object("wand4")]).as_unknown()
    belief = belief_from_posterior(posterior, watched)
    torch.testing.assert_close(belief.std(), belief_from_posterior(posterior, loose).std())
    assert belief.obj is watched and len(belief.object_offset) == 0


def test_a_scattered_estimate_starts_a_wider_belief(made) -> None:
    _, obj, _, _ = made
    fit = batch(made, 6)
    std = belief_from_posterior(make_posterior(fit, obj), obj).std()
    wider = belief_from_posterior(
        make_posterior(replace(fit, inflation=torch.full((fit.rig.num_cameras,), 2.0, dtype=torch.float64)), obj), obj
    ).std()
    assert 1.3 < float((wider / std)[:, 6].median()) < 2.001


def test_a_rig_that_was_changed_has_no_posterior() -> None:
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    truth = simulate_truth(factory, obj, 4, torch.Generator().manual_seed(1), PhysicalDrift())
    result = imgcal.calibrate(true_detections(truth), factory, obj)
    posterior = calibration_posterior(result.rig)
    assert posterior is not None
    assert posterior.snapshots == 4
    assert calibration_posterior(replace(result.rig, focal_length=result.rig.focal_length + 0.1)) is None
    assert calibration_posterior(factory) is None


def test_some_cameras_in_another_order_and_in_single_precision_keep_what_is_known_of_them(made) -> None:
    _, obj, _, _ = made
    fit = batch(made, 6)
    posterior = make_posterior(fit, obj)
    rig, order = replace(posterior.rig, posterior=lambda: posterior), [2, 0, 3]
    whole = belief_from_posterior(posterior, obj).covariance()
    kept = calibration_posterior(rig.select(order))
    assert kept is not None and kept.rig.camera_names == rig.select(order).camera_names
    size = posterior.unit.shape[1]
    rows = torch.arange(len(whole)).view(-1, size)[order].flatten()
    found, expected = belief_from_posterior(kept, obj).covariance(), whole[rows][:, rows]
    scale = expected.diagonal().sqrt()
    assert torch.allclose(found / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-6)
    assert calibration_posterior(rig.to(torch.float32)) is posterior
    renamed = replace(rig, camera_names=("left", *rig.camera_names[1:]))
    assert calibration_posterior(renamed) is None
