"""`SplatRenderer`: fiducials as coloured dots."""

from __future__ import annotations

from typing import Literal

from torch import Tensor, nn

from imgcal.geometry import Projection
from renderers import splat


class SplatRenderer(nn.Module):
    """Draw fiducials as Gaussian splats: anti-aliased, sub-pixel exact, differentiable in positions and intensities.

    A pixel is the integral of its splats over its area. On CPUs "add" is a compiled operator that only visits pixels
    that a splat reaches. The module wraps `renderers.splat`.

    Args:
        colours: (N, K) in [0, 1], such as `CalibrationObject.colours`.
        image_size: height and width of the images, pixels.
        size: standard deviation of a splat, pixels.
        compositing: "add" sums the light of splats in any order, "over" lets nearer ones occlude those behind.

    Shape:
        - uv: (*B, N, 2) pixels of the image, or a `Projection` of them with visibility and depth.
        - visible: (*B, N) bool; None = that of the projection, or all.
        - depth: (*B, N), for "over"; None = that of the projection, or increasing with the fiducial's index.
        - intensity: broadcastable to (*B, N); None = 1.
        - Output: (*B, K, H, W) images on black, in the dtype of uv.

    Source: Gaussians integrated over pixels as in single-molecule microscopy (Smith et al., Nature Methods 2010).

    Example:
        >>> import torch
        >>> from imgcal.nn import SplatRenderer
        >>> renderer = SplatRenderer(torch.eye(3), image_size=(48, 64))
        >>> uv = torch.tensor([[10.0, 10.0], [30.5, 20.25], [50.0, 40.0]], requires_grad=True)
        >>> images = renderer(uv.expand(2, -1, -1))
        >>> images.shape
        torch.Size([2, 3, 48, 64])
        >>> images.square().sum().backward()
        >>> uv.grad.shape
        torch.Size([3, 2])
    """

    colours: Tensor

    def __init__(
        self,
        colours: Tensor,
        image_size: tuple[int, int],
        size: float = 1.5,
        compositing: Literal["add", "over"] = "add",
    ) -> None:
        super().__init__()
        if compositing not in ("add", "over"):
            raise ValueError(f"compositing must be 'add' or 'over', found {compositing!r}")
        self.image_size, self.size, self.compositing = image_size, size, compositing
        self.register_buffer("colours", colours.clone(), persistent=False)

    def forward(
        self,
        uv: Tensor | Projection,
        visible: Tensor | None = None,
        depth: Tensor | None = None,
        intensity: Tensor | None = None,
    ) -> Tensor:
        """Draw the N fiducials into images (*B, K, H, W); arguments as under Shape."""
        if isinstance(uv, Projection):
            visible = uv.visible if visible is None else visible
            depth = uv.depth if depth is None else depth
            uv = uv.uv
        return splat(
            uv,
            self.colours.to(uv),
            self.size,
            self.image_size,
            intensity=intensity,
            visible=visible,
            depth=depth if self.compositing == "over" else None,
            compositing=self.compositing,
        )

    def extra_repr(self) -> str:
        """Describe the settings."""
        return f"image_size={self.image_size}, size={self.size}, compositing={self.compositing!r}"
