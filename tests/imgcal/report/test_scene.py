"""The 3D figure: geometry against the cameras themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.estimation import Gauge
from imgcal.report import ReportContent
from imgcal.report.scene import Figure, drawn_fiducials, rig_figure


def _points(trace: Figure) -> np.ndarray:
    return np.array([trace[axis] for axis in "xyz"], dtype=float).T


def _named(figure: Figure, name: str) -> Figure:
    return next(trace for trace in figure["data"] if trace["name"] == name)


def test_frustums_start_at_the_camera_and_look_along_its_axis(content: ReportContent) -> None:
    strokes = _points(_named(rig_figure(content), "factory")).reshape(10, -1, 3)
    np.testing.assert_allclose(strokes[:, 9], content.factory.positions.numpy(), atol=0.01)
    axis = content.factory.cam_from_rig.rotation[:, 2].numpy()
    corners = strokes[:, [4, 5, 6, 7]].mean(axis=1) - strokes[:, 9]
    assert ((corners / np.linalg.norm(corners, axis=1, keepdims=True) * axis).sum(1) > 0.999).all()


def test_drawn_fiducials_project_onto_their_images(content: ReportContent) -> None:
    """Points and recalibrated cameras share a frame: what is drawn is what was seen."""
    assert content.recalibrated is not None
    points = _points(_named(rig_figure(content), "fiducials, by snapshot")).reshape(6, 8, 3)
    drawn = content.laid
    assert drawn is not None
    uv = drawn.expand(6).project(torch.as_tensor(points)).uv.numpy()
    rows = np.flatnonzero(content.used)
    d = content.detections
    expected = content.predicted_after
    assert expected is not None
    found = uv[d.snapshot[rows], d.camera[rows], content.labels[rows]]
    np.testing.assert_allclose(found, expected[rows], atol=0.05)


def test_exaggeration_scales_the_shift_and_keeps_the_reference(content: ReportContent) -> None:
    meta = rig_figure(replace(content, gauge=Gauge.of_camera(0, 10)))["layout"]["meta"]
    assert meta["factors"][:3] == [1, 2, 5]
    arrows = [np.array(step, dtype=float).T.reshape(10, 3, 3) for step in meta["moving"][1]["steps"]]
    shift = [a[:, 1] - a[:, 0] for a in arrows]
    np.testing.assert_allclose(shift[2], 5 * shift[0], atol=0.1)
    np.testing.assert_allclose(shift[0][0], 0, atol=0.01)
    assert np.linalg.norm(shift[0], axis=1).max() > 1


def test_refused_rig_shows_the_factory_alone(refused_content: ReportContent) -> None:
    figure = rig_figure(refused_content)
    assert [trace["name"] for trace in figure["data"]] == ["factory", "camera names", "rig axes"]
    assert figure["layout"]["meta"]["factors"] == []


def test_rejected_snapshots_are_not_drawn(content: ReportContent) -> None:
    assert content.rig_from_object is not None
    translation = content.rig_from_object.translation.clone()
    translation[2] = torch.nan
    partly = replace(content, rig_from_object=replace(content.rig_from_object, translation=translation))
    assert drawn_fiducials(partly)[0].tolist() == [0, 1, 3, 4, 5]
    cloud = _named(rig_figure(partly), "fiducials, by snapshot")
    assert np.isfinite(_points(cloud)).all()


@pytest.mark.parametrize("snapshots", [0, 1, 59, 60, 61, 5000])
def test_number_of_points_is_bounded(content: ReportContent, snapshots: int) -> None:
    assert content.rig_from_object is not None
    poses = content.rig_from_object[torch.zeros(snapshots, dtype=torch.int64)]
    many = replace(content, rig_from_object=poses, object_points=np.zeros((437, 3)))
    chosen, fiducials = drawn_fiducials(many)
    assert len(chosen) == min(snapshots, 60)
    assert len(chosen) * len(fiducials) <= 6000
