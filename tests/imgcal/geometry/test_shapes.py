"""Compiled loops read whatever lies behind an array that is too small: shapes are checked before."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.geometry import RigidTransform, undistort_cpu
from imgcal.types import CameraRig


def _points() -> Tensor:
    return torch.tensor([[0.0, 0.0, 850.0], [20.0, 0.0, 850.0], [0.0, 30.0, 900.0]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("focal_length", lambda rig: {"focal_length": rig.focal_length[:1]}),
        ("focal_length", lambda rig: {"focal_length": rig.focal_length[:, :1]}),
        ("principal_point", lambda rig: {"principal_point": rig.principal_point[:1]}),
        ("distortion", lambda rig: {"distortion": rig.distortion[:1]}),
        ("distortion", lambda rig: {"distortion": rig.distortion[:, :4]}),
        ("distortion", lambda rig: {"lens_model": "rational"}),
        ("distortion", lambda rig: {"lens_model": "equidistant", "distortion": rig.distortion[:, :3]}),
        ("lens models", lambda rig: {"lens_model": ("brown_conrady", "rational")}),
        ("lens model fish", lambda rig: {"lens_model": "fish"}),
        ("image_size", lambda rig: {"image_size": rig.image_size[:1]}),
        ("image_size", lambda rig: {"image_size": rig.image_size[0]}),
        (
            "translation",
            lambda rig: {
                "cam_from_rig": RigidTransform(rig.cam_from_rig.rotation, rig.cam_from_rig.translation[:1]),
            },
        ),
    ],
)
def test_a_rig_whose_values_do_not_fit_together_is_not_projected(name: str, change: Any, o10: CameraRig) -> None:
    with pytest.raises(InputError, match=f"found .*{name}.*expected"):
        replace(o10, **change(o10)).project_values(_points())


@pytest.mark.parametrize("radius", [torch.ones(()), torch.ones(1), torch.ones(4), torch.ones(3, 1)])
def test_radii_must_be_one_for_each_point(radius: Tensor, o10: CameraRig) -> None:
    with pytest.raises(InputError, match=r"found radius of shape .*, expected \(3,\)"):
        o10.project_values(_points(), radius.double())


@pytest.mark.parametrize("points", [torch.ones(3, 2), torch.ones(3, 4), torch.ones(3, 3, dtype=torch.int64)])
def test_points_must_have_three_real_coordinates(points: Tensor, o10: CameraRig) -> None:
    with pytest.raises(InputError, match="found points"):
        o10.project_values(points)


def test_undistortion_needs_coefficients_of_each_camera(o10: CameraRig) -> None:
    xy = torch.full((10, 3, 2), 0.3, dtype=torch.float64)
    for lenses, model in (
        (o10.distortion[:, :4], "brown_conrady"),
        (o10.distortion, "rational"),
        (o10.distortion[:3], "brown_conrady"),
    ):
        with pytest.raises(InputError, match="distortion"):
            undistort_cpu(xy, lenses, model)
    with pytest.raises(InputError, match="points"):
        undistort_cpu(xy[..., :1], o10.distortion)
