"""The scene of the report: positions are correct, and changes are exaggerated as stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.estimation import Gauge
from imgcal.report import ReportContent
from imgcal.report.scene import LARGEST_CLOUD, choose_fiducials, describe_scene


def test_drawn_fiducials_project_onto_their_images(content: ReportContent) -> None:
    """Points and recalibrated cameras share a frame: what is drawn is what was seen."""
    assert content.recalibrated is not None
    points = torch.as_tensor(describe_scene(content).values["groups"]).double()
    drawn = content.aligned_rig
    assert points.shape == (6, 8, 3) and drawn is not None
    uv = drawn.expand(6).project(points).uv.numpy()
    rows = np.flatnonzero(content.used)
    d = content.detections
    expected = content.predicted_after
    assert expected is not None
    found = uv[d.snapshot[rows], d.camera[rows], content.labels[rows]]
    np.testing.assert_allclose(found, expected[rows], atol=0.05)


def test_exaggeration_scales_the_shift_and_keeps_the_reference(content: ReportContent) -> None:
    drawn = describe_scene(replace(content, gauge=Gauge.from_camera(0, 10)))
    assert drawn.factors[:3] == (1, 2, 5)
    factory, recalibrated = drawn.values["rigs"]
    centres = np.array(recalibrated["steps"])[:, :, 0]  # (factors, C, 3)
    shift = centres - np.array(factory["steps"])[:, :, 0]
    np.testing.assert_allclose(shift[2], 5 * shift[0], atol=0.1)
    np.testing.assert_allclose(shift[0][0], 0, atol=0.01)
    assert np.linalg.norm(shift[0], axis=1).max() > 1


def test_refused_rig_shows_the_factory_alone(refused_content: ReportContent) -> None:
    drawn = describe_scene(refused_content)
    assert [rig["name"] for rig in drawn.values["rigs"]] == ["factory"]
    assert drawn.values["groups"] == []
    assert drawn.factors == ()


def test_rejected_snapshots_are_not_drawn(content: ReportContent) -> None:
    assert content.rig_from_object is not None
    translation = content.rig_from_object.translation.clone()
    translation[2] = torch.nan
    partly = replace(content, rig_from_object=replace(content.rig_from_object, translation=translation))
    assert choose_fiducials(partly)[0].tolist() == [0, 1, 3, 4, 5]
    scene = describe_scene(partly).values
    assert np.isfinite(np.array(scene["groups"])).all()
    assert scene["groupNames"] == [f"snapshot {i:04d}" for i in (0, 1, 3, 4, 5)]


@pytest.mark.parametrize("snapshots", [0, 1, 59, 60, 61, 5000])
def test_number_of_points_is_bounded(content: ReportContent, snapshots: int) -> None:
    assert content.rig_from_object is not None
    poses = content.rig_from_object[torch.zeros(snapshots, dtype=torch.int64)]
    many = replace(content, rig_from_object=poses, object_points=np.zeros((437, 3)))
    chosen, fiducials = choose_fiducials(many)
    assert len(chosen) == min(snapshots, 60)
    assert len(chosen) * len(fiducials) <= LARGEST_CLOUD
