"""The small compiled functions against the tensors that say the same."""

import numpy as np
import pytest
import torch

from imgcal.geometry import kernels, left_jacobian, rotation_from_vector


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


@pytest.mark.parametrize("size", [1, 31, 32, 33, 100])
def test_mirror_fills_the_upper_triangle(size: int) -> None:
    matrix = np.random.default_rng(size).standard_normal((size, size))
    expected = np.tril(matrix) + np.tril(matrix, -1).T
    kernels.mirror(matrix)
    np.testing.assert_array_equal(matrix, expected)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_ranks_are_those_of_sorted_values(kind: type) -> None:
    random = np.random.default_rng(3)
    for count in (1, 2, 7, 40):
        for rank in {0, count // 4, count // 2, count - 1}:
            values = random.integers(0, 9, count + 3).astype(kind)  # many are equal; the last three do not count
            expected, rest = np.sort(values[:count]), values[count:].copy()
            found = kernels.select_rank(values, count, rank)
            assert found == expected[rank] == values[rank]
            assert (values[:rank] <= found).all() and (values[rank:count] >= found).all()
            assert np.array_equal(np.sort(values[:count]), expected) and np.array_equal(values[count:], rest)
