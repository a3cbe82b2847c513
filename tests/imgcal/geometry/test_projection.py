"""Projection: cv2 as oracle, kornia's path against the fused one, visibility, kornia's warts."""

import math

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.calibration import distort_points, undistort_points
from kornia.geometry.camera.perspective import project_points
from kornia.geometry.liegroup import Se3
from kornia.geometry.quaternion import Quaternion
from torch import Tensor

from imgcal.geometry import NEAREST_DEPTH, Projection, project_kornia, undistort, undistort_cpu
from imgcal.geometry.projection import apparent_centre_scale, is_inside, project
from imgcal.synthesis import RelativeDrift, synthesize
from imgcal.types import CalibrationObject, CameraRig

SHAPES = [((), 4), ((1,), 4), ((2, 3), 4), ((4,), 4)]  # the last one has as many rigs as cameras
FIDUCIALS = 5


def arguments(batch: tuple[int, ...], cameras: int, seed: int = 0) -> dict[str, Tensor]:
    """Random cameras with all five distortion coefficients, and points before them."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return 2 * torch.rand(*batch, cameras, *shape, generator=generator, dtype=torch.float64) - 1

    depth = 800 + 200 * uniform(FIDUCIALS, 1)
    return {
        "points_cam": torch.cat((0.4 * depth * uniform(FIDUCIALS, 2), depth), dim=-1),
        "focal_length": 1600 + 50 * uniform(2),
        "principal_point": torch.tensor([1024.0, 544.0], dtype=torch.float64) + 30 * uniform(2),
        "distortion": uniform(5) * torch.tensor([0.1, 0.1, 0.01, 0.01, 0.05], dtype=torch.float64),
        "image_size": torch.tensor([2048, 1088]).expand(cameras, 2),
    }


def assert_same(first: Projection, second: Projection, tolerance: float) -> None:
    torch.testing.assert_close(first.uv, second.uv, rtol=0, atol=tolerance)
    torch.testing.assert_close(first.depth, second.depth, rtol=0, atol=tolerance)
    assert torch.equal(first.visible, second.visible)


@pytest.mark.parametrize("path", [project, project_kornia])
@pytest.mark.parametrize(("batch", "cameras"), SHAPES)
def test_equals_cv2(path, batch: tuple[int, ...], cameras: int) -> None:
    given_ = arguments(batch, cameras)
    uv = path(**given_).uv
    assert uv.shape == (*batch, cameras, FIDUCIALS, 2)
    flat = {name: given_[name].reshape(math.prod(batch) * cameras, -1).numpy() for name in list(given_)[:4]}
    for row, ours in enumerate(uv.reshape(-1, FIDUCIALS, 2).numpy()):
        (fx, fy), (cx, cy) = flat["focal_length"][row], flat["principal_point"][row]
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        points = flat["points_cam"][row].reshape(-1, 1, 3)
        theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, flat["distortion"][row])
        np.testing.assert_allclose(ours, theirs[:, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("radius", [None, torch.linspace(1, 40, FIDUCIALS, dtype=torch.float64)])
@pytest.mark.parametrize(("batch", "cameras"), SHAPES)
def test_kornia_path_equals_fused_path(batch: tuple[int, ...], cameras: int, radius: Tensor | None) -> None:
    given_ = arguments(batch, cameras, seed=1)
    leaves = {name: value.clone().requires_grad_() for name, value in list(given_.items())[:4]}
    upstream = torch.randn(*batch, cameras, FIDUCIALS, 2, generator=torch.Generator().manual_seed(2)).double()
    gradients = []
    for path in (project, project_kornia):
        found = path(**leaves, image_size=given_["image_size"], radius=radius)
        gradients.append(torch.autograd.grad(found.uv, list(leaves.values()), upstream))
    for fused, kornias in zip(*gradients, strict=True):
        torch.testing.assert_close(fused, kornias, rtol=1e-10, atol=1e-8)
    fused, kornias = (path(**given_, radius=radius) for path in (project, project_kornia))
    assert_same(fused, kornias, 1e-9)


@pytest.mark.parametrize("path", [project, project_kornia])
def test_gradcheck(path) -> None:
    given_ = arguments((2,), 3, seed=3)
    leaves = [value.clone().requires_grad_() for value in list(given_.values())[:4]]
    radius = torch.full((FIDUCIALS,), 20.0, dtype=torch.float64, requires_grad=True)

    def scaled_uv(*tensors: Tensor) -> Tensor:
        return path(*tensors[:4], given_["image_size"], tensors[4]).uv / 1000

    assert torch.autograd.gradcheck(scaled_uv, (*leaves, radius), atol=1e-6)


def test_kornia_path_trains_every_parameter(o10: CameraRig, asymmetric8: CalibrationObject) -> None:
    snapshots = synthesize(o10, asymmetric8, 3, torch.Generator().manual_seed(0), drift=None)
    target = snapshots.projection.uv
    parts = ("rotation", "position", "focal_length", "principal_point", "distortion")
    widths = (3, 3, 2, 2, 5)
    generator = torch.Generator().manual_seed(1)
    step = 1e-3 * torch.randn(3, o10.num_cameras, 15, generator=generator, dtype=torch.float64)
    leaves = [part.clone().requires_grad_() for part in step.split(widths, dim=-1)]
    rig = o10.expand(3).retract(torch.cat(leaves, dim=-1)).from_object(snapshots.rig_from_object)
    points_cam = rig.cam_from_rig.apply(asymmetric8.points)
    found = project_kornia(points_cam, rig.focal_length, rig.principal_point, rig.distortion, rig.image_size)
    gradients = torch.autograd.grad((found.uv - target).square().mean(), leaves)
    for name, gradient in zip(parts, gradients, strict=True):
        assert torch.isfinite(gradient).all(), name
        assert (gradient.abs() > 0).all(), name


def test_points_behind_are_finite_and_invisible() -> None:
    given_ = arguments((), 3)
    depth = torch.tensor([-500.0, -1e-9, 0.0, 0.5 * NEAREST_DEPTH, 900.0], dtype=torch.float64)
    points = torch.stack((torch.zeros_like(depth), torch.zeros_like(depth), depth), dim=-1).expand(3, -1, -1)
    for path in (project, project_kornia):
        found = path(**{**given_, "points_cam": points.contiguous()})
        assert torch.isfinite(found.uv).all()
        assert found.visible.tolist() == [[False, False, False, False, True]] * 3


def test_image_borders() -> None:
    u = torch.tensor([[-0.5, -0.51, 2047.5, 2047.51, 100.0, 100.0, 100.0, math.nan]], dtype=torch.float64)
    v = torch.tensor([[0.0, 0.0, 0.0, 0.0, -0.51, 1087.5, 1087.51, 5.0]], dtype=torch.float64)
    inside = is_inside(u, v, torch.tensor([[2048, 1088]]))
    assert inside.tolist() == [[True, False, True, False, False, True, False, False]]


def test_fold_makes_points_inside_the_image_invisible() -> None:
    # At k1 = -0.3 the image folds at r = 1.054, and beyond it comes back towards the centre.
    radius = torch.tensor([0.2, 1.0, 1.1, 1.5], dtype=torch.float64)
    points = torch.stack((radius, torch.zeros(4), torch.ones(4)), dim=-1)[None] * 1000
    focal, centre = torch.full((1, 2), 1000.0).double(), torch.full((1, 2), 1000.0).double()
    distortion = torch.tensor([[-0.3, 0, 0, 0, 0]], dtype=torch.float64)
    found = project(points, focal, centre, distortion, torch.tensor([[3000, 2000]]))
    assert is_inside(found.uv[..., 0], found.uv[..., 1], torch.tensor([[3000, 2000]])).all()
    assert found.visible.tolist() == [[True, True, False, False]]


@pytest.mark.parametrize(("batch", "cameras"), SHAPES)
def test_undistort_inverts_distortion(batch: tuple[int, ...], cameras: int) -> None:
    given_ = arguments(batch, cameras, seed=4)
    plain = {"focal_length": torch.ones_like(given_["focal_length"]), "principal_point": torch.zeros(2).double()}
    distorted = project(**{**given_, **plain, "principal_point": 0 * given_["principal_point"]}).uv
    xy, good = undistort(distorted, given_["distortion"])
    assert good.all()
    expected = given_["points_cam"][..., :2] / given_["points_cam"][..., 2:]
    torch.testing.assert_close(xy, expected, rtol=0, atol=1e-13)


def test_undistort_says_where_it_cannot() -> None:
    # k1 = -0.3 never reaches further than 0.703: nothing there to find.
    xy = torch.tensor([[[0.5, 0.0], [0.9, 0.0]]], dtype=torch.float64)
    found, good = undistort(xy, torch.tensor([[-0.3, 0, 0, 0, 0]], dtype=torch.float64))
    assert good.tolist() == [[True, False]]
    torch.testing.assert_close(found[0, 1], xy[0, 1])


def test_apparent_centre_is_the_centre_of_the_silhouette() -> None:
    centre, radius = np.array([210.0, -130.0, 700.0]), 60.0
    # Tangent points of the cone from the camera: a circle across the line to the centre.
    distance = np.linalg.norm(centre)
    across = np.linalg.svd(centre[None])[2][1:]
    angle = np.linspace(0, 2 * np.pi, 20001)[:, None]
    circle = radius * np.sqrt(1 - (radius / distance) ** 2) * (np.cos(angle) * across[0] + np.sin(angle) * across[1])
    contour = centre * (1 - (radius / distance) ** 2) + circle
    image = contour[:, :2] / contour[:, 2:]
    ellipse_centre = 0.5 * (image.min(0) + image.max(0))
    depth = torch.tensor([centre[2]])
    scale = float(apparent_centre_scale(depth, torch.tensor([radius]).double()))
    np.testing.assert_allclose(centre[:2] / centre[2] * scale, ellipse_centre, atol=1e-8)
    assert abs(ellipse_centre[0] - centre[0] / centre[2]) > 1e-3


def test_shifting_the_principal_point_shifts_the_image() -> None:
    given_ = arguments((2,), 3)
    shifted = {**given_, "principal_point": given_["principal_point"] + 1}
    torch.testing.assert_close(project(**shifted).uv, project(**given_).uv + 1)


def test_permuting_cameras_and_fiducials_permutes_the_image(o10: CameraRig, asymmetric8: CalibrationObject) -> None:
    snapshots = synthesize(o10, asymmetric8, 4, torch.Generator().manual_seed(0), drift=RelativeDrift())
    points = snapshots.rig_from_object.apply(asymmetric8.points)
    generator = torch.Generator().manual_seed(1)
    cameras = torch.randperm(o10.num_cameras, generator=generator).tolist()
    fiducials = torch.randperm(asymmetric8.num_fiducials, generator=generator)
    found = snapshots.rig.select(cameras).project(points[:, fiducials])
    expected = snapshots.projection
    torch.testing.assert_close(found.uv, expected.uv[:, cameras][:, :, fiducials])
    torch.testing.assert_close(found.depth, expected.depth[:, cameras][..., fiducials])


def test_wart_kornia_distortion_is_pixels_to_pixels_in_opencv_order() -> None:
    given_ = arguments((), 1)
    eye = torch.eye(3, dtype=torch.float64)[None]
    xy = given_["points_cam"][..., :2] / given_["points_cam"][..., 2:]
    expected = project(**given_).uv
    expected = (expected - given_["principal_point"][:, None]) / given_["focal_length"][:, None]
    torch.testing.assert_close(distort_points(xy, eye, given_["distortion"], new_K=eye), expected, rtol=0, atol=1e-13)


def test_wart_kornia_undistortion_diverges() -> None:
    matrix = torch.tensor([[[1600.0, 0, 1024], [0, 1600, 544], [0, 0, 1]]], dtype=torch.float64)
    distortion = torch.tensor([[0.5, 0.5, 0, 0, 0]], dtype=torch.float64)
    uv = torch.tensor([[[0.9 * 1600 + 1024, 544.0]]], dtype=torch.float64)
    back = undistort_points(distort_points(uv, matrix, distortion, new_K=matrix), matrix, distortion)
    assert float((back - uv).abs().max()) > 100
    xy, good = undistort(
        (distort_points(uv, matrix, distortion, new_K=matrix) - matrix[:, :2, 2]) / 1600, distortion, iterations=20
    )
    assert good.all()
    assert float(xy[0, 0, 0]) == pytest.approx(0.9, abs=1e-12)


def test_wart_kornia_pairs_the_batch_with_the_camera_axis() -> None:
    focal = torch.tensor([100.0, 200.0, 300.0])
    matrices = torch.diag_embed(torch.stack((focal, focal, torch.ones(3)), dim=-1))  # (B, 3, 3)
    points = torch.ones(3, 3, 5, 3)  # (B, C, N, 3) with B == C
    u = project_points(points, matrices)[..., 0]
    assert torch.equal(u[:, :, 0], focal.expand(3, 3))  # by camera, not by rig, and without a word
    with pytest.raises(RuntimeError):
        project_points(points[:2], matrices[:2])


def test_wart_kornia_projects_points_behind_the_camera() -> None:
    assert torch.equal(
        project_points(torch.tensor([[1.0, 1.0, -2.0]]), torch.eye(3)[None]), torch.tensor([[-0.5, -0.5]])
    )


def test_wart_kornia_se3_turns_a_constant_into_a_parameter() -> None:
    translation = torch.zeros(1, 3)
    assert isinstance(Se3(Quaternion.identity(1), translation).t, torch.nn.Parameter)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_compiled_undistortion_is_that_of_tensors(dtype):
    generator = torch.Generator().manual_seed(4)
    xy = 2.0 * torch.rand(3, 500, 2, generator=generator, dtype=torch.float64) - 1  # some beyond the fold
    lens = torch.tensor([[0.0] * 5, [-0.3, 0.1, 1e-3, -2e-3, 0.02], [-0.9, 0.2, 0.0, 0.0, 0.0]], dtype=torch.float64)
    expected, good = undistort(xy, lens)
    found, compiled = undistort_cpu(xy.to(dtype), lens.to(dtype))
    assert found.dtype == dtype and found.shape == xy.shape
    if dtype == torch.float64:
        assert torch.equal(good, compiled) and 0 < int((~good).sum()) < 500
    both = good & compiled
    assert both.sum() > 0.99 * good.sum()
    tolerance = 1e-13 if dtype == torch.float64 else 1e-4
    torch.testing.assert_close(found[both].double(), expected[both], rtol=0, atol=tolerance)
