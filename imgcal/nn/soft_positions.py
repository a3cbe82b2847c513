"""`SoftPositions`: positions of fiducials in colour-coded images."""

from __future__ import annotations

from torch import Tensor, nn

from imgcal.networks import find_soft_positions


class SoftPositions(nn.Module):
    """Locate fiducials in colour-coded images: soft coordinates by colour, weighted by heatmap logits.

    Processes only pixels that are not black. Differentiable in the logits; one opaque operator in a compiled or
    exported graph.

    Args:
        colours: (N, 3) in [0, 1] of the fiducials.
        dot: standard deviation of a dot, pixels.

    Shape:
        - images: (*B, 3, H, W) in [0, 1], coloured splats on black.
        - logits: (*B, N, h, w) on a coarser grid, weights for pixels of a fiducial's colour; None = none.
        - Output: uv (*B, N, 2) pixels of the image, and confidence (*B, N) in [0, 1]: the share of a full dot's light
          that was found in one place; zero without a detection, with finite positions.

    Source: soft-argmax, as in `kornia.geometry.subpix.spatial_expectation2d`, on the pixels of one hue.

    Example:
        >>> import torch
        >>> from imgcal.nn import SoftPositions, SplatRenderer
        >>> colours, uv = torch.eye(3), torch.tensor([[10.0, 10.5], [30.5, 20.25], [50.0, 40.0]])
        >>> images = SplatRenderer(colours, (48, 64))(uv)
        >>> found, confidence = SoftPositions(colours)(images)
        >>> bool((found - uv).abs().max() < 0.02)
        True
    """

    colours: Tensor

    def __init__(self, colours: Tensor, dot: float = 1.5) -> None:
        super().__init__()
        self.dot = dot
        self.register_buffer("colours", colours.clone(), persistent=False)

    def forward(self, images: Tensor, logits: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Locate the N fiducials in (*B) images; arguments as under Shape."""
        batch = images.shape[:-3]
        given = None if logits is None else logits.reshape(-1, *logits.shape[-3:])
        uv, confidence = find_soft_positions(
            images.reshape(-1, *images.shape[-3:]), self.colours.to(images), self.dot, given, through_window=True
        )
        return uv.reshape(*batch, *uv.shape[1:]), confidence.reshape(*batch, *confidence.shape[1:])

    def extra_repr(self) -> str:
        """Describe the settings."""
        return f"fiducials={len(self.colours)}, dot={self.dot}"
