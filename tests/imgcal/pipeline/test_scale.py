"""The source of the scale, and the stated effect of an error in the object's file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.estimation import predicted_error
from imgcal.evaluation.true_error import true_error
from imgcal.synthesis import PhysicalDrift, simulate_truth, simulate_volume, true_detections
from imgcal.types import CalibrationObject, RigPrior


@pytest.mark.parametrize("rig_name", ["T4", "O10"])
def test_an_object_that_is_one_percent_larger_adds_what_is_said(rig_name: str) -> None:
    rig = replace(imgcal.load_rig(rig_name), prior=RigPrior(position=30.0))
    obj = imgcal.load_object("asymmetric8")
    larger = replace(obj, points=1.01 * obj.points)
    truth = simulate_truth(rig, larger, 10, torch.Generator().manual_seed(3), PhysicalDrift(position=1.0))
    found = imgcal.calibrate(true_detections(truth), rig, obj)
    assert found.scale.source == "object" and found.scale.sigma == 0
    assert found.scale.noticed_from is None or found.scale.noticed_from > 0.01
    volume = found.predicted_error.volume
    px, mm = true_error(found.predicted_error.uncertainty, truth.rig, volume.grid().flatten(0, 2))
    assert found.scale.px_per_percent == pytest.approx(float(px[px.isfinite()].median()), rel=0.25)
    assert found.scale.mm_per_percent == pytest.approx(float(mm[mm.isfinite()].median()), rel=0.25)
    assert found.scale.px_per_percent > 10 * found.predicted_error.median_px
    assert f"1 % error in it adds {found.scale.mm_per_percent:.2g} mm" in str(found.scale)
    assert predicted_error(found).median_px == found.predicted_error.median_px


def test_a_scale_that_the_cameras_know_better_is_theirs() -> None:
    rig = replace(imgcal.load_rig("O10"), prior=RigPrior(position=1.0))
    obj = replace(imgcal.load_object("asymmetric8"), scale_tolerance=0.1)
    truth = simulate_truth(rig, obj, 6, torch.Generator().manual_seed(4), PhysicalDrift(position=1.0))
    found = imgcal.calibrate(true_detections(truth), rig, obj)
    assert found.scale.values["from"] == "cameras"
    assert 0 < found.scale.sigma < 0.01
    assert str(found.scale) == ""


STICKS = {"of two": ((0.0, 0, 0), (500, 0, 0)), "of three": ((0.0, 0, 0), (200, 0, 0), (500, 0, 0))}


@pytest.mark.parametrize("points", STICKS.values(), ids=STICKS)
def test_a_stick_whose_scale_may_be_off_is_as_long_as_the_cameras_say(points) -> None:
    """The factory positions know its length a hundred times as well as its file."""
    drift = PhysicalDrift(position=1.0, rotation_deg=0.1)
    prior = RigPrior(drift.focal_length, drift.principal_point, drift.distortion, np.radians(drift.rotation_deg), 1.0)
    rig = replace(imgcal.load_rig("room10"), prior=prior)
    places = torch.tensor(points, dtype=torch.float64)
    stick = CalibrationObject(places, torch.ones(len(places), 3).double(), name="stick", scale_tolerance=0.02)
    errors = []
    for seed in range(4):
        truth = simulate_volume(
            rig, replace(stick, points=1.02 * places), 40, torch.Generator().manual_seed(seed), drift
        )
        blobs = true_detections(truth)
        blobs.uv[:] += 0.05 * np.random.default_rng(seed).standard_normal(blobs.uv.shape)
        blobs.sigma[:] = 0.05
        found = imgcal.calibrate(blobs, rig, stick)
        length = float((found.points_object[-1] - found.points_object[0]).norm()) / 500
        assert found.scale.source == "cameras" and found.scale.sigma < 2e-4 and found.displaced == ()
        errors.append((length / 1.02 - 1) / found.scale.sigma)
    assert np.abs(errors).max() < 3 and 0.3 < np.sqrt(np.mean(np.square(errors))) < 1.8
    with pytest.raises(imgcal.RefusedError, match="give its scale a tolerance"):
        imgcal.calibrate(blobs, rig, replace(stick, scale_tolerance=0.0))


@pytest.mark.parametrize("rig_name", ["T4", "O10"])
def test_the_scale_s_share_of_the_predicted_error_is_stated(rig_name: str) -> None:
    """An object with tolerances is as large as their mean says, and the predicted error includes that."""
    rig = replace(imgcal.load_rig(rig_name), prior=RigPrior(position=100.0))
    obj = imgcal.load_object("asymmetric8")
    loose = replace(obj, tolerance=torch.full((8,), 0.5, dtype=torch.float64))
    truth = simulate_truth(rig, obj, 10, torch.Generator().manual_seed(3), PhysicalDrift(position=1.0))
    found = imgcal.calibrate(true_detections(truth), rig, loose)
    away = obj.points - obj.points.mean(0)
    assert found.scale.source == "object"
    assert found.scale.sigma == pytest.approx(0.5 / float(away.norm()), rel=0.05)
    share = 100 * found.scale.sigma * found.scale.mm_per_percent
    assert 0.5 * found.predicted_error.median_mm < share < found.predicted_error.median_mm
    assert f"from the object file and its tolerance, {share:.2g} mm" in str(found.scale)


def test_tolerances_that_the_images_asked_for_count_as_well() -> None:
    rig = replace(imgcal.load_rig("O10"), prior=RigPrior(position=100.0))
    obj = imgcal.load_object("wand4")
    shift = torch.zeros_like(obj.points)
    shift[1, 0], shift[2, 1], shift[3, 0] = 0.7, -0.5, 0.6
    truth = simulate_truth(
        rig, replace(obj, points=obj.points + shift), 40, torch.Generator().manual_seed(5), PhysicalDrift()
    )
    found = imgcal.calibrate(true_detections(truth), rig, obj)
    assert found.scale.source == "object" and found.scale.sigma > 1e-4


def test_an_estimated_object_that_is_used_again_is_as_uncertain_as_before(tmp_path) -> None:
    rig = replace(imgcal.load_rig("O10"), prior=RigPrior(position=100.0))
    obj = imgcal.load_object("asymmetric8")
    loose = replace(obj, tolerance=torch.full((8,), 0.5, dtype=torch.float64))
    truth = simulate_truth(rig, obj, 10, torch.Generator().manual_seed(3), PhysicalDrift(position=1.0))
    first = imgcal.calibrate(true_detections(truth), rig, loose)
    imgcal.save_object(first.object, tmp_path / "object.csv")
    again = imgcal.calibrate(true_detections(truth), rig, imgcal.load_object(tmp_path / "object.csv"))
    assert again.scale.sigma == pytest.approx(first.scale.sigma, rel=0.1)
    assert again.predicted_error.median_mm == pytest.approx(first.predicted_error.median_mm, rel=0.2)
