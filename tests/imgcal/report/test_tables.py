"""Tables: digits, flags and fixed values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.estimation import Gauge
from imgcal.report import ReportContent
from imgcal.report.tables import GROUPS, camera_rows, format_signed, knowledge_rows
from imgcal.types import PARAMETERS


@pytest.mark.parametrize(
    ("value", "std", "expected"),
    [
        (7.314, 0.42, ("+7.31", "0.42")),
        (-7.314, 0.42, ("−7.31", "0.42")),
        (1234.5, 17.0, ("+1234", "17")),
        (0.00012, 0.0034, ("+0.0001", "0.0034")),
        (-0.4, 50.0, ("+0", "50")),
        (5.0, 0.0, ("+5", "")),
        (5.0, float("nan"), ("+5", "")),
    ],
)
def test_signed(value: float, std: float, expected: tuple[str, str]) -> None:
    assert format_signed(value, std) == expected


def test_rows_show_changes_in_their_units(content: ReportContent) -> None:
    step = torch.zeros(10, PARAMETERS, dtype=torch.float64)
    step[3, 0], step[3, 4], step[3, 6], step[3, 10] = np.radians(1.5), 2.0, 8.0, 0.004
    std = np.full((10, PARAMETERS), 0.05)
    std[:, :3], std[:, 10:] = np.radians(0.1), 1e-3
    rig = content.factory.retract(step)
    changed = replace(content, recalibrated=rig, std=std, gauge=Gauge.from_majority(rig, content.factory))
    row = camera_rows(changed)[3]
    cells = {(g[0], c.name): c for g, group in zip(GROUPS, row.groups, strict=True) for c in group}
    assert (cells["rotation (deg)", "x"].change, cells["rotation (deg)", "x"].std) == ("+1.50", "0.10")
    assert cells["focal length (px)", "fx"].change == "+8.000"
    assert cells["distortion (10⁻³)", "k1"].change == "+4.0"
    assert row.moved == ("focal length", "distortion", "rotation", "position")
    assert row.observations == content.observations[3]
    assert camera_rows(changed)[2].moved == ()


def test_reference_has_no_extrinsics_of_its_own(content: ReportContent) -> None:
    assert not any(row.reference for row in camera_rows(content))
    content = replace(content, gauge=Gauge.from_camera(0, 10))
    first, *others = camera_rows(content)
    kinds = [{cell.kind for cell in group} for group in first.groups]
    assert first.reference
    assert kinds[3:] == [{"fixed"}, {"fixed"}]
    assert "fixed" not in kinds[0]
    assert not any(row.reference for row in others)
    assert [cell.label for cell in knowledge_rows(content)[0][:6]] == ["·"] * 6


def test_knowledge_compares_with_the_prior(content: ReportContent) -> None:
    std = np.full((10, PARAMETERS), 0.5)
    std[1, 8], std[1, 9] = 0.999, 0.001
    cells = knowledge_rows(replace(content, std=std, prior_std=np.ones((10, PARAMETERS))))[1]
    assert (cells[8].label, cells[8].unknown) == ("100", True)
    assert (cells[9].label, cells[9].unknown) == ("<1", False)
    assert (cells[6].label, cells[6].unknown) == ("50", False)


def test_refused_rows_count_blobs(refused_content: ReportContent) -> None:
    rows = camera_rows(refused_content)
    assert sum(row.blobs for row in rows) == len(refused_content.detections)
    assert all(row.groups == () and row.after == "" for row in rows)
    assert knowledge_rows(refused_content) == []
