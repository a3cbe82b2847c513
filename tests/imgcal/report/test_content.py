"""Shared numbers of the report, against direct computation and the estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.estimation import Gauge
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.report import ReportContent
from imgcal.types import PARAMETERS


def test_residuals_agree_with_the_estimate(content: ReportContent) -> None:
    used = content.used
    assert 0 < used.sum() < len(used)
    rms = np.sqrt((content.residual_after[used] ** 2).sum(-1).mean())
    assert rms == pytest.approx(content.rms_after, rel=1e-6)
    assert np.sqrt((content.residual_before[used] ** 2).sum(-1).mean()) == pytest.approx(content.rms_before, rel=1e-6)
    assert content.whitened.std() == pytest.approx(rms / (2**0.5 * 0.05), rel=1e-2)


def test_rms_by_group(content: ReportContent) -> None:
    rms = content.rms_by(content.detections.camera, content.residual_after, len(content.cameras) + 1)
    for camera in range(len(content.cameras)):
        rows = content.used & (content.detections.camera == camera)
        assert rms[camera] == pytest.approx(np.sqrt(np.mean((content.residual_after[rows] ** 2).sum(1))))
    assert np.isnan(rms[-1])


def test_motion_of_the_whole_rig_is_no_change(content: ReportContent) -> None:
    rotation = rotation_from_vector(torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64))
    motion = RigidTransform(rotation, torch.tensor([10.0, 20.0, -30.0], dtype=torch.float64))
    moved = replace(content.factory, cam_from_rig=content.factory.cam_from_rig @ motion)
    change = replace(content, recalibrated=moved).change
    assert change is not None
    np.testing.assert_allclose(change, 0, atol=1e-9)


def test_moved_and_undetermined_leave_out_the_reference(content: ReportContent) -> None:
    step = torch.zeros(10, PARAMETERS, dtype=torch.float64)
    step[3, 6] = 5.0
    std = np.ones((10, PARAMETERS))
    prior = np.full((10, PARAMETERS), 1.1)
    prior[4] = 10.0
    gauge = Gauge.from_camera(0, 10)
    changed = replace(content, recalibrated=content.factory.retract(step), std=std, prior_std=prior, gauge=gauge)
    assert changed.moved.nonzero() == ([3], [6])
    expected = np.ones((10, PARAMETERS), dtype=bool)
    expected[4] = False
    expected[0, :6] = False
    np.testing.assert_array_equal(changed.undetermined, expected)


@pytest.mark.parametrize("name", ["labels", "predicted_before", "predicted_after", "sigma", "std", "prior_std"])
def test_wrong_shapes_are_refused(content: ReportContent, name: str) -> None:
    with pytest.raises(ValueError, match=name):
        replace(content, **{name: np.zeros(3)})


def test_frames_and_cameras_must_agree(content: ReportContent) -> None:
    with pytest.raises(ValueError, match="frames"):
        replace(content, frames=(None,))
    with pytest.raises(ValueError, match="cameras"):
        replace(content, detections=replace(content.detections, camera_names=("a",)))
