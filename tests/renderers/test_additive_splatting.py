"""Compiled windows against whole matrix products: values, first and second gradients, borders, threads."""

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from renderers import additive_splatting, additive_splatting_cpu, additive_splatting_operator, splat
from renderers.additive_splatting import Splats

SIZE = (19, 33)


def scene(images: int, count: int, dtype: torch.dtype = torch.float64, channels: int = 3) -> Splats:
    """Draw splats of many sizes: in the image, on its border, far outside, not finite, invisible."""
    random = torch.Generator().manual_seed(3)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(images, count, *shape, generator=random, dtype=dtype)

    uv = (uniform(2) * 1.6 - 0.3) * torch.tensor(SIZE[::-1])
    uv[0, 0] = torch.tensor([1e30, -1e30])
    uv[1, 1, 0] = torch.nan
    return Splats(uv, 0.1 + 4 * uniform() ** 3, uniform(), uniform(channels) - 0.2, uniform() > 0.1)


def leaves(splats: Splats) -> list[Tensor]:
    return [x.requires_grad_() for x in splats[:4]]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 3e-6)])
@pytest.mark.parametrize("widest", [1.0, 40.0])
@pytest.mark.parametrize("channels", [1, 3, 7])
def test_equals_whole_matrix_products(dtype: torch.dtype, tolerance: float, widest: float, channels: int) -> None:
    splats = scene(4, 6, dtype, channels)
    splats.sizes[2, 3] *= widest  # windows larger than the image
    upstream = torch.randn(4, channels, *SIZE, generator=torch.Generator().manual_seed(0), dtype=dtype)
    found = []
    for path in (additive_splatting, additive_splatting_operator):
        images = (
            path.splat_additively(splats, SIZE)
            if found
            else path.splat_additively(Splats(*leaves(splats), splats.visible), SIZE)
        )
        found.append((images, *torch.autograd.grad(images, splats[:4], upstream)))
    torch.testing.assert_close(found[1][0], found[0][0], rtol=0, atol=tolerance)
    for slow, fast in zip(found[0][1:], found[1][1:], strict=True):
        torch.testing.assert_close(fast, slow, rtol=100 * tolerance, atol=100 * tolerance)


@pytest.mark.parametrize("path", [additive_splatting, additive_splatting_operator])
def test_a_buffer_holds_the_same_images(path) -> None:
    splats = scene(3, 5)
    out = torch.full((3, 3, *SIZE), torch.nan, dtype=torch.float64)
    assert path.splat_additively(splats, SIZE, out) is out
    assert torch.equal(out, path.splat_additively(splats, SIZE))


def test_second_gradients() -> None:
    splats = scene(2, 4)
    uv, sizes, weight, colours = splats[:4]
    given = [x.requires_grad_() for x in (uv.nan_to_num(5.0).clamp(-5, 40), sizes + 0.5, weight, colours)]
    assert torch.autograd.gradgradcheck(
        lambda *x: additive_splatting_operator.splat_additively(Splats(*x, splats.visible), SIZE), given, fast_mode=True
    )


def test_gradient_of_one_argument_from_an_expanded_upstream() -> None:
    splats = scene(2, 3)
    splats.uv.requires_grad_()
    found, expected = (
        torch.autograd.grad(path.splat_additively(splats, SIZE).sum(), splats.uv)[0]
        for path in (additive_splatting_operator, additive_splatting)
    )
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


@pytest.fixture
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("three_threads")
def test_threads_change_nothing() -> None:
    splats = scene(3 * additive_splatting_cpu.IMAGES_PER_THREAD + 1, 4)
    found = []
    for threads in (3, 1):
        torch.set_num_threads(threads)
        images = additive_splatting_operator.splat_additively(Splats(*leaves(splats), splats.visible), SIZE)
        found.append((images, *torch.autograd.grad(images.square().sum(), splats[:4])))
    for many, one in zip(*found, strict=True):
        assert torch.equal(many, one)


def test_images_of_one_batch_do_not_depend_on_each_other() -> None:
    uv, sizes, _, colours, _ = scene(5, 4, torch.float32)
    alone = splat(uv[2], colours[2], sizes[2], SIZE)
    sizes[0] = 5.0  # wider windows for all
    torch.testing.assert_close(splat(uv, colours, sizes, SIZE)[2], alone, rtol=0, atol=3e-7)
