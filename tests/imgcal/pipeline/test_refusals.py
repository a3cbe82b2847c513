"""Refusals say in plain words what was found and what to do."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import imgcal
from imgcal.association import PipelineOptions
from imgcal.errors import RefusedError
from imgcal.pipeline import recalibration
from imgcal.pipeline.refusals import require_fit, require_most_labels, require_near_prior, require_views
from imgcal.synthesis import simulate_truth, true_detections
from imgcal.types import RigPrior

OPTIONS = PipelineOptions()


def drifted(rig, camera, parameter, deviations):
    prior = RigPrior().std(rig)
    offset = torch.zeros_like(prior)
    offset[camera, parameter] = deviations
    state = SimpleNamespace(offset=offset[None])
    return SimpleNamespace(solution=SimpleNamespace(state=state), problem=SimpleNamespace(prior_std=prior[None])), prior


@pytest.mark.parametrize(
    ("parameter", "expected"),
    [
        (1, r"cam03: rotation y would differ from its factory value by 6\.3 deg, with a tolerance \(prior\) of 0\.573"),
        (5, r"cam03: position z would differ from its factory value by 110 mm, with a tolerance \(prior\) of 10 mm"),
        (8, "cam03: cx would differ from its factory value by 110 px"),
        (11, "cam03: k2 would differ from its factory value by 0.55,"),
    ],
)  # fmt: skip
def test_a_value_too_far_from_the_factory_is_told_in_its_unit(parameter, expected, o10):
    fit, prior = drifted(o10, 2, parameter, 11.0)
    with pytest.raises(RefusedError, match=expected) as found:
        require_near_prior(fit, prior, o10, {}, OPTIONS)
    assert "under `prior` in the rig file" in found.value.for_command and "RigPrior(" in str(found.value)


def test_a_kind_of_values_too_far_from_the_factory_is_named(o10):
    fit, prior = drifted(o10, 2, 1, 5.5)
    require_near_prior(fit, prior, o10, {"rotation": 3.9}, OPTIONS)
    with pytest.raises(RefusedError, match=r"the focal length of all cameras .* 4\.2 times"):
        require_near_prior(fit, prior, o10, {"rotation": 2.0, "focal_length": 4.2}, OPTIONS)


@pytest.mark.parametrize(("kept", "unexplained", "refused"), [(0, 1, False), (0, 3, False), (0, 4, True), (1, 2, True)])
def test_a_false_blob_or_two_do_not_make_an_image_mirrored(kept, unexplained, refused, o10):
    shape = (2, o10.num_cameras)

    def only_one_camera(count):
        counts = np.zeros(shape, dtype=np.int64)
        counts[0, 3] = count
        return counts

    counts = SimpleNamespace(
        kept=only_one_camera(kept), unexplained=only_one_camera(unexplained), expected=only_one_camera(unexplained)
    )
    if not refused:
        require_views(counts, o10)
        return
    with pytest.raises(
        RefusedError, match=f"^camera cam04: .* put {unexplained} fiducials into .*, found {kept} there"
    ):
        require_views(counts, o10)


def test_residuals_and_outliers_are_told_with_what_to_do():
    require_fit(0.9, 0.2, 0.3, OPTIONS)
    with pytest.raises(RefusedError, match=r"misses the blobs by 1\.60 px .* 1\.50 px are not noise"):
        require_fit(1.5, 0.0, 1.6, OPTIONS)
    with pytest.raises(RefusedError, match="30 % of the labelled blobs") as found:
        require_fit(0.0, 0.3, 0.1, OPTIONS)
    assert "--snapshots" in found.value.for_command and "--snapshots" not in str(found.value)


def test_a_camera_or_a_fiducial_most_of_whose_labels_do_not_fit_is_named(o10):
    labels = np.ones((4, 10, 8), dtype=bool)
    kept = labels.copy()
    kept[:3, 6] = False
    with pytest.raises(RefusedError, match="estimation: camera cam07: 24 of 32 labels") as found:
        require_most_labels(labels, kept, o10)
    assert found.value.for_command.endswith("--without cam07")
    kept = labels.copy()
    kept[:3, :, 5] = False
    with pytest.raises(RefusedError, match=r"fiducial 5 .* 30 of 40 labels"):
        require_most_labels(labels, kept, o10)


def test_equations_without_a_solution_in_an_explanation_leave_the_refusal_as_it_is(monkeypatch) -> None:
    def unsolvable(*_: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(recalibration, "require_units", unsolvable)
    factory, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
    truth = simulate_truth(factory, obj, 4, torch.Generator().manual_seed(1), None)
    blobs = true_detections(truth)
    noisy = replace(blobs, uv=blobs.uv + 30 * np.random.default_rng(0).standard_normal(blobs.uv.shape))
    with pytest.raises(RefusedError, match=r"^estimation"):
        imgcal.calibrate(noisy, factory, obj)
