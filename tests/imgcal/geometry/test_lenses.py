"""All lens models: cv2 and autograd as oracles, inverse, fold, cameras of different models."""

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from imgcal.geometry import (
    LENS_MODELS,
    RigidTransform,
    distort_by_coefficients,
    distort_with_jacobian,
    lens_codes,
    lens_label,
    lens_names,
    lens_width,
    project_cpu,
    project_kornia,
    undistort,
    undistort_cpu,
)
from imgcal.geometry.lenses import distort, is_before_fold
from imgcal.geometry.projection import project
from tests.imgcal.geometry.lens_cases import LENSES, coefficients, mixed, points

FOCAL, CENTRE = torch.tensor([[700.0, 690.0]]).double(), torch.tensor([[640.0, 500.0]]).double()
SIZE = torch.tensor([[1280, 1000]])


def test_every_model_has_a_case() -> None:
    assert set(LENSES) == set(LENS_MODELS)
    assert all(len(LENSES[name][0]) == len(model.coefficients) for name, model in LENS_MODELS.items())


def theirs(name: str, at: Tensor) -> np.ndarray:
    """OpenCV's pixels of points (N, 3)."""
    matrix = np.array([[700.0, 0.0, 640.0], [0.0, 690.0, 500.0], [0.0, 0.0, 1.0]])
    given = (at.numpy()[:, None], np.zeros(3), np.zeros(3), matrix, np.array(LENSES[name][0]))
    return (cv2.fisheye if name == "equidistant" else cv2).projectPoints(*given)[0][:, 0]


@pytest.mark.parametrize("name", LENSES)
def test_pixels_are_those_of_opencv(name: str) -> None:
    depth = 1000 + 300 * torch.rand(1, 200, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    at = torch.cat((points(name) * depth, depth), dim=-1)
    given = (FOCAL, CENTRE, coefficients(name), SIZE)
    expected = theirs(name, at[0])
    for path in (project, project_kornia):
        np.testing.assert_allclose(path(at, *given, models=name).uv[0], expected, rtol=0, atol=1e-9)
    still = RigidTransform.identity(1, 1, dtype=torch.float64)
    values = project_cpu(at, still, *(part[None] for part in given[:3]), SIZE, models=name)
    np.testing.assert_allclose(values.uv[0, 0], expected, rtol=0, atol=1e-9)
    assert torch.equal(values.visible[0], project(at, *given, models=name).visible)
    assert int(values.visible.sum()) >= 10


@pytest.mark.parametrize("name", LENSES)
def test_derivatives_are_those_of_autograd(name: str) -> None:
    x, y = (part.clone().requires_grad_() for part in points(name, 40).unbind(-1))
    k = coefficients(name).expand(1, -1).clone().requires_grad_()
    xd, yd, jxx, jxy, jyy, rr = distort_with_jacobian(x, y, k, name)
    torch.testing.assert_close(rr, x.square() + y.square())
    for value, other, along, across in (
        (xd, distort(x, y, k, name)[0], jxx, jxy),
        (yd, distort(x, y, k, name)[1], jxy, jyy),
    ):
        torch.testing.assert_close(value, other, rtol=0, atol=0)
        slopes = torch.autograd.grad(value.sum(), (x, y), retain_graph=True)
        torch.testing.assert_close(slopes[0], along, rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(slopes[1], across, rtol=1e-9, atol=1e-10)
    by_coefficients = distort_by_coefficients(x, y, k, name)
    for n in range(0, 40, 7):
        for value, derivative in ((xd, by_coefficients[0]), (yd, by_coefficients[1])):
            (expected,) = torch.autograd.grad(value[0, n], k, retain_graph=True)
            torch.testing.assert_close(derivative[0, n], expected[0], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", LENSES)
def test_derivatives_are_those_of_finite_differences(name: str) -> None:
    x, y = points(name, 40).unbind(-1)
    k, step = coefficients(name), 1e-6
    _, _, jxx, jxy, _, _ = distort_with_jacobian(x, y, k, name)
    ahead, behind = (distort(x + sign * step, y, k, name) for sign in (1, -1))
    torch.testing.assert_close((ahead[0] - behind[0]) / (2 * step), jxx, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close((ahead[1] - behind[1]) / (2 * step), jxy, rtol=1e-6, atol=1e-8)
    by_x, by_y = distort_by_coefficients(x, y, k, name)
    for i in range(k.shape[1]):
        change = torch.zeros_like(k)
        change[0, i] = step
        ahead, behind = (distort(x, y, k + sign * change, name) for sign in (1, -1))
        torch.testing.assert_close((ahead[0] - behind[0]) / (2 * step), by_x[..., i], rtol=1e-6, atol=1e-8)
        torch.testing.assert_close((ahead[1] - behind[1]) / (2 * step), by_y[..., i], rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("name", LENSES)
def test_a_second_derivative_exists_on_the_axis(name: str) -> None:
    x = torch.zeros(1, 1, dtype=torch.float64, requires_grad=True)
    jxx = distort_with_jacobian(x, torch.zeros_like(x), coefficients(name), name)[2]
    (slope,) = torch.autograd.grad(jxx.sum(), x)
    assert torch.isfinite(slope).all()


@pytest.mark.parametrize("inverse", [undistort, undistort_cpu])
@pytest.mark.parametrize("name", LENSES)
def test_the_inverse_comes_back(name: str, inverse) -> None:
    xy = points(name)
    distorted = torch.stack(distort(*xy.unbind(-1), coefficients(name), name)[:2], dim=-1)
    found, good = inverse(distorted, coefficients(name), name)
    assert good.all()
    torch.testing.assert_close(found, xy, rtol=1e-12, atol=1e-13)


def test_a_strong_pincushion_is_inverted_far_out() -> None:
    """The start, the distorted point, is 6 times as far out as the point at 65 degrees."""
    lens = torch.tensor([[0.12, 0.1, 0.0, 0.0, 0.05]], dtype=torch.float64)
    r = torch.deg2rad(torch.linspace(0.0, 65.0, 200, dtype=torch.float64)).tan()[None]
    distorted = torch.stack(distort(r, torch.zeros_like(r), lens, "brown_conrady")[:2], dim=-1)
    found, good = undistort_cpu(distorted, lens)
    assert good.all()
    torch.testing.assert_close(found[..., 0], r, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(
    ("name", "lens"),
    [
        ("rational", [-0.4, 0.05, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0]),
        ("rational", [0.2, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0]),  # a pole at r^2 = 2
        ("equidistant", [-0.2, 0.0, 0.0, 0.0]),
        ("equidistant", [-0.5, 0.3, 0.0, 0.0]),
        ("equidistant", [-0.9, 0.6, -0.1, 0.0]),
    ],
)
def test_the_image_folds_where_the_distorted_radius_stops_growing(name: str, lens: list[float]) -> None:
    k = torch.tensor([lens], dtype=torch.float64)
    r = torch.linspace(1e-3, 8.0, 80001, dtype=torch.float64)[None]
    along = distort(r, torch.zeros_like(r), k, name)[0]
    growing = (along[:, 1:] > along[:, :-1]) & (along[:, 1:] > 0)
    last = float(r[0, int((~growing[0]).int().argmax())]) if not bool(growing.all()) else float("inf")
    before = is_before_fold(r.square(), k, name)
    found = float(r[before].max()) if not bool(before.all()) else float("inf")
    assert found == pytest.approx(last, rel=2e-3)
    assert torch.equal(before[0], r[0] <= found)  # never again, once it has folded
    still, flat = RigidTransform.identity(1, 1, dtype=torch.float64), torch.zeros_like(r)
    at = torch.stack((r, flat, torch.ones_like(r)), dim=-1)[0, None, ::40] * 1000
    large = torch.tensor([[100_000, 100_000]])
    lenses = (torch.ones(1, 1, 2).double(), torch.full((1, 1, 2), 5e4).double(), k[None])
    compiled = project_cpu(at, still, *lenses, large, models=name).visible[0, 0]
    assert torch.equal(compiled, before[0, ::40])


def test_what_lies_beyond_the_image_of_a_fisheye_has_no_inverse() -> None:
    xy = torch.tensor([[[1.2, 0.0], [1.8, 0.0]]], dtype=torch.float64)  # 1.57 is 90 degrees
    for inverse in (undistort, undistort_cpu):
        found, good = inverse(xy, torch.zeros(1, 4, dtype=torch.float64), "equidistant")
        assert good.tolist() == [[True, False]]
        assert torch.equal(found[0, 1], xy[0, 1])


def test_cameras_of_different_models_are_those_of_each() -> None:
    models, k = mixed()
    xy = 0.5 * points("brown_conrady", 30).expand(4, -1, -1)
    x, y = xy.unbind(-1)
    together = (*distort_with_jacobian(x, y, k, models), *distort_by_coefficients(x, y, k, models))
    for c, name in enumerate(models):
        width = len(LENS_MODELS[name].coefficients)
        one = (x[c : c + 1], y[c : c + 1], k[c : c + 1, :width], name)
        for mine, alone in zip(together, (*distort_with_jacobian(*one), *distort_by_coefficients(*one)), strict=True):
            part = mine[c : c + 1] if mine.dim() == 2 else mine[c : c + 1, :, :width]
            assert torch.equal(part, alone)
        assert not together[6][c, :, width:].any() and not together[7][c, :, width:].any()
    assert torch.equal(is_before_fold(x * x + y * y, k, models), torch.ones(4, 30, dtype=torch.bool))
    for inverse in (undistort, undistort_cpu):
        found, good = inverse(torch.stack(together[:2], dim=-1), k, models)
        assert good.all()
        torch.testing.assert_close(found, xy, rtol=0, atol=1e-13)


def test_names_and_numbers() -> None:
    assert lens_names("rational", 2) == ("rational", "rational")
    assert lens_label(["rational", "rational"]) == "rational"
    assert lens_label(["rational", "equidistant"]) == ("rational", "equidistant")
    assert (lens_width("equidistant"), lens_width(("equidistant", "rational"))) == (5, 8)
    assert lens_codes("brown_conrady", 3, 5) is None
    codes = lens_codes(("equidistant", "brown_conrady"), 2, 5)
    assert codes is not None and [list(LENS_MODELS)[code] for code in codes] == ["equidistant", "brown_conrady"]
    wide = lens_codes("brown_conrady", 2, 8)  # some cameras of a wider rig
    assert wide is not None and wide.tolist() == [0, 0]
