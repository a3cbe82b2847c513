"""The small compiled functions against the tensors that say the same."""

import numpy as np
import pytest
import torch

from imgcal.geometry import distort_with_jacobian, kernels, left_jacobian, rotation_from_vector
from imgcal.geometry import undistort as undistort_tensors
from imgcal.geometry.projection import is_before_fold

LENS = (0.08, -0.05, 0.004, -0.003, 0.02)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_the_lens_is_that_of_the_tensors(kind: type) -> None:
    generator = np.random.default_rng(1)
    for x, y in generator.uniform(-0.6, 0.6, (20, 2)).astype(kind):
        given = [kind(value) for value in (x, y, *LENS)]
        found = kernels.distort(kind(1), *given)
        expected = distort_with_jacobian(*(torch.as_tensor(value) for value in given))
        assert np.allclose(found, [float(value) for value in expected], rtol=0, atol=20 * np.finfo(kind).eps)


@pytest.mark.parametrize("radius", [0.0, 12.0])
def test_the_image_of_a_sphere_and_its_derivatives_match_autograd(radius: float) -> None:
    point = torch.tensor([310.0, -220.0, 1400.0], dtype=torch.float64, requires_grad=True)
    depth = point[2]
    scale = depth / (depth * depth - radius**2)
    coefficients = [torch.tensor(value, dtype=torch.float64) for value in LENS]
    xd, yd, *_ = distort_with_jacobian(point[0] * scale, point[1] * scale, *coefficients)
    found = kernels.lens(*point.tolist(), radius**2, *LENS)
    per_depth, log_slope, x, y, rr, found_x, found_y, jxx, jxy, jyy = found
    assert (found_x, found_y) == pytest.approx((xd.item(), yd.item()), abs=1e-15)
    assert rr == pytest.approx(x * x + y * y, abs=1e-15)
    for value, (along, across) in ((xd, (jxx, jxy)), (yd, (jxy, jyy))):
        (slope,) = torch.autograd.grad(value, point, retain_graph=True)
        expected = (along * per_depth, across * per_depth, log_slope * (along * x + across * y))
        assert slope.tolist() == pytest.approx(expected, rel=1e-12)


def test_fixed_points_undo_the_distortion() -> None:
    at = torch.tensor([[[0.3, -0.2], [-0.45, 0.4], [0.0, 0.0]]], dtype=torch.float64)
    exact, good = undistort_tensors(at, torch.tensor([LENS], dtype=torch.float64))
    assert bool(good.all())
    for distorted, ideal in zip(at[0].tolist(), exact[0].tolist(), strict=True):
        assert kernels.undistort(*distorted, *LENS) == pytest.approx(ideal, abs=1e-6)


@pytest.mark.parametrize("lens", [(-0.4, 0.05, 0.0), (-0.4, 0.2, 0.1), (0.1, -0.3, 0.02), (0.1, 0.0, 0.0)])
def test_the_image_folds_where_the_tensors_say(lens: tuple[float, float, float]) -> None:
    rr = torch.linspace(0, 4, 401, dtype=torch.float64)
    k1, k2, k3 = lens
    before = is_before_fold(rr[None], torch.tensor([[k1, k2, 0, 0, k3]], dtype=torch.float64))[0]
    slope = 1 + rr * (3 * k1 + rr * (5 * k2 + rr * 7 * k3))
    assert torch.equal(before, (slope > 0) & (rr < kernels.blind_from(3 * k1, 5 * k2, 7 * k3)))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.01, 1.0, 3.1])
def test_the_exponential_is_that_of_the_tensors(angle: float) -> None:
    vector = angle * torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64)
    rotation, left = np.empty((3, 3)), np.empty((3, 3))
    kernels.exponential(vector.numpy(), rotation, left)
    assert np.allclose(rotation, rotation_from_vector(vector), rtol=0, atol=1e-15)
    assert np.allclose(left, left_jacobian(vector), rtol=0, atol=1e-11)
    product = np.empty((3, 3))
    kernels.multiply(rotation, left, product)
    assert np.allclose(product, rotation @ left, rtol=0, atol=1e-15)


@pytest.mark.parametrize("size", [1, 3, 21])
def test_cholesky_factors_solve(size: int) -> None:
    generator = np.random.default_rng(size)
    root = generator.normal(size=(size, size + 2))
    matrix, right = root @ root.T, generator.normal(size=size)
    factor, found = matrix.copy(), right.copy()
    factor[np.triu_indices(size, 1)] = np.nan  # the lower triangle is all that counts
    assert kernels.cholesky(factor)
    assert np.allclose(np.tril(factor), np.linalg.cholesky(matrix), rtol=1e-12)
    kernels.cholesky_solve(factor, found)
    assert np.allclose(found, np.linalg.solve(matrix, right), rtol=1e-9)
    assert not kernels.cholesky(-matrix)
    assert not kernels.cholesky(np.full((size, size), np.nan))


def test_subtract_gram_fills_the_lower_triangle() -> None:
    generator = np.random.default_rng(0)
    matrix, tall = generator.normal(size=(5, 5)), generator.normal(size=(6, 5))
    found = matrix.copy()
    kernels.subtract_gram(found, tall)
    assert np.allclose(found, np.triu(matrix, 1) + np.tril(matrix - tall.T @ tall), rtol=0, atol=1e-14)
