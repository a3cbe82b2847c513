"""Building blocks: transformer and convolutional encoders over the cameras of a rig, and heads."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from torch import Tensor, nn
from torch.nn import functional


class TransformerBlock(nn.Module):
    """Pre-norm transformer block: attention over the tokens, then a two-layer network on each.

    Source: Xiong et al., "On Layer Normalization in the Transformer Architecture", ICML 2020.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.attention_norm = nn.LayerNorm(width)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.attention_out = nn.Linear(width, width)
        self.mlp_norm = nn.LayerNorm(width)
        self.mlp = mlp((width, 4 * width, width))

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width)."""
        projected = self.query_key_value(self.attention_norm(tokens))
        query, key, value = projected.unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        attended = _attend(query, key, value)
        tokens = tokens + self.attention_out(attended.transpose(1, 2).flatten(-2))
        return tokens + self.mlp(self.mlp_norm(tokens))


def _attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Attention of (B, heads, T, D); as plain products on a CPU, where their gradient is several times faster."""
    if query.device.type != "cpu":
        return functional.scaled_dot_product_attention(query, key, value)
    return (query * query.shape[-1] ** -0.5 @ key.mT).softmax(-1) @ value


class ConvBlock(nn.Module):
    """Residual pair of 1D convolutions along the cameras, with a wider inner layer."""

    def __init__(self, width: int, inner: int, kernel: int = 3) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.widen = nn.Conv1d(width, inner, kernel, padding="same")
        self.mix = nn.Conv1d(inner, inner, kernel, padding="same") if inner > width else nn.Identity()
        self.narrow = nn.Conv1d(inner, width, kernel, padding="same")

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, T, width) -> (B, T, width)."""
        inside = functional.gelu(self.widen(self.norm(tokens).mT))
        return tokens + self.narrow(functional.gelu(self.mix(inside))).mT


def transformer(width: int, depth: int, heads: int) -> nn.Sequential:
    """Stack transformer blocks: (B, T, width) -> (B, T, width), normalized."""
    return nn.Sequential(*(TransformerBlock(width, heads) for _ in range(depth)), nn.LayerNorm(width))


def conv1d(width: int, depth: int) -> nn.Sequential:
    """Stack convolutional blocks: (B, T, width) -> (B, T, width), normalized."""
    return nn.Sequential(*(ConvBlock(width, width) for _ in range(depth)), nn.LayerNorm(width))


def mlp(widths: Sequence[int]) -> nn.Sequential:
    """Chain linear layers with GELU between them; `widths` from input to output."""
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.GELU()]
    return nn.Sequential(*layers[:-1])


def zero_last_layer(head: nn.Sequential) -> nn.Sequential:
    """Zero the last layer, so that an untrained head returns zero."""
    last = head[-1]
    if not isinstance(last, nn.Linear):
        raise TypeError(f"found {type(last).__name__} at the end of a head, expected a linear layer")
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return head
