"""The module against the function, and under every transform; the operators have tests of their own."""

import pytest
import torch

from imgcal.geometry import Projection
from imgcal.nn import SplatRenderer
from renderers import splat, splat_reference

SIZE = (14, 17)


def places(*batch: int, count: int = 5, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    random = torch.Generator().manual_seed(2)
    return torch.rand(*batch, count, 2, generator=random, dtype=dtype) * torch.tensor([SIZE[1], SIZE[0]])


def colours(count: int = 5) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)


@pytest.mark.parametrize("compositing", ["add", "over"])
def test_draws_what_the_reference_does(batch, device, dtype, compositing):
    module = SplatRenderer(colours(), SIZE, 1.2, compositing).to(device)
    found = module(places(*batch).to(device, dtype))
    expected = splat_reference(places(*batch), colours(), 1.2, SIZE, compositing=compositing)
    assert found.shape == (*batch, 3, *SIZE)
    assert found.dtype == dtype
    torch.testing.assert_close(found.cpu().double(), expected, rtol=0, atol=2e-5)


def test_a_projection_says_what_is_visible_and_how_deep():
    uv = places(2)
    depth, visible = torch.rand(2, 5, dtype=torch.float64), torch.rand(2, 5) > 0.4
    found = SplatRenderer(colours(), SIZE, 1.2, "over")(Projection(uv, depth, visible))
    expected = splat(uv, colours(), 1.2, SIZE, depth=depth, visible=visible, compositing="over")
    assert torch.equal(found, expected)
    SplatRenderer(colours(), SIZE)(Projection(uv, depth, visible))  # depth does not matter where light adds up


@pytest.mark.parametrize("compositing", ["add", "over"])
def test_gradcheck(batch, compositing):
    module = SplatRenderer(colours(), SIZE, 1.2, compositing)
    uv, intensity = places(*batch), torch.full((*batch, 5), 0.4, dtype=torch.float64)

    def draw(uv, intensity):
        return module(uv, intensity=intensity)

    leaves = [uv.requires_grad_(), intensity.requires_grad_()]
    assert torch.autograd.gradcheck(draw, leaves, fast_mode=True, check_forward_ad=True)


@pytest.mark.parametrize("compositing", ["add", "over"])
def test_graphs(same_in_graphs, compositing):
    same_in_graphs(SplatRenderer(colours(), SIZE, 1.2, compositing), places(2, 3))


def test_vmap_and_jacobians():
    module, uv = SplatRenderer(colours(), SIZE), places(3)
    torch.testing.assert_close(torch.func.vmap(module)(uv), module(uv))
    torch.testing.assert_close(torch.func.jacfwd(module)(uv[0]), torch.func.jacrev(module)(uv[0]))


@pytest.mark.slow
def test_inductor(compiler):
    module, uv = SplatRenderer(colours(), SIZE), places(2)
    torch.testing.assert_close(torch.compile(module, fullgraph=True)(uv), module(uv))


def test_an_unknown_way_of_compositing_is_refused_when_the_module_is_made():
    with pytest.raises(ValueError, match="compositing must be 'add' or 'over', found 'under'"):
        SplatRenderer(torch.eye(3), (8, 8), compositing="under")
