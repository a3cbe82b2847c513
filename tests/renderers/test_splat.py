"""Splats against the dense reference, and their invariants."""

import math
from typing import Any, Literal

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from renderers import palette, splat, splat_reference

Mode = Literal["add", "over"]
MODES: tuple[Mode, ...] = ("add", "over")
BATCHES = [(), (1,), (2, 3), (5,), (0,)]
SIZE = (23, 31)


def scene(batch: tuple[int, ...], count: int = 5, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
    """Draw a scene whose splats overlap, touch the border and differ in all values."""
    random = torch.Generator().manual_seed(7)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*batch, count, *shape, generator=random, dtype=dtype)

    return {
        "uv": uniform(2) * torch.tensor([SIZE[1], SIZE[0]]) - 0.5,
        "colours": uniform(3),
        "size": 0.4 + 1.5 * uniform(),
        "intensity": 0.3 + 0.5 * uniform(),
        "depth": uniform(),
        "visible": uniform() > 0.2,
    }


def arguments(values: dict[str, Tensor], mode: Mode) -> dict[str, Any]:
    return {k: v for k, v in values.items() if mode == "over" or k != "depth"} | {
        "image_size": SIZE,
        "compositing": mode,
    }


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("batch", BATCHES)
def test_values_and_gradients_equal_the_reference(batch: tuple[int, ...], mode: Mode) -> None:
    tolerance = 1e-12 if mode == "add" else 1e-5  # "over" cuts the profile off at 5 sizes
    found, gradients = {}, {}
    for render in (splat, splat_reference):
        values = scene(batch)
        leaves = [values[k].requires_grad_() for k in ("uv", "colours", "size", "intensity")]
        image = render(**arguments(values, mode))
        ramp = torch.linspace(-1, 1, image[..., 0, 0, 0].numel() * 3 * SIZE[0] * SIZE[1], dtype=image.dtype)
        found[render] = image
        gradients[render] = torch.autograd.grad((image * ramp.view_as(image)).sum(), leaves)
    assert found[splat].shape == (*batch, 3, *SIZE)
    torch.testing.assert_close(found[splat], found[splat_reference], atol=tolerance, rtol=0)
    for fast, slow in zip(gradients[splat], gradients[splat_reference], strict=True):
        torch.testing.assert_close(fast, slow, atol=20 * tolerance, rtol=1e-5)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("batch", [(), (2,)])
def test_gradcheck(batch: tuple[int, ...], mode: Mode) -> None:
    values = scene(batch, count=3)
    rest = {k: v for k, v in arguments(values, mode).items() if k not in ("uv", "colours", "size", "intensity")}

    def render(uv: Tensor, colours: Tensor, size: Tensor, intensity: Tensor) -> Tensor:
        return splat(uv, colours, size, intensity=intensity, **rest)

    leaves = [values[k].requires_grad_() for k in ("uv", "colours", "size", "intensity")]
    assert torch.autograd.gradcheck(render, leaves, fast_mode=True)


@pytest.mark.parametrize("mode", MODES)
def test_a_shift_by_one_pixel_shifts_the_image(mode: Mode) -> None:
    values = scene((2,), dtype=torch.float64)
    values["uv"] = 8 + values["uv"] * 0.4
    moved = dict(values, uv=values["uv"] + torch.tensor([1.0, 2.0]))
    image, other = (splat(**arguments(v, mode)) for v in (values, moved))
    torch.testing.assert_close(other[..., 2:, 1:], image[..., :-2, :-1], atol=1e-5, rtol=0)


@pytest.mark.parametrize("size", [0.05, 0.3, 1.0, 2.5])
@pytest.mark.parametrize("offset", [0.0, 0.21, 0.5])
def test_mass_and_centre_do_not_depend_on_the_position_in_the_pixel(size: float, offset: float) -> None:
    image = splat(torch.tensor([[15.0 + offset, 15.0 - offset]]), torch.ones(1, 1), size, (31, 31))[0].double()
    assert image.sum().item() == pytest.approx(2 * math.pi * size**2, rel=1e-5)
    if size >= 1:  # narrower splats are too few pixels for a centroid
        position = torch.arange(31.0, dtype=torch.float64)
        assert (image.sum(0) @ position / image.sum()).item() == pytest.approx(15 + offset, abs=1e-4)
        assert (image.sum(1) @ position / image.sum()).item() == pytest.approx(15 - offset, abs=1e-4)


def test_a_wide_splat_peaks_at_its_colour() -> None:
    image = splat(torch.tensor([[50.0, 50.0]]), torch.tensor([[0.2, 0.6, 1.0]]), 10.0, (101, 101))
    torch.testing.assert_close(image[:, 50, 50], torch.tensor([0.2, 0.6, 1.0]), atol=1e-3, rtol=0)


def test_addition_does_not_depend_on_the_order() -> None:
    values = scene((2,))
    order = torch.tensor([3, 0, 4, 2, 1])
    permuted = {k: v[:, order] for k, v in values.items()}
    torch.testing.assert_close(splat(**arguments(permuted, "add")), splat(**arguments(values, "add")))


def test_the_nearer_splat_hides_the_deeper_one() -> None:
    uv = torch.tensor([[15.0, 11.0], [15.0, 11.0]])
    red_and_green = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    for depth, nearer in ((torch.tensor([1.0, 2.0]), 0), (torch.tensor([2.0, 1.0]), 1)):
        pixel = splat(uv, red_and_green, 8.0, SIZE, depth=depth, compositing="over")[:, 11, 15]
        assert pixel[nearer] > 0.99
        assert pixel[1 - nearer] < 0.01


def test_both_modes_agree_where_nothing_overlaps() -> None:
    uv = torch.tensor([[7.3, 8.1], [23.6, 14.2]])
    images = [splat(uv, palette(2), 1.0, SIZE, compositing=mode) for mode in MODES]
    torch.testing.assert_close(images[0], images[1], atol=1e-5, rtol=0)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, -1.0, 0.0])
def test_fiducials_without_a_positive_finite_size_draw_nothing(bad: float, mode: Mode) -> None:
    uv = torch.tensor([[10.0, 12.0], [20.0, 4.0]], requires_grad=True)
    size = torch.tensor([1.5, bad], requires_grad=True)
    found = splat(uv, torch.eye(3)[:2], size, (32, 24), compositing=mode)
    assert torch.equal(found, splat(uv[:1], torch.eye(3)[:1], size[:1], (32, 24), compositing=mode))
    found.square().sum().backward()
    assert uv.grad.isfinite().all() and uv.grad[0].any() and not uv.grad[1].any()
    assert size.grad[0].isfinite() and size.grad[0] != 0 and size.grad[1] == 0


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
def test_fiducials_that_are_not_drawn_leave_images_and_gradients_clean(bad: float, mode: Mode) -> None:
    values = {k: v for k, v in scene((2,), dtype=torch.float32).items() if k != "visible"}
    kept = {k: v[:, 1:] for k, v in values.items()}
    values["uv"][:, 0] = bad
    leaves = [values[k].requires_grad_() for k in ("uv", "size", "intensity", "colours")]
    image = splat(**arguments(values, mode))
    torch.testing.assert_close(image, splat(**arguments(kept, mode)))
    for gradient in torch.autograd.grad(image.square().sum(), leaves):
        assert gradient.isfinite().all()
        assert (gradient[:, 0] == 0).all()
        assert (gradient[:, 1:] != 0).any()


@pytest.mark.parametrize("mode", MODES)
def test_invisible_fiducials_may_hold_anything(mode: Mode) -> None:
    values = scene((2,), dtype=torch.float32)
    values["visible"][:] = torch.tensor([False, True, True, False, True])
    clean = splat(**arguments(values, mode))
    for key in ("uv", "size", "intensity", "colours"):
        values[key][:, [0, 3]] = math.nan
    leaves = [values[k].requires_grad_() for k in ("uv", "size", "intensity", "colours")]
    image = splat(**arguments(values, mode))
    torch.testing.assert_close(image, clean)
    for gradient in torch.autograd.grad(image.sum(), leaves):
        assert gradient.isfinite().all()
        assert (gradient[:, [0, 3]] == 0).all()


@pytest.mark.parametrize("mode", MODES)
def test_shared_values_are_broadcast(mode: Mode) -> None:
    uv = scene((2, 3))["uv"]
    colours = palette(5).double()
    short = splat(uv, colours, 1.2, SIZE, intensity=torch.tensor(0.5), compositing=mode)
    full = torch.full(uv.shape[:-1], 1.2, dtype=uv.dtype)
    long = splat(uv, colours.expand(2, 3, 5, 3), full, SIZE, intensity=0.5 * torch.ones_like(full), compositing=mode)
    torch.testing.assert_close(short, long)


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float32, 0.0), (torch.bfloat16, 2**-8), (torch.float16, 2**-11)]
)
@pytest.mark.parametrize("mode", MODES)
def test_a_buffer_is_overwritten_with_the_same_images(dtype: torch.dtype, tolerance: float, mode: Mode) -> None:
    values = arguments(scene((7, 5), dtype=torch.float32), mode)
    out = torch.full((7, 5, 3, *SIZE), math.nan, dtype=dtype)
    returned = splat(**values, out=out)
    assert returned is out
    torch.testing.assert_close(out.float(), splat(**values), rtol=tolerance, atol=1e-7)


class LargestTensor(TorchDispatchMode):
    """Record the number of values in the largest tensor that any operation returns."""

    largest = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        self.largest = max([self.largest, *(x.numel() for x in tree_leaves(result) if isinstance(x, Tensor))])
        return result


@pytest.mark.parametrize("mode", MODES)
def test_no_tensor_is_larger_than_the_images(mode: Mode) -> None:
    uv = (20 * torch.rand(2, 60, 2, generator=torch.Generator().manual_seed(0))).requires_grad_()
    with LargestTensor() as record:
        image = splat(uv, palette(60), 0.6, (128, 96), compositing=mode)
        image.square().sum().backward()
    assert record.largest == image.numel()


def test_no_fiducials_give_black_images() -> None:
    for mode in MODES:
        assert torch.equal(
            splat(torch.zeros(2, 0, 2), torch.zeros(0, 3), 1.0, SIZE, compositing=mode), torch.zeros(2, 3, *SIZE)
        )


def test_autocast_does_not_round_the_images() -> None:
    values = arguments(scene((2,), dtype=torch.float32), "add")
    with torch.autocast("cpu", dtype=torch.bfloat16):
        image = splat(**values)
    assert torch.equal(image, splat(**values))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"uv": torch.zeros(5, 3)}, "uv must be floating point of shape"),
        ({"uv": torch.zeros(5, 2, dtype=torch.int64)}, "uv must be floating point"),
        ({"colours": torch.zeros(4, 3)}, r"colours must have shape \(5, K\)"),
        ({"colours": torch.zeros(2, 5, 3)}, r"colours must have shape \(5, K\)"),
        ({"intensity": torch.ones(4)}, r"intensity must have shape \(5,\) or broadcast to it, found \(4,\)"),
        ({"size": torch.ones(4)}, "size must have shape"),
        ({"visible": torch.ones(2, 5) > 0}, "visible must have shape"),
        ({"compositing": "max"}, "compositing must be 'add' or 'over'"),
        ({"depth": torch.zeros(5)}, "depth needs"),
        ({"out": torch.zeros(3, 5, 5)}, "out must be contiguous"),
        ({"uv": torch.zeros(5, 2, requires_grad=True), "out": torch.zeros(3, *SIZE)}, "out is not differentiable"),
    ],
)
def test_unusable_arguments_are_named(change: dict[str, Any], message: str) -> None:
    usual: dict[str, Any] = {"uv": torch.zeros(5, 2), "colours": torch.zeros(5, 3), "size": 1.0, "image_size": SIZE}
    with pytest.raises(ValueError, match=message):
        splat(**(usual | change))
