"""Encoders over the cameras of a rig: their symmetries, and that nothing but a zeroed head is silent."""

import pytest
import torch
from torch import nn

from imgcal.networks.layers import ConvBlock, TransformerBlock, conv1d, mlp, transformer, zero_last_layer

WIDTH = 16


@pytest.fixture(autouse=True)
def seeded():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


def tokens(batch: int = 2, count: int = 5) -> torch.Tensor:
    return torch.randn(batch, count, WIDTH, generator=torch.Generator().manual_seed(1))


def test_attention_does_not_care_about_the_order_of_cameras() -> None:
    encoder, given = transformer(WIDTH, 2, 4).eval(), tokens()
    order = torch.tensor([3, 0, 4, 1, 2])
    torch.testing.assert_close(encoder(given[:, order]), encoder(given)[:, order], rtol=1e-4, atol=1e-5)


def test_attention_is_that_of_torch() -> None:
    block, given = TransformerBlock(WIDTH, 4), tokens()
    reference = nn.MultiheadAttention(WIDTH, 4, batch_first=True)
    with torch.no_grad():
        reference.in_proj_weight.copy_(block.query_key_value.weight)
        reference.in_proj_bias.copy_(block.query_key_value.bias)
        reference.out_proj.load_state_dict(block.attention_out.state_dict())
    normed = block.attention_norm(given)
    expected = given + reference(normed, normed, normed)[0]
    expected = expected + block.mlp(block.mlp_norm(expected))
    torch.testing.assert_close(block(given), expected, rtol=1e-4, atol=1e-5)


def test_convolutions_see_neighbours_only() -> None:
    block, given = ConvBlock(WIDTH, WIDTH), tokens(1, 12)
    changed = given.clone()
    changed[0, 6] += torch.randn(WIDTH)
    apart = (block(changed) - block(given)).abs().amax(-1)[0]
    assert (apart[:4] == 0).all() and (apart[9:] == 0).all() and (apart[4:9] > 0).all()


@pytest.mark.parametrize("make", [lambda: transformer(WIDTH, 2, 4), lambda: conv1d(WIDTH, 2)])
def test_encoders_take_any_number_of_cameras_and_rigs_apart(make) -> None:
    encoder = make()
    for count in (1, 2, 7):
        given = tokens(3, count)
        found = encoder(given)
        assert found.shape == given.shape
        torch.testing.assert_close(encoder(given[1:2]), found[1:2], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(found.mean(-1), torch.zeros(3, count), rtol=0, atol=1e-5)  # normalized


def test_heads_have_the_widths_they_are_given_and_end_without_a_nonlinearity() -> None:
    head = mlp((3, 5, 7, 2))
    shapes = [(layer.in_features, layer.out_features) for layer in head if isinstance(layer, nn.Linear)]
    assert shapes == [(3, 5), (5, 7), (7, 2)]
    assert isinstance(head[-1], nn.Linear) and sum(isinstance(layer, nn.GELU) for layer in head) == 2


def test_a_zeroed_head_says_nothing_and_learns() -> None:
    head = zero_last_layer(mlp((4, 6, 3)))
    given = torch.randn(5, 4)
    assert not head(given).any()
    (head(given) - 1).square().sum().backward()
    assert head[-1].weight.grad.abs().max() > 0 and head[-1].bias.grad.abs().min() > 0
    with pytest.raises(TypeError, match="found GELU at the end of a head"):
        zero_last_layer(nn.Sequential(nn.Linear(2, 2), nn.GELU()))
