"""The module against the function, its operator, and under every transform."""

import pytest
import torch

from imgcal.networks import find_soft_positions
from imgcal.nn import SoftPositions, SplatRenderer

SIZE = (40, 48)
COLOURS = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1]], dtype=torch.float64)


def scene(*batch: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Places far apart, their images, and logits."""
    random = torch.Generator().manual_seed(1)
    base = torch.tensor([[8.0, 8], [24, 8], [40, 8], [12, 30], [34, 30]], dtype=torch.float64)
    uv = base + 3 * torch.rand(*batch, 5, 2, generator=random, dtype=torch.float64)
    logits = torch.randn(*batch, 5, 5, 6, generator=random, dtype=torch.float64)
    return uv, SplatRenderer(COLOURS, SIZE)(uv), logits


def test_finds_dots_where_they_were_drawn(batch, device, dtype):
    uv, images, _ = scene(*batch)
    found, confidence = SoftPositions(COLOURS).to(device)(images.to(device, dtype))
    assert found.shape == (*batch, 5, 2)
    assert confidence.shape == (*batch, 5)
    assert found.dtype == dtype
    assert found.device.type == device.type
    torch.testing.assert_close(found.cpu().double(), uv, rtol=0, atol=0.02)
    assert confidence.min() > 0.9


def test_is_the_function(batch):
    _, images, logits = scene(*batch)
    found = SoftPositions(COLOURS)(images, logits)
    flat = find_soft_positions(images.reshape(-1, 3, *SIZE), COLOURS, 1.5, logits.reshape(-1, 5, 5, 6))
    for one, other in zip(found, flat, strict=True):
        assert torch.equal(one.reshape(other.shape), other)


def test_gradcheck(batch):
    _, images, logits = scene(*batch)
    module = SoftPositions(COLOURS)
    assert torch.autograd.gradcheck(lambda x: module(images, x), [logits.requires_grad_()], fast_mode=True)


def test_without_the_window_the_gradient_is_smaller():
    """The networks were trained so; otherwise what draws a window nearer counts twice."""
    _, images, logits = scene(2)
    leaf = logits.requires_grad_()
    uv = [find_soft_positions(images, COLOURS, 1.5, leaf, through_window=through)[0] for through in (False, True)]
    found = [torch.autograd.grad(each.square().sum(), leaf)[0] for each in uv]
    assert torch.equal(*uv)
    assert found[0].norm() < found[1].norm()


@pytest.mark.parametrize("given", [True, False], ids=["logits", "colour alone"])
def test_graphs(same_in_graphs, given):
    _, images, logits = scene(2, 3)
    same_in_graphs(SoftPositions(COLOURS), images, *([logits] if given else []))


def test_the_compiled_gradient_is_the_eager_one():
    _, images, logits = scene(2)
    module = SoftPositions(COLOURS)
    compiled = torch.compile(module, fullgraph=True, backend="aot_eager")
    leaf = logits.requires_grad_()
    found, expected = (torch.autograd.grad(f(images, leaf)[0].square().sum(), leaf)[0] for f in (compiled, module))
    assert expected.abs().max() > 0
    torch.testing.assert_close(found, expected)


def test_vmap_and_jacobians():
    _, images, logits = scene(3)
    module = SoftPositions(COLOURS)
    for one, other in zip(torch.func.vmap(module)(images, logits), module(images, logits), strict=True):
        torch.testing.assert_close(one, other)

    def uv(logits):
        return module(images[0], logits)[0]

    torch.testing.assert_close(torch.func.jacfwd(uv)(logits[0]), torch.func.jacrev(uv)(logits[0]))


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # opcheck itself asks its copies for it
def test_the_operator_is_sound():
    _, images, logits = scene(2)
    inputs = (images, COLOURS, logits.requires_grad_(), "1.5 1")
    torch.library.opcheck(torch.ops.imgcal.soft_positions.default, inputs)
