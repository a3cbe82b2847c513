"""Rigid transforms: neighbours cancel, inverses invert, batch axes broadcast."""

import pytest
import torch
from torch import Tensor

from imgcal.geometry import RigidTransform, rotate, rotation_from_vector


def transform(*shape: int, seed: int = 0) -> RigidTransform:
    numbers = torch.randn(*shape, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return RigidTransform(rotation_from_vector(numbers[..., :3]), 100 * numbers[..., 3:])


def points(*shape: int) -> Tensor:
    return 50 * torch.randn(*shape, 5, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)


@pytest.mark.parametrize("shape", [(), (1,), (2, 3)])
def test_chain_apply_and_inverse(shape: tuple[int, ...]) -> None:
    a_from_b, b_from_c, points_c = transform(*shape), transform(*shape, seed=1), points(*shape)
    chained = (a_from_b @ b_from_c).apply(points_c)
    assert chained.shape == (*shape, 5, 3)
    torch.testing.assert_close(chained, a_from_b.apply(b_from_c.apply(points_c)))
    torch.testing.assert_close(a_from_b.inverse().apply(a_from_b.apply(points_c)), points_c)
    torch.testing.assert_close(
        (a_from_b @ a_from_b.inverse()).rotation, RigidTransform.identity(*shape).rotation.double()
    )


def test_batch_axes_broadcast() -> None:
    many, one = transform(2, 3), transform(seed=4)
    together = many @ one
    assert together.translation.shape == (2, 3, 3)
    torch.testing.assert_close(together[1, 2].apply(points()), many[1, 2].apply(one.apply(points())))
    torch.testing.assert_close(many.apply(points())[0, 1], many[0, 1].apply(points()))


def test_apply_by_hand() -> None:
    quarter = RigidTransform(rotation_from_vector(torch.tensor([0, 0, torch.pi / 2])), torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(quarter.apply(torch.tensor([[1.0, 0.0, 0.0]])), torch.tensor([[1.0, 3.0, 3.0]]))
    torch.testing.assert_close(quarter.origin_image(), torch.tensor([2.0, -1.0, 3.0]))


def test_reshape_identity_and_types() -> None:
    many = transform(2, 3)
    torch.testing.assert_close(many.reshape(6).reshape(2, 3).rotation, many.rotation)
    torch.testing.assert_close(RigidTransform.identity(4).apply(points().float()), points().float().expand(4, 5, 3))
    assert many.to(torch.float32).translation.dtype == torch.float32


def test_rotate_is_the_matrix_product() -> None:
    many, vectors = transform(2, 3).rotation, points()[:3].expand(2, 3, 3)
    torch.testing.assert_close(rotate(many, vectors), (many @ vectors[..., None]).squeeze(-1))
    inputs = (many[0, :2].clone().requires_grad_(), vectors[0, :2].clone().requires_grad_())
    assert torch.autograd.gradcheck(rotate, inputs)
