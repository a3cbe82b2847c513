"""The source of the scale, and the stated effect of an error in the object's file."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import imgcal
from imgcal.estimation import predicted_error
from imgcal.evaluation.true_error import true_error
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from imgcal.types import RigPrior


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
