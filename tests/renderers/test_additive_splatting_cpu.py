"""The compiled loops alone: windows, threads, undrawn splats. For gradients, see test_additive_splatting."""

import math

import numpy as np
import pytest
import torch

from renderers import additive_splatting, additive_splatting_cpu
from renderers.additive_splatting import Splats
from renderers.additive_splatting_cpu import IMAGES_PER_THREAD, NOWHERE, REACH, draw, draw_new, windows

SIZE = (17, 23)


def splats(images: int, count: int = 4, dtype: torch.dtype = torch.float64) -> Splats:
    random = torch.Generator().manual_seed(1)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(images, count, *shape, generator=random, dtype=dtype)

    uv = uniform(2) * torch.tensor(SIZE[::-1], dtype=dtype)
    return Splats(uv, 0.3 + uniform(), uniform(), uniform(3), uniform() > 0.2)


@pytest.mark.parametrize("images", [1, 3, 2 * IMAGES_PER_THREAD + 5])
def test_images_are_those_of_the_tensors_in_any_number_of_threads(images: int) -> None:
    given = splats(images)
    expected = additive_splatting.splat_additively(given, SIZE)
    torch.testing.assert_close(draw_new(given, SIZE)[0], expected, rtol=0, atol=1e-14)
    images_ = torch.full_like(expected, torch.nan)
    draw(images_, given)
    torch.testing.assert_close(images_, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_windows_hold_the_error_function_at_the_edges_of_their_pixels(dtype: torch.dtype) -> None:
    given = splats(3, dtype=dtype)
    steps, starts = windows(given, max(SIZE))
    for image, splat in np.ndindex(3, 4):
        if not given.visible[image, splat]:
            assert (starts[image, splat] == NOWHERE).all()
            continue
        size = float(given.sizes[image, splat])
        for axis in range(2):
            first = int(starts[image, splat, axis]) - 0.5
            centre = float(given.uv[image, splat, axis])
            edges = [math.erf((first + k - centre) / (math.sqrt(2) * size)) for k in range(steps.shape[-1])]
            tolerance = 1e-6 if dtype == torch.float32 else 1e-13
            np.testing.assert_allclose(steps[image, splat, axis], edges, atol=tolerance)
            reach = (REACH[dtype] - 1) * size
            assert first <= centre - reach and centre + reach <= first + steps.shape[-1] - 1


def test_what_is_not_finite_or_far_away_is_not_drawn() -> None:
    given = splats(1, 6)
    given.visible[:] = True
    given.uv[0, 0, 0], given.uv[0, 1, 1] = torch.nan, torch.inf
    given.uv[0, 2], given.uv[0, 3] = torch.tensor([1e30, 3.0]), torch.tensor([5.0, -900.0])
    few = Splats(*(x[:, 4:] for x in given))
    torch.testing.assert_close(draw_new(given, SIZE)[0], draw_new(few, SIZE)[0], rtol=0, atol=1e-15)


def test_windows_are_no_larger_than_the_image_asks_for() -> None:
    given = splats(2)
    given.sizes[0, 0], given.visible[0, 0] = 1e4, True
    steps, _ = windows(given, max(SIZE))
    assert steps.shape[-1] <= 2 * max(SIZE) + 2
    torch.testing.assert_close(
        draw_new(given, SIZE)[0], additive_splatting.splat_additively(given, SIZE), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("place", [(-10.0, 8.0), (-40.0, 30.0), (33.0, -12.0), (300.0, 9.0)])
@pytest.mark.parametrize("size", [6.0, 20.0, 100.0])
def test_wide_splats_reach_into_the_image_from_outside(place: tuple[float, float], size: float) -> None:
    given = splats(2, 3)
    given.visible[:], given.sizes[:, 1:] = True, size
    given.uv[0, 1], given.uv[1, 2] = torch.tensor(place).double(), torch.tensor(place[::-1]).double()
    expected = additive_splatting.splat_additively(given, SIZE)
    torch.testing.assert_close(draw_new(given, SIZE)[0], expected, rtol=0, atol=1e-13)


def test_no_splats_leave_images_black() -> None:
    assert not draw_new(splats(2, 0), SIZE)[0].any()
    assert additive_splatting_cpu.draw_new(splats(0), SIZE)[0].shape == (0, 3, *SIZE)
