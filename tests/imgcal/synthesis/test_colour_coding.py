import math

import pytest
import torch

from imgcal.errors import InputError
from imgcal.synthesis import ImageOptions, render_views

SENSOR = torch.tensor([[512, 272], [512, 272], [400, 300]])  # C = 3, and square images: scales differ across and down
SMALL = ImageOptions(size=40, dot=1.2)


def scene(*batch, count=8, seed=3, dtype=torch.float64):
    random = torch.Generator().manual_seed(seed)
    uv = torch.rand(*batch, 3, count, 2, generator=random, dtype=dtype) * SENSOR[:, None] - 0.5
    return uv, torch.rand(*batch, 3, count, generator=random) > 0.2


@pytest.mark.parametrize("batch", [(), (1,), (2, 5)])
def test_every_dot_is_where_the_pixel_centre_rule_puts_it(batch, asymmetric8):
    uv = SENSOR[:, None] * torch.rand(*batch, 3, 1, 2, generator=torch.Generator().manual_seed(1)).double()
    uv = uv.clamp_min(0.3 * SENSOR[:, None]).minimum(0.7 * SENSOR[:, None]).expand(*batch, 3, 8, 2)
    seen = (torch.arange(8) == 4).expand(*batch, 3, 8)
    images = render_views(uv, seen, SENSOR, asymmetric8, SMALL)
    assert images.shape == (*batch, 3, 3, 40, 40) and images.dtype == uv.dtype
    light = images.sum(-3)
    x = torch.arange(40).double()
    found = torch.stack(((light.sum(-2) * x).sum(-1), (light.sum(-1) * x).sum(-1)), -1) / light.sum((-1, -2))[..., None]
    expected = (uv[..., 4, :] + 0.5) * 40 / SENSOR - 0.5
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
    colour = images.sum((-1, -2)) / (2 * math.pi * 1.2**2)
    torch.testing.assert_close(colour, asymmetric8.colours[4].double().expand_as(colour), atol=1e-6, rtol=0)


def test_image_and_sensor_pixels_invert_each_other():
    uv, _ = scene(2)
    options = ImageOptions(224)
    torch.testing.assert_close(options.to_sensor(options.from_sensor(uv, SENSOR), SENSOR), uv, atol=1e-10, rtol=0)


def test_light_is_at_most_one_and_what_is_not_seen_is_not_drawn(asymmetric8):
    uv, seen = scene(4)
    uv[:] = 100.0  # all in one place
    images = render_views(uv, torch.ones_like(seen), SENSOR, asymmetric8, SMALL)
    assert float(images.max()) == 1.0
    nothing = render_views(torch.full_like(uv, torch.nan), torch.zeros_like(seen), SENSOR, asymmetric8, SMALL)
    assert float(nothing.abs().max()) == 0.0


def test_quantised_images_are_grey_levels_within_half_a_level(asymmetric8):
    uv, seen = scene(2)
    exact, rounded = (render_views(uv, seen, SENSOR, asymmetric8, SMALL, quantise=q) for q in (False, True))
    levels = rounded * 255
    torch.testing.assert_close(levels, levels.round(), atol=1e-9, rtol=0)
    assert 0.4 / 255 < float((rounded - exact).abs().max()) <= 0.5 / 255 + 1e-9


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_reused_buffer_holds_the_same_images(dtype, asymmetric8):
    uv, seen = scene(2, dtype=torch.float32)
    out = torch.empty(2, 3, 3, 40, 40, dtype=dtype)
    for quantise in (False, True):
        fresh = render_views(uv, seen, SENSOR, asymmetric8, SMALL, quantise=quantise)
        assert render_views(uv, seen, SENSOR, asymmetric8, SMALL, quantise=quantise, out=out) is out
        torch.testing.assert_close(out, fresh.to(dtype), rtol=0, atol=0 if quantise or dtype == fresh.dtype else 1e-2)


def test_gradient_by_uv(asymmetric8):
    uv, seen = scene(2, count=8)
    uv.requires_grad_()
    tiny = ImageOptions(size=12, dot=1.0)
    assert torch.autograd.gradcheck(
        lambda uv: render_views(uv, seen, SENSOR, asymmetric8, tiny), (uv,), fast_mode=True, atol=1e-6
    )
    weight = torch.linspace(-1, 1, 144, dtype=uv.dtype).view(12, 12)
    by_exact, by_rounded = (
        torch.autograd.grad((render_views(uv, seen, SENSOR, asymmetric8, tiny, quantise=q) * weight).sum(), uv)[0]
        for q in (False, True)
    )
    torch.testing.assert_close(by_exact, by_rounded)
    assert float(by_exact.abs().max()) > 0
    with pytest.raises(ValueError, match="no_grad"):
        render_views(uv, seen, SENSOR, asymmetric8, tiny, out=torch.empty(2, 3, 3, 12, 12, dtype=uv.dtype))


@pytest.mark.parametrize(("size", "dot"), [(4, 1.5), (100_000, 1.5), (224, 0.0), (224, math.nan), (224, 300.0)])
def test_impossible_options_are_refused(size, dot):
    with pytest.raises(InputError, match=r"^size: found|^dot: found"):
        ImageOptions(size, dot)
