"""The compiled projection agrees with the tensor version and OpenCV, and shares no memory with its inputs."""

import cv2
import numpy as np
import pytest
import torch

from imgcal.errors import InputError
from imgcal.geometry import NEAREST_DEPTH
from imgcal.synthesis import PhysicalDrift
from imgcal.types import CalibrationObject, CameraRig


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("with_radius", [False, True])
def test_compiled_path_equals_fused_path(
    o10: CameraRig, asymmetric8: CalibrationObject, dtype: torch.dtype, with_radius: bool
) -> None:
    generator = torch.Generator().manual_seed(0)
    rigs = PhysicalDrift(rotation_deg=8, position=100, distortion=0.3).apply(o10, generator, 60).to(dtype)
    depth = torch.tensor([0.0, 0.0, 700.0], dtype=dtype)
    points = depth + 400 * torch.randn(60, 7, 3, generator=generator, dtype=dtype)
    radius = torch.linspace(1, 40, 7, dtype=dtype) if with_radius else None
    compiled, fused = rigs.project_values(points, radius), rigs.project(points, radius)
    share = float(fused.visible.double().mean())
    assert 0.05 < share < 0.95
    exact = dtype == torch.float64
    near = fused.depth > 100  # pixels of points beside a camera are huge
    torch.testing.assert_close(compiled.depth, fused.depth, rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(compiled.uv[near], fused.uv[near], rtol=1e-9 if exact else 1e-3, atol=1e-2)
    agreeing = float((compiled.visible == fused.visible).double().mean())
    assert agreeing == 1 if exact else agreeing > 0.999


def test_pixels_are_those_of_opencv(o10: CameraRig) -> None:
    rig = PhysicalDrift(distortion=0.1).apply(o10, torch.Generator().manual_seed(1), 1)
    points = 100 * torch.randn(1, 9, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    points[..., 2] += 800
    found = rig.project_values(points)
    for c in range(10):
        fx, fy, cx, cy = *rig.focal_length[0, c].tolist(), *rig.principal_point[0, c].tolist()
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        turn, shift = (part[0, c].numpy() for part in (rig.cam_from_rig.rotation, rig.cam_from_rig.translation))
        lens = rig.distortion[0, c].numpy()
        pixels, _ = cv2.projectPoints(points[0].numpy(), cv2.Rodrigues(turn)[0], shift, matrix, lens)
        np.testing.assert_allclose(found.uv[0, c], pixels[:, 0], atol=1e-8)


def test_one_rig_needs_no_batch_axis(o10: CameraRig) -> None:
    points = 100 * torch.randn(9, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    points[..., 2] += 800
    alone, many = o10.project_values(points), o10.expand(1).project_values(points[None])
    for name in ("uv", "depth", "visible"):
        assert torch.equal(getattr(alone, name), getattr(many, name)[0])
    assert alone.uv.shape == (10, 9, 2) and alone.visible.any()
    some = points + torch.arange(6.0).view(2, 3, 1, 1)
    rigs = o10.expand(2, 3)
    torch.testing.assert_close(rigs.project_values(some).uv, rigs.project(some).uv, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("rigs", "points"), [((), (3,)), ((2, 3), ()), ((2,), (3,))])
def test_points_must_have_the_batch_axes_of_the_rigs(
    o10: CameraRig, rigs: tuple[int, ...], points: tuple[int, ...]
) -> None:
    with pytest.raises(InputError, match=r"points: found shape \(.*9, 3\), expected \(.*N, 3\)"):
        o10.expand(*rigs).project_values(torch.ones(*points, 9, 3, dtype=torch.float64))


def test_points_behind_are_finite_and_invisible(o10: CameraRig) -> None:
    rig = o10.select([0])
    depth = torch.tensor([-500.0, -1e-9, 0.0, 0.5 * NEAREST_DEPTH, 900.0], dtype=torch.float64)
    inside = torch.stack((torch.zeros(5), torch.zeros(5), depth), dim=-1).double()
    found = rig.expand(1).project_values(rig.cam_from_rig.inverse()[0].apply(inside)[None])
    assert torch.isfinite(found.uv).all()
    assert found.visible.tolist() == [[[False, False, False, False, True]]]


def test_views_that_are_not_contiguous_give_the_same_and_inputs_stay(o10: CameraRig) -> None:
    points = torch.randn(4, 3, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64).mT * 50
    points = points + torch.tensor([0.0, 0.0, 800.0])
    before, rigs = points.clone(), o10.expand(4)
    found, again = rigs.project_values(points.mT.contiguous().mT), rigs.project_values(points.contiguous())
    assert torch.equal(found.uv, again.uv) and torch.equal(found.visible, again.visible)
    found.uv.zero_()
    assert torch.equal(points, before)


def test_permuting_cameras_points_and_rigs_permutes_the_image(o10: CameraRig) -> None:
    random = torch.Generator().manual_seed(4)
    rigs = PhysicalDrift().apply(o10, random, 3)
    points = 80 * torch.randn(3, 7, 3, generator=random, dtype=torch.float64)
    points[..., 2] += 800
    found = rigs.project_values(points)
    rows, cameras, order = (torch.randperm(n, generator=random) for n in (3, 10, 7))
    mixed = rigs[rows].select(cameras.tolist()).project_values(points[rows][:, order])
    torch.testing.assert_close(mixed.uv, found.uv[rows][:, cameras][:, :, order], rtol=0, atol=1e-9)


def test_no_points_and_no_rigs(o10: CameraRig) -> None:
    assert o10.expand(2).project_values(torch.zeros(2, 0, 3).double()).uv.shape == (2, 10, 0, 2)
    assert o10.expand(0).project_values(torch.zeros(0, 5, 3).double()).visible.shape == (0, 10, 5)
