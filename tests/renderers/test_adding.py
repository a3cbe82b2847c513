"""Compiled windows against whole matrix products: values, first and second gradients, borders, threads."""

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from renderers import adding, adding_compiled, palette, splat

SIZE = (19, 33)


def scene(images: int, count: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor]:
    """Draw splats of many sizes, in the image, on its border, far outside: uv, sizes, colours."""
    random = torch.Generator().manual_seed(3)
    uv = (torch.rand(images, count, 2, generator=random, dtype=dtype) * 1.6 - 0.3) * torch.tensor(SIZE[::-1])
    uv[0, 0] = torch.tensor([1e30, -1e30])
    sizes = 0.1 + 4 * torch.rand(images, count, generator=random, dtype=dtype) ** 3
    return uv, sizes, torch.rand(images, count, 3, generator=random, dtype=dtype) - 0.2


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 3e-6)])
@pytest.mark.parametrize("widest", [1.0, 40.0])
def test_equals_whole_matrix_products(dtype: torch.dtype, tolerance: float, widest: float) -> None:
    uv, sizes, colours = scene(4, 6, dtype)
    sizes[2, 3] *= widest  # windows larger than the image
    leaves = [x.requires_grad_() for x in (uv, sizes, colours)]
    upstream = torch.randn(4, 3, *SIZE, generator=torch.Generator().manual_seed(0), dtype=dtype)
    images, gradients = zip(
        *((made := path.added(*leaves, SIZE), torch.autograd.grad(made, leaves, upstream))
          for path in (adding, adding_compiled)), strict=True
    )  # fmt: skip
    torch.testing.assert_close(images[1], images[0], rtol=0, atol=tolerance)
    for slow, fast in zip(*gradients, strict=True):
        torch.testing.assert_close(fast, slow, rtol=100 * tolerance, atol=100 * tolerance)


def test_a_buffer_holds_the_same_images() -> None:
    with torch.no_grad():
        given = scene(3, 5)
        for path in (adding, adding_compiled):
            out = torch.full((3, 3, *SIZE), torch.nan, dtype=torch.float64)
            assert path.added(*given, SIZE, out) is out
            assert torch.equal(out, path.added(*given, SIZE))


def test_second_gradients() -> None:
    uv, sizes, colours = scene(2, 3)
    uv[0, 0] = torch.tensor([3.0, 4.0])
    leaves = [x.requires_grad_() for x in (uv, sizes + 0.5, colours)]
    leaves[1] = leaves[1].detach().requires_grad_()
    assert torch.autograd.gradgradcheck(lambda *x: adding_compiled.added(*x, SIZE), leaves, fast_mode=True)


def test_gradients_of_one_argument_and_of_an_expanded_upstream() -> None:
    uv, sizes, colours = scene(2, 3)
    uv.requires_grad_()
    (found,) = torch.autograd.grad(adding_compiled.added(uv, sizes, colours, SIZE).sum(), uv)
    (expected,) = torch.autograd.grad(adding.added(uv, sizes, colours, SIZE).sum(), uv)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


@pytest.fixture
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("three_threads")
def test_threads_change_nothing() -> None:
    count = 3 * adding_compiled.IMAGES_PER_THREAD + 1
    uv, sizes, colours = scene(count, 4)
    uv.requires_grad_()
    images = adding_compiled.added(uv, sizes, colours, SIZE)
    (gradient,) = torch.autograd.grad(images.square().sum(), uv)
    torch.set_num_threads(1)
    again = adding_compiled.added(uv, sizes, colours, SIZE)
    assert torch.equal(images, again)
    assert torch.equal(gradient, torch.autograd.grad(again.square().sum(), uv)[0])


def test_images_of_one_batch_do_not_depend_on_each_other() -> None:
    uv, sizes, colours = scene(5, 4, torch.float32)
    sizes = sizes.clamp_max(1)
    alone = splat(uv[1], colours[1], sizes[1], SIZE)
    sizes[0] = 5.0  # wider windows for all
    torch.testing.assert_close(splat(uv, colours, sizes, SIZE)[1], alone, rtol=0, atol=3e-7)


def test_many_channels() -> None:
    uv, sizes, _ = scene(2, 4)
    colours = torch.cat([palette(4).double()] * 3, dim=1).expand(2, 4, 9)
    torch.testing.assert_close(
        adding_compiled.added(uv, sizes, colours, SIZE), adding.added(uv, sizes, colours, SIZE), rtol=0, atol=1e-14
    )
