"""Which rigs are used to compile ahead of time; tests/scripts/test_container.py compiles."""

import pytest
import torch

from imgcal.online import warm_up
from imgcal.online.warmup import replace_lenses
from imgcal.types import CameraRig


def test_other_lenses_are_warmed_up_where_that_is_asked_for(monkeypatch: pytest.MonkeyPatch, o10: CameraRig) -> None:
    warmed: list[CameraRig] = []
    monkeypatch.setattr("imgcal.online.warmup._warm_up", warmed.append)
    warm_up()
    warm_up(all_lenses=True)
    assert [rig.lens_model for rig in warmed] == ["brown_conrady", "brown_conrady", "rational"]
    points = torch.tensor([[10.0, 20.0, 860.0]], dtype=torch.float64)
    images = [rig.project(points).uv for rig in (o10, replace_lenses(o10))]
    torch.testing.assert_close(*images)  # the same lens in other words
